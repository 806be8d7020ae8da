"""GLB in: primitives with their materials as assets; see ``gltf.py`` for the container."""

from __future__ import annotations

import io
import math
import os
import warnings

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from reli3d.geometry.mesh import Mesh
from reli3d.geometry.tangents import with_tangents
from reli3d.io.files import InputError, shown
from reli3d.io.gltf import Document
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import srgb_to_linear

FORMATS = ("PNG", "JPEG", "WEBP")
MAX_PARTS = 4096  # primitives as placed: each is a mesh with textures of its own
MAX_SCALE = 1e6  # of a normal texture's slopes: beyond it float32 has only the plane
PLAIN = 4  # texels along a side of a texture without an image


def read_parts(
    path: str | os.PathLike, *, max_bytes: int = 1 << 29, max_vertices: int = 20_000_000, max_pixels: int = 1 << 26
) -> list[Asset]:
    """See :func:`reli3d.io.glb.read_glb`.

    max_bytes: of the file.  max_vertices: in all meshes as placed.  max_pixels: of all images together.
    """
    document = Document(path, max_bytes=max_bytes, max_vertices=max_vertices)
    materials = _Materials(document, max_pixels)
    parts, vertices = [], 0
    placed = document.placed_meshes()
    count = sum(len(document.get(mesh, "primitives", list, f"{name}.primitives")) for mesh, _, name in placed)
    if count > MAX_PARTS:
        document.fail("meshes", f"expected at most {MAX_PARTS} primitives as placed", count, "join the meshes")
    for mesh, world, name in placed:
        for k, primitive in enumerate(mesh["primitives"]):
            field = f"{name}.primitives[{k}]"
            if not isinstance(primitive, dict):
                document.fail(field, "expected an object", primitive)
            part = _part(document, materials, primitive, world, field)
            if part is not None:
                parts.append(part)
                vertices += len(part.mesh.vertices)
                if vertices > max_vertices:
                    document.fail(
                        field, f"expected at most {max_vertices} vertices in all", vertices, "simplify the mesh"
                    )
    if not parts:
        raise InputError(path, "expected triangles in its scene, got none; export a mesh")
    return parts


def has_material_maps(path: str | os.PathLike, *, max_bytes: int = 1 << 29, max_vertices: int = 20_000_000) -> bool:
    """Whether a material of the file has a metallic-roughness texture.

    Without one its roughness and metallic are two numbers, which exporters fill in where nobody chose them.  Raises
    InputError as :func:`read_parts` does.
    """
    document = Document(path, max_bytes=max_bytes, max_vertices=max_vertices)
    for k in range(len(document.get(document.json, "materials", list, "materials", []))):
        material = document.item("materials", k, f"materials[{k}]")
        pbr = document.get(material, "pbrMetallicRoughness", dict, f"materials[{k}].pbrMetallicRoughness", {})
        if "metallicRoughnessTexture" in pbr:
            return True
    return False


def _part(document: Document, materials: _Materials, primitive: dict, world: np.ndarray, field: str) -> Asset | None:
    attributes = document.get(primitive, "attributes", dict, f"{field}.attributes")
    if "POSITION" not in attributes:
        document.fail(f"{field}.attributes", "expected POSITION", sorted(attributes))

    def read(name: str, kind: str) -> np.ndarray | None:
        if name not in attributes:
            return None
        values = document.accessor(attributes[name], f"{field}.attributes.{name}", (kind,)).astype(np.float64)
        if len(values) != len(position):
            document.fail(f"{field}.attributes.{name}", f"expected {len(position)} elements", len(values))
        return values

    position = document.accessor(attributes["POSITION"], f"{field}.attributes.POSITION", ("VEC3",)).astype(np.float64)
    faces = document.triangles(primitive, len(position), field)
    if faces is None or len(faces) == 0:
        return None
    textures, channel = materials.textures(primitive.get("material"), f"{field}.material")
    uv, normal, tangent = read(f"TEXCOORD_{channel}", "VEC2"), read("NORMAL", "VEC3"), read("TANGENT", "VEC4")
    if uv is None:
        if textures.size != PLAIN:
            document.fail(f"{field}.attributes", f"expected TEXCOORD_{channel} for its texture", sorted(attributes))
        uv = np.full((len(position), 2), 0.5)
    linear = world[:3, :3]
    if np.linalg.det(linear) < 0:  # a mirror turns the faces inside out
        faces = faces[:, [0, 2, 1]]
    position = position @ linear.T + world[:3, 3]
    if normal is None:
        tangent = None
        position, uv = position[faces.ravel()], uv[faces.ravel()]
        faces = np.arange(len(position), dtype=np.int32).reshape(-1, 3)
        normal = np.repeat(np.cross(position[1::3] - position[::3], position[2::3] - position[::3]), 3, axis=0)
    else:
        u, s, vt = np.linalg.svd(linear)
        normal = normal @ (u @ np.diag(1.0 / np.maximum(s, 1e-12 * s.max() + 1e-300)) @ vt).T  # inverse transpose
    vertices, normals, coordinates = _tensor(position), _tensor(_unit(normal)), _tensor(uv)
    mesh = Mesh(vertices, torch.from_numpy(np.ascontiguousarray(faces)), normals, coordinates)
    if not all(bool(torch.isfinite(t).all()) for t in (vertices, coordinates)):
        document.fail(f"{field}.attributes", "expected values within the range of float32", "an overflow")
    sign = 1.0 if np.linalg.det(linear) >= 0 else -1.0
    if tangent is None or not (np.linalg.norm(tangent[:, :3], axis=1) > 1e-6).all():
        return Asset(with_tangents(mesh), textures)
    direction = tangent[:, :3] @ linear.T
    n = normals.double().numpy()
    direction -= n * (n * direction).sum(1, keepdims=True)
    if not (np.linalg.norm(direction, axis=1) > 1e-9 * max(float(np.linalg.norm(linear)), 1e-300)).all():
        return Asset(with_tangents(mesh), textures)
    frame = np.concatenate([_unit(direction), np.where(tangent[:, 3:] < 0, -sign, sign)], 1)
    return Asset(Mesh(mesh.vertices, mesh.faces, mesh.normals, mesh.uv, _tensor(frame)), textures)


def _unit(v: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=1, keepdims=True)
    return np.where(length > 1e-30, v / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])


def _tensor(values: np.ndarray) -> Tensor:
    with np.errstate(over="ignore"):  # an infinity is reported by the caller
        values = values.astype(np.float32)
    return torch.from_numpy(np.ascontiguousarray(values))


class _Materials:
    """Texture sets of the materials of one document, each made once."""

    def __init__(self, document: Document, max_pixels: int):
        self.document, self.left, self.squares = document, max_pixels, max_pixels
        self.made: dict[object, tuple[TextureSet, int]] = {}
        self.images: dict[object, Tensor] = {}

    def textures(self, index: object, field: str) -> tuple[TextureSet, int]:
        """Texture set of a material and the UV channel it uses."""
        material = {} if index is None else self.document.item("materials", index, field)
        if index not in self.made:
            self.made[index] = self._make(material, f"materials[{index}]")
        return self.made[index]

    def _make(self, material: dict, field: str) -> tuple[TextureSet, int]:
        get, numbers = self.document.get, self.document.numbers
        where = f"{field}.pbrMetallicRoughness"
        pbr = get(material, "pbrMetallicRoughness", dict, where, {})
        color = numbers(pbr, "baseColorFactor", 4, f"{where}.baseColorFactor", [1, 1, 1, 1])[:3]
        roughness = get(pbr, "roughnessFactor", float, f"{where}.roughnessFactor", 1.0)
        metallic = get(pbr, "metallicFactor", float, f"{where}.metallicFactor", 1.0)
        slots = [
            (pbr, "baseColorTexture", where),
            (pbr, "metallicRoughnessTexture", where),
            (material, "normalTexture", field),
        ]
        images: list[Tensor | None] = []
        channels: set[int] = set()
        scale = 1.0
        for node, key, place in slots:
            info = get(node, key, dict, f"{place}.{key}", {}) if key in node else None
            if info is None:
                images.append(None)
                continue
            if "KHR_texture_transform" in get(info, "extensions", dict, f"{place}.{key}.extensions", {}):
                self.document.fail(
                    f"{place}.{key}",
                    "expected UV without KHR_texture_transform",
                    "one",
                    "apply the transform to the UV",
                )
            channels.add(get(info, "texCoord", int, f"{place}.{key}.texCoord", 0))
            if key == "normalTexture":
                scale = get(info, "scale", float, f"{place}.{key}.scale", 1.0)
                if abs(scale) > MAX_SCALE:
                    self.document.fail(f"{place}.{key}.scale", f"expected at most {MAX_SCALE:g}", scale)
            texture = self.document.item("textures", info.get("index"), f"{place}.{key}.index")
            where_from = f"textures[{info['index']}].extensions"
            webp = get(get(texture, "extensions", dict, where_from, {}), "EXT_texture_webp", dict, where_from, {})
            source = webp.get("source", texture.get("source"))
            images.append(self._image(source, f"textures[{info['index']}].source"))
        if len(channels) > 1:
            self.document.fail(
                field, "expected one UV channel for all textures", sorted(channels), "bake to one UV channel"
            )
        size = max((max(i.shape[:2]) for i in images if i is not None), default=PLAIN)
        if size > PLAIN:
            self.squares -= size * size
            if self.squares < 0:
                self.document.fail(
                    field,
                    "expected smaller textures: images are made square, for each material",
                    size,
                    "use smaller textures or fewer materials",
                )
        base, orm, normal = (_square(i, size) for i in images)
        factor = torch.tensor(color).clamp(0.0, 1.0)
        base = (srgb_to_linear(base) if base is not None else torch.ones(size, size, 3)) * factor
        orm = orm if orm is not None else torch.ones(size, size, 3)
        rough, metal = (orm[..., k] * min(max(v, 0.0), 1.0) for k, v in ((1, roughness), (2, metallic)))
        if normal is not None and scale != 1.0:
            local = (normal * 2.0 - 1.0) * torch.tensor([scale, scale, 1.0])
            normal = torch.nn.functional.normalize(local, dim=-1, eps=1e-6) * 0.5 + 0.5
        return TextureSet(base.clamp(0.0, 1.0), rough, metal, normal), channels.pop() if channels else 0

    def _image(self, index: object, field: str) -> Tensor:
        entry = self.document.item("images", index, field)
        if index in self.images:
            return self.images[index]
        where = f"images[{index}]"
        if "bufferView" in entry:
            data = bytes(self.document.view(entry["bufferView"], f"{where}.bufferView")[0])
        else:
            data = self.document.data_uri(self.document.get(entry, "uri", str, f"{where}.uri"), f"{where}.uri")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                    if not 0 < math.prod(image.size) <= self.left:
                        self.document.fail(
                            where,
                            f"expected at most {self.left} more pixels in all",
                            image.size,
                            "use smaller textures",
                        )
                    self.left -= math.prod(image.size)
                    pixels = np.asarray(image.convert("RGB"))
        except InputError:
            raise
        except Exception as error:  # on a broken file decoders raise almost anything: struct.error, IndexError ...
            raise InputError(
                self.document.path,
                f"{where}: expected a PNG, JPEG or WebP image, got {shown(str(error))}; save the image again",
            ) from None
        self.images[index] = torch.from_numpy(pixels.astype(np.float32)) / 255.0
        return self.images[index]


def _square(image: Tensor | None, size: int) -> Tensor | None:
    """``(size, size, 3)`` by bilinear interpolation, texel centres at +0.5."""
    if image is None or image.shape[:2] == (size, size):
        return image
    resized = torch.nn.functional.interpolate(
        image.permute(2, 0, 1)[None], (size, size), mode="bilinear", align_corners=False
    )
    return resized[0].permute(1, 2, 0).contiguous()
