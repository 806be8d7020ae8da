"""A scan without a metallic-roughness texture has placeholders: its shape and base color train, its finish does not."""

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from safetensors.torch import load_file, save_file

from reli3d.cli.data import main as data
from reli3d.nn.local import LocalReconstructor
from reli3d.nn.presets import SMALL
from reli3d.train.batches import load_sample
from reli3d.train.losses import losses, pixel_losses
from reli3d.train.pixels import Group, read_views_reduced
from reli3d.train.stages.views import Samples
from tests.support.stages import rendered_sample, write_maps

FINISH = {"roughness", "metallic"}


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """Samples of one box without material maps: as it is, and with exchanged materials."""
    root = tmp_path_factory.mktemp("scans")
    maps = write_maps(root)
    trimesh.creation.box().export(root / "box.glb")
    (root / "sets" / "one").mkdir(parents=True)
    for name in ("basecolor", "roughness", "metallic"):
        Image.new("RGB", (32, 32), (128, 128, 128)).save(root / "sets" / "one" / f"{name}.png")
    call = ["--maps", str(maps), "--meshes", str(root / "box.glb"), "--count", "1", "--views", "2"]
    call += ["--size", "32", "--workers", "1"]
    rendered_sample(root / "plain", maps, views=2, size=32, meshes=(root / "box.glb",))
    assert data(["render", str(root / "refinished"), *call, "--materials", str(root / "sets")]) == 0
    return root


def path_of(scans, name):
    return scans / name / "0000000000.safetensors"


def test_a_sample_stores_whether_its_finish_is_ground_truth(scans, folder):
    for name, known in (("plain", 0), ("refinished", 1)):
        assert load_file(path_of(scans, name))["finish_known"].tolist() == [known, known]
        assert read_views_reduced(path_of(scans, name), 1).finish_known.tolist() == [bool(known)] * 2
        views = Samples(scans / name).load(0, range)  # of the paper's stages
        assert (views.material is not None) == known and views.normal is not None
    procedural = next(folder.glob("*.safetensors"))
    assert bool(read_views_reduced(procedural, 1).finish_known.all())


def test_a_sample_of_version_0_3_does_not_store_it_and_is_known(scans, tmp_path):
    tensors = load_file(path_of(scans, "plain"))
    del tensors["finish_known"]
    save_file(tensors, tmp_path / "old.safetensors")
    assert read_views_reduced(tmp_path / "old.safetensors", 1).finish_known.tolist() == [True, True]


def test_an_unknown_finish_takes_part_in_no_loss(scans):
    torch.manual_seed(0)
    model = LocalReconstructor(SMALL)
    for head in model.pyramid.says.values():
        torch.nn.init.normal_(head[1].weight, std=0.3)
    plain, refinished = (read_views_reduced(path_of(scans, name), 1) for name in ("plain", "refinished"))
    alone = pixel_losses(model, Group.of([plain]))
    assert set(alone) == {"pixel_color", "pixel_pattern", "pixel_normal", "pixel_depth"}
    both, known = (pixel_losses(model, Group.of(parts)) for parts in ([plain, refinished], [refinished]))
    for name in FINISH:
        torch.testing.assert_close(both[f"pixel_{name}"], known[f"pixel_{name}"], rtol=1e-3, atol=1e-5)
    for name, parts in (("plain", set()), ("refinished", FINISH)):
        sample = load_sample(path_of(scans, name), 2, 256, np.random.default_rng(0), augment=False)
        found = set(losses(model, sample)) & {*FINISH, "pixel_roughness", "pixel_metallic"}
        assert found == parts | {f"pixel_{part}" for part in parts}
