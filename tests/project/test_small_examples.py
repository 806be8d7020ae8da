"""The small examples run with nothing but the package, and find what they look for."""

import runpy
import sys

import pytest
import torch

from reli3d.io.glb import read_glb
from reli3d.io.images import read_image
from tests.support.checkout import ROOT

EXAMPLES = ROOT / "examples"


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs an example with a folder and options; gives the last word of each line that it printed, as a number."""

    def example(name: str, *options: str) -> list[float]:
        monkeypatch.setattr(sys, "argv", [name, str(tmp_path), *options])
        runpy.run_path(str(EXAMPLES / f"{name}.py"))
        return [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines()]

    return example


def test_textures_are_found(run, tmp_path):
    (start,) = run("fit_texture", "--steps", "1", "--size", "48")
    (error,) = run("fit_texture", "--steps", "60", "--size", "48")
    assert error < start / 2  # of 60 steps; 150 at 96 pixels find it better
    found, true = (read_image(tmp_path / f"{name}.png")[0] for name in ("found", "true"))
    assert found.shape == true.shape == (64, 64, 3)


def test_light_is_found(run, tmp_path):
    (start,) = run("fit_light", "--steps", "1", "--size", "24")
    (error,) = run("fit_light", "--steps", "80", "--size", "24")
    assert error < start / 4
    assert (tmp_path / "found.png").is_file()


def test_surface_comes_nearer_than_the_hull(run, tmp_path):
    hull, found = run("fit_shape", "--steps", "25", "--size", "64")
    assert found < hull / 2
    (asset,) = read_glb(tmp_path / "shape.glb")
    assert len(asset.mesh.faces) > 1000


def test_object_and_light_turn(run, tmp_path):
    run("fit_shape", "--steps", "1", "--size", "32")
    run("turntable", "--glb", str(tmp_path / "shape.glb"), "--frames", "3", "--size", "32")
    frames = [read_image(tmp_path / f"{name}_{i:02d}.png") for name in ("turn", "light") for i in range(3)]
    assert all(float(alpha.max()) == 1.0 and torch.isfinite(color).all() for color, alpha in frames)
    assert not torch.equal(frames[3][0], frames[4][0])
    assert (tmp_path / "turntable.webp").stat().st_size > 500
