"""Environment maps and other linear images: OpenEXR through the OpenEXR package, Radiance RGBE by our own code.

Pixels are linear Rec. 709 radiance, row 0 at the top, +Y of an environment.  The centre column of an environment looks
to +X and right of it lies +Z, in files and in memory, as three.js, model-viewer and Blender read it.

NaN and negative values are never written: they are refused.  Infinity and, in half precision, values above 65504 are
clamped to 65504 and counted.  On reading, NaN is refused, negative values become 0 and infinity 65504.
"""

from __future__ import annotations

import os

import numpy as np
import OpenEXR
import torch
from torch import Tensor

from reli3d.io.exr_header import read_exr_header
from reli3d.io.files import InputError, file_size, read_bytes, replacing, shown, write_bytes

HALF_MAX = 65504.0  # largest finite half
MAX_PIXELS = 1 << 25  # 8192 x 4096
MAX_BYTES = 1 << 28  # MAX_PIXELS of RGBE, run lengths that do not pay, and a header


def read_environment(path: str | os.PathLike, *, notes: list[str] | None = None) -> Tensor:
    """Lat-long map ``(H, 2H, 3)``, float32 linear radiance, from a ``.hdr`` or ``.exr`` file; its content tells which.

    Row 0 is +Y, the centre column +X, right of it +Z.  What was clamped is appended to ``notes``.  Raises InputError on
    a broken file, NaN, a shape other than 2:1, or a map above 8192 x 4096.
    """
    image = read_hdr_image(path, notes=notes)
    height, width = image.shape[:2]
    if width != 2 * height:
        raise InputError(path, f"size: expected a map twice as wide as high, got {width} x {height}; convert it")
    return image


def write_environment(path: str | os.PathLike, radiance: Tensor) -> int:
    """Write the map ``radiance`` ``(H, 2H, 3)`` as ``.exr`` or ``.hdr``, by the suffix of ``path``.

    Returns the number of values clamped.  Raises ValueError on NaN, negative values or another shape, OSError where it
    cannot be written.
    """
    write = {".exr": write_exr, ".hdr": write_hdr}.get(os.path.splitext(path)[1].lower())
    if write is None:
        raise ValueError(f"path: expected a name that ends in .exr or .hdr, got {shown(os.path.basename(path))}")
    if radiance.ndim != 3 or radiance.shape[1] != 2 * radiance.shape[0]:
        raise ValueError(f"radiance: expected shape (H, 2H, 3), got {tuple(radiance.shape)}")
    return write(path, radiance)


def environment_bytes(radiance: Tensor) -> bytes:
    """What :func:`write_environment` writes into a ``.hdr`` file.  Raises as it does."""
    pixels, _ = _writable(radiance, float(np.finfo(np.float32).max) / 2)
    return rgbe_bytes(pixels)


def read_hdr_image(path: str | os.PathLike, *, notes: list[str] | None = None) -> Tensor:
    """Linear image ``(H, W, 3)``, float32, finite and not negative, of a ``.hdr`` or ``.exr`` file (see the module)."""
    file_size(path)  # raises for a pipe, which would block
    try:
        with open(path, "rb") as file:
            start = file.read(4)
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error}); check its permissions") from None
    pixels = _read_exr(path) if start == b"\x76\x2f\x31\x01" else _read_rgbe(path)
    if np.isnan(pixels).any():
        count = int(np.isnan(pixels).any(-1).sum())
        raise InputError(path, f"pixels: expected numbers, got NaN at {count} pixels; render it again")
    high, low = np.isposinf(pixels), pixels < 0
    if notes is not None and (high.any() or low.any()):
        counts = f"{int(high.sum())} infinite values set to 65504, {int(low.sum())} negative to 0"
        notes.append(f"{os.path.basename(path)}: {counts}")
    pixels[high], pixels[low] = HALF_MAX, 0.0
    return torch.from_numpy(pixels)


def write_exr(path: str | os.PathLike, image: Tensor, *, half: bool = True) -> int:
    """Write ``image`` as OpenEXR with ZIP compression, in half or float; the whole file or nothing.

    image: ``(H, W)`` luminance Y, ``(H, W, 3)`` RGB or ``(H, W, 4)`` RGBA, premultiplied by alpha.
    Returns the number of values clamped to 65504.  Raises ValueError on NaN or negative values, OSError where it cannot
    be written.
    """
    pixels, clamped = _writable(image, HALF_MAX if half else float(np.finfo(np.float32).max), layouts=((), (3,), (4,)))
    name = "Y" if pixels.ndim == 2 else "RGBA"[: pixels.shape[2]]
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(path) as temporary:
        temporary.touch()  # an unwritable folder gives an OSError here instead of the library's own exception
        with OpenEXR.File(header, {name: pixels.astype(np.float16) if half else pixels}) as file:
            file.write(str(temporary))
    return clamped


def write_hdr(path: str | os.PathLike, image: Tensor) -> int:
    """Write ``image`` ``(H, W, 3)`` as Radiance RGBE with run lengths; the whole file or nothing.

    A pixel keeps its largest channel to 1/256 and the others to the same absolute error.  Returns the number of values
    clamped to 65504.  Raises ValueError on NaN or negative values, OSError where it cannot be written.
    """
    pixels, clamped = _writable(image, float(np.finfo(np.float32).max) / 2)
    write_bytes(path, rgbe_bytes(pixels))
    return clamped


def _writable(image: Tensor, limit: float, layouts: tuple[tuple[int, ...], ...] = ((3,),)) -> tuple[np.ndarray, int]:
    if not isinstance(image, Tensor) or image.dtype != torch.float32:
        raise TypeError(f"image: expected a float32 tensor, got {getattr(image, 'dtype', type(image).__name__)}")
    if image.ndim < 2 or image.shape[2:] not in layouts or image.numel() == 0:
        wanted = " or ".join(f"(H, W{''.join(f', {n}' for n in layout)})" for layout in layouts)
        raise ValueError(f"image: expected shape {wanted}, got {tuple(image.shape)}")
    pixels = image.detach().cpu().numpy()
    if np.isnan(pixels).any() or (pixels < 0).any():
        raise ValueError(f"image: expected values >= 0, got NaN or negative at {int((~(pixels >= 0)).sum())} places")
    over = pixels > limit
    return np.ascontiguousarray(np.where(over, np.float32(HALF_MAX), pixels)), int(over.sum())


def _read_exr(path) -> np.ndarray:
    header = read_exr_header(path)
    if header.width * header.height > MAX_PIXELS:
        size = f"{header.width} x {header.height}"
        raise InputError(path, f"size: expected at most {MAX_PIXELS} pixels, got {size}; scale the map down")
    names = [n for n in "RGB" if n in header.channels] or [n for n in "Y" if n in header.channels]
    if len(names) not in (1, 3) or names == ["R"]:
        got = shown(sorted(header.channels))
        raise InputError(path, f"channels: expected R, G, B or Y, got {got}; save as plain RGB")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = [np.asarray(file.channels()[n].pixels, dtype=np.float32) for n in names]
    except Exception as error:  # the binding raises RuntimeError, ValueError, TypeError ... for a broken file
        raise InputError(path, f"pixels: cannot be decoded ({shown(str(error))}); save the file again") from None
    if any(p.shape != (header.height, header.width) for p in planes):
        raise InputError(path, "pixels: expected the size of the header; save the file again")
    return np.stack(planes * (3 // len(planes)), axis=-1)


# Radiance RGBE.  Source: Ward, Real Pixels, Graphics Gems II (1991), and the file format notes of Radiance.  A pixel is
# three mantissas and the exponent they share: value = mantissa / 256 * 2 ** (exponent - 128).


def rgbe_bytes(pixels: np.ndarray) -> bytes:
    """Radiance file of ``(H, W, 3)`` float32 pixels, finite and not negative."""
    height, width = pixels.shape[:2]
    quads = _to_rgbe(pixels)
    out = bytearray(f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode())
    if not 8 <= width < 32768:  # the run-length form has no place for other widths
        return bytes(out) + quads.tobytes()
    lead = bytes((2, 2, width >> 8, width & 255))
    for row in quads:
        out += lead
        for channel in range(4):
            _pack(out, np.ascontiguousarray(row[:, channel]))
    return bytes(out)


def _to_rgbe(pixels: np.ndarray) -> np.ndarray:
    largest = pixels.max(axis=-1)
    _, exponent = np.frexp(largest.astype(np.float64))
    rounded_up = np.rint(np.ldexp(largest.astype(np.float64), 8 - exponent)) > 255  # 256 does not fit the byte
    exponent += rounded_up.astype(exponent.dtype)
    mantissa = np.rint(np.ldexp(pixels.astype(np.float64), (8 - exponent)[..., None]))
    quads = np.concatenate((mantissa, (exponent + 128)[..., None]), axis=-1)
    quads[(exponent < -127) | (largest == 0)] = 0  # below 2e-39 the format has only zero
    return quads.astype(np.uint8)


def _pack(out: bytearray, line: np.ndarray) -> None:
    """Append one channel of a scanline: runs of 4 to 127 equal bytes, the rest in literals of up to 128."""
    data = line.tobytes()
    starts = np.flatnonzero(np.concatenate(([True], line[1:] != line[:-1])))
    lengths = np.diff(np.append(starts, len(line)))
    literal = 0  # first byte not yet written
    for start, length in zip(starts[lengths >= 4].tolist(), lengths[lengths >= 4].tolist()):
        _literals(out, data[literal:start])
        literal = start + length
        while length > 0:
            part = min(length, 127)
            out += bytes((128 + part, data[start]))
            length -= part
    _literals(out, data[literal:])


def _literals(out: bytearray, data: bytes) -> None:
    for at in range(0, len(data), 128):
        part = data[at : at + 128]
        out.append(len(part))
        out += part


def _read_rgbe(path) -> np.ndarray:
    data = read_bytes(path, MAX_BYTES)
    if data[:10] != b"#?RADIANCE" and data[:6] != b"#?RGBE":
        raise InputError(path, "expected a Radiance .hdr or OpenEXR .exr file, got something else; convert the map")
    end = data.find(b"\n\n", 0, 1 << 16)
    line_end = data.find(b"\n", end + 2, end + 2 + 256)
    if end < 0 or line_end < 0:
        raise InputError(path, "header: expected an empty line and a resolution line, got neither; save the file again")
    exposure = 1.0
    for line in data[:end].split(b"\n"):
        key, _, value = line.partition(b"=")
        if key == b"FORMAT" and value.strip() != b"32-bit_rle_rgbe":
            got = shown(value.decode("latin-1"))
            raise InputError(path, f"FORMAT: expected 32-bit_rle_rgbe, got {got}; convert to RGB")
        if key == b"EXPOSURE":
            exposure *= _positive(path, "EXPOSURE", value)
    words = data[end + 2 : line_end].split()
    if len(words) != 4 or words[0] != b"-Y" or words[2] != b"+X" or not (words[1] + words[3]).isdigit():
        size = data[end + 2 : line_end].decode("latin-1")
        raise InputError(path, f"resolution: expected '-Y height +X width', got {shown(size)}; save the file again")
    if len(words[1]) > 8 or len(words[3]) > 8 or not 0 < int(words[1]) * int(words[3]) <= MAX_PIXELS:
        size = f"{shown(words[3].decode())} x {shown(words[1].decode())}"
        raise InputError(path, f"resolution: expected 1 to {MAX_PIXELS} pixels, got {size}; scale the map down")
    height, width = int(words[1]), int(words[3])
    quads = _unpack(path, data, line_end + 1, height, width)
    scale = np.ldexp(np.float64(1 / exposure), quads[..., 3].astype(np.int32) - 136)
    pixels = quads[..., :3] * np.where(quads[..., 3] == 0, 0.0, scale)[..., None]
    with np.errstate(over="ignore"):  # a tiny EXPOSURE; the caller clamps infinity
        return pixels.astype(np.float32)


def _positive(path, field: str, value: bytes) -> float:
    try:
        number = float(value)
    except ValueError:
        number = 0.0
    if not 1e-12 < number < 1e12:
        got = shown(value.decode("latin-1"))
        raise InputError(path, f"{field}: expected a positive number, got {got}; correct the header")
    return number


def _unpack(path, data: bytes, at: int, height: int, width: int) -> np.ndarray:
    truncated = InputError(path, "pixels: expected all scanlines, got a shorter or broken file; save the file again")
    if data[at : at + 2] != b"\2\2" or not 8 <= width < 32768:
        need = 4 * height * width
        if len(data) - at < need:
            raise truncated  # the run lengths of before 1991 end here as well
        return np.frombuffer(data, np.uint8, need, at).reshape(height, width, 4)
    if len(data) - at < height * (4 + 8 * -(-width // 127)):  # the shortest scanline that the format can hold
        raise truncated
    lead, planes = bytes((2, 2, width >> 8, width & 255)), []
    for _ in range(height):
        if data[at : at + 4] != lead:
            raise truncated
        at += 4
        line = bytearray()
        for channel in range(1, 5):
            while len(line) < channel * width:
                if at + 1 >= len(data):
                    raise truncated
                count = data[at]
                if count > 128:
                    line += data[at + 1 : at + 2] * (count - 128)
                    at += 2
                else:
                    line += data[at + 1 : at + 1 + count]
                    at += 1 + count
                if count == 0:
                    raise truncated
            if len(line) != channel * width:  # a run may not cross into the next channel
                raise truncated
        planes.append(line)
    return np.frombuffer(b"".join(planes), np.uint8).reshape(height, 4, width).transpose(0, 2, 1)
