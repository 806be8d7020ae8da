"""GLB files by the standard alone: packed, taken apart, and built part by part."""

import io
import json
import struct

import numpy as np
from PIL import Image

CODES = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125, "i1": 5120, "i2": 5122}
DTYPES = {code: f"<{name}" for name, code in CODES.items()}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
KINDS = {width: kind for kind, width in WIDTHS.items()}


def packed(document: dict, binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def parsed(data: bytes) -> tuple[dict, bytes]:
    """The document and the binary chunk."""
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def view_of(document: dict, binary: bytes, index: int) -> bytes:
    """Content of a buffer view."""
    view = document["bufferViews"][index]
    return binary[view.get("byteOffset", 0) :][: view["byteLength"]]


def array_of(document: dict, binary: bytes, index: int) -> np.ndarray:
    """Values of an accessor whose rows follow each other, ``(count, width)``."""
    accessor = document["accessors"][index]
    data, width = view_of(document, binary, accessor["bufferView"]), WIDTHS[accessor["type"]]
    count, start = accessor["count"] * width, accessor.get("byteOffset", 0)
    return np.frombuffer(data, DTYPES[accessor["componentType"]], count, start).reshape(-1, width)


class Builder:
    """A document whose accessors and textures are added one by one."""

    def __init__(self) -> None:
        self.binary = b""
        self.document: dict = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
        self.document |= {name: [] for name in ("accessors", "bufferViews", "images", "samplers", "textures")}

    def view(self, data: bytes) -> int:
        self.document["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)})
        self.binary += data + bytes(-len(data) % 4)
        return len(self.document["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, **fields) -> int:
        """fields: set beside, or in place of, those of ``values``."""
        width = values.shape[1] if values.ndim == 2 else 1
        entry = {"bufferView": self.view(values.tobytes()), "componentType": CODES[values.dtype.str[1:]]}
        self.document["accessors"].append({**entry, "count": len(values), "type": KINDS[width], **fields})
        return len(self.document["accessors"]) - 1

    def texture(self, pixels: np.ndarray, **sampler) -> dict:
        """The texture info of a PNG."""
        data = io.BytesIO()
        Image.fromarray(pixels).save(data, "PNG")
        self.document["images"].append({"bufferView": self.view(data.getvalue()), "mimeType": "image/png"})
        self.document["samplers"].append(sampler)
        count = len(self.document["images"])
        self.document["textures"].append({"source": count - 1, "sampler": count - 1})
        return {"index": count - 1}

    def data(self) -> bytes:
        """The file; lists without entries are left out."""
        document = {k: v for k, v in self.document.items() if v != []}
        return packed({**document, "buffers": [{"byteLength": len(self.binary)}]}, self.binary)
