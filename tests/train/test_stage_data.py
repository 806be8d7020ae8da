"""Sources of objects: real captures, shards and latents of lights."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from reli3d.cli.data import main as data
from reli3d.errors import InputError
from reli3d.geometry.camera import look_at, project
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import TINY
from reli3d.render.latlong import lat_long_directions
from reli3d.train.stages.captures import Captures
from reli3d.train.stages.latents import fitted
from reli3d.train.stages.shards import Shards, pack, source
from reli3d.train.stages.views import Samples
from tests.support.stages import write_samples


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return write_samples(tmp_path_factory.mktemp("packed"), seeds=(1, 2, 3), views=3)


def write_capture(folder: Path, scores: dict | None, radius: float = 3.0, target: float = 0.45) -> None:
    """Three photographs of a disc of radius 0.6 about the origin, off the center of frames of 60 by 40 pixels."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for k, eye in enumerate(([0.3, 0.2, 3.0], [2.5, 0.5, 1.5], [-2.0, 1.0, 2.0])):
        eye = radius * np.array(eye) / np.linalg.norm(eye)
        c2w = look_at(torch.tensor(eye, dtype=torch.float32), [target, 0.0, 0.0])
        camera = torch.tensor([50.0, 50.0, 30.0, 20.0])
        middle, depth = project(torch.zeros(1, 3), c2w, camera)
        y, x = np.mgrid[:40, :60] + 0.5
        inside = np.hypot(x - float(middle[0, 0]), y - float(middle[0, 1])) < 50.0 * 0.6 / float(depth)
        rng = np.random.default_rng(k)
        rgba = np.concatenate([rng.integers(0, 255, (40, 60, 3)), 255 * inside[..., None]], -1).astype(np.uint8)
        Image.fromarray(rgba).save(folder / "images" / f"{k}.png")
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": c2w.tolist()})
    text = {"fl_x": 50.0, "fl_y": 50.0, "cx": 30.0, "cy": 20.0, "w": 60, "h": 40, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(text))
    if scores is not None:
        (folder / "metadata.json").write_text(json.dumps(scores))


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    names = ("camera_quality_score", "gaussian_splats_quality_score")
    write_capture(folder / "good", dict(zip(names, (1.0, 1.7), strict=True)))
    write_capture(folder / "blurred", dict(zip(names, (2.0, 0.99), strict=True)))
    write_capture(folder / "broken", {"camera_quality_score": 2.0})
    write_capture(folder / "own", None, radius=6.0)
    write_capture(folder / "side", None, target=1.15)
    return folder


def test_captures_are_filtered_by_both_scores(captures):
    found = Captures(captures, 32)
    assert [f.name for f in found.folders] == ["good", "own", "side"]
    assert "gaussian_splats_quality_score 0.99" in found.rejected["blurred"] and "broken" in found.rejected["broken"]


def test_a_capture_is_cropped_centered_and_scaled(captures):
    found = Captures(captures, 32)
    for index in range(2):  # the second is as the first, seen from twice as far: the same size after scaling
        views = found.load(index, range)
        assert views.material is None and views.normal is None and views.latent is None and views.background
        for v in range(3):
            rows, columns = (views.masks[v] > 0.5).nonzero().unbind(1)
            assert abs(float(rows.float().mean()) + 0.5 - 16) < 1.5 and abs(float(columns.float().mean()) - 15.5) < 1.5
            center, depth = project(torch.zeros(1, 3), views.c2w[v], views.intrinsics[v])
            assert float((center - 16).abs().max()) < 2.5  # the hull of three views encloses the object
            width = float((views.masks[v] > 0.5).any(0).sum()) / float(views.intrinsics[v, 0]) * float(depth)
            assert 0.7 < width < 1.1  # longest side of the hull 1, the ball in it a little less


def test_pixels_outside_a_photograph_are_not_valid(captures):
    views = Captures(captures, 32).load(2, range)
    y, x = torch.meshgrid(torch.arange(32) + 0.5, torch.arange(32) + 0.5, indexing="ij")
    for v in range(3):
        fx, fy, cx, cy = views.intrinsics[v]
        column, row = 50 * (x - cx) / fx + 30, 50 * (y - cy) / fy + 20  # of the photograph
        inside = torch.minimum(torch.minimum(column, 60 - column), torch.minimum(row, 40 - row))
        certain = inside.abs() > 1.0  # resampling blends a pixel across the border
        assert bool((inside < -1).any()) or v > 0
        assert torch.equal((views.valid[v] > 0.5)[certain], (inside > 0)[certain])
        assert float(views.masks[v][inside < -1].sum()) == 0.0


def test_shards_contain_the_samples_and_any_reader_reads_them(samples, tmp_path):
    import webdataset

    assert data(["pack", str(samples), str(tmp_path), "--each", "2"]) == 0
    packed, plain = Shards(tmp_path), Samples(samples)
    assert isinstance(source(tmp_path), Shards) and len(packed) == 3
    for k in range(3):
        a, b = packed.load(k, lambda total: [2, 0]), plain.load(k, lambda total: [2, 0])
        for name in ("images", "masks", "c2w", "intrinsics", "material", "normal", "shown"):
            assert torch.equal(getattr(a, name), getattr(b, name)), name
    urls = [str(path) for path in sorted(tmp_path.glob("*.tar"))]
    streamed = [entry["__key__"] for entry in webdataset.WebDataset(urls, shardshuffle=False)]
    assert streamed == [p.stem for p in plain.files] and len(urls) == 2


def test_packing_continues_where_it_stopped(samples, tmp_path):
    pack(Samples(samples), tmp_path, each=1)
    (tmp_path / "000001.tar").unlink()
    times = {p: p.stat().st_mtime_ns for p in tmp_path.glob("*.tar")}
    pack(Samples(samples), tmp_path, each=1)
    assert {p: p.stat().st_mtime_ns for p in times} == times and len(Shards(tmp_path)) == 3


def test_a_broken_shard_is_refused_by_name(samples, tmp_path):
    pack(Samples(samples), tmp_path, each=2)
    content = (tmp_path / "000000.tar").read_bytes()
    (tmp_path / "000000.tar").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="000000.tar: expected a tar file, got a broken one"):
        Shards(tmp_path)
    for path in tmp_path.glob("*.tar"):
        path.unlink()
    with pytest.raises(InputError, match="pack again"):
        Shards(tmp_path)


def test_captures_are_packed_as_they_are_loaded(captures, tmp_path, capsys):
    assert data(["pack", str(captures), str(tmp_path)]) == 0
    assert "blurred: left out" in capsys.readouterr().err
    views, loaded = Shards(tmp_path).load(0, range), Captures(captures).load(0, range)
    assert views.material is None and views.background
    assert torch.equal(views.valid, loaded.valid) and float((views.images - loaded.images).abs().max()) < 0.002  # 8 bit


def test_latents_decode_to_the_light_and_are_kept(samples, tmp_path):
    torch.manual_seed(0)
    model = Reconstructor(TINY)
    files = Samples(samples).files
    found = fitted(model.environment, files[:1], tmp_path / "cache", steps=60)
    again = fitted(model.environment, files, tmp_path / "cache", steps=60)
    assert torch.equal(found[files[0].stem][0], again[files[0].stem][0]) and len(again) == 3
    latent, strength = found[files[0].stem]
    with torch.no_grad():
        radiance = model.environment(latent[None], torch.eye(3)[None], strength[None], 16)[0]
    bright = radiance.mean(-1)[lat_long_directions(16)[..., 0].abs() > 0.8]
    assert float(bright.max()) > 1.3 * float(bright.min())  # by a decoder that nothing was taught
    other = fitted(model.environment, files[:1], tmp_path / "cache", steps=40)
    assert not torch.equal(other[files[0].stem][0], latent)  # another number of steps is another fit
    tensors = load_file(files[0])
    tensors["environment"] = tensors["environment"].flip(1).contiguous()
    save_file(tensors, tmp_path / files[0].name)
    rendered = fitted(model.environment, [tmp_path / files[0].name], tmp_path / "cache", steps=60)
    assert not torch.equal(rendered[files[0].stem][0], latent)  # another light under the same name
