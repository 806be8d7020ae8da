"""GLB in: the container, accessors and nodes of any glTF 2.0 file, checked before use.

Nothing outside the file is opened (data URIs only).  Sizes are limited before memory is taken.  Every fault is an
InputError that names the field.  Primitives and materials are read in ``gltf_parts.py``.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import os
import struct
from typing import NoReturn

import numpy as np

from reli3d.io.files import InputError, read_bytes, shown

DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
SHAPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
EXTENSIONS = {"EXT_texture_webp", "KHR_materials_unlit", "KHR_mesh_quantization", "KHR_lights_punctual"}  # readable
EMPTY = 1 << 20  # values of an accessor without a buffer view: all zero, and not limited by the file's size
DEPTH = 256  # of the node tree
TRIANGLES, STRIP, FAN = 4, 5, 6
_KINDS: dict[type, str] = {list: "a list", dict: "an object", str: "a string"}


class Document:
    """A parsed GLB: typed access to its JSON and its accessors.

    Every getter raises InputError with the place in the file for a wrong type, index or range.
    """

    def __init__(self, path: str | os.PathLike, *, max_bytes: int, max_vertices: int):
        self.path, self.max_bytes, self.max_vertices = path, max_bytes, max_vertices
        self.taken = 0  # accessor elements read so far, over all meshes
        self.json, self.binary = self._container(read_bytes(path, max_bytes))
        version = self.get(self.get(self.json, "asset", dict, "asset"), "version", str, "asset.version")
        if not version.startswith("2."):
            self.fail("asset.version", "expected 2.x", version, "export as glTF 2.0")
        needed = self.get(self.json, "extensionsRequired", list, "extensionsRequired", [])
        if not all(isinstance(name, str) for name in needed):
            self.fail("extensionsRequired", "expected names", needed)
        needed = set(needed)
        if not needed <= EXTENSIONS:
            self.fail(
                "extensionsRequired",
                "expected none that must be decoded",
                sorted(needed - EXTENSIONS),
                "export without compression or extensions",
            )
        self._buffers: dict[int, bytes] = {}

    def fail(self, field: str, expected: str, got: object, fix: str = "export the file again") -> NoReturn:
        """Raise the InputError of ``field``."""
        raise InputError(self.path, f"{field}: {expected}, got {shown(got)}; {fix}")

    def get(self, node: dict, key: str, kind: type, field: str, default=None):
        """``node[key]`` of the given kind (an int is a float too, a bool is neither), or ``default`` if not None."""
        value = node.get(key, default)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            try:
                value = float(value)
            except OverflowError:
                self.fail(field, "expected a number", "an integer of hundreds of digits")
        if not isinstance(value, kind) or isinstance(value, bool) != (kind is bool):
            if value is None:
                self.fail(field, "expected a value", None)
            self.fail(field, f"expected {_KINDS.get(kind, kind.__name__)}", value)
        if isinstance(value, float) and not math.isfinite(value):
            self.fail(field, "expected a finite number", value)
        return value

    def item(self, kind: str, index: object, field: str) -> dict:
        """Element ``index`` of the top-level list ``kind``; ``field`` is what refers to it."""
        items = self.get(self.json, kind, list, kind, [])
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(items):
            self.fail(field, f"expected an index into {len(items)} {kind}", index)
        if not isinstance(items[index], dict):
            self.fail(f"{kind}[{index}]", "expected an object", items[index])
        return items[index]

    def numbers(self, node: dict, key: str, count: int, field: str, default: list) -> list[float]:
        """``count`` finite numbers."""
        values = self.get(node, key, list, field, default)
        if len(values) != count:
            self.fail(field, f"expected {count} numbers", values)
        return [self.get({"x": v}, "x", float, field) for v in values]

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

        def refuse(text):
            raise ValueError(f"number {text}")

        try:
            document = json.loads(chunks[b"JSON"].decode("utf-8"), parse_constant=refuse)
        except (ValueError, RecursionError) as error:
            self.fail("JSON", "expected valid JSON", str(error))
        if not isinstance(document, dict):
            self.fail("JSON", "expected an object", document)
        return document, chunks.get(b"BIN\0")

    def data_uri(self, uri: str, field: str) -> bytes:
        """Bytes of a ``data:`` URI; any other URI is refused."""
        head, comma, body = uri.partition(",")
        if not head.startswith("data:") or not comma or not head.endswith(";base64"):
            self.fail(field, "expected data inside the file", uri, "export as one GLB with everything embedded")
        try:
            return base64.b64decode(body, validate=True)
        except (binascii.Error, ValueError):
            self.fail(field, "expected base64", uri)

    def view(self, index: object, field: str) -> tuple[memoryview, int]:
        """Bytes of a buffer view, and its stride (0: packed)."""
        view = self.item("bufferViews", index, field)
        where = f"bufferViews[{index}]"
        number = self.get(view, "buffer", int, f"{where}.buffer")
        if number not in self._buffers:
            buffer = self.item("buffers", number, f"{where}.buffer")
            if "uri" in buffer:
                uri = self.get(buffer, "uri", str, f"buffers[{number}].uri")
                self._buffers[number] = self.data_uri(uri, f"buffers[{number}].uri")
            elif number == 0 and self.binary is not None:
                self._buffers[number] = self.binary
            else:
                self.fail(f"buffers[{number}]", "expected data inside the file", "none")
        data = self._buffers[number]
        offset = self.get(view, "byteOffset", int, f"{where}.byteOffset", 0)
        length = self.get(view, "byteLength", int, f"{where}.byteLength")
        stride = self.get(view, "byteStride", int, f"{where}.byteStride", 0)
        if offset < 0 or length < 0 or offset + length > len(data):
            self.fail(f"{where}.byteLength", f"expected a range within {len(data)} bytes", [offset, length])
        if not 0 <= stride <= 252:
            self.fail(f"{where}.byteStride", "expected at most 252", stride)
        return memoryview(data)[offset : offset + length], stride

    def accessor(self, index: object, field: str, kinds: tuple[str, ...]) -> np.ndarray:
        """``(N, C)`` values; normalised integers and floats as float32 (finite), indices as stored."""
        entry = self.item("accessors", index, field)
        where = f"accessors[{index}]"
        kind = self.get(entry, "type", str, f"{where}.type")
        if kind not in kinds:
            self.fail(f"{where}.type", f"expected {' or '.join(kinds)} for {field}", kind)
        code = self.get(entry, "componentType", int, f"{where}.componentType")
        if code not in DTYPES:
            self.fail(f"{where}.componentType", f"expected one of {sorted(DTYPES)}", code)
        count = self.get(entry, "count", int, f"{where}.count")
        self.taken += max(count, 0)
        if count < 0 or self.taken > 8 * self.max_vertices:
            self.fail(f"{where}.count", f"expected at most {self.max_vertices} vertices", count, "simplify the mesh")
        if "sparse" in entry:
            self.fail(f"{where}.sparse", "expected a dense accessor", "sparse", "export without sparse accessors")
        dtype, width = np.dtype(DTYPES[code]), SHAPES[kind]
        if "bufferView" not in entry:
            if count > EMPTY:
                self.fail(f"{where}.count", f"expected at most {EMPTY} values without data", count)
            return np.zeros((count, width), np.float32 if code == 5126 else dtype)
        data, stride = self.view(entry["bufferView"], f"{where}.bufferView")
        offset = self.get(entry, "byteOffset", int, f"{where}.byteOffset", 0)
        item = dtype.itemsize * width
        stride = stride or item
        if offset < 0 or stride < item or (count and offset + (count - 1) * stride + item > len(data)):
            self.fail(f"{where}.count", f"expected a range within {len(data)} bytes of its buffer view", count)
        if count == 0:
            return np.zeros((0, width), dtype)
        flat = np.frombuffer(data, np.uint8)
        rows = np.lib.stride_tricks.as_strided(flat[offset:], (count, item), (stride, 1), writeable=False)
        values = np.ascontiguousarray(rows).view(dtype).reshape(count, width)
        if code == 5126:
            if not np.isfinite(values).all():
                self.fail(where, "expected finite values", "NaN or infinity")
            return values.astype(np.float32)
        if self.get(entry, "normalized", bool, f"{where}.normalized", False):
            return np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1.0)
        return values

    def triangles(self, primitive: dict, vertices: int, field: str) -> np.ndarray | None:
        """Faces ``(F, 3)`` int32 of a primitive, None for points and lines."""
        mode = self.get(primitive, "mode", int, f"{field}.mode", TRIANGLES)
        if mode not in (TRIANGLES, STRIP, FAN):
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
        count = max(len(index) - 2, 0)
        k = np.arange(count)
        if mode == FAN:
            return np.stack([index[k + 1], index[k + 2], np.broadcast_to(index[:1], count)], 1).astype(np.int32)
        return np.stack([index[k], index[k + 1 + k % 2], index[k + 2 - k % 2]], 1)

    def placed_meshes(self) -> list[tuple[dict, np.ndarray, str]]:
        """``(mesh, world transform 4x4, name of the mesh)`` of every node of the scene that has a mesh."""
        scenes = self.get(self.json, "scenes", list, "scenes", [])
        nodes = self.get(self.json, "nodes", list, "nodes", [])
        if scenes:
            number = self.get(self.json, "scene", int, "scene", 0)
            roots = self.get(self.item("scenes", number, "scene"), "nodes", list, f"scenes[{number}].nodes", [])
        else:
            lists = [
                self.get(self.item("nodes", k, "nodes"), "children", list, f"nodes[{k}].children", [])
                for k in range(len(nodes))
            ]
            children = {c for items in lists for c in items if isinstance(c, int)}
            roots = [k for k in range(len(nodes)) if k not in children]
        stack = [(r, np.eye(4), 0) for r in reversed(roots)]
        seen: set[int] = set()
        found = []
        while stack:
            number, parent, depth = stack.pop()
            node = self.item("nodes", number, "children")
            if number in seen or depth > DEPTH:
                self.fail(f"nodes[{number}]", "expected a tree", "a node with two parents or a cycle")
            seen.add(number)
            world = parent @ self._local(node, f"nodes[{number}]")
            if not np.isfinite(world).all():
                self.fail(f"nodes[{number}]", "expected a finite transform", "an overflow")
            if "mesh" in node:
                mesh = self.item("meshes", node["mesh"], f"nodes[{number}].mesh")
                found.append((mesh, world, f"meshes[{node['mesh']}]"))
            children = self.get(node, "children", list, f"nodes[{number}].children", [])
            stack += [(c, world, depth + 1) for c in reversed(children)]
        return found

    def _local(self, node: dict, field: str) -> np.ndarray:
        if "matrix" in node:
            return np.array(self.numbers(node, "matrix", 16, f"{field}.matrix", [])).reshape(4, 4).T
        x, y, z, w = self.numbers(node, "rotation", 4, f"{field}.rotation", [0, 0, 0, 1])
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        if not 0.9 < norm < 1.1:
            self.fail(f"{field}.rotation", "expected a unit quaternion", [x, y, z, w])
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
        local = np.eye(4)
        local[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        local[:3, :3] *= self.numbers(node, "scale", 3, f"{field}.scale", [1, 1, 1])
        local[:3, 3] = self.numbers(node, "translation", 3, f"{field}.translation", [0, 0, 0])
        return local
