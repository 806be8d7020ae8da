"""OBJ and USDZ, read back by trimesh and by Pixar's library."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from reli3d.io.obj import obj_files
from reli3d.io.usd import usdz_bytes
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import linear_to_srgb
from tests.support.scenes import ball_mesh

SIZE = 64


@pytest.fixture(scope="module")
def asset() -> Asset:
    row, column = torch.meshgrid(torch.linspace(0, 1, SIZE), torch.linspace(0, 1, SIZE), indexing="ij")
    color = torch.stack([row, column, torch.full_like(row, 0.2)], -1)  # different at top and bottom
    flat = torch.tensor([0.5, 0.5, 1.0]).expand(SIZE, SIZE, 3).contiguous()
    return Asset(ball_mesh(2, 1.0), TextureSet(color, row, column, flat))


def test_trimesh_reads_the_obj_back(asset, tmp_path):
    files = obj_files(asset, "ball")
    maps = {f"ball_{name}.png" for name in ("base_color", "metallic", "normal", "roughness")}
    assert files.keys() == {"ball.obj", "ball.mtl"} | maps
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    shape = trimesh.load(tmp_path / "ball.obj", process=False, force="mesh")
    corners = asset.mesh.vertices[asset.mesh.faces.long()].numpy()
    assert np.array_equal(shape.triangles.astype(np.float32), corners)  # nine digits give float32 back
    uv = np.asarray(shape.visual.uv)[shape.faces]
    expected = asset.mesh.uv[asset.mesh.faces.long()].numpy() * (1, -1) + (0, 1)
    np.testing.assert_allclose(uv, expected, atol=1e-7)  # v up, float32
    image = np.asarray(shape.visual.material.image.convert("RGB"))
    assert np.array_equal(image, np.rint(linear_to_srgb(asset.textures.base_color).numpy() * 255).astype(np.uint8))
    words = dict(line.split(" ", 1) for line in files["ball.mtl"].decode().splitlines())
    for word, map_of in (("map_Kd", "base_color"), ("map_Pr", "roughness"), ("map_Pm", "metallic"), ("norm", "normal")):
        assert words[word] in files and map_of in words[word]
    gray = np.asarray(Image.open(io.BytesIO(files["ball_roughness.png"])))
    assert np.array_equal(gray[..., 0], np.rint(asset.textures.roughness.numpy() * 255).astype(np.uint8))


def test_pixars_library_reads_the_usdz_and_finds_it_compliant(asset, tmp_path):
    pytest.importorskip("pxr.UsdValidation", reason="needs usd-core with its validators")
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    path = tmp_path / "ball.usdz"
    path.write_bytes(usdz_bytes(asset))
    first, *maps = zipfile.ZipFile(path).namelist()
    assert first.endswith(".usdc")
    assert {Path(n).name for n in maps} == {"base_color.png", "metallic_roughness.png", "normal.png"}
    stage = Usd.Stage.Open(str(path))
    judges = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(judges).Validate(stage)
    assert [e.GetMessage() for e in found] == [] and len(judges) > 10
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and stage.GetDefaultPrim().GetName() == "object"
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/object/mesh"))
    assert np.array_equal(np.array(shape.GetPointsAttr().Get()), asset.mesh.vertices.numpy())
    assert np.array_equal(np.array(shape.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), asset.mesh.faces.numpy())
    st = np.array(UsdGeom.PrimvarsAPI(shape).GetPrimvar("st").Get())
    np.testing.assert_allclose(st, asset.mesh.uv.numpy() * (1, -1) + (0, 1), atol=1e-7)
    surface = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]
    for slot, texture, channel in (
        ("diffuseColor", "base_color", "rgb"),
        ("roughness", "metallic_roughness", "g"),
        ("metallic", "metallic_roughness", "b"),
        ("normal", "normal", "rgb"),
    ):
        source, output, _ = surface.GetInput(slot).GetConnectedSource()
        assert (source.GetPrim().GetName(), output) == (texture, channel)
