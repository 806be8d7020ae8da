"""Reads and writes Radiance HDR images (``.hdr``, RGBE).

A pixel is three mantissas and a common exponent: value = mantissa / 256 * 2 ** (exponent - 128).  Sources: Ward,
Real Pixels, Graphics Gems II (1991); Radiance's "File Formats" (https://radsite.lbl.gov/radiance/refer/filefmts.pdf).
"""

import contextlib
import os

import numpy as np

from reli3d.errors import InputError, shown
from reli3d.io.files import read_bytes
from reli3d.render.color import rec709_from_primaries

MAX_BYTES = 1 << 28  # 8192 x 4096 pixels, run lengths that do not pay, and a header
MAX_HEADER = 1 << 16  # bytes
RLE_WIDTHS = range(8, 32768)  # lengths of scanlines that may have the run lengths of 1991


def read_rgbe(path: str | os.PathLike, max_pixels: int, notes: list[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """Pixels ``(H, W, 3)`` float32, top row first, and the 3x3 matrix from their primaries to Rec. 709, or None.

    Supported: flat pixels, run-length encoding of 1991 and earlier, all eight orientations.  EXPOSURE and COLORCORR are
    divided out.  PRIMARIES give the matrix; without PRIMARIES, colors are Rec. 709.  Raises InputError, also for
    ``32-bit_rle_xyze``.
    """
    data = read_bytes(path, MAX_BYTES)
    if data[:2] != b"#?":
        raise InputError(path, "expected a Radiance .hdr or OpenEXR .exr file, got something else; convert the map")
    factor, matrix, at = _variables(path, data, notes)
    end = data.find(b"\n", at, at + 256)
    words = data[at:end].split() if end >= 0 else []
    axes = tuple(word.decode("latin-1") for word in words[::2])
    if len(words) != 4 or sorted(a[-1:] for a in axes) != ["X", "Y"] or {a[:-1] for a in axes} - {"+", "-"}:
        got = shown(data[at : at + 64].split(b"\n")[0].decode("latin-1"))
        raise InputError(path, f"resolution: expected such as '-Y height +X width', got {got}; save the file again")
    sizes = [int(word) if word.isdigit() and len(word) <= 8 else 0 for word in words[1::2]]
    if not 0 < sizes[0] * sizes[1] <= max_pixels:
        got = shown(b" x ".join(words[1::2]).decode("latin-1"))
        raise InputError(path, f"resolution: expected 1 to {max_pixels} pixels, got {got}; scale the map down")
    quads = _scanlines(path, data, end + 1, *sizes)
    if axes[0][1] == "X":  # scanlines are columns
        quads, axes = quads.transpose(1, 0, 2), axes[::-1]
    quads = quads[:: 1 if axes[0] == "-Y" else -1, :: 1 if axes[1] == "+X" else -1]
    scale = np.ldexp(1.0, quads[..., 3].astype(np.int32) - 136)
    pixels = quads[..., :3] * np.where(quads[..., 3] == 0, 0.0, scale)[..., None] / factor
    with np.errstate(over="ignore"):  # a tiny EXPOSURE; the caller clamps infinity
        return pixels.astype(np.float32), matrix


def _variables(path, data: bytes, notes: list[str]) -> tuple[np.ndarray, np.ndarray | None, int]:
    """The factors of EXPOSURE and COLORCORR, the matrix of PRIMARIES, and the offset of the resolution line."""
    factor, matrix, at = np.ones(3), None, 0
    while True:
        end = data.find(b"\n", at, MAX_HEADER)
        if end < 0:
            raise InputError(path, "header: expected an empty line and a resolution line, got neither; save it again")
        line, at = data[at:end].rstrip(b"\r").decode("latin-1"), end + 1
        if not line:
            return factor, matrix, at
        key, _, value = line.partition("=")  # an indented line is the header of an image that this was derived from
        if key == "FORMAT" and value.strip() != "32-bit_rle_rgbe":
            raise InputError(path, f"FORMAT: expected 32-bit_rle_rgbe, got {shown(value)}; convert it with ra_xyze -r")
        if key in ("EXPOSURE", "COLORCORR"):
            factor = factor * _positive(path, key, value)
        elif key in ("PIXASPECT", "GAMMA") and _positive(path, key, value) != [1.0]:
            notes.append(f"{os.path.basename(path)}: {key} {shown(value)} is not applied")
        elif key == "PRIMARIES":
            try:
                numbers = [float(word) for word in value.split()]
                matrix = None if numbers == [0.0] * 8 else rec709_from_primaries(numbers)  # Photoshop writes zeros
            except ValueError:
                expected = "expected those of a color space"
                raise InputError(path, f"PRIMARIES: {expected}, got {shown(value)}; resave it") from None
            if matrix is not None:
                notes.append(f"{os.path.basename(path)}: colors converted to Rec. 709 from PRIMARIES")


def _positive(path, field: str, value: str) -> list[float]:
    count, amount = (3, "3 positive numbers") if field == "COLORCORR" else (1, "a positive number")
    with contextlib.suppress(ValueError):
        numbers = [float(word) for word in value.split()]
        if len(numbers) == count and all(1e-12 < number < 1e12 for number in numbers):
            return numbers
    raise InputError(path, f"{field}: expected {amount}, got {shown(value)}; correct the header")


def _scanlines(path, data: bytes, at: int, count: int, length: int) -> np.ndarray:
    """``(count, length, 4)`` bytes.  The first pixel of a scanline determines its encoding."""
    lines = np.empty((count, length, 4), np.uint8)
    for k in range(count):
        first, rest = data[at : at + 4], len(data) - at
        marked = length in RLE_WIDTHS and first[:2] == b"\2\2" and first[2:3] < b"\x80"
        if marked and first[2:] == length.to_bytes(2, "big"):
            at = _run_lengths(path, data, at + 4, lines[k])
        elif marked and rest != 4 * length * (count - k):  # of another length, and not flat to the end of the file
            raise _truncated(path)
        else:
            at = _pixels(path, data, at, lines[k])
    return lines


def _truncated(path) -> InputError:
    return InputError(path, "pixels: expected all scanlines, got a shorter or broken file; save the file again")


def _run_lengths(path, data: bytes, at: int, line: np.ndarray) -> int:
    """Decode one scanline, channel by channel, from ``at`` on into ``line``; returns the offset behind it."""
    length = len(line)
    for channel in range(4):
        values = bytearray()
        while len(values) < length:
            if at + 1 >= len(data):
                raise _truncated(path)
            count = data[at]
            if count > 128:
                values += data[at + 1 : at + 2] * (count - 128)
                at += 2
            else:
                values += data[at + 1 : at + 1 + count]
                at += 1 + count
        if len(values) != length:  # a run may not cross into the next channel
            raise _truncated(path)
        line[:, channel] = np.frombuffer(values, np.uint8)
    return at


def _pixels(path, data: bytes, at: int, line: np.ndarray) -> int:
    """Decode a scanline of whole pixels; (1, 1, 1, n), low byte first, repeats the one before; returns the offset."""
    length, done, shift = len(line), 0, 0
    while done < length:
        quads = np.frombuffer(data, np.uint8, min(length - done, (len(data) - at) // 4) * 4, at).reshape(-1, 4)
        repeats = np.flatnonzero((quads[:, :3] == 1).all(1)[done == 0 :]) + (done == 0)
        literals = int(repeats[0]) if len(repeats) else len(quads)
        line[done : done + literals] = quads[:literals]
        done, at = done + literals, at + 4 * literals
        if literals:
            shift = 0
        if done == length:
            break
        if not len(repeats):  # the end of the file
            raise _truncated(path)
        count = min(int(quads[literals, 3]) << min(shift, 24), length - done)
        line[done : done + count] = line[done - 1]
        done, at, shift = done + count, at + 4, shift + 8
    return at


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
        for at in range(start, literal, 127):
            out += bytes((128 + min(127, literal - at), data[at]))
    _literals(out, data[literal:])


def _literals(out: bytearray, data: bytes) -> None:
    for at in range(0, len(data), 128):
        part = data[at : at + 128]
        out.append(len(part))
        out += part
