"""The header of an OpenEXR file, checked before the library allocates anything for it.

A file of 54 bytes can claim gigabytes.  Taken is what an environment map needs: one flat part, scanlines or one level
of tiles, a bounded number of samples, and a chunk table whose chunks lie inside the file.  Source: the OpenEXR file
layout, https://openexr.com/en/latest/OpenEXRFileLayout.html.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass

from reli3d.io.files import InputError, read_bytes, shown

MAX_BYTES = 1 << 29  # MAX_SAMPLES in float32, which ZIP never exceeds
MAX_SAMPLES = 1 << 27  # 8192 x 4096 with four channels
_ATTRIBUTES = 256  # a render with every metadata field has about 60
_BLOCK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}  # scanlines a chunk, by compression
_TYPES = {0: "uint", 1: "half", 2: "float"}


@dataclass(frozen=True)
class ExrHeader:
    width: int
    height: int
    channels: dict[str, str]  # name -> "half" or "float"


def read_exr_header(path: str | os.PathLike) -> ExrHeader:
    """Size and channels of the EXR file at ``path``.  Raises InputError unless it is safe to hand to OpenEXR."""
    data = read_bytes(path, MAX_BYTES)
    try:
        return _header(path, data)
    except (struct.error, IndexError, UnicodeDecodeError, KeyError):
        raise InputError(path, "EXR header: expected a complete one, got a broken one; save the file again") from None


def _header(path, data: bytes) -> ExrHeader:
    magic, version = struct.unpack_from("<II", data)
    if magic != 20000630:
        raise InputError(path, "expected an OpenEXR file, got something else; check the file")
    if version & 0xFF != 2 or version & ~(0xFF | 0x200 | 0x400 | 0x800 | 0x1000):
        raise InputError(path, f"EXR version: expected 2, got {version & 0xFF}; save as a plain scanline EXR")
    if version & 0x1800:
        raise InputError(path, "EXR kind: expected one flat image, got a deep or multi-part file; save as a plain EXR")
    attributes: dict[str, tuple[str, bytes]] = {}
    at = 8
    while data[at] != 0:
        name, at = _text(data, at)
        kind, at = _text(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        at += 4
        if size < 0 or at + size > len(data):
            raise InputError(path, f"EXR attribute {shown(name)}: expected a size in the file, got {size}; resave it")
        if kind == "idmanifest" or len(attributes) >= _ATTRIBUTES:
            raise InputError(path, f"EXR attribute {shown(name)}: expected a plain header; save without extra metadata")
        attributes[name] = (kind, data[at : at + size])
        at += size
    at += 1
    x0, y0, x1, y1 = struct.unpack("<4i", attributes["dataWindow"][1])
    width, height = x1 - x0 + 1, y1 - y0 + 1
    channels = _channels(path, attributes["channels"][1])
    if width < 1 or height < 1 or width * height * len(channels) > MAX_SAMPLES:
        raise InputError(
            path,
            f"EXR dataWindow: expected at most {MAX_SAMPLES} samples, got {width} x {height} x "
            f"{len(channels)}; scale the map down",
        )
    compression = attributes["compression"][1][0]
    if compression not in _BLOCK:
        raise InputError(path, f"EXR compression: expected a known kind, got {compression}; save with ZIP compression")
    if version & 0x200:
        tile_x, tile_y, mode = struct.unpack("<IIB", attributes["tiles"][1])
        if mode & 0xF != 0 or not (1 <= tile_x <= 8192 and 1 <= tile_y <= 8192):
            raise InputError(path, "EXR tiles: expected one level of tiles up to 8192; save as a plain scanline EXR")
        chunks, lead = -(-width // tile_x) * -(-height // tile_y), 20
    else:
        chunks, lead = -(-height // _BLOCK[compression]), 8
    if at + 8 * chunks > len(data):
        raise InputError(path, f"EXR chunk table: expected {chunks} chunks, got a shorter file; it is truncated")
    for offset in struct.unpack_from(f"<{chunks}Q", data, at):
        if offset < at or offset + lead > len(data):
            raise InputError(path, "EXR chunk table: expected offsets within the file; it is truncated")
        (size,) = struct.unpack_from("<i", data, offset + lead - 4)
        if size < 0 or offset + lead + size > len(data):
            raise InputError(path, "EXR chunk: expected its data within the file; it is truncated")
    return ExrHeader(width, height, channels)


def _channels(path, data: bytes) -> dict[str, str]:
    channels: dict[str, str] = {}
    at = 0
    while data[at] != 0:
        name, at = _text(data, at)
        kind, _, step_x, step_y = struct.unpack_from("<iIii", data, at)
        at += 16
        if kind not in _TYPES or (step_x, step_y) != (1, 1) or name in channels or len(channels) >= 32:
            raise InputError(path, f"EXR channel {shown(name)}: expected half or float, not subsampled; save as RGB")
        channels[name] = _TYPES[kind]
    if not channels:
        raise InputError(path, "EXR channels: expected R, G, B, got none; save as plain RGB")
    return channels


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.find(b"\0", at, at + 256)
    if end < 0:
        raise IndexError
    return data[at:end].decode("utf-8"), end + 1
