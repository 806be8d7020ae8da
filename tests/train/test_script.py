"""The script that trains the small network from nothing."""

import os
import subprocess

import numpy as np
import pytest
from PIL import Image

import reli3d
from tests.support.checkout import ROOT
from tests.support.scenes import ball
from tests.support.stages import write_maps


@pytest.mark.slow
def test_every_stage_runs_and_the_weights_are_read(tmp_path):
    meshes, steel = tmp_path / "meshes", tmp_path / "materials" / "steel"
    meshes.mkdir()
    steel.mkdir(parents=True)
    for name, mode, value in (("basecolor", "RGB", (188, 188, 188)), ("roughness", "L", 51), ("metallic", "L", 255)):
        Image.new(mode, (64, 64), value).save(steel / f"{name}.png")
    reli3d.write_glb(meshes / "ball.glb", ball("cpu"))
    maps = write_maps(tmp_path, np.ones((6, 16, 32, 3), np.float32))
    command = [ROOT / "tools" / "train_small.sh", maps, meshes, steel.parent, tmp_path / "out"]
    subprocess.run(command, env={**os.environ, "DRY_RUN": "1", "PROCESSES": "2"}, check=True, timeout=600)
    views = reli3d.load_views(ROOT / "reli3d" / "assets" / "example", views=2)
    options = reli3d.ReconstructOptions(texture_size=256)
    asset = reli3d.reconstruct(views, weights=str(tmp_path / "out" / "small.safetensors"), options=options)
    assert len(asset.mesh.faces) > 100
