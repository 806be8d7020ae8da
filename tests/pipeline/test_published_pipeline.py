"""The way of the published model from views to files, at sizes that run in seconds."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from reli3d import pipeline
from reli3d.cli import infer
from reli3d.geometry.mesh import report
from reli3d.geometry.surface import CubeWeights, extract_surface, surface_cubes
from reli3d.nn import field
from reli3d.nn.heads import deformation
from reli3d.nn.model import Code, Reconstructor
from reli3d.nn.published import our_key
from reli3d.nn.weights import load_model, save
from reli3d.output import results
from reli3d.pipeline import NoSurface, ReconstructOptions, place, prepare, reconstruct
from reli3d.views.folder import load_views
from reli3d.views.published_views import published_views
from reli3d.views.similarity import Similarity
from tests.support.networks import NANO, TINY, golden_tiny, views

EXAMPLE = load_views(infer.EXAMPLE, views=2)


@pytest.fixture(scope="module")
def tiny(goldens):
    """The network of the golden ``tiny_system``: its field crosses the threshold all over the cube."""
    return golden_tiny(goldens)[0]


@torch.no_grad()
def test_weights_evaluated_near_the_surface_give_the_published_mesh(goldens):
    data = np.load(goldens / "object_representation_mesh16.npz")
    heads = np.load(goldens / "object_representation_heads.npz")
    state = {our_key("object_representation." + k[6:]): torch.from_numpy(heads[k]) for k in heads if k[:6] == "param."}
    model = Reconstructor(TINY).eval()
    missing, unknown = model.load_state_dict(state, strict=False)
    assert not unknown and not [k for k in missing if k.startswith(("heads.", "merger."))]
    none = torch.zeros(1)
    code = Code(torch.from_numpy(data["triplane"]), none, none, none, none)
    axis = torch.linspace(-0.87, 0.87, 17)
    flat = torch.cartesian_prod(axis, axis, axis)
    sdf = model.sdf(model.query(code, flat[None], ("density",))["density"])[0, :, 0].view(17, 17, 17)
    weights = field.TriplaneField(None, model, code).cube_weights(flat, sdf)
    got = extract_surface(sdf, radius=0.87, closed=False, weights=weights)
    assert np.array_equal(got.faces.numpy(), data["faces"])
    # density is exp of a sum of 64 products: 1e-5 relative, over gradients of about 1 a cell of 0.1
    np.testing.assert_allclose(got.vertices.numpy(), data["v_pos"], rtol=0, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("half_space", [False, True])
def test_weights_near_the_surface_are_those_of_the_whole_grid(tiny, half_space):
    """Also where the cap touches the box, away from every cube that the surface crosses inside."""
    code, n = tiny.encode(*views(1, 2, 76)), 12
    axis = torch.linspace(-0.87, 0.87, n + 1)
    flat = torch.cartesian_prod(axis, axis, axis)
    raw = tiny.query(code, flat[None], ("density", "deformation", "flexicubes"))
    sdf = tiny.sdf(raw["density"])[0, :, 0].view(13, 13, 13)
    if half_space:
        sdf = (flat[:, 1] - 0.05).view(13, 13, 13)
    corner = raw["flexicubes"][0].view(13, 13, 13, 16)
    eight = [corner[i : i + n, j : j + n, k : k + n] for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    dense = tiny.merger(torch.stack(eight, -2).view(n**3, 8, 16))
    shift = deformation(raw["deformation"][0], n).view(13, 13, 13, 3)
    expected = extract_surface(sdf, radius=0.87, weights=CubeWeights(shift, dense.alpha, dense.beta, dense.gamma))
    weights = field.TriplaneField(None, tiny, code).cube_weights(flat, sdf)
    assert len(weights.alpha) == len(surface_cubes(sdf))
    got = extract_surface(sdf, radius=0.87, weights=weights)
    assert torch.equal(got.faces, expected.faces)
    # products of other shapes sum in another order: a few units in the last place of 0.87
    torch.testing.assert_close(got.vertices, expected.vertices, rtol=0, atol=2e-6)


@torch.no_grad()
def test_grid_sdf_equals_queries_at_the_grid_points(tiny):
    """Also with the box of one axis away from the middle."""
    code, maps = tiny.encode(*views(1, 2, 76)), SimpleNamespace(c2w=torch.zeros(2, 4, 4))
    axis = torch.linspace(-0.8, 0.6, 61)  # points of more than one tile of the kernel
    queried = tiny.query(code, torch.cartesian_prod(axis, axis, axis)[None], ("density",))["density"]
    expected = tiny.sdf(queried).view(61, 61, 61)
    assert float(expected.min()) < 0 < float(expected.max())
    # sums of 24 float32 products in another order, behind exp
    torch.testing.assert_close(field.TriplaneField(maps, tiny, code).grid_sdf(axis), expected, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_the_release_s_preparation_is_a_switch_of_the_preset(tiny):
    prepared = prepare(tiny, EXAMPLE, Similarity.identity())
    expected = published_views(EXAMPLE, 76)
    assert torch.equal(prepared.batch.images, expected.images) and torch.equal(prepared.batch.masks, expected.masks)
    assert torch.equal(prepared.batch.c2w, EXAMPLE.c2w)
    torch.testing.assert_close(prepared.batch.intrinsics, expected.intrinsics)
    own = prepare(Reconstructor(NANO), EXAMPLE, Similarity.identity()).batch
    cropped = EXAMPLE.resampled(NANO.image_size, crop=True)
    assert torch.equal(own.images, cropped.images) and torch.equal(own.intrinsics, cropped.intrinsics)
    double = {"dtype": torch.float64}
    away = EXAMPLE.transformed(Similarity(1.0, torch.eye(3, **double), torch.tensor([3.0, 0.0, 0.0], **double)))
    assert place(away, TINY).model_from_input.is_identity()
    assert float(place(away, NANO).model_from_input.translation.norm()) > 2.0


def test_reference_view_and_background_reach_the_network(tiny, monkeypatch):
    seen = {}

    def encode(images, masks, c2w, intrinsics, *, background_visible):
        seen.update(c2w=c2w, background=background_visible)
        raise InterruptedError

    monkeypatch.setattr(tiny, "encode", encode)

    def run(**options):
        with pytest.raises(InterruptedError):
            reconstruct(EXAMPLE, weights=tiny, options=ReconstructOptions(256, **options))
        return seen["background"].tolist(), seen["c2w"][0]

    background, c2w = run()
    assert background == [False] and torch.equal(c2w, EXAMPLE.c2w)  # poses as stored
    background, c2w = run(hero=1, background="visible")
    assert background == [True] and torch.equal(c2w, EXAMPLE.c2w[[1, 0]])
    moved = run(normalization="hull")[1]
    assert (moved - EXAMPLE.c2w).abs().max() > 1e-3
    with pytest.raises(ValueError, match="hero: expected"):
        reconstruct(EXAMPLE, weights=tiny, options=ReconstructOptions(hero=2))
    with pytest.raises(ValueError, match="background: expected"):
        reconstruct(EXAMPLE, weights=tiny, options=ReconstructOptions(background="gray"))


@pytest.fixture(scope="module")
def asset(tiny):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline.ViewMaps, "visibility", None)  # visibility is not evaluated
        patch.setattr(pipeline, "RayScene", None)
        return reconstruct(EXAMPLE, weights=tiny, options=ReconstructOptions(256, 16))


def test_views_become_an_asset_without_looking_at_them_again(asset):
    found = report(asset.mesh)
    assert found.watertight and found.manifold
    roughness = asset.textures.roughness
    assert 0.1**0.5 - 1e-6 <= float(roughness.min()) <= float(roughness.max()) <= 1.0  # the head's range is [0.1, 1]
    assert bool(asset.environment.radiance.isfinite().all()) and asset.environment.radiance.shape == (64, 128, 3)


@pytest.mark.parametrize("bias", [-50.0, 50.0])
def test_a_field_of_one_sign_is_an_error_and_not_a_box(tiny, bias):
    empty = Reconstructor(TINY).eval()
    empty.load_state_dict(tiny.state_dict())
    with torch.no_grad():
        empty.heads["density"][-1].bias.fill_(bias)
    with pytest.raises(NoSurface, match=r"^sdf: expected values on both sides of 0, got \[.*\]: no surface$"):
        reconstruct(EXAMPLE, weights=empty, options=ReconstructOptions(256, 16))


def test_exported_roughness_is_the_root_of_the_published_number(tiny, asset):
    same = Reconstructor(replace(TINY, roughness_is_alpha=False)).eval()
    same.load_state_dict(tiny.state_dict())
    release = reconstruct(EXAMPLE, weights=same, options=ReconstructOptions(256, 16))
    ours, theirs = asset.textures.roughness, release.textures.roughness
    # the same width alpha in a viewer that squares, after baking means roots of texels beyond the charts as well
    torch.testing.assert_close(ours.square(), theirs, rtol=0, atol=1e-5)
    assert float((ours - theirs).max()) > 0.05  # shown as it is, the release's number is too glossy


def test_the_command_takes_published_weights_and_reports_how_it_used_them(tiny, tmp_path, capsys):
    weights = tmp_path / "tiny.safetensors"
    save(weights, tiny, license="of the test", dtype=torch.float32)
    places = [str(infer.EXAMPLE), "--weights", str(weights), "--output", str(tmp_path / "out")]
    arguments = places + ["--device", "cpu", "--views", "2", "--texture-size", "256", "--resolution", "16"]
    assert infer.main([*arguments, "--hero", "1", "--background", "visible", "--precision", "bfloat16"]) == 0
    folder = tmp_path / "out" / "example"
    assert sorted(p.name for p in folder.iterdir()) == sorted(results.FILES)
    info = json.loads((folder / "run_info.json").read_text())
    assert info["environment_centre"] == "+X" and f"reference view: {info['views'][0]}" in info["notes"]
    assert info["views"] == list(EXAMPLE.names[::-1]) and info["background"] == "visible"
    assert info["precision"] == "bfloat16" and load_model(weights).dtype == torch.float32
    assert info["model_from_input"] == torch.eye(4).tolist()  # poses as stored
    capsys.readouterr()
    assert infer.main([*arguments, "--skip-existing"]) == 0
    assert "skipped" in capsys.readouterr().err
    assert infer.main([*arguments, "--hero=2"]) == 2
    assert "expected 0 to 1 with 2 views" in capsys.readouterr().err
