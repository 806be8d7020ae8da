"""Random changes of files that know the format: a hostile value in a field, with lengths and checksums made right."""

import json
import math
import struct
import zlib
from collections.abc import Callable
from random import Random

VALUES = [0, -1, 1, 2, 0.5, -0.0, 1e308, -1e308, 5e-324, 1e-44, 1e30, 1e5]
VALUES += [2**31 - 1, 2**31, 2**32, 2**63, -(2**63), 10**400, math.nan, math.inf, -math.inf, None, True, False]
VALUES += ["", " ", "\0", "\ud800", "x" * 300, "y" * 5000]
VALUES += ["../../../etc/passwd", "/dev/zero", "file:///etc/passwd", "data:,", "rgba/1.png"]
VALUES += [[], {}, [[]], [None], [0] * 5000, {"": {}}]
INTEGERS = [0, 1, 2, 3, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1]
LONGEST = 1 << 22  # bytes of a file that edits may reach


def damaged(data: bytes, rng: Random) -> bytes:
    """Bytes changed, cut, put in, doubled; integers of two and four bytes at their ends."""
    if not data:
        return bytes(rng.randrange(256) for _ in range(rng.randrange(64)))
    at = rng.randrange(len(data))
    some = slice(at, at + rng.choice((1, 2, 4, 16, 256, len(data))))
    kind = rng.randrange(7)
    if kind == 0:
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if kind == 1:
        return data[:at] + data[some.stop :]
    if kind == 2:
        return data[:at] + bytes(rng.randrange(256) for _ in range(rng.choice((1, 4, 64)))) + data[at:]
    if kind == 3:
        return data[:at]
    if kind == 4:
        times = min(rng.choice((2, 3, 1000)), LONGEST // len(data[some]) + 1)  # no more than is kept
        return (data[:at] + data[some] * times + data[some.stop :])[:LONGEST]
    form = rng.choice("<>") + rng.choice("HI")
    value = struct.pack(form, rng.choice(INTEGERS) % (1 << 8 * struct.calcsize(form)))
    return data[:at] + value + data[at + len(value) :]


def structure(value: object, rng: Random) -> object:
    """A JSON value with one place in it changed: another value, gone, doubled, exchanged, wrapped, or scaled."""
    places = []

    def walk(node) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], dict | list):
                walk(node[key])

    if not isinstance(value, dict | list) or not value:
        return rng.choice(VALUES)
    walk(value)
    node, key = rng.choice(places)
    kind = rng.randrange(8)
    if kind == 0:
        del node[key]
    elif kind == 1 and isinstance(node, list):
        node.extend(node[:] * rng.choice((1, 40)))
    elif kind == 2:
        other, there = rng.choice(places)
        node[key], other[there] = other[there], node[key]
        if _endless(value):
            other[there] = None
            node[key] = None
    elif kind == 3:
        node[key] = [node[key]]
    elif kind == 4 and isinstance(node[key], int | float):
        node[key] = node[key] * rng.choice((-1, 2, 0.001, 1e3, 1e-44, 1e40))
    else:
        node[key] = rng.choice(VALUES)
    return value


def _endless(value: object) -> bool:
    try:
        json.dumps(value)
    except (ValueError, RecursionError):
        return True
    return False


def rig(data: dict, rng: Random) -> dict:
    """All cameras of a ``transforms.json`` moved, scaled, turned or put in one point together."""
    matrices = [f["transform_matrix"] for f in data["frames"]]
    kind = rng.randrange(8)
    factor, shift = 10.0 ** rng.uniform(-50, 7), [rng.choice((0, 1)) * 10.0 ** rng.uniform(-3, 6.2) for _ in range(3)]
    for m in matrices:
        for row in range(3):
            if kind == 0:
                m[row][3] *= factor
            elif kind == 1:
                m[row][3] += shift[row]
            elif kind == 2:
                m[row][3] = matrices[0][row][3]
            elif kind == 3:
                m[row][1], m[row][2] = -m[row][1], -m[row][2]
            elif kind == 4:
                m[row][3] = m[row][3] * factor + shift[row]
            elif kind == 5:
                m[row] = list(matrices[0][row])
            elif kind == 6:
                m[row][3] = -m[row][3]
    if kind == 7:
        for f in data["frames"]:
            f["camera_fov"] = [10.0 ** rng.uniform(-6, 0.49)] * 2
    return data


def _json(data: bytes, rng: Random) -> bytes:
    value = json.loads(data)
    change = rig if "frames" in value and rng.random() < 0.3 else structure
    return json.dumps(change(value, rng)).encode("utf-8", "surrogatepass")


def _png(data: bytes, rng: Random) -> bytes:
    """Chunks changed, dropped, doubled and exchanged, with right checksums."""
    chunks, at = [], 8
    while at + 8 <= len(data):
        size = struct.unpack(">I", data[at : at + 4])[0]
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    k, kind = rng.randrange(len(chunks)), rng.randrange(6)
    if kind == 0:
        del chunks[k]
    elif kind == 1:
        chunks[k:k] = [chunks[k]] * rng.choice((1, 500))
    elif kind == 2:
        j = rng.randrange(len(chunks))
        chunks[k], chunks[j] = chunks[j], chunks[k]
    elif kind == 3:
        chunks[k] = rng.choice((b"tRNS", b"PLTE", b"acTL", b"iCCP", b"zTXt", b"eXIf", b"gAMA")), chunks[k][1]
    else:
        chunks[k] = chunks[k][0], damaged(chunks[k][1], rng)
    parts = [struct.pack(">I", len(d)) + t + d + struct.pack(">I", zlib.crc32(t + d)) for t, d in chunks]
    return data[:8] + b"".join(parts)


def _glb(data: bytes, rng: Random) -> bytes:
    """The JSON chunk changed, or the binary one, with right lengths."""
    size = struct.unpack("<I", data[12:16])[0]
    text, rest = data[20 : 20 + size], data[20 + size :]
    if rng.random() < 0.8:
        text = json.dumps(structure(json.loads(text), rng)).encode("utf-8", "surrogatepass")
        text += b" " * (-len(text) % 4)
    else:
        rest = rest[:8] + damaged(rest[8:], rng)
        rest = struct.pack("<I", len(rest) - 8) + rest[4:]
    return struct.pack("<4sIII", b"glTF", 2, 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest


def _safetensors(data: bytes, rng: Random) -> bytes:
    size = struct.unpack("<Q", data[:8])[0]
    text = json.dumps(structure(json.loads(data[8 : 8 + size]), rng)).encode("utf-8", "surrogatepass")
    return struct.pack("<Q", len(text)) + text + data[8 + size :]


def _txt(data: bytes, rng: Random) -> bytes:
    """A word or a line of a text file changed."""
    lines = [line.split(" ") for line in data.decode().split("\n")]
    k, kind = rng.randrange(len(lines)), rng.randrange(4)
    if kind == 0:
        del lines[k]
    elif kind == 1:
        lines[k:k] = [lines[k]] * rng.choice((1, 3000))
    else:
        lines[k][rng.randrange(len(lines[k]))] = str(rng.choice(VALUES))
    return "\n".join(map(" ".join, lines)).encode("utf-8", "surrogatepass")


AWARE: dict[str, Callable[[bytes, Random], bytes]] = {
    "json": _json,
    "png": _png,
    "glb": _glb,
    "safetensors": _safetensors,
    "txt": _txt,
}


def edited(files: dict[str, bytes], seed: int) -> dict[str, bytes]:
    """``files`` of a folder by name, with one change that ``seed`` draws."""
    rng = Random(seed)
    name = rng.choice(sorted(files))
    change = AWARE.get(name.rsplit(".", 1)[-1], damaged) if rng.random() < 0.75 else damaged
    try:
        content = change(files[name], rng)
    except (ValueError, LookupError, TypeError, AttributeError, struct.error, OverflowError, RecursionError):
        content = damaged(files[name], rng)  # what another change has broken
    return {**files, name: content}
