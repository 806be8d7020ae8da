"""GLB files judged from outside: the Khronos validator, trimesh and pygltflib, and limits.

The validator is npm's ``gltf-validator``: ``npm install gltf-validator`` in any folder outside the checkout, then set
RELI3D_GLTF_VALIDATOR to its ``node_modules``.
"""

import io
import json
import os
import shutil
import struct
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from reli3d.geometry.uv import unwrap
from reli3d.io.glb import glb_bytes, read_glb, write_glb
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from tests.support.gltf import packed, parsed
from tests.support.meshes import loaded
from tests.support.scenes import ball_mesh

SIZE = 128
STEP = 1 / 255
JUDGE = """
const fs = require('fs'), path = require('path');
const validator = require(path.join(process.argv[1], 'gltf-validator'));
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])), {format: 'glb', maxIssues: 50})
  .then(report => console.log(JSON.stringify(report.issues)));
"""


@pytest.fixture(scope="module")
def asset() -> Asset:
    """Smooth maps, different at top and bottom, left and right."""
    y, x = torch.meshgrid(torch.linspace(0, 1, SIZE), torch.linspace(0, 1, SIZE), indexing="ij")
    normal = torch.stack([0.5 + 0.1 * torch.sin(6 * x), 0.5 + 0.1 * torch.sin(6 * y), torch.full_like(x, 0.95)], -1)
    return Asset(ball_mesh(3, 1.0), TextureSet(torch.stack([x, y, x * y], -1), x, y, normal))


def judge(path) -> None:
    modules = os.environ.get("RELI3D_GLTF_VALIDATOR", "")
    if not shutil.which("node") or not os.path.isdir(os.path.join(modules, "gltf-validator")):
        pytest.skip("needs node, and RELI3D_GLTF_VALIDATOR pointing to a node_modules with gltf-validator")
    command = ["node", "-e", JUDGE, modules, str(path)]
    issues = json.loads(subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout)
    assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]


def test_khronos_validator_finds_nothing(asset, tmp_path):
    write_glb(tmp_path / "a.glb", asset, extras={"license": "CC0-1.0", "world_from_model": np.eye(4).tolist()})
    judge(tmp_path / "a.glb")


def test_webp_textures_are_smaller_exact_and_valid(asset, tmp_path):
    sizes = {}
    for kind in ("png", "webp"):
        write_glb(tmp_path / f"{kind}.glb", asset, textures=kind)
        sizes[kind] = (tmp_path / f"{kind}.glb").stat().st_size
    assert sizes["webp"] < sizes["png"]
    png, webp = (read_glb(tmp_path / f"{kind}.glb")[0].textures for kind in ("png", "webp"))
    for name in ("base_color", "roughness", "metallic", "normal"):
        assert torch.equal(getattr(png, name), getattr(webp, name))
    document = parsed((tmp_path / "webp.glb").read_bytes())[0]
    assert document["extensionsRequired"] == ["EXT_texture_webp"]
    with pytest.raises(ValueError, match="textures: expected png or webp, got jpeg"):
        glb_bytes(asset, textures="jpeg")
    judge(tmp_path / "webp.glb")


def test_khronos_validator_on_a_real_mesh(shared_data, tmp_path):
    mesh = unwrap(loaded(shared_data / "meshes" / "scifi_crate.glb"), texture_size=64).with_tangents()
    plain = torch.full((64, 64, 3), 0.5)
    write_glb(tmp_path / "a.glb", Asset(mesh, TextureSet(plain, 0.5, 0.5, plain)))
    judge(tmp_path / "a.glb")


def test_container_and_accessors_follow_the_standard(asset):
    data = glb_bytes(asset)
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data)) and len(data) % 4 == 0
    document, binary = parsed(data)
    for view in document["bufferViews"]:
        assert view["byteOffset"] % 4 == 0 and view["byteOffset"] + view["byteLength"] <= len(binary)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    assert sorted(attributes) == ["NORMAL", "POSITION", "TANGENT", "TEXCOORD_0"]
    position = document["accessors"][attributes["POSITION"]]
    assert position["min"] == asset.mesh.vertices.min(0).values.tolist()
    assert position["max"] == asset.mesh.vertices.max(0).values.tolist()
    material = document["materials"][0]
    pbr = material["pbrMetallicRoughness"]
    assert pbr["metallicFactor"] == pbr["roughnessFactor"] == 1.0
    assert material["doubleSided"] is False and document["asset"]["generator"].startswith("reli3d ")
    assert document["samplers"] == [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]
    assert "extensionsUsed" not in document and "matrix" not in document["nodes"][0]


def test_an_open_mesh_is_double_sided(asset):
    half = replace(asset, mesh=replace(asset.mesh, faces=asset.mesh.faces[:100]))
    assert parsed(glb_bytes(half))[0]["materials"][0]["doubleSided"] is True
    assert parsed(glb_bytes(half, double_sided=False))[0]["materials"][0]["doubleSided"] is False


def test_trimesh_reads_the_same_surface_and_colors(asset, tmp_path):
    write_glb(tmp_path / "a.glb", asset)
    shape = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    assert np.array_equal(shape.vertices.astype(np.float32), asset.mesh.vertices.numpy())
    assert np.array_equal(shape.faces, asset.mesh.faces.numpy())
    assert np.allclose(shape.visual.uv[:, 1], 1 - asset.mesh.uv[:, 1].numpy(), atol=1e-6)  # trimesh turns v up
    image = np.asarray(shape.visual.material.baseColorTexture.convert("RGB"))
    assert np.array_equal(image, (linear_to_srgb(asset.textures.base_color) * 255).round().byte().numpy())


@pytest.mark.parametrize("byte", [0, 37, 255])
def test_pygltflib_reads_constants_back_exactly(asset, tmp_path, byte):
    pygltflib = pytest.importorskip("pygltflib")
    flat = torch.full((8, 8, 3), byte * STEP)
    write_glb(tmp_path / "a.glb", Asset(asset.mesh, TextureSet(srgb_to_linear(flat), 0.2, 0.6, flat)))
    document = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))

    def pixels(texture):
        view = document.bufferViews[document.images[document.textures[texture.index].source].bufferView]
        blob = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
        return np.asarray(Image.open(io.BytesIO(blob)))

    material = document.materials[0]
    assert (pixels(material.pbrMetallicRoughness.baseColorTexture) == byte).all()
    assert (pixels(material.pbrMetallicRoughness.metallicRoughnessTexture) == [255, 51, 153]).all()  # G rough, B metal
    assert (pixels(material.normalTexture) == byte).all()


def test_own_reader_gives_the_asset_and_every_code_of_a_color_back(asset, tmp_path):
    write_glb(tmp_path / "a.glb", asset)
    (back,) = read_glb(tmp_path / "a.glb")
    for name in ("vertices", "faces", "uv"):
        assert torch.equal(getattr(back.mesh, name), getattr(asset.mesh, name))
    for name in ("normals", "tangents"):
        torch.testing.assert_close(getattr(back.mesh, name), getattr(asset.mesh, name), rtol=0, atol=1e-6)
    for name in ("base_color", "roughness", "metallic", "normal"):
        stored = linear_to_srgb if name == "base_color" else lambda value: value
        difference = stored(getattr(back.textures, name)) - stored(getattr(asset.textures, name))
        assert float(difference.abs().max()) <= 0.5 * STEP + 1e-4  # 8 bit
    codes = torch.arange(256).reshape(16, 16, 1).expand(-1, -1, 3)
    write_glb(tmp_path / "a.glb", Asset(asset.mesh, TextureSet(srgb_to_linear(codes / 255), 0.5, 0.0)))
    color = read_glb(tmp_path / "a.glb")[0].textures.base_color
    assert torch.equal((linear_to_srgb(color) * 255).round().long(), codes)
    assert float(color[11, 12, 0]) == pytest.approx(0.502886, abs=1e-5)  # IEC 61966-2-1 at code 188


def test_node_transforms_reach_positions_normals_and_mirrors(asset, tmp_path):
    document, binary = parsed(glb_bytes(asset))
    document["nodes"] = [
        {"children": [1], "translation": [1, 2, 3]},
        {"mesh": 0, "scale": [-2, 1, 1], "rotation": [0, 0, 0.5**0.5, 0.5**0.5]},
    ]
    (tmp_path / "a.glb").write_bytes(packed(document, binary))
    (part,) = read_glb(tmp_path / "a.glb")
    p = asset.mesh.vertices
    expected = torch.stack([1 - p[:, 1], 2 - 2 * p[:, 0], 3 + p[:, 2]], 1)  # mirrored, then a quarter turn about z
    torch.testing.assert_close(part.mesh.vertices, expected, rtol=0, atol=1e-5)
    a, b, c = (part.mesh.vertices[part.mesh.faces[:, k].long()] for k in range(3))
    outward = torch.linalg.cross(b - a, c - a)
    center = (a + b + c) / 3 - torch.tensor([1.0, 2, 3])
    assert bool(((outward * center).sum(1) > 0).all())
    assert bool((part.mesh.tangents[:, 3] == -1).all())
    face_normal = outward / outward.norm(dim=1, keepdim=True)
    assert float((part.mesh.normals[part.mesh.faces[:, 0].long()] * face_normal).sum(1).min()) > 0.9
    assert trimesh.load(tmp_path / "a.glb", force="mesh").bounds == pytest.approx(
        np.stack([part.mesh.vertices.min(0).values, part.mesh.vertices.max(0).values]), abs=1e-5
    )


def test_factors_and_missing_parts(asset, tmp_path):
    document, binary = parsed(glb_bytes(asset))
    pbr = {"baseColorFactor": [0.5, 0.25, 1.0, 1.0], "roughnessFactor": 0.5}
    document["materials"][0] = {"pbrMetallicRoughness": pbr}
    for name in ("NORMAL", "TANGENT", "TEXCOORD_0"):
        del document["meshes"][0]["primitives"][0]["attributes"][name]
    (tmp_path / "a.glb").write_bytes(packed(document, binary))
    (part,) = read_glb(tmp_path / "a.glb")
    assert part.textures.base_color[0, 0].tolist() == [0.5, 0.25, 1.0]  # factors of glTF are linear
    assert float(part.textures.roughness[0, 0]) == 0.5 and float(part.textures.metallic[0, 0]) == 1.0
    a, b, c = (part.mesh.vertices[part.mesh.faces[:, k].long()] for k in range(3))
    flat = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    torch.testing.assert_close(part.mesh.normals[part.mesh.faces[:, 0].long()], flat, rtol=0, atol=1e-5)


def test_real_files_are_read_as_trimesh_reads_them(shared_data):
    for name in ("scifi_crate", "wicker_sphere"):
        path = shared_data / "meshes" / f"{name}.glb"
        parts = read_glb(path)
        shape = trimesh.load(path, force="mesh", process=False)
        assert sum(len(p.mesh.faces) for p in parts) == len(shape.faces)
        low = torch.stack([p.mesh.vertices.min(0).values for p in parts]).min(0).values
        assert np.allclose(low, shape.bounds[0], atol=1e-5)


def test_indices_and_nan_in_the_buffer_are_refused_and_limits_kept(asset, tmp_path):
    document, binary = parsed(glb_bytes(asset))
    damage = (4, struct.pack("<I", 10**6), "indices below"), (0, struct.pack("<f", np.nan), "finite values")
    for view, value, message in damage:
        at = document["bufferViews"][view]["byteOffset"]
        (tmp_path / "a.glb").write_bytes(packed(document, binary[:at] + value + binary[at + 4 :]))
        with pytest.raises(ValueError, match=message):
            read_glb(tmp_path / "a.glb")
    write_glb(tmp_path / "a.glb", asset)
    for limit, value, message in (
        ("max_bytes", 1000, "expected at most 1000 bytes"),
        ("max_pixels", SIZE * SIZE + 1, "more pixels"),
        ("max_vertices", 100, "at most 100 vertices"),
    ):
        with pytest.raises(ValueError, match=message):
            read_glb(tmp_path / "a.glb", **{limit: value})


def test_missing_parts_of_an_asset_are_named(asset, tmp_path):
    with pytest.raises(ValueError, match=r"^asset\.textures: expected a value, got None"):
        write_glb(tmp_path / "a.glb", replace(asset, textures=None))
    for change, words in (
        ({"faces": asset.mesh.faces[:0]}, "faces: expected at least one face"),
        ({"tangents": None}, "tangents: expected a tensor, got None"),
        ({"uv": asset.mesh.uv * torch.nan}, "uv: expected finite values"),
        ({"normals": asset.mesh.normals * 2}, "normals: expected unit length"),
        ({"tangents": asset.mesh.tangents * torch.tensor([1, 1, 1, 0.5])}, "tangents: expected w"),
    ):
        with pytest.raises(ValueError, match=f"asset.mesh.{words}"):
            write_glb(tmp_path / "a.glb", replace(asset, mesh=replace(asset.mesh, **change)))
    bad = replace(asset.textures, base_color=asset.textures.base_color + 1)
    with pytest.raises(ValueError, match="asset.textures.base_color: expected values in"):
        write_glb(tmp_path / "a.glb", replace(asset, textures=bad))
    assert os.listdir(tmp_path) == []  # nothing half-written stays behind
