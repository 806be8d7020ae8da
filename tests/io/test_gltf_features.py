"""glTF 2.0 and its extensions, on quads with ground truth by construction."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.errors import InputError
from reli3d.io.glb import read_glb, write_glb
from reli3d.io.gltf import LEFT_OUT
from reli3d.io.obj import obj_files
from reli3d.io.usd import usdz_bytes
from reli3d.render.asset import Asset
from reli3d.render.color import srgb_to_linear
from reli3d.render.gbuffer import surface_points
from tests.support.gltf import Builder

CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # upright: v is down
FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)


class Quad(Builder):
    """A GLB of one quad; ``document`` may be changed before :meth:`read`."""

    def __init__(self, **material):
        super().__init__()
        self.attributes = {"POSITION": self.accessor(CORNERS), "NORMAL": self.accessor(np.float32([[0, 0, 1]] * 4))}
        self.primitive = {"attributes": self.attributes, "indices": self.accessor(FACES)}
        self.document["meshes"] = [{"primitives": [self.primitive]}]
        if material:
            self.attributes["TEXCOORD_0"] = self.accessor(UV)
            self.primitive["material"] = 0
            self.document["materials"] = [material]

    def material(self) -> dict:
        return self.document["materials"][0]

    def read(self, folder) -> tuple[Asset, list[str]]:
        notes: list[str] = []
        (folder / "a.glb").write_bytes(self.data())
        (asset,) = read_glb(folder / "a.glb", notes=notes)
        assert all(note.startswith("a.glb: ") for note in notes)
        return asset, [note[7:] for note in notes]


def at(asset: Asset, *places: tuple[float, float]):
    """Material at points ``(x, y)`` of the quad's square [-1, 1]."""
    x, y = torch.tensor(places).T
    low = y < x  # the face with the corner (1, -1)
    face = torch.where(low, 0, 1).int()
    first = torch.where(low, (x - y) / 2, (x + 1) / 2)
    second = torch.where(low, (y + 1) / 2, (y - x) / 2)
    return surface_points(asset.mesh, asset.textures, face, torch.stack([first, second], -1))


def noise(*shape: int, dtype=np.uint8, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max + 1, shape, dtype)


def linear(pixels: np.ndarray) -> torch.Tensor:
    return srgb_to_linear(torch.from_numpy(pixels / np.float32(np.iinfo(pixels.dtype).max)).float())


def near(got: torch.Tensor, expected, atol: float = 1e-5) -> None:
    torch.testing.assert_close(got, torch.as_tensor(expected).to(got), rtol=0, atol=atol)


def test_16_bit_gray_textures(tmp_path):
    quad, gray = Quad(pbrMetallicRoughness={}), noise(4, 4, dtype=np.uint16)
    quad.material()["pbrMetallicRoughness"]["metallicRoughnessTexture"] = quad.texture(gray)
    asset, notes = quad.read(tmp_path)
    near(asset.textures.roughness, gray / np.float32(65535), 1e-6)
    near(asset.textures.metallic, gray / np.float32(65535), 1e-6)
    assert not notes


@pytest.mark.parametrize("kind, top, channels", [("f4", 1.0, 3), ("u1", 255, 3), ("u2", 65535, 3), ("u1", 255, 4)])
def test_vertex_colors_multiply(tmp_path, kind, top, channels):
    quad, colors = Quad(pbrMetallicRoughness={}), np.random.default_rng(1).random((4, channels), np.float32)
    stored = colors if kind == "f4" else np.rint(colors * top).astype(kind)
    stored = np.pad(stored, ((0, 0), (0, -(channels * stored.itemsize) % 4 // stored.itemsize)))  # rows of 4 bytes
    quad.attributes["COLOR_0"] = quad.accessor(stored, normalized=kind != "f4", type=f"VEC{channels}")
    row = stored.shape[1] * stored.itemsize
    quad.document["bufferViews"][-1]["byteStride"] = row
    quad.material()["pbrMetallicRoughness"]["baseColorTexture"] = quad.texture(np.full((4, 4, 3), 200, np.uint8))
    asset, notes = quad.read(tmp_path)
    mixed = np.array([0.25, 0.5, 0.25, 0]) @ (stored[:, :3] / top)  # face 0 at x = 1/2, y = -1/2
    near(at(asset, (0.5, -0.5)).base_color[0], mixed * float(linear(np.uint8([200]))))
    write_glb(tmp_path / "b.glb", asset)
    (back,) = read_glb(tmp_path / "b.glb")
    assert torch.equal(back.mesh.colors, asset.mesh.colors) and not notes
    for write in (lambda a: obj_files(a, "a"), usdz_bytes):
        with pytest.raises(ValueError, match="asset: expected no mesh.colors"):
            write(asset)


def test_one_vertex_color_becomes_part_of_the_texture(tmp_path):
    quad = Quad()
    quad.attributes["COLOR_0"] = quad.accessor(np.uint8([[255, 51, 0, 9]] * 4), normalized=True)
    asset, _ = quad.read(tmp_path)
    assert asset.mesh.colors is None
    near(asset.textures.base_color, torch.tensor([1.0, 0.2, 0.0]).expand(4, 4, 3))


WRAPS = {10497: "wrap", 33648: "symmetric", 33071: "edge"}  # glTF 2.0, 3.8.4.2, by NumPy's modes of padding


@pytest.mark.parametrize("wrap_s, wrap_t", [(10497, 10497), (10497, 33648), (33648, 33071), (33071, 10497)])
def test_wrap_modes(tmp_path, wrap_s, wrap_t):
    quad, pixels = Quad(pbrMetallicRoughness={"metallicFactor": 0.0}), noise(4, 4, 3)
    quad.attributes["TEXCOORD_0"] = quad.accessor(UV * 4 - 1.5)  # over four tiles
    texture = quad.texture(pixels, wrapS=wrap_s, wrapT=wrap_t)
    quad.material()["pbrMetallicRoughness"]["baseColorTexture"] = texture
    asset, _ = quad.read(tmp_path)
    ks = [(i, j) for i in range(-5, 9) for j in range(-5, 9)]  # texel centers
    places = [((((i + 0.5) / 4 + 1.5) / 4) * 2 - 1, 1 - (((j + 0.5) / 4 + 1.5) / 4) * 2) for i, j in ks]
    beyond = np.pad(pixels, ((5, 5), (0, 0), (0, 0)), WRAPS[wrap_t])
    beyond = np.pad(beyond, ((0, 0), (5, 5), (0, 0)), WRAPS[wrap_s])
    near(at(asset, *places).base_color, linear(beyond).transpose(0, 1).reshape(-1, 3), 1e-4)
    write_glb(tmp_path / "b.glb", asset)
    (back,) = read_glb(tmp_path / "b.glb")
    assert back.textures.wrap == asset.textures.wrap
    if asset.textures.wrap != ("repeat", "repeat"):
        with pytest.raises(ValueError, match="asset: expected no mesh.colors"):
            obj_files(asset, "a")


def test_a_skin_at_rest(tmp_path):
    quad, rng = Quad(), np.random.default_rng(2)
    joints = np.uint8([[0, 1, 0, 0], [1, 0, 0, 0], [0, 1, 1, 0], [1, 1, 0, 0]])
    weights = np.uint8([[255, 0, 0, 0], [255, 0, 0, 0], [51, 204, 0, 0], [102, 51, 102, 0]])
    binds = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    binds[:, :3] += 0.3 * rng.standard_normal((2, 3, 4)).astype(np.float32)
    quad.attributes |= {"JOINTS_0": quad.accessor(joints), "WEIGHTS_0": quad.accessor(weights, normalized=True)}
    columns = np.ascontiguousarray(binds.transpose(0, 2, 1)).reshape(2, 16)
    quad.document["skins"] = [{"joints": [2, 3], "inverseBindMatrices": quad.accessor(columns)}]
    quad.document["nodes"] = [
        {"mesh": 0, "skin": 0, "scale": [100, 100, 100], "translation": [7, 7, 7]},  # of no effect
        {"children": [2], "translation": [1, 2, 3]},
        {"children": [3], "scale": [0.5, 2, 1]},
        {"translation": [0, 0, -1]},
    ]
    quad.document["scenes"] = [{"nodes": [0, 1]}]
    asset, notes = quad.read(tmp_path)
    first = np.diag([0.5, 2, 1, 1]).astype(float)
    first[:3, 3] = 1, 2, 3
    second = first.copy()
    second[:3, 3] = 1, 2, 2
    matrices = np.stack([first @ binds[0], second @ binds[1]])
    for k, corner in enumerate(CORNERS):
        matrix = sum(w / 255 * matrices[j] for w, j in zip(weights[k].astype(float), joints[k]))
        near(asset.mesh.vertices[k], (matrix @ [*corner, 1])[:3])
        normal = np.linalg.inv(matrix[:3, :3]).T @ [0, 0, 1]
        near(asset.mesh.normals[k], normal / np.linalg.norm(normal))
    assert not notes
    quad.document["skins"][0]["joints"] = [2]
    with pytest.raises(InputError, match="JOINTS_0: expected joints below 1"):
        quad.read(tmp_path)


def test_morph_targets_sparse_and_quantized_accessors(tmp_path):
    quad = Quad()
    rows = {"bufferView": quad.view(np.float32([[0, 0, 2], [0, 0, 4]]).tobytes())}
    sparse = {"count": 2, "indices": {"bufferView": quad.view(bytes([1, 3])), "componentType": 5121}, "values": rows}
    zeros = {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse}
    quad.document["accessors"].append(zeros)  # without a buffer view: zeros but for two rows
    targets = [{"POSITION": len(quad.document["accessors"]) - 1}, {"POSITION": quad.accessor(CORNERS)}]
    quad.primitive["targets"] = targets
    quad.document["meshes"][0]["weights"] = [0.5, 0.0]
    asset, _ = quad.read(tmp_path)
    lifted = CORNERS + np.float32([[0, 0, 0], [0, 0, 1], [0, 0, 0], [0, 0, 2]])
    near(asset.mesh.vertices, lifted)
    quad.document["nodes"][0]["weights"] = [0.0, 1.0]  # those of a node come first
    near(quad.read(tmp_path)[0].mesh.vertices, 2 * CORNERS)
    del quad.primitive["targets"], quad.document["nodes"][0]["weights"]
    stored = np.pad(np.rint(CORNERS * 32767).astype("i2"), ((0, 0), (0, 1)))
    quad.attributes["POSITION"] = quad.accessor(stored, normalized=True, type="VEC3")
    quad.document["bufferViews"][-1]["byteStride"] = 8
    quad.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    near(quad.read(tmp_path)[0].mesh.vertices, CORNERS)


def test_specular_glossiness_is_converted_for_each_texel(tmp_path):
    """Gray materials of the metallic-roughness model, written in the other one, are read back."""
    base, metal, gloss = (np.random.default_rng(k).uniform(low, 1, (8, 8)) for k, low in enumerate((0.3, 0, 0)))
    metal[:, ::2] = np.rint(metal[:, ::2])
    specular = 0.04 * (1 - metal) + base * metal
    diffuse = base * (1 - metal) * 0.96 / (1 - specular)

    def encoded(value):
        value = value.clip(0, 1)
        return np.rint(255 * np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055))

    quad = Quad(extensions={})
    rgb = np.repeat(encoded(diffuse)[..., None], 3, -1).astype(np.uint8)
    rgba = np.concatenate([np.repeat(encoded(specular)[..., None], 3, -1), np.rint(255 * gloss)[..., None]], -1)
    quad.material()["extensions"]["KHR_materials_pbrSpecularGlossiness"] = {
        "diffuseTexture": quad.texture(rgb),
        "specularGlossinessTexture": quad.texture(rgba.astype(np.uint8)),
        "glossinessFactor": 0.5,
    }
    quad.document["extensionsRequired"] = ["KHR_materials_pbrSpecularGlossiness"]
    asset, notes = quad.read(tmp_path)
    near(asset.textures.roughness, 1 - 0.5 * np.rint(255 * gloss) / 255)
    near(asset.textures.metallic, metal, 0.05)  # 8 bits of sRGB, and near 0.04 a step is 0.03 of metallic
    near(asset.textures.base_color[..., 1], base, 0.05)
    assert notes == ["KHR_materials_pbrSpecularGlossiness is converted to metallic and roughness"]
    gloss = {"diffuseFactor": [0.5, 0.25, 0, 1], "specularFactor": [0.04] * 3, "glossinessFactor": 0.2}
    asset, _ = Quad(extensions={"KHR_materials_pbrSpecularGlossiness": gloss}).read(tmp_path)
    near(asset.textures.base_color[0, 0], [0.5, 0.25, 0.0])  # a dielectric of glTF's own reflectance
    near(asset.textures.roughness[0, 0], 0.8)
    assert float(asset.textures.metallic.max()) < 1e-6


@pytest.mark.parametrize(
    "change, quadrant",
    [  # the first two are the examples of the extension's text
        ({"offset": [0, 1], "rotation": math.pi / 2, "scale": [0.5, 0.5]}, lambda q: np.rot90(q[4:, :4], -1)),
        ({"offset": [0, 1], "scale": [1, -1]}, lambda q: q[::-1]),
        ({"offset": [0.5, 0.0], "scale": [0.5, 0.5]}, lambda q: q[:4, 4:]),
        ({"rotation": math.pi}, lambda q: q[::-1, ::-1]),
        ({"texCoord": 1}, lambda q: q[:, ::-1]),
        ({}, lambda q: q),
    ],
)
def test_transforms_of_texture_coordinates(tmp_path, change, quadrant):
    quad, pixels = Quad(pbrMetallicRoughness={"metallicFactor": 0.0}), noise(8, 8, 3)
    quad.attributes["TEXCOORD_1"] = quad.accessor(np.float32([1, 0]) + UV * np.float32([-1, 1]))
    info = {**quad.texture(pixels), "extensions": {"KHR_texture_transform": change}}
    quad.material()["pbrMetallicRoughness"]["baseColorTexture"] = info
    quad.document["extensionsRequired"] = ["KHR_texture_transform"]
    asset, notes = quad.read(tmp_path)
    shown = linear(np.ascontiguousarray(quadrant(pixels)))
    rows, columns = shown.shape[:2]
    places = [((j + 0.5) / columns * 2 - 1, 1 - (i + 0.5) / rows * 2) for i in range(rows) for j in range(columns)]
    near(at(asset, *places).base_color, shown.reshape(-1, 3), 1e-4)
    assert not notes


def test_textures_of_different_transforms_are_resampled(tmp_path):
    quad, color, rough = Quad(pbrMetallicRoughness={}), noise(16, 16, 3), noise(8, 8, 3, seed=1)
    pbr = quad.material()["pbrMetallicRoughness"]
    pbr["baseColorTexture"] = quad.texture(color, wrapS=33071, wrapT=33071)
    tiled = {"KHR_texture_transform": {"scale": [2, 2]}}
    pbr["metallicRoughnessTexture"] = {**quad.texture(rough), "extensions": tiled}
    asset, notes = quad.read(tmp_path)
    places = [((j + 0.5) / 8 - 1, 1 - (i + 0.5) / 8) for i in range(16) for j in range(16)]  # 16 texels of either
    got = at(asset, *places)
    near(got.base_color, linear(color).reshape(-1, 3), 1e-4)
    near(got.roughness, np.tile(rough[..., 1], (2, 2)).reshape(-1) / 255.0, 1e-4)
    assert len(notes) == 1 and "resampled to one layout" in notes[0]
    tiled["KHR_texture_transform"]["scale"] = [1e5, 1e5]
    with pytest.raises(InputError, match="fit one of 4096 texels"):
        quad.read(tmp_path)
    tiled["KHR_texture_transform"] = {"texCoord": 1}
    with pytest.raises(InputError, match="expected one UV channel"):
        quad.read(tmp_path)


@pytest.mark.parametrize("required", [False, True])
def test_extensions_that_core_gltf_approximates_are_noted_and_others_refused(tmp_path, required):
    for name in sorted(LEFT_OUT):
        quad = Quad(pbrMetallicRoughness={"baseColorFactor": [1, 0, 0, 1]}, extensions={name: {"anything": [1, {}]}})
        quad.document["extensionsRequired"] = [name] if required else []
        asset, notes = quad.read(tmp_path)
        assert notes == [f"{name} is left out"]
        near(asset.textures.base_color[0, 0], [1.0, 0.0, 0.0])
    coded = "KHR_draco_mesh_compression EXT_meshopt_compression KHR_texture_basisu EXT_mesh_gpu_instancing"
    for name in coded.split():
        quad.document["extensionsRequired"] = [name]
        with pytest.raises(InputError, match=f"extensionsRequired: expected none that must be decoded, got .'{name}"):
            quad.read(tmp_path)


def test_an_image_of_twenty_materials_is_decoded_once(tmp_path, monkeypatch):
    quad = Quad(normalTexture={"index": 0})
    quad.texture(noise(32, 32, 3))
    quad.document["textures"] *= 20
    quad.document["materials"] = [{"normalTexture": {"index": k}, "name": str(k)} for k in range(20)]
    quad.document["meshes"][0]["primitives"] = [{**quad.primitive, "material": k} for k in range(20)]
    (tmp_path / "a.glb").write_bytes(quad.data())
    opened, real = [], Image.open
    monkeypatch.setattr(Image, "open", lambda *args, **options: opened.append(1) or real(*args, **options))
    assert len(read_glb(tmp_path / "a.glb")) == 20 and len(opened) == 1


def test_compressed_data_without_a_fallback_are_refused(tmp_path):
    quad = Quad()
    quad.primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}}
    assert quad.read(tmp_path)[1] == []
    del quad.document["accessors"][0]["bufferView"]
    with pytest.raises(InputError, match="expected uncompressed data"):
        quad.read(tmp_path)
    quad = Quad(pbrMetallicRoughness={})
    quad.material()["pbrMetallicRoughness"]["baseColorTexture"] = quad.texture(noise(4, 4, 3))
    quad.document["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": 0}}}
    with pytest.raises(InputError, match="textures.0..source"):
        quad.read(tmp_path)


def test_omissions_are_noted_once(tmp_path):
    quad = Quad(alphaMode="BLEND", emissiveFactor=[0, 0, 1])
    quad.material()["occlusionTexture"] = quad.texture(noise(4, 4, 3))
    quad.document["materials"].append({"alphaMode": "MASK"})
    quad.document["meshes"][0]["primitives"] += [{**quad.primitive, "material": 1}, {**quad.primitive, "mode": 0}]
    quad.document["animations"] = [{"channels": [], "samplers": []}]
    (tmp_path / "a.glb").write_bytes(quad.data())
    notes: list[str] = []
    assert len(read_glb(tmp_path / "a.glb", notes=notes)) == 2
    left = ["animation", "alpha", "emission", "occlusionTexture", "what consists of points or lines"]
    assert notes == [f"a.glb: {name} is left out" for name in left]


@pytest.mark.parametrize(
    "mode, indices, faces", [(5, [0, 1, 3, 2], [[0, 1, 3], [1, 2, 3]]), (6, [0, 1, 2, 3], [[1, 2, 0], [2, 3, 0]])]
)
def test_strips_and_fans_are_triangles(tmp_path, mode, indices, faces):
    quad = Quad()
    quad.primitive |= {"mode": mode, "indices": quad.accessor(np.uint16(indices))}
    assert quad.read(tmp_path)[0].mesh.faces.tolist() == faces


def test_hidden_nodes_are_not_read(tmp_path):
    quad = Quad()
    hidden = {"extensions": {"KHR_node_visibility": {"visible": False}}, "children": [2]}
    quad.document["nodes"] += [hidden, {"mesh": 0}]
    quad.document["scenes"] = [{"nodes": [0, 1]}]
    assert quad.read(tmp_path)[1] == []  # one surface


def test_colors_are_interpolated_in_linear_light(tmp_path):
    """A texture of two texels, enlarged for a larger normal map: a quarter between black and white is linear 0.25."""
    quad = Quad(pbrMetallicRoughness={})
    color = np.array([[[0, 0, 0], [255, 255, 255]]] * 2, np.uint8)
    quad.material()["pbrMetallicRoughness"]["baseColorTexture"] = quad.texture(color, wrapS=33071, wrapT=33071)
    flat = np.full((8, 8, 3), (128, 128, 255), np.uint8)
    quad.material()["normalTexture"] = quad.texture(flat, wrapS=33071, wrapT=33071)
    asset, _ = quad.read(tmp_path)
    row = asset.textures.base_color[4, :, 0]
    expected = ((torch.arange(8) + 0.5) / 8 * 2 - 0.5).clamp(0.0, 1.0)  # texel centers at +0.5
    near(row, expected, 1e-5)
