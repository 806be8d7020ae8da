"""The scripts that pack the training data and train the small network from nothing."""

import os
import subprocess
import sys
import tarfile

import numpy as np
import pytest
from PIL import Image

import reli3d
from reli3d.io.glb import read_glb
from tests.support.checkout import ROOT
from tests.support.scenes import ball
from tests.support.stages import write_maps


@pytest.fixture
def packed(tmp_path):
    """The archive of one ball, as a mesh and as a shape, of one material set and of six maps."""
    meshes, steel = tmp_path / "meshes", tmp_path / "materials" / "steel"
    meshes.mkdir()
    steel.mkdir(parents=True)
    Image.new("RGB", (512, 512), (188, 188, 188)).save(steel / "basecolor.jpg")
    Image.fromarray(np.full((512, 512), 13137, np.uint16)).save(steel / "roughness.png")
    Image.new("L", (512, 512), 255).save(steel / "metallic.jpg")
    reli3d.write_glb(meshes / "ball.glb", ball("cpu"))
    maps = write_maps(tmp_path, np.ones((6, 16, 32, 3), np.float32))
    command = [sys.executable, ROOT / "tools" / "pack_training_data.py", tmp_path / "data.tar.xz", "--maps", maps]
    command += ["--meshes", meshes, "--shapes", meshes, "--materials", steel.parent]
    subprocess.run(command, check=True, timeout=120)
    return tmp_path / "data.tar.xz"


def test_packed_meshes_have_the_shape_and_materials_of_the_files(packed, tmp_path):
    with tarfile.open(packed) as archive:
        archive.extractall(tmp_path / "data", filter="data")
    (before,) = read_glb(tmp_path / "meshes" / "ball.glb")
    (after,) = read_glb(tmp_path / "data" / "meshes" / "0000_ball.glb")
    size = float((before.mesh.vertices.amax(0) - before.mesh.vertices.amin(0)).max())
    rounding = size / 16384  # half a step
    np.testing.assert_allclose(after.mesh.vertices, before.mesh.vertices, rtol=0, atol=rounding)
    np.testing.assert_array_equal(after.mesh.faces, before.mesh.faces)
    for name in ("base_color", "roughness", "metallic"):  # means: JPEG changes texels by a few of 255 levels
        a, b = (float(getattr(asset.textures, name).mean()) for asset in (after, before))
        assert abs(a - b) < 2 / 255, name
    roughness = np.asarray(Image.open(tmp_path / "data" / "materials" / "steel" / "roughness.jpg"))
    np.testing.assert_array_equal(roughness, np.full((256, 256, 3), 51))  # 13137 of 65535
    shape = tmp_path / "data" / "shapes" / "0000_ball.glb"
    assert shape.read_bytes() == (tmp_path / "meshes" / "ball.glb").read_bytes()


@pytest.mark.slow
def test_every_stage_runs_and_the_weights_are_read(packed, tmp_path):
    command = [ROOT / "tools" / "train_small.sh", packed, tmp_path / "out"]
    subprocess.run(command, env={**os.environ, "DRY_RUN": "1", "PROCESSES": "2"}, check=True, timeout=600)
    views = reli3d.load_views(ROOT / "reli3d" / "assets" / "example", views=2)
    options = reli3d.ReconstructOptions(texture_size=256)
    asset = reli3d.reconstruct(views, weights=str(tmp_path / "out" / "dry_run" / "small.safetensors"), options=options)
    assert len(asset.mesh.faces) > 100
