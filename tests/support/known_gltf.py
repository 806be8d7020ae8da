"""GLB files of one quad with random features of glTF 2.0, and their appearance by the standard."""

from collections.abc import Callable
from dataclasses import dataclass
from random import Random

import numpy as np
import torch

from reli3d.geometry.camera import Camera, look_at
from reli3d.render.asset import Asset
from reli3d.render.environment import Environment
from reli3d.render.image import render_asset
from reli3d.render.shading import Samples, ShadeOptions
from tests.support.gltf import Builder
from tests.support.misread import check

CELLS, CELL, SIZE = 4, 32, 24  # blocks of one color a side, their texels, pixels of the view
ONE_RAY = ShadeOptions(samples=Samples(light=1, bsdf=1, cosine=1))
WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
SPEC_GLOSS = "KHR_materials_pbrSpecularGlossiness"
READABLE = ("KHR_materials_clearcoat", "KHR_materials_sheen", "KHR_materials_specular", "KHR_materials_ior")
CODED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu", "NO_such_extension")


@dataclass(frozen=True)
class Look:
    """low, high: bounds of the vertices.  color: linear base color at points ``x, y`` of the unit quad and whether the
    point is clear of the borders between texels' blocks.
    """

    low: np.ndarray
    high: np.ndarray
    color: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    roughness: float
    metallic: float
    refused: bool
    plain: bool  # of core glTF alone: a refusal is a fault


def linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def wrapped(t: np.ndarray, mode: int) -> np.ndarray:
    if mode == 33071:
        return t.clip(0.0, 1.0 - 1e-9)
    if mode == 33648:
        t = t % 2.0
        return np.where(t >= 1.0, 2.0 - t, t).clip(0.0, 1.0 - 1e-9)
    return t % 1.0


def quad(rng: Random) -> tuple[bytes, Look]:
    numbers = np.random.default_rng(rng.getrandbits(32))
    file = Builder()
    corners = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    uv_scale, uv_offset = rng.choice((1.0, 2.0)), rng.choice((0.03, -0.27))
    uv = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]]) * np.float32(uv_scale) + np.float32(uv_offset)
    attributes = {
        "POSITION": file.accessor(corners, min=[-1, -1, 0], max=[1, 1, 0]),
        "NORMAL": file.accessor(np.float32([[0, 0, 1]] * 4)),
        "TEXCOORD_0": file.accessor(uv),
    }
    extensions, used, required, plain = {}, [], [], True
    modes = [rng.choice(list(WRAPS)) for _ in range(2)]
    blocks = numbers.integers(20, 256, (CELLS, CELLS, 3), dtype=np.uint8)
    wraps = {"wrapS": modes[0], "wrapT": modes[1]}
    base = file.texture(blocks.repeat(CELL, 0).repeat(CELL, 1), **wraps)
    move, stretch, turn = np.zeros(2), np.ones(2), 0.0
    if rng.random() < 0.3:
        move = np.array([rng.choice((0.0, 0.25, 0.5)) for _ in range(2)])
        stretch = np.array([rng.choice((0.5, -1.0, 2.0)) for _ in range(2)])
        turn = rng.choice((0.0, rng.uniform(-4.0, 4.0)))
        base["extensions"] = {"KHR_texture_transform": {"offset": move.tolist(), "scale": stretch.tolist()}}
        if turn:
            base["extensions"]["KHR_texture_transform"]["rotation"] = turn
        used.append("KHR_texture_transform")
        required += used if rng.random() < 0.5 else []
    factor = np.array([rng.uniform(0.2, 1.0) for _ in range(3)])
    roughness, metallic = rng.uniform(0.1, 1.0), rng.uniform(0.0, 1.0)
    pbr: dict = {"baseColorTexture": base, "baseColorFactor": [*factor, 1.0]}
    packed = rng.choice(["factor", "8 bits", "16 bits gray"])
    if packed == "factor":
        pbr |= {"roughnessFactor": roughness, "metallicFactor": metallic}
    elif packed == "8 bits":
        rough, metal = rng.randrange(30, 256), rng.randrange(256)
        pixels = np.full((4, 4, 3), (rng.randrange(256), rough, metal), np.uint8)
        pbr["metallicRoughnessTexture"] = file.texture(pixels, **wraps)
        roughness, metallic = rough / 255, metal / 255
    else:
        gray = rng.randrange(8000, 65536)
        pbr["metallicRoughnessTexture"] = file.texture(np.full((4, 4), gray, np.uint16), **wraps)
        roughness = metallic = gray / 65535
    vertex = np.ones(3)
    if rng.random() < 0.4:
        vertex = np.array([rng.choice((0.2, 0.4, 0.6, 0.8, 1.0)) for _ in range(3)])
        kind, top = rng.choice([(np.uint8, 255), (np.uint16, 65535), (np.float32, 1)])
        color = (np.append(vertex, 1.0) * top).astype(kind)[None].repeat(4, 0)
        attributes["COLOR_0"] = file.accessor(color, normalized=top != 1)
    material: dict = {"pbrMetallicRoughness": pbr}
    if rng.random() < 0.15:  # below the dielectric's reflectance, so that nothing is metal
        material = {"extensions": {SPEC_GLOSS: {"diffuseTexture": base, "diffuseFactor": [*factor, 1.0]}}}
        material["extensions"][SPEC_GLOSS] |= {"specularFactor": [0.03] * 3, "glossinessFactor": 1.0 - roughness}
        metallic = 0.0
        vertex = vertex * 0.97 / 0.96  # transmission of the specular layer, theirs and the dielectric's
        used.append(SPEC_GLOSS)
        plain = False
    if rng.random() < 0.15:
        name = rng.choice(READABLE)
        used.append(name)
        required += [name] if rng.random() < 0.5 else []
        material.setdefault("extensions", {})[name] = {}
    refused = rng.random() < 0.1
    if refused:
        name = rng.choice(CODED)
        used.append(name)
        required.append(name)
    grow, shift = rng.choice((0.5, 1.0, 3.0)), np.array([rng.uniform(-1, 1) for _ in range(3)])
    nodes: list[dict] = [{"children": [1], "translation": shift.tolist()}, {"mesh": 0, "scale": [grow] * 3}]
    if rng.random() < 0.2:  # a skin: the node's own transform is ignored, the joint's counts
        nodes = [{"mesh": 0, "skin": 0, "scale": [100.0] * 3}]
        nodes.append({"translation": shift.tolist(), "scale": [grow] * 3})
        attributes["JOINTS_0"] = file.accessor(np.zeros((4, 4), np.uint8))
        attributes["WEIGHTS_0"] = file.accessor(np.float32([[1, 0, 0, 0]] * 4))
        extensions["skins"] = [{"joints": [1]}]
    indices = file.accessor(np.uint16([0, 1, 2, 0, 2, 3]))
    file.document |= {
        "scene": 0,
        "scenes": [{"nodes": [0, 1] if "skins" in extensions else [0]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [material],
        "extensionsUsed": used,
        "extensionsRequired": required,
        **extensions,
    }

    def color(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = (((1 + t) / 2 * uv_scale + uv_offset) * s for t, s in ((x, stretch[0]), (-y, stretch[1])))
        turned = (u - 1j * v) * np.exp(1j * turn)  # counter-clockwise as seen: v is down
        cells, clear = [], np.ones(x.shape, bool)
        for t, mode in ((turned.real + move[0], modes[0]), (-turned.imag + move[1], modes[1])):
            t = wrapped(t, mode) * CELLS
            cells.append(t.astype(int).clip(0, CELLS - 1))
            border = np.rint(t)
            joined = (mode != 10497) & ((border == 0) | (border == CELLS))  # the same texel on both sides
            clear &= joined | (np.abs(t - border) > 2.5 / CELL)  # bilinear, and texels of another size
        return linear(blocks[cells[1], cells[0]] / 255.0) * factor * vertex, clear

    look = Look(
        np.array([-grow, -grow, 0.0]) + shift,
        np.array([grow, grow, 0.0]) + shift,
        color,
        roughness,
        metallic,
        refused,
        plain and not used and not refused,
    )
    return file.data(), look


def compare(parts: list[Asset], look: Look, notes: list[str]) -> None:
    check(len(parts) == 1, f"{len(parts)} parts")
    (asset,) = parts
    vertices = asset.mesh.vertices.numpy()
    for name, got, expected in (("low", vertices.min(0), look.low), ("high", vertices.max(0), look.high)):
        check(
            np.abs(got - expected).max() < 1e-4,
            f"bounds: {name} {got.tolist()}, not {expected.tolist()}; notes {notes}",
        )
    middle, grow = (look.low + look.high) / 2, (look.high[0] - look.low[0]) / 2
    eye = middle + np.array([0.0, 0.0, 4.0 * grow])
    pose = look_at(eye.tolist(), middle.tolist())
    camera = Camera.from_fov(pose, 0.45, SIZE, SIZE)
    image = render_asset(asset, camera, Environment(torch.ones(4, 8, 3)), options=ONE_RAY)
    check(bool((image.alpha > 0.999).all()), "the quad does not fill the view")
    pixel = (np.arange(SIZE) + 0.5 - SIZE / 2) * 4.0 / float(camera.intrinsics[0])
    x, y = np.meshgrid(pixel, -pixel)
    expected, clear = look.color(x, y)
    off = np.abs(image.base_color.numpy() - expected)[clear]
    check(
        clear.sum() > 20 and off.max() < 0.02, f"base color differs by {off.max():.3f}; notes {notes}"
    )  # 8 bits, sRGB
    for name, value in (("roughness", look.roughness), ("metallic", look.metallic)):
        off = np.abs(getattr(image, name).numpy() - value).max()
        check(off < 0.01, f"{name} differs by {off:.3f} from {value:.3f}; notes {notes}")
