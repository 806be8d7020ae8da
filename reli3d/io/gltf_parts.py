"""Reads GLB primitives, at rest, as assets; see ``gltf.py`` for the container."""

import os
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from reli3d._bridge import present
from reli3d.errors import InputError
from reli3d.geometry.mesh import Mesh
from reli3d.io.gltf import Document, Placed
from reli3d.io.gltf_materials import Materials
from reli3d.render.asset import Asset

MAX_PARTS = 4096  # primitives as placed: each is a mesh with textures of its own
DRACO = "KHR_draco_mesh_compression"


def read_parts(
    path: str | os.PathLike,
    *,
    notes: list[str] | None = None,
    origin: list[float] | None = None,
    max_bytes: int = 1 << 29,
    max_vertices: int = 20_000_000,
    max_pixels: int = 1 << 26,
) -> list[Asset]:
    """See :func:`reli3d.io.glb.read_glb`.

    max_bytes: size of the file.  max_vertices: in all placed meshes together.  max_pixels: in all images together.
    """
    document = Document(path, max_bytes=max_bytes, max_vertices=max_vertices)
    materials = Materials(document, max_pixels)
    parts, vertices = [], 0
    placed = document.placed_meshes(origin)
    count = sum(len(document.get(p.mesh, "primitives", list, p.name)) for p in placed)
    if count > MAX_PARTS:
        document.fail("meshes", f"expected at most {MAX_PARTS} primitives as placed", count, "join the meshes")
    for mesh in placed:
        for k, primitive in enumerate(mesh.mesh["primitives"]):
            field = f"{mesh.name}.primitives[{k}]"
            if not isinstance(primitive, dict):
                document.fail(field, "expected an object", primitive)
            part = _Primitive(document, primitive, field).asset(mesh, materials)
            if part is not None:
                parts.append(part)
                vertices += len(part.mesh.vertices)
                if vertices > max_vertices:
                    expected = f"expected at most {max_vertices} vertices in all"
                    document.fail(field, expected, vertices, "simplify the mesh")
    if not parts:
        raise InputError(path, "expected triangles in its scene, got none; export a mesh")
    if notes is not None:
        notes += document.notes
    return parts


def has_material_maps(path: str | os.PathLike) -> bool:
    """Whether a material has a metallic-roughness texture, not two numbers, which exporters write as defaults."""
    document = Document(path)
    count = len(document.get(document.json, "materials", list, "", []))
    materials = ((f"materials[{k}]", document.item("materials", k, f"materials[{k}]")) for k in range(count))
    factors = (document.get(material, "pbrMetallicRoughness", dict, where, {}) for where, material in materials)
    return any("metallicRoughnessTexture" in pbr for pbr in factors)


class _Primitive:
    """Reading one primitive; arrays are float64, ``(N, C)``."""

    def __init__(self, document: Document, primitive: dict, field: str):
        self.document, self.primitive, self.field = document, primitive, field
        self.attributes = document.get(primitive, "attributes", dict, field)
        if "POSITION" not in self.attributes:
            document.fail(f"{field}.attributes", "expected POSITION", sorted(self.attributes))
        if DRACO in document.extensions(primitive, field, DRACO):  # attributes with data are its fallback
            position = document.item("accessors", self.attributes["POSITION"], f"{field}.attributes.POSITION")
            if "bufferView" not in position:
                document.fail(f"{field}.extensions", "expected uncompressed data", DRACO, "export without compression")
        self.count: int | None = None
        self.position = present("POSITION", self.read("POSITION", "VEC3"))
        self.count = len(self.position)

    def read(self, name: str, *kinds: str, of: dict | None = None) -> np.ndarray | None:
        """Values of an attribute, or None where the primitive has none; ``of``: of a morph target instead."""
        attributes = self.attributes if of is None else of
        if name not in attributes:
            return None
        field = f"{self.field}.attributes.{name}"
        values = self.document.accessor(attributes[name], field, kinds)
        if values.dtype.kind == "u" and name.startswith(("COLOR", "WEIGHTS")):
            self.document.fail(field, "expected floats or normalized integers", values.dtype.name)
        if values.dtype.kind != "u" and name.startswith("JOINTS"):
            self.document.fail(field, "expected unsigned integers", values.dtype.name)
        if self.count not in (None, len(values)):
            self.document.fail(field, f"expected {self.count} elements", len(values))
        return values.astype(np.float64)

    def asset(self, placed: Placed, materials: Materials) -> Asset | None:
        document, field = self.document, self.field
        faces = document.triangles(self.primitive, len(self.position), field)
        if faces is None or len(faces) == 0:
            return None
        textures, uv = materials.textures(
            self.primitive.get("material"), f"{field}.material", lambda n: self.read(f"TEXCOORD_{n}", "VEC2")
        )
        if uv is None:
            uv = np.full((len(self.position), 2), 0.5)
        colors = self.read("COLOR_0", "VEC3", "VEC4")
        if "COLOR_1" in self.attributes:
            document.leave_out("COLOR_1")
        position, normal, tangent = self._morphed(placed.weights)
        linear, offset = self._transforms(placed)
        mirrored = np.linalg.det(linear).mean() < 0
        if mirrored:  # a mirror turns the faces inside out
            faces = faces[:, [0, 2, 1]]
        position = (linear @ position[..., None])[..., 0] + offset
        if normal is None:
            tangent = None
            position, uv = position[faces.ravel()], uv[faces.ravel()]
            colors = None if colors is None else colors[faces.ravel()]
            faces = np.arange(len(position), dtype=np.int32).reshape(-1, 3)
            normal = np.repeat(np.cross(position[1::3] - position[::3], position[2::3] - position[::3]), 3, axis=0)
        else:
            normal = (_cofactors(linear) @ normal[..., None])[..., 0] * (-1.0 if mirrored else 1.0)
        vertices, normals, coordinates = _tensor(position), _tensor(_unit(normal)), _tensor(uv)
        mesh = Mesh(vertices, torch.from_numpy(np.ascontiguousarray(faces)), normals, coordinates)
        if not all(bool(torch.isfinite(t).all()) for t in (vertices, coordinates)):
            document.fail(f"{field}.attributes", "expected values within the range of float32", "an overflow")
        if colors is not None:
            factors = _tensor(np.maximum(colors[:, :3], 0.0))
            if bool((factors == factors[0]).all()):  # one color: part of the texture
                textures = replace(textures, base_color=(textures.base_color * factors[0]).clamp(0.0, 1.0))
            else:
                mesh = replace(mesh, colors=factors)
        if tangent is None or not (np.linalg.norm(tangent[:, :3], axis=1) > 1e-6).all():
            return Asset(mesh.with_tangents(), textures)
        direction = (linear @ tangent[:, :3, None])[..., 0]
        n = normals.double().numpy()
        direction -= n * (n * direction).sum(1, keepdims=True)
        if not (np.linalg.norm(direction, axis=1) > 1e-9 * max(float(np.abs(linear).max()), 1e-300)).all():
            return Asset(mesh.with_tangents(), textures)
        sign = np.where((tangent[:, 3:] < 0) != mirrored, -1.0, 1.0)
        return Asset(replace(mesh, tangents=_tensor(np.concatenate([_unit(direction), sign], 1))), textures)

    def _morphed(self, weights: list[float]) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Position, normal and tangent with the morph targets at their default weights."""
        position, normal, tangent = self.position, self.read("NORMAL", "VEC3"), self.read("TANGENT", "VEC4")
        targets = self.document.get(self.primitive, "targets", list, self.field, [])
        for target, weight in zip(targets, weights):
            if weight == 0.0:
                continue
            if not isinstance(target, dict):
                self.document.fail(f"{self.field}.targets", "expected objects", target)
            moved, turned, along = (self.read(name, "VEC3", of=target) for name in ("POSITION", "NORMAL", "TANGENT"))
            position = position if moved is None else position + weight * moved
            normal = normal if normal is None or turned is None else normal + weight * turned
            if tangent is not None and along is not None:
                tangent = tangent + weight * np.pad(along, ((0, 0), (0, 1)))
        return position, normal, tangent

    def _transforms(self, placed: Placed) -> tuple[np.ndarray, np.ndarray]:
        """Linear parts and offsets for the vertices: ``(N, 3, 3)`` and ``(N, 3)`` of a skin, one row of a node."""
        if placed.joints is None:
            return placed.world[None, :3, :3], placed.world[None, :3, 3]
        total, sums = np.zeros((len(self.position), 4, 4)), np.zeros(len(self.position))
        for k in range(len(self.attributes)):  # sets of four joints
            joints, weights = self.read(f"JOINTS_{k}", "VEC4"), self.read(f"WEIGHTS_{k}", "VEC4")
            if joints is None or weights is None:
                if k == 0:
                    self.document.fail(f"{self.field}.attributes", "expected JOINTS_0, WEIGHTS_0", [*self.attributes])
                break
            if len(joints) and joints.max() >= len(placed.joints):
                expected = f"expected joints below {len(placed.joints)}"
                self.document.fail(f"{self.field}.attributes.JOINTS_{k}", expected, int(joints.max()))
            for joint, weight in zip(joints.T.astype(np.int64), weights.T, strict=True):
                total += weight[:, None, None] * placed.joints[joint]
                sums += weight
        if len(sums) and sums.min() <= 0.0:
            self.document.fail(f"{self.field}.attributes.WEIGHTS_0", "expected a positive sum", float(sums.min()))
        total /= sums[:, None, None]  # the specification: they are meant to sum to 1
        return total[:, :3, :3], total[:, :3, 3]


def _cofactors(linear: np.ndarray) -> np.ndarray:
    """Matrices ``(N, 3, 3)`` that take normals as ``linear`` takes points: determinant times inverse transpose."""
    scaled = linear / np.maximum(np.abs(linear).max((1, 2), keepdims=True), 1e-300)  # the length does not matter
    a, b, c = scaled[:, 0], scaled[:, 1], scaled[:, 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1)


def _unit(v: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=1, keepdims=True)
    return np.where(length > 1e-30, v / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])


def _tensor(values: np.ndarray) -> Tensor:
    with np.errstate(over="ignore"):  # an infinity is reported by the caller
        values = values.astype(np.float32)
    return torch.from_numpy(np.ascontiguousarray(values))
