"""Reads GLB: the container, accessors, nodes and skins of any glTF 2.0 file, checked before use.

Nothing outside the file is opened (data URIs only).  Sizes are checked before memory is allocated.  Every fault is an
InputError that names the field; every omission is a note.  Primitives are read in ``gltf_parts.py``, materials in
``gltf_materials.py``.  Source: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

import base64
import json
import math
import os
import struct
import sys
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from reli3d.errors import InputError, printable, shown
from reli3d.io.files import read_bytes

DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
SHAPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
SUPPORTED = {
    "EXT_texture_webp",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
}
MATERIALS = "anisotropy clearcoat diffuse_transmission dispersion emissive_strength ior iridescence sheen specular"
LEFT_OUT = {  # which core glTF approximates, or which have no part in a surface at rest
    *(f"KHR_materials_{name}" for name in (*MATERIALS.split(), "transmission", "unlit", "variants", "volume")),
    "KHR_animation_pointer",
    "KHR_lights_punctual",
    "KHR_xmp_json_ld",
}
EMPTY = 1 << 20  # values of an accessor without a buffer view: all zero, and not limited by the file's size
DEPTH = 256  # of the node tree
TRIANGLES, STRIP, FAN = 4, 5, 6
_KINDS: dict[type, str] = {list: "a list", dict: "an object", str: "a string"}


@dataclass(frozen=True)
class Placed:
    """A mesh of the scene: its JSON, name, node transform (4, 4), joint matrices (J, 4, 4) and morph weights."""

    mesh: dict
    name: str
    world: np.ndarray
    joints: np.ndarray | None
    weights: list[float]


class Document:
    """A parsed GLB: typed access to its JSON and its accessors.  notes: omissions, one line each."""

    def __init__(self, path: str | os.PathLike, *, max_bytes: int = 1 << 29, max_vertices: int = 20_000_000):
        self.path, self.max_bytes, self.max_vertices = path, max_bytes, max_vertices
        self.taken = 0  # accessor elements read so far, over all meshes
        self.notes: list[str] = []
        self.json, self.binary = self._container(read_bytes(path, max_bytes))
        version = self.get(self.get(self.json, "asset", dict, ""), "version", str, "asset")
        if not version.startswith("2."):
            self.fail("asset.version", "expected 2.x", version, "export as glTF 2.0")
        needed = self.get(self.json, "extensionsRequired", list, "", [])
        if not all(isinstance(name, str) for name in needed):
            self.fail("extensionsRequired", "expected names", needed)
        if unknown := sorted(set(needed) - SUPPORTED - LEFT_OUT):
            expected, fix = "expected none that must be decoded", "export without compression or extensions"
            self.fail("extensionsRequired", expected, unknown, fix)
        for name in sorted(set(needed) & LEFT_OUT):
            self.leave_out(name)
        if self.json.get("animations"):
            self.leave_out("animation")
        self._buffers: dict[int, bytes] = {}

    def note(self, text: str) -> None:
        """Appends a note on the file, once."""
        line = f"{printable(os.path.basename(self.path))}: {printable(text)}"
        if line not in self.notes:
            self.notes.append(line)

    def leave_out(self, what: str) -> None:
        """Adds a note that ``what`` is not in the result."""
        self.note(f"{what[:80]} is left out")

    def extensions(self, node: dict, field: str, *quiet: str) -> dict:
        """Extensions of ``node``; ignored ones (neither supported nor in ``quiet``) are reported in a note."""
        found = self.get(node, "extensions", dict, field, {})
        for name in found:
            if name not in SUPPORTED and name not in quiet:
                self.leave_out(name)
        return found

    def fail(self, field: str, expected: str, got: object, fix: str = "export the file again") -> NoReturn:
        raise InputError(self.path, f"{field}: {expected}, got {shown(got)}; {fix}")

    def get(self, node: dict, key: str, kind: type, where: str, default=None):
        """``node[key]`` of type ``kind``, or ``default`` if not None; where: place of ``node``, empty for the root."""
        return self._typed(node.get(key, default), kind, f"{where}.{key}" if where else key)

    def _typed(self, value, kind: type, field: str):
        """``value`` if it is of type ``kind``: an int is a float too, a bool is neither."""
        if kind is float and type(value) is int and abs(value) <= sys.float_info.max:
            value = float(value)
        if not isinstance(value, kind) or isinstance(value, bool) != (kind is bool):
            self.fail(field, f"expected {_KINDS.get(kind, kind.__name__)}", value)
        if isinstance(value, float) and not math.isfinite(value):
            self.fail(field, "expected a finite number", value)
        return value

    def item(self, kind: str, index: object, field: str) -> dict:
        """Element ``index`` of the top-level list ``kind``; ``field``: where it is referenced, for error messages."""
        items = self.get(self.json, kind, list, "", [])
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(items):
            self.fail(field, f"expected an index into {len(items)} {kind}", index)
        if not isinstance(items[index], dict):
            self.fail(f"{kind}[{index}]", "expected an object", items[index])
        return items[index]

    def numbers(self, node: dict, key: str, count: int, where: str, default: list) -> list[float]:
        """``count`` finite numbers of ``node[key]``."""
        values = self.get(node, key, list, where, default)
        if len(values) != count:
            self.fail(f"{where}.{key}", f"expected {count} numbers", values)
        return [self._typed(value, float, f"{where}.{key}") for value in values]

    def _container(self, data: bytes) -> tuple[dict, bytes | None]:
        if len(data) < 20 or data[:4] != b"glTF":
            raise InputError(self.path, "expected a binary glTF (.glb), got something else; export as GLB")
        _, version, length = struct.unpack("<4sII", data[:12])
        if version != 2:
            self.fail("header.version", "expected 2", version, "export as glTF 2.0")
        if length > len(data):
            self.fail("header.length", f"expected at most {len(data)}, the file's size", length, "the file is cut off")
        chunks: dict[bytes, bytes] = {}
        at = 12
        while at + 8 <= length:
            size, kind = struct.unpack("<I4s", data[at : at + 8])
            if at + 8 + size > length:
                self.fail("chunk.length", f"expected at most {length - at - 8}", size, "the file is cut off")
            chunks.setdefault(kind, data[at + 8 : at + 8 + size])
            at += 8 + size
        if b"JSON" not in chunks:
            self.fail("chunks", "expected a JSON chunk", [str(k) for k in chunks])
        try:
            document = json.loads(chunks[b"JSON"].decode("utf-8"), parse_constant=_no_number)
        except (ValueError, RecursionError) as error:
            self.fail("JSON", "expected valid JSON", str(error))
        return self._typed(document, dict, "JSON"), chunks.get(b"BIN\0")

    def data_uri(self, node: dict, where: str) -> bytes:
        """Bytes of the ``data:`` URI of ``node``; any other URI is an error."""
        uri = self.get(node, "uri", str, where)
        head, comma, body = uri.partition(",")
        if not head.startswith("data:") or not comma or not head.endswith(";base64"):
            self.fail(f"{where}.uri", "expected data inside the file", uri, "export as one GLB with all embedded")
        try:
            return base64.b64decode(body, validate=True)
        except ValueError:
            self.fail(f"{where}.uri", "expected base64", uri)

    def view(self, index: object, field: str) -> tuple[memoryview, int]:
        """Bytes of a buffer view, and its stride (0: packed)."""
        view = self.item("bufferViews", index, field)
        where = f"bufferViews[{index}]"
        number = self.get(view, "buffer", int, where)
        if number not in self._buffers:
            buffer = self.item("buffers", number, f"{where}.buffer")
            if "uri" in buffer:
                self._buffers[number] = self.data_uri(buffer, f"buffers[{number}]")
            elif number == 0 and self.binary is not None:
                self._buffers[number] = self.binary
            else:
                self.fail(f"buffers[{number}]", "expected data inside the file", "none")
        data = self._buffers[number]
        offset = self.get(view, "byteOffset", int, where, 0)
        length = self.get(view, "byteLength", int, where)
        stride = self.get(view, "byteStride", int, where, 0)
        if offset < 0 or length < 0 or offset + length > len(data):
            self.fail(f"{where}.byteLength", f"expected a range within {len(data)} bytes", [offset, length])
        if not 0 <= stride <= 252:
            self.fail(f"{where}.byteStride", "expected at most 252", stride)
        return memoryview(data)[offset : offset + length], stride

    def accessor(self, index: object, field: str, kinds: tuple[str, ...]) -> np.ndarray:
        """``(N, C)`` values; normalized integers and floats as float32 (finite), indices as stored."""
        entry = self.item("accessors", index, field)
        where = f"accessors[{index}]"
        kind = self.get(entry, "type", str, where)
        if kind not in kinds:
            self.fail(f"{where}.type", f"expected {' or '.join(kinds)} for {field}", kind)
        code = self.get(entry, "componentType", int, where)
        if code not in DTYPES:
            self.fail(f"{where}.componentType", f"expected one of {sorted(DTYPES)}", code)
        count = self.get(entry, "count", int, where)
        self.taken += max(count, 0)
        if count < 0 or self.taken > 8 * self.max_vertices:
            self.fail(f"{where}.count", f"expected at most {self.max_vertices} vertices", count, "simplify the mesh")
        dtype, width = np.dtype(DTYPES[code]), SHAPES[kind]
        if "bufferView" in entry:
            values = self._rows(entry, count, dtype, width, where)
        elif count > EMPTY:
            self.fail(f"{where}.count", f"expected at most {EMPTY} values without data", count)
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in entry:
            values = self._replaced(values, self.get(entry, "sparse", dict, where), f"{where}.sparse")
        if code == 5126:
            if not np.isfinite(values).all():
                self.fail(where, "expected finite values", "NaN or infinity")
            return values.astype(np.float32)
        if self.get(entry, "normalized", bool, where, False):
            return np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1.0)
        return values

    def _rows(self, entry: dict, count: int, dtype: np.dtype, width: int, where: str) -> np.ndarray:
        """``(count, width)`` values of the buffer view and offset that ``entry`` names."""
        data, stride = self.view(entry.get("bufferView"), f"{where}.bufferView")
        offset = self.get(entry, "byteOffset", int, where, 0)
        item = dtype.itemsize * width
        stride = stride or item
        if offset < 0 or stride < item or (count and offset + (count - 1) * stride + item > len(data)):
            self.fail(f"{where}.count", f"expected a range within {len(data)} bytes of its buffer view", count)
        if count == 0:
            return np.zeros((0, width), dtype)
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize)).copy()

    def _replaced(self, values: np.ndarray, sparse: dict, where: str) -> np.ndarray:
        """``values`` with the rows of a sparse accessor in place of some."""
        count = self.get(sparse, "count", int, where)
        if not 0 <= count <= len(values):
            self.fail(f"{where}.count", f"expected at most {len(values)}", count)
        indices = self.get(sparse, "indices", dict, where)
        code = self.get(indices, "componentType", int, f"{where}.indices")
        if code not in (5121, 5123, 5125):
            self.fail(f"{where}.indices.componentType", "expected an unsigned integer", code)
        index = self._rows(indices, count, np.dtype(DTYPES[code]), 1, f"{where}.indices")[:, 0]
        if count and int(index.max()) >= len(values):
            self.fail(f"{where}.indices", f"expected indices below {len(values)}", int(index.max()))
        rows = self.get(sparse, "values", dict, where)
        values[index] = self._rows(rows, count, values.dtype, values.shape[1], f"{where}.values")
        return values

    def triangles(self, primitive: dict, vertices: int, field: str) -> np.ndarray | None:
        """Faces ``(F, 3)`` int32 of a primitive, None for points and lines."""
        mode = self.get(primitive, "mode", int, field, TRIANGLES)
        if mode not in (TRIANGLES, STRIP, FAN):
            self.leave_out("what consists of points or lines")
            return None
        if "indices" in primitive:
            index = self.accessor(primitive["indices"], f"{field}.indices", ("SCALAR",))[:, 0]
            if index.dtype.kind != "u":
                self.fail(f"{field}.indices", "expected unsigned integers", index.dtype.name)
            if len(index) and int(index.max()) >= vertices:
                self.fail(f"{field}.indices", f"expected indices below {vertices}", int(index.max()))
        else:
            index = np.arange(vertices)
        index = index.astype(np.int32)
        if mode == TRIANGLES:
            return index[: len(index) // 3 * 3].reshape(-1, 3)
        k = np.arange(len(index) - 2)
        if mode == FAN:
            return np.stack([index[k + 1], index[k + 2], index[0 * k]], 1)
        return np.stack([index[k], index[k + 1 + k % 2], index[k + 2 - k % 2]], 1)

    def placed_meshes(self, origin: list[float] | None = None) -> list[Placed]:
        """The meshes of all visible nodes; origin: receives the position of the first, which is subtracted from all."""
        scenes = self.get(self.json, "scenes", list, "", [])
        nodes = self.get(self.json, "nodes", list, "", [])
        if scenes:
            number = self.get(self.json, "scene", int, "", 0)
            roots = self.get(self.item("scenes", number, "scene"), "nodes", list, f"scenes[{number}]", [])
        else:
            every = [self.item("nodes", k, "nodes") for k in range(len(nodes))]
            lists = [self.get(node, "children", list, f"nodes[{k}]", []) for k, node in enumerate(every)]
            children = {c for items in lists for c in items if isinstance(c, int)}
            roots = [k for k in range(len(nodes)) if k not in children]
        stack = [(r, np.eye(4), 0, False) for r in reversed(roots)]
        worlds: dict[int, np.ndarray] = {}
        found = []
        while stack:
            number, parent, depth, hidden = stack.pop()
            node = self.item("nodes", number, "children")
            if number in worlds or depth > DEPTH:
                self.fail(f"nodes[{number}]", "expected a tree", "a node with two parents or a cycle")
            world = parent @ self._local(node, f"nodes[{number}]")
            if not np.isfinite(world).all():
                self.fail(f"nodes[{number}]", "expected a finite transform", "an overflow")
            worlds[number] = world
            where, extensions = f"nodes[{number}].extensions", self.extensions(node, f"nodes[{number}]")
            visibility = self.get(extensions, "KHR_node_visibility", dict, where, {})
            hidden = hidden or not self.get(visibility, "visible", bool, where, True)
            if "mesh" in node and not hidden:
                found.append(number)
            children = self.get(node, "children", list, f"nodes[{number}]", [])
            stack += [(c, world, depth + 1, hidden) for c in reversed(children)]
        if origin is not None and found:
            origin[:] = worlds[found[0]][:3, 3].tolist()
            for world in worlds.values():
                world[:3, 3] -= origin
        return [self._placed(number, worlds) for number in found]

    def _placed(self, number: int, worlds: dict[int, np.ndarray]) -> Placed:
        node, field = self.item("nodes", number, "nodes"), f"nodes[{number}]"
        mesh = self.item("meshes", node["mesh"], f"{field}.mesh")
        name = f"meshes[{node['mesh']}]"
        owner, where = (node, field) if "weights" in node else (mesh, name)
        weights = self.get(owner, "weights", list, where, [])
        weights = self.numbers(owner, "weights", len(weights), where, [])
        joints = self._joints(node["skin"], worlds, f"{field}.skin") if "skin" in node else None
        return Placed(mesh, name, worlds[number], joints, weights)

    def _joints(self, index: object, worlds: dict[int, np.ndarray], field: str) -> np.ndarray:
        """Joint matrices ``(J, 4, 4)`` of a skin at rest: the joint's transform times its inverse bind matrix."""
        skin, where = self.item("skins", index, field), f"skins[{index}]"
        numbers = self.get(skin, "joints", list, where)
        if not numbers or not all(isinstance(n, int) and n in worlds for n in numbers):
            self.fail(f"{where}.joints", "expected nodes of the scene", numbers)
        joints = np.stack([worlds[n] for n in numbers])
        if "inverseBindMatrices" in skin:
            binds = self.accessor(skin["inverseBindMatrices"], f"{where}.inverseBindMatrices", ("MAT4",))
            if len(binds) < len(joints):
                self.fail(f"{where}.inverseBindMatrices", f"expected {len(joints)} matrices", len(binds))
            joints = joints @ binds[: len(joints)].astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
        return joints

    def _local(self, node: dict, field: str) -> np.ndarray:
        if "matrix" in node:
            return np.array(self.numbers(node, "matrix", 16, field, [])).reshape(4, 4).T
        x, y, z, w = self.numbers(node, "rotation", 4, field, [0, 0, 0, 1])
        if not 0.9 < math.sqrt(x * x + y * y + z * z + w * w) < 1.1:
            self.fail(f"{field}.rotation", "expected a unit quaternion", [x, y, z, w])
        local = np.eye(4)
        local[:3, :3] = rotation_of(w, x, y, z)
        local[:3, :3] *= self.numbers(node, "scale", 3, field, [1, 1, 1])
        local[:3, 3] = self.numbers(node, "translation", 3, field, [0, 0, 0])
        return local


def _no_number(text: str):
    raise ValueError(f"number {text}")


def rotation_of(w: float, x: float, y: float, z: float) -> np.ndarray:
    """``(3, 3)`` rotation of a quaternion of any length but 0."""
    w, x, y, z = np.array([w, x, y, z]) / math.sqrt(w * w + x * x + y * y + z * z)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross)
