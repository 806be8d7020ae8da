"""Writes GLB files: one mesh, one metallic-roughness material, three PNG or WebP textures (glTF 2.0, Khronos).

Axes and units are as in glTF (+Y up, right-handed), so nothing is rotated.  Base color is 8-bit sRGB; roughness and
metallic are the green and blue channel of a linear texture.  All factors are 1.
"""

import io
import json
import os
import struct
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import reli3d
from reli3d._bridge import expect, full_precision, over_rows, present
from reli3d.geometry.mesh import watertight
from reli3d.io.files import write_bytes
from reli3d.io.gltf_parts import read_parts
from reli3d.io.images import png_bytes
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb

UNIT_TOLERANCE = 1.0e-3  # deviation from length 1 that readers accept
KINDS = ("png", "webp")  # of textures
WEBP = "EXT_texture_webp"
FLOAT, UINT = 5126, 5125
LINEAR, LINEAR_MIPMAP_LINEAR = 9729, 9987
WRAPS = {"repeat": 10497, "mirror": 33648, "clamp": 33071}


def encode_image(values: Tensor, kind: str = "png") -> bytes:
    """PNG or lossless WebP file, 8-bit RGB, of ``(H, W, 3)`` values in [0, 1], rounded to the nearest 1/255."""
    pixels = np.ascontiguousarray((values.detach() * 255.0).round_().to(torch.uint8).cpu().numpy())
    if kind == "png":
        return png_bytes(pixels)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "WEBP", lossless=True, exact=True)
    return buffer.getvalue()


def texture_images(asset: Asset, kind: str = "png") -> dict[str, bytes]:
    """Encoded images ``base_color``, ``metallic_roughness`` (green roughness, blue metallic, red 1) and ``normal``."""
    rough = asset.textures.roughness
    orm = torch.stack([torch.ones_like(rough), rough, asset.textures.metallic], -1)  # no occlusion is baked
    base_color = linear_to_srgb(asset.textures.base_color)
    maps = (base_color, orm, asset.textures.normal)
    encoded = over_rows(len(maps), 1, lambda k, _: encode_image(maps[k], kind))
    return dict(zip(("base_color", "metallic_roughness", "normal"), encoded, strict=True))


def addressing(asset: Asset) -> tuple[str, str]:
    """Wrap modes for a file: those of the textures, with "repeat" replaced by "clamp" if UV stay within [0, 1]."""
    low, high = torch.aminmax(present("uv", asset.mesh.uv).detach(), dim=0)
    inside = ((low >= 0.0) & (high <= 1.0)).tolist()
    first, second = ("clamp" if m == "repeat" and i else m for m, i in zip(asset.textures.wrap, inside, strict=True))
    return first, second


def portable(asset: Asset) -> bool:
    """Whether OBJ and USD can represent ``asset``: no vertex colors, and textures that repeat or have UV in [0, 1]."""
    uv = present("uv", asset.mesh.uv).detach()
    inside = bool(((uv >= 0.0) & (uv <= 1.0)).all())
    return asset.mesh.colors is None and (inside or asset.textures.wrap == ("repeat", "repeat"))


def check_portable(asset: Asset) -> None:
    """:func:`check_asset` for OBJ and USD; also raises ValueError unless ``asset`` is :func:`portable`."""
    check_asset(asset)
    if not portable(asset):
        raise ValueError("asset: expected no mesh.colors, and uv in [0, 1] or textures.wrap repeat; bake it anew")


def check_asset(asset: Asset) -> None:
    """Raises TypeError or ValueError for an asset with missing attributes or with values out of range or non-finite."""
    expect("asset", asset, Asset)
    mesh = asset.mesh
    if len(mesh.faces) == 0:
        raise ValueError("asset.mesh.faces: expected at least one face, got 0")
    fixes = {"vertices": "", "normals": "Mesh.with_normals", "uv": "unwrap", "tangents": "Mesh.with_tangents"}
    for name, fix in fixes.items():
        value = getattr(mesh, name)
        if value is None:
            raise ValueError(f"asset.mesh.{name}: expected a tensor, got None (see {fix})")
        if not bool(torch.isfinite(value).all()):
            raise ValueError(f"asset.mesh.{name}: expected finite values, got NaN or infinity")
        if name in ("normals", "tangents"):
            worst = float((value.detach()[:, :3].norm(dim=1) - 1.0).abs().max())
            if worst > UNIT_TOLERANCE:
                raise ValueError(f"asset.mesh.{name}: expected unit length, got a length off by {worst:.3g}")
    if not bool((present("tangents", mesh.tangents)[:, 3].abs() == 1.0).all()):
        raise ValueError("asset.mesh.tangents: expected w = +1 or -1, got another value")
    textures = present("asset.textures", asset.textures)
    for name in ("base_color", "roughness", "metallic", "normal"):
        value = getattr(textures, name)
        low, high = (float(v) for v in torch.aminmax(value)) if value.numel() else (-1.0, -1.0)
        if not 0.0 <= low <= high <= 1.0:  # NaN fails too
            raise ValueError(f"asset.textures.{name}: expected values in [0, 1], got others or none")


def glb_bytes(
    asset: Asset,
    *,
    extras: Mapping | None = None,
    double_sided: bool | None = None,
    translation: Sequence[float] = (0.0, 0.0, 0.0),
    textures: str = "png",
) -> bytes:
    """The GLB file of :func:`write_glb` as bytes."""
    check_asset(asset)
    if textures not in KINDS:
        raise ValueError(f"textures: expected {' or '.join(KINDS)}, got {textures}")
    mesh = asset.mesh
    if double_sided is None:
        double_sided = not watertight(mesh)
    images = texture_images(asset, textures)
    document, chunks = _geometry(mesh)
    names, chunks = tuple(images), chunks + list(images.values())
    views, offset = [], 0
    targets = [34962] * (len(document["accessors"]) - 1) + [34963]  # vertex attributes, indices; images have none
    wrap_s, wrap_t = (WRAPS[mode] for mode in addressing(asset))
    for k, chunk in enumerate(chunks):
        view = {"buffer": 0, "byteOffset": offset, "byteLength": len(chunk)}
        views.append({**view, "target": targets[k]} if k < len(targets) else view)
        offset += len(chunk) + -len(chunk) % 4

    def source(image: int) -> dict:  # a viewer that does not know the extension finds none
        return {"source": image} if textures == "png" else {"extensions": {WEBP: {"source": image}}}

    info: dict[str, object] = {"version": "2.0", "generator": f"reli3d {reli3d.__version__}"}
    if extras:
        info["extras"] = dict(extras)
    document |= {
        "asset": info,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "object"} | ({"translation": list(translation)} if any(translation) else {})],
        "materials": [
            {
                "name": "baked",
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "baseColorFactor": [1.0, 1.0, 1.0, 1.0],
                    "metallicRoughnessTexture": {"index": 1},
                    "metallicFactor": 1.0,
                    "roughnessFactor": 1.0,
                },
                "normalTexture": {"index": 2, "scale": 1.0},
                "doubleSided": bool(double_sided),
            }
        ],
        "textures": [{"sampler": 0, "name": name, **source(k)} for k, name in enumerate(names)],
        "images": [
            {"bufferView": len(targets) + k, "mimeType": f"image/{textures}", "name": name}
            for k, name in enumerate(names)
        ],
        "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": wrap_s, "wrapT": wrap_t}],
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    if textures == "webp":
        document |= {"extensionsUsed": [WEBP], "extensionsRequired": [WEBP]}
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + offset
    if total >= 1 << 32:
        raise ValueError(f"asset: expected less than 4 GiB, got {total} bytes; use smaller textures")
    parts = [
        struct.pack("<4sII", b"glTF", 2, total),
        struct.pack("<I4s", len(text), b"JSON"),
        text,
        struct.pack("<I4s", offset, b"BIN\0"),
    ]
    for chunk in chunks:
        parts += [chunk, b"\0" * (-len(chunk) % 4)]
    return b"".join(parts)


def _geometry(mesh) -> tuple[dict, list[bytes]]:
    """Accessors with their mesh, and the bytes of the first buffer views."""
    arrays = {"POSITION": mesh.vertices, "NORMAL": mesh.normals, "TANGENT": mesh.tangents, "TEXCOORD_0": mesh.uv}
    if mesh.colors is not None:
        arrays["COLOR_0"] = mesh.colors
    accessors, chunks = [], []
    for k, (name, tensor) in enumerate(arrays.items()):
        value = np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype="<f4")
        accessor = {"bufferView": k, "componentType": FLOAT, "count": len(value), "type": f"VEC{value.shape[1]}"}
        if name == "POSITION":
            accessor |= {"min": value.min(0).astype(float).tolist(), "max": value.max(0).astype(float).tolist()}
        accessors.append(accessor)
        chunks.append(value.tobytes())
    faces = np.ascontiguousarray(mesh.faces.cpu().numpy(), dtype="<u4")
    accessors.append({"bufferView": len(arrays), "componentType": UINT, "count": faces.size, "type": "SCALAR"})
    chunks.append(faces.tobytes())
    attributes = {name: k for k, name in enumerate(arrays)}
    primitive = {"attributes": attributes, "indices": len(arrays), "material": 0, "mode": 4}
    return {"accessors": accessors, "meshes": [{"name": "object", "primitives": [primitive]}]}, chunks


def write_glb(
    path: str | os.PathLike,
    asset: Asset,
    *,
    extras: Mapping | None = None,
    double_sided: bool | None = None,
    translation: Sequence[float] = (0.0, 0.0, 0.0),
    textures: str = "png",
) -> None:
    """Writes mesh and textures of ``asset`` as a GLB file, completely or not at all; the environment is not written.

    asset: with normals, UV and tangents; :func:`unwrap` and :meth:`Mesh.with_tangents` add them.  extras: JSON for
    glTF's ``asset.extras``.  double_sided: None: unless watertight.  translation: of the glTF node, for objects so far
    from the origin that float32 would lose precision.  textures: ``png``, or ``webp`` (lossless, smaller, needs
    ``EXT_texture_webp``).  Raises TypeError for a wrong type; ValueError for missing attributes, non-finite values or
    ones outside [0, 1], non-unit normals, or 4 GiB and more; OSError if writing fails.

    >>> reli3d.write_glb("object.glb", asset, extras={"license": "CC0-1.0"})
    >>> parts = reli3d.read_glb("object.glb")
    """
    data = glb_bytes(asset, extras=extras, double_sided=double_sided, translation=translation, textures=textures)
    write_bytes(path, data)


@full_precision
def read_glb(
    path: str | os.PathLike, *, notes: list[str] | None = None, origin: list[float] | None = None, **limits: int
) -> list[Asset]:
    """Reads a GLB file: one :class:`Asset` per primitive, in scene coordinates, without environment.

    Node transforms, skins at rest and default morph targets are applied.  Vertex colors become ``Mesh.colors``; one
    color multiplies the textures.  Textures become squares of equal size, with factors and transforms applied.  Missing
    normals are those of faces, tangents MikkTSpace's.  Specular-glossiness is converted.

    notes: receives a line for every ignored feature (animation, emission, occlusion, alpha, points, lines, extensions).
    origin: an empty list, which receives the position (x, y, z) of the first mesh's node; vertices are relative to it,
    so those far away keep their digits.  limits: see :func:`reli3d.io.gltf_parts.read_parts`.  Raises
    InputError (field, value, fix), also for compressed data (Draco, meshopt, KTX2).

    >>> reli3d.write_glb("object.glb", asset)
    >>> parts = reli3d.read_glb("object.glb")
    """
    return read_parts(path, notes=notes, origin=origin, **limits)
