"""The paper's figures against closed forms, and its tables on a ball."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.cli import tables
from reli3d.eval import objects
from reli3d.eval.metrics import geometry, psnr, ssim, surface_samples
from reli3d.io.glb import write_glb
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions
from tests.support import small_scene
from tests.support.meshes import mesh_of
from tests.support.stages import write_maps


def sphere(radius, count=20_000, seed=0):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def test_chamfer_and_f_score_of_two_spheres():
    """Spheres of radius 1 and 1.15: every point is 0.15 from the other, in a frame whose half side is 1."""
    found = geometry(sphere(1.15), sphere(1.0, seed=1))
    # the nearest of 20,000 points differs from the foot: sqrt(4 pi / 20000) / 2, far less than 0.15 in quadrature
    assert found["cd"] == pytest.approx(0.15, rel=0.01)
    assert found["fs@0.1"] == 0.0 and found["fs@0.2"] == 1.0 and found["fs@0.5"] == 1.0
    scaled = geometry(7.0 * sphere(1.15), 7.0 * sphere(1.0, seed=1))
    assert scaled["cd"] == pytest.approx(found["cd"], rel=1e-9)


def test_surface_samples_lie_on_the_surface_evenly():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    mesh = mesh_of(np.concatenate([corners, corners / 3 + (2, 0, 1)]), np.arange(6).reshape(2, 3))  # areas 9 to 1
    points = surface_samples(mesh, 4000)
    large = points[:, 2] < 0.5
    assert abs(large.mean() - 0.9) < 0.02  # four standard deviations, as below
    assert np.abs(points[large].mean(0) - (1 / 3, 1 / 3, 0)).max() < 0.016 and (points[large] >= 0).all()
    assert abs((points[large, :2] ** 2).mean() - 1 / 6) < 0.012


def test_psnr_and_ssim_of_known_images():
    image = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0)) * 0.5
    assert psnr(image + 0.1, image) == pytest.approx(20.0, abs=1e-4) and psnr(image, image) == 100.0
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-12)
    even = torch.full((20, 20, 3), 0.4)  # no variance: the luminance term alone
    luminance = (2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4)
    assert ssim(even, even + 0.2) == pytest.approx(luminance, rel=1e-5)
    assert ssim(image, image.flip(0)) < 0.2
    with pytest.raises(ValueError, match="11 pixels"):
        ssim(even[:5], even[:5])


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    write_glb(folder / "ball.glb", replace(small_scene.ball(), environment=None))
    sky = (0.3 + lat_long_directions(64).clamp(min=0)).numpy()[None].repeat(12, 0)
    write_maps(folder, sky * (1 + np.arange(12)[:, None, None, None] / 12))
    return folder


def test_the_reference_reconstructed_perfectly_has_perfect_figures(place, monkeypatch):
    """The pipeline replaced by one that gives the object itself, under its lighting at the photographs' exposure."""
    light = Environment(torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(0)) + 0.2)
    ground_truth = objects.load_reference(place / "ball.glb", light, light, inputs=2, size=32, seed=0)
    exposure = objects.exposure_of(ground_truth, light)
    given = []

    def perfect(views, *, weights, options):
        given.append(views)
        return replace(ground_truth.parts[0], environment=Environment(light.radiance * exposure))

    monkeypatch.setattr(objects, "reconstruct", perfect)
    found, images = objects.evaluate(None, ground_truth, 2)
    assert len(given[0]) == 2 and len(images) == 7
    for name in objects.MAPS:
        assert found[f"{name}_psnr"] == 100.0
    assert found["image_psnr"] > 60 and found["relit_psnr"] == 100.0  # the light's product rounds
    assert found["cd"] < 0.02 and found["fs@0.1"] == 1.0  # two draws of 30,000 points
    assert found["empty"] == 0.0


def test_the_command_writes_table_rows_and_images(place, monkeypatch, capsys):
    monkeypatch.setattr("reli3d.nn.weights.load_model", lambda name: None)

    def nothing(views, *, weights, options):
        raise objects.NoSurface("sdf", "expected a surface, got none")

    monkeypatch.setattr(objects, "reconstruct", nothing)
    out = place / "out"
    args = [str(place / "ball.glb"), "--maps", str(place / "maps.npz"), "--views", "1", "2", "--size", "24"]
    assert tables.main([*args, "--output", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("| views | objects | cd | fs@0.1") and len(lines) == 4
    assert lines[2].split("|")[3].strip() == "-"  # no geometry where there is no surface
    assert len((out / "objects.csv").read_text().splitlines()) == 3
    assert Image.open(out / "sheet.png").size == (24 * 7, 24)
