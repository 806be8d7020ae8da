"""Reads OpenEXR images with the OpenEXR package.

Supported: one flat part of scanlines or single-level tiles, with channels R, G, B, or Y as gray.  Deep, multi-part,
multi-level and luminance-chroma files are errors.  Source: https://openexr.com/en/latest/TechnicalIntroduction.html.
"""

import os
import struct

import numpy as np
import OpenEXR

from reli3d.errors import InputError, shown
from reli3d.io.files import read_bytes
from reli3d.render.color import rec709_from_primaries

MAX_BYTES = 1 << 29  # MAX_SAMPLES in float32, which ZIP never exceeds
MAX_SAMPLES = 1 << 27  # 8192 x 4096 with four channels
MAX_ATTRIBUTES = 256  # a rendering with every metadata field has about 60; OpenEXR takes quadratic time
MAX_CHANNEL_BYTES = 4096  # of the channel list: at least 100 channels; again quadratic time
_LINES = {  # scanlines in a chunk
    **dict.fromkeys((OpenEXR.NO_COMPRESSION, OpenEXR.RLE_COMPRESSION, OpenEXR.ZIPS_COMPRESSION), 1),
    **dict.fromkeys((OpenEXR.ZIP_COMPRESSION, OpenEXR.PXR24_COMPRESSION), 16),
    **dict.fromkeys((OpenEXR.PIZ_COMPRESSION, OpenEXR.B44_COMPRESSION, OpenEXR.B44A_COMPRESSION), 32),
    **{OpenEXR.DWAA_COMPRESSION: 32, OpenEXR.DWAB_COMPRESSION: 256},
}
_PRIMARIES = {  # of colorInteropID (Color Interop Forum) without chromaticities
    "lin_rec709_scene": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290),
    "lin_p3d65_scene": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290),
    "lin_rec2020_scene": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290),
    "lin_ap0_scene": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
    "lin_ap1_scene": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
}


def read_exr(path: str | os.PathLike, max_pixels: int, notes: list[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """Pixels ``(H, W, 3)`` float32 of the display window, and the 3x3 matrix from their primaries to Rec. 709, or None.

    Outside the data window the image is black; pixels outside the display window are cropped.  Both are appended to
    ``notes``.  Raises InputError.
    """
    header, names = _header(path, notes, max_pixels)
    try:
        with OpenEXR.File(os.fsencode(path), separate_channels=True) as file:
            planes = [np.asarray(file.channels()[n].pixels, dtype=np.float32) for n in names]
    except Exception as error:  # the binding raises RuntimeError, ValueError, TypeError ... for a broken file
        raise InputError(path, f"pixels: cannot be decoded ({shown(str(error))}); save the file again") from None
    (x0, y0), (x1, y1) = (w.tolist() for w in header["dataWindow"])
    if any(p.shape != (y1 - y0 + 1, x1 - x0 + 1) for p in planes):
        raise InputError(path, "pixels: expected the size of the header; save the file again")
    data = np.stack(planes * (3 // len(planes)), axis=-1)
    (left, top), (right, bottom) = (w.tolist() for w in header["displayWindow"])
    if (left, top, right, bottom) != (x0, y0, x1, y1):
        image = np.zeros((bottom - top + 1, right - left + 1, 3), np.float32)
        inside = image[max(y0 - top, 0) : max(y1 - top + 1, 0), max(x0 - left, 0) : max(x1 - left + 1, 0)]
        row, column = max(top - y0, 0), max(left - x0, 0)
        inside[:] = data[row : row + inside.shape[0], column : column + inside.shape[1]]
        data = image
        where = f"dataWindow ({x0}, {y0})..({x1}, {y1}) differs from displayWindow ({left}, {top})..({right}, {bottom})"
        notes.append(f"{os.path.basename(path)}: {where}: black where there are no data, cropped where there are more")
    return data, _matrix(path, header, notes)


def _header(path, notes: list[str], max_pixels: int) -> tuple[dict, list[str]]:
    """Header as OpenEXR reads it, and the channels to read.  Raises InputError unless decoding it is safe."""
    data = read_bytes(path, MAX_BYTES)
    table = _header_end(path, data)
    try:
        with OpenEXR.File(os.fsencode(path), separate_channels=True, header_only=True) as file:
            parts, header = len(file.parts), dict(file.header())  # the file empties its own
            channels = {c.name: (c.xSampling, c.ySampling) for c in header["channels"]}
    except Exception as error:
        raise InputError(path, f"EXR header: cannot be read ({shown(str(error))}); save the file again") from None
    if parts != 1 or header["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise InputError(path, "EXR kind: expected one flat image, got a deep or multi-part file; save as a plain EXR")
    names = [n for n in "RGB" if n in channels] or [n for n in "Y" if n in channels]
    other = channels.keys() & {"RY", "BY"} or channels.keys() >= {"X", "Z"}  # Y is luminance or of CIE XYZ
    if names != list("RGB") and (names != ["Y"] or other):
        raise InputError(path, f"channels: expected R, G, B or Y, got {shown(sorted(channels))}; save as plain RGB")
    if any(step != (1, 1) for step in channels.values()):
        raise InputError(path, "channels: expected one sample for each pixel, got subsampled ones; save as plain RGB")
    for name in ("dataWindow", "displayWindow"):
        (x0, y0), (x1, y1) = (w.tolist() for w in header[name])
        width, height = x1 - x0 + 1, y1 - y0 + 1
        samples = width * height * (len(channels) if name == "dataWindow" else 3)
        if width < 1 or height < 1 or width * height > max_pixels or samples > MAX_SAMPLES:
            got = f"{width} x {height} x {len(channels)}"
            expected = f"expected at most {max_pixels} pixels and {MAX_SAMPLES} samples"
            raise InputError(path, f"EXR {name}: {expected}, got {got}; scale the map down")
    _check_chunks(path, data, table, header)
    if header.get("envmap") == OpenEXR.ENVMAP_CUBE:
        raise InputError(path, "envmap: expected a lat-long map, got cube faces; convert it with exrenvmap")
    if header.get("envmap") == OpenEXR.ENVMAP_LATLONG:
        notes.append(f"{os.path.basename(path)}: envmap: its orientation (+Z at the horizontal center) is not applied")
    if abs(header.get("pixelAspectRatio", 1.0) - 1.0) > 1e-3:
        notes.append(f"{os.path.basename(path)}: pixelAspectRatio {header['pixelAspectRatio']:g} is not applied")
    return header, names


def _header_end(path, data: bytes) -> int:
    """Offset of the end of the header.  Bounds its counts before OpenEXR parses them in quadratic time."""
    try:
        magic, version = struct.unpack_from("<II", data)
        if magic != 20000630:
            raise InputError(path, "expected an OpenEXR file, got something else; check the file")
        if version & 0xFF != 2 or version & ~0x6FF:
            got = f"version {version & 0xFF}, flags {version & ~0xFF:#x}"
            raise InputError(path, f"EXR kind: expected one flat image, got {got}; save as a plain EXR")
        at = 8
        for _ in range(MAX_ATTRIBUTES + 1):
            if data[at] == 0:
                return at + 1
            name = data.index(0, at, at + 256)
            kind = data.index(0, name + 1, name + 257)
            (size,) = struct.unpack_from("<I", data, kind + 1)
            if size > (MAX_CHANNEL_BYTES if data[name + 1 : kind] == b"chlist" else len(data)):
                field = shown(data[at:name].decode("latin-1"))
                raise InputError(path, f"EXR attribute {field}: expected a shorter one, got {size} bytes; resave it")
            at = kind + 5 + size
    except (struct.error, IndexError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "EXR header: expected a complete one, got a broken one; save the file again") from None
    raise InputError(path, f"EXR header: expected at most {MAX_ATTRIBUTES} attributes, got more; save without metadata")


def _check_chunks(path, data: bytes, table: int, header: dict) -> None:
    """Raise InputError for a truncated file, about which OpenEXR would print lines of its own."""
    (x0, y0), (x1, y1) = (w.tolist() for w in header["dataWindow"])
    if header["type"] == OpenEXR.scanlineimage:
        if header["compression"] not in _LINES:  # younger than this table: OpenEXR judges
            return
        chunks, lead = -(-(y1 - y0 + 1) // _LINES[header["compression"]]), 8
    else:
        tiles = header["tiles"]
        if tiles.mode != OpenEXR.ONE_LEVEL:
            raise InputError(path, "EXR tiles: expected one level, got several; save as a plain scanline EXR")
        chunks, lead = -(-(x1 - x0 + 1) // tiles.xSize) * -(-(y1 - y0 + 1) // tiles.ySize), 20
    if table + 8 * chunks > len(data):
        raise InputError(path, f"EXR chunk table: expected {chunks} chunks, got a shorter file; it is truncated")
    for offset in np.unique(np.frombuffer(data, "<u8", chunks, table)).tolist():
        size = int.from_bytes(data[offset + lead - 4 : offset + lead], "little", signed=True)
        if offset < table or offset + lead + size > len(data) or size < 0:
            raise InputError(path, "EXR chunk: expected its data within the file; it is truncated")


def _matrix(path, header: dict, notes: list[str]) -> np.ndarray | None:
    """Matrix from the file's primaries (``chromaticities`` or a substitute) to Rec. 709."""
    primaries, field = header.get("chromaticities"), "chromaticities"
    if primaries is None and header.get("acesImageContainerFlag") == 1:
        primaries, field = _PRIMARIES["lin_ap0_scene"], "acesImageContainerFlag"
    space = header.get("colorInteropID", "unknown")
    if primaries is None and space != "unknown":
        if space not in _PRIMARIES:
            raise InputError(path, f"colorInteropID: expected a linear RGB space, got {shown(space)}; convert to it")
        primaries, field = _PRIMARIES[space], "colorInteropID"
    if primaries is None:
        return None
    try:
        matrix = rec709_from_primaries(primaries)
    except (TypeError, ValueError):
        raise InputError(path, f"{field}: expected primaries and a white, got {shown(primaries)}; resave it") from None
    if matrix is not None:
        notes.append(f"{os.path.basename(path)}: colors converted to Rec. 709 from the primaries of {field}")
    return matrix
