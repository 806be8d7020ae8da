"""Reads images and masks; writes PNG, OpenEXR and Radiance HDR images.

Color is sRGB in [0, 1] as stored; alpha is straight (not premultiplied), and color where alpha is 0 is kept.
"""

import io
import math
import os
import re
import struct
import warnings
import zlib
from pathlib import Path
from threading import BoundedSemaphore, Lock

import numpy as np
import torch
from PIL import ExifTags, Image, ImageChops, ImageCms, ImageOps
from torch import Tensor

from reli3d.errors import InputError, printable, shown
from reli3d.io.files import file_size, write_bytes
from reli3d.io.hdr import check_linear, write_exr, write_hdr
from reli3d.render.color import linear_to_srgb

MAX_PIXELS = 1 << 26  # 64 MP: 256 MiB of RGBA, above any camera this is meant for
MAX_BYTES = 1 << 29  # an uncompressed 16-bit RGBA image of MAX_PIXELS
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF")  # nothing that runs a program or unpacks streams of its own
MAX_SCANS = 100  # progressive files have about ten; a thousand in a small file take minutes
ORIENTATION = 0x0112  # of EXIF
EXPOSURE_TAGS = ExifTags.Base.ExposureTime, ExifTags.Base.FNumber, ExifTags.Base.ISOSpeedRatings
QUARTER_TURNS = (5, 6, 7, 8)  # orientations that exchange the sides
INVERSES = {6: 8, 8: 6}  # of orientations; the others are their own inverses
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")  # start of a JPEG segment; other bytes after 0xff are data
ASPECT = 0.01  # relative difference up to which two sizes have the same aspect
_TOP = {"L": 255, "RGB": 255, "RGBA": 255, "F": 65535}  # mode: the value that is 1
_DECODING = BoundedSemaphore(2)  # images at a time: one of 24 MP takes 96 MB
_OPENING = Lock()  # Python's warning filters are global; decoding runs outside
_GRAY = ("1", "L", "LA", "I;16", "I;16B", "I;16L", "I")
_COLOR = ("RGB", "RGBA", "P", "PA", "CMYK", "YCbCr")
_CUBE = Image.fromarray(np.indices((6, 6, 6)).reshape(3, 36, 6).transpose(1, 2, 0).astype(np.uint8) * 51)  # all of RGB


class _Reader(io.BufferedReader):
    """A file whose reads are limited to its size: a broken chunk may claim any length, which Python would allocate."""

    def __init__(self, path: str | os.PathLike, size: int):
        super().__init__(io.FileIO(path))
        self._size = size

    def read(self, size: int | None = -1) -> bytes:
        return super().read(self._size if size is None or size < 0 else min(size, self._size))


def read_image(path: str | os.PathLike, *, notes: list[str] | None = None) -> tuple[Tensor, Tensor | None]:
    """Reads color ``(H, W, 3)`` in [0, 1], sRGB-encoded as stored, and straight alpha ``(H, W)`` in [0, 1] or None.

    Formats, ``notes`` and errors as in :func:`~reli3d.io.images.decode_image`.

    >>> reli3d.write_image("gray.png", torch.full((4, 4, 3), 0.5))
    >>> color, alpha = reli3d.read_image("gray.png")
    >>> linear = reli3d.srgb_to_linear(color)
    """
    bitmap = decode_image(path, notes=notes)
    alpha = torch.from_numpy(unit(bitmap.getchannel("A"))) if bitmap.mode == "RGBA" else None
    return color_of(bitmap), alpha


def color_of(bitmap: Image.Image) -> Tensor:
    """Color ``(H, W, 3)`` in [0, 1] of an image from :func:`decode_image`."""
    values = unit(bitmap)
    return torch.from_numpy(np.repeat(values[..., None], 3, -1) if values.ndim == 2 else values)


def unit(bitmap: Image.Image) -> np.ndarray:
    """Values of an image or channel without alpha, normalized by the mode's maximum: float32 in [0, 1]."""
    values = np.asarray(bitmap)
    return np.divide(values[..., :3] if values.ndim == 3 else values, np.float32(_TOP[bitmap.mode]), dtype=np.float32)


def above(channel: Image.Image, limit: float) -> np.ndarray:
    """``(H, W)`` bool: where a channel exceeds ``limit`` of its highest value."""
    threshold = limit * _TOP[channel.mode]
    return np.asarray(channel) > (threshold if channel.mode == "F" else np.uint8(threshold))  # without a float copy


def decode_image(
    path: str | os.PathLike,
    *,
    notes: list[str] | None = None,
    calibrated: tuple[int, int] | None = None,
    upright: bool = False,
) -> Image.Image:
    """Decodes an image to mode RGB, RGBA, L, or F for 16-bit gray in [0, 65535].

    Reads PNG, JPEG, WebP or TIFF: 8-bit color, palette, gray, CMYK, 16-bit gray; 16-bit color is reduced to 8 bits.
    The size is checked before decoding.  notes: receives changes of the pixels.  calibrated: width and height in the
    camera file; the EXIF orientation is applied if only the rotated image has this aspect ratio, otherwise noted, as
    cameras refer to the stored pixels.  upright: it is always applied.  Raises InputError for other formats, more than
    64 MP, several frames, or a broken file.
    """
    size = file_size(path)
    if size > MAX_BYTES:
        raise InputError(path, f"expected at most {MAX_BYTES} bytes, got {size}; give a smaller image")
    try:
        with _Reader(path, size) as file:
            with _OPENING, warnings.catch_warnings():
                warnings.simplefilter("error", Image.DecompressionBombWarning)
                warnings.simplefilter("ignore", UserWarning)  # broken EXIF or TIFF tags that the pixels do not need
                image = Image.open(file, formats=FORMATS)  # reads the header only
            with image, _DECODING:
                return _decoded(path, image, notes if notes is not None else [], calibrated, upright)
    except InputError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise InputError(path, f"expected at most {MAX_PIXELS} pixels; scale the image down") from None
    except Image.UnidentifiedImageError:
        raise InputError(path, "expected a PNG, JPEG, WebP or TIFF image, got something else; convert it") from None
    except PermissionError:
        raise InputError(path, "cannot be read; check its permissions") from None
    except MemoryError:
        raise InputError(path, "does not fit into memory; scale the image down") from None
    except Exception as error:  # on a broken file decoders raise almost anything: struct.error, IndexError ...
        raise InputError(path, f"cannot be decoded ({shown(str(error))}); save the image again") from None


def _decoded(
    path, image: Image.Image, notes: list[str], calibrated: tuple[int, int] | None, upright: bool
) -> Image.Image:
    width, height = image.size
    if width * height > MAX_PIXELS:
        raise InputError(path, f"expected at most {MAX_PIXELS} pixels, got {width} x {height}; scale the image down")
    if width < 1 or height < 1:
        raise InputError(path, f"expected at least one pixel, got {width} x {height}; save the image again")
    if image.format != "MPO" and _several(image):  # MPO: JPEG of many phones, the photo comes first
        raise InputError(path, "expected one image, got several frames; save a single frame")
    if image.format in ("JPEG", "MPO") and (scans := _scans(path)) > MAX_SCANS:
        raise InputError(path, f"expected at most {MAX_SCANS} scans, got {scans}; save the image again")
    orientation = image.getexif().get(ORIENTATION, 1)
    if orientation not in (0, 1):
        name = f"{os.path.basename(path)}: EXIF orientation {shown(orientation)}"
        tiff = image.format == "TIFF"  # Pillow turns it and exchanges the sides before
        stored = image.size[::-1] if tiff and orientation in QUARTER_TURNS else image.size
        fits = calibrated is not None and _aspect(calibrated, stored[::-1]) and not _aspect(calibrated, stored)
        applied = upright or fits
        if calibrated and fits:
            notes.append(f"{name} applied: the camera file has {calibrated[0]} x {calibrated[1]} pixels")
        elif not upright:
            notes.append(f"{name} not applied, cameras refer to stored pixels")
        if tiff and not applied:
            image.load()
            image.getexif()[ORIENTATION] = INVERSES.get(orientation, orientation)
        if applied != tiff:
            image = ImageOps.exif_transpose(image)
    check_depth(path, image)
    image = in_srgb(image, os.path.basename(path), notes)
    if image.mode.startswith("I"):
        return Image.fromarray(np.asarray(image).astype(np.float32))
    mode = "RGBA" if image.has_transparency_data else "L" if image.mode in ("1", "L") else "RGB"
    image.load()
    return image if image.mode == mode else image.convert(mode)


def exposure_data(image: Image.Image) -> tuple[float, float, float] | None:
    """Exposure time [s], f-number and sensitivity (ISO) of the EXIF data; None if one is missing or not positive."""
    try:
        tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
        time, f_number, iso = (float(tags[key]) for key in EXPOSURE_TAGS)
    except Exception:  # decoders of broken EXIF data raise almost anything
        return None
    return (time, f_number, iso) if all(0.0 < value < math.inf for value in (time, f_number, iso)) else None


def with_exposure(data: tuple[float, float, float] | None) -> bytes:
    """EXIF data with the values of :func:`exposure_data`; empty for None."""
    if data is None:
        return b""
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update(zip(EXPOSURE_TAGS, data, strict=True))
    return exif.tobytes()


def exposure(path: str | os.PathLike) -> float | None:
    """Exposure of an image file by its EXIF data, time * ISO / f-number^2, to which linear values are proportional.

    None if it is not known.  The file must be one that :func:`decode_image` has read.
    """
    with _OPENING, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # broken EXIF data
        with Image.open(path, formats=FORMATS) as image:
            data = exposure_data(image)
    return data and data[0] * data[2] / data[1] ** 2


def check_depth(path: str | os.PathLike, image: Image.Image) -> None:
    """Raises InputError unless ``image`` is color or gray of 8 or 16 bits."""
    if image.mode not in _GRAY + _COLOR:
        raise InputError(path, f"expected 8 or 16 bit gray or color, got mode {image.mode}; save as 8 bit PNG")
    if image.mode == "I" and not 0 <= np.asarray(image).min() <= np.asarray(image).max() <= 65535:
        raise InputError(path, "expected 8 or 16 bit gray, got 32 bit; save as 8 bit PNG")


def in_srgb(image: Image.Image, name: str, notes: list[str]) -> Image.Image:
    """``image`` converted to sRGB, RGB or RGBA, from the color space of its ICC profile or EXIF data, with a note.

    Unchanged where neither names one, or one equal to sRGB up to rounding.  Profiles of gray images are not used.
    """
    profile = image.info.get("icc_profile")
    if not profile and _is_adobe_rgb(image):
        profile = _adobe_rgb()
    if not profile:
        return image
    if image.mode in _GRAY:
        notes.append("color profiles of gray images are not used, sRGB is assumed")
        return image
    mode = "RGBA" if image.has_transparency_data else "RGB"
    try:
        source, target = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
        if image.mode != "CMYK":
            converted = ImageCms.buildTransform(source, target, "RGB", "RGB").apply(_CUBE)
            if np.asarray(ImageChops.difference(converted, _CUBE)).max() <= 1:  # linear profiles may be named sRGB
                return image
            image = image if image.mode == mode else image.convert(mode)
        title = ImageCms.getProfileDescription(source).strip()
        converted = ImageCms.buildTransform(source, target, image.mode, mode).apply(image)
    except (ImageCms.PyCMSError, ImportError, OSError, ValueError, TypeError) as error:
        notes.append(f"{name}: its color profile is not used ({shown(str(error))}), sRGB is assumed")
        return image
    notes.append(f"{name}: colors converted from {printable(title)} to sRGB")
    return converted


def _is_adobe_rgb(image: Image.Image) -> bool:
    """Whether EXIF has an uncalibrated color space and the interoperability index R03: Adobe RGB (DCF 2.0)."""
    if b"R03\0" not in image.info.get("exif", b""):  # spares the EXIF data of most images, which may be broken
        return False
    return image.getexif().get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.ColorSpace) == 0xFFFF


def _adobe_rgb() -> bytes:
    """ICC profile of Adobe RGB (1998): an exponent of 563/256, and its primaries adapted to D50."""

    def xyz(*values: float) -> bytes:
        return struct.pack(">4s4x3i", b"XYZ ", *(round(65536 * value) for value in values))

    white = xyz(0.9642, 1.0, 0.8249)
    primaries = xyz(0.60974, 0.31111, 0.01947), xyz(0.20528, 0.62567, 0.06087), xyz(0.14919, 0.06322, 0.74457)
    curve = struct.pack(">4s4xIH2x", b"curv", 1, 563)
    title = struct.pack(">4s4xI17s79x", b"desc", 17, b"Adobe RGB (1998)")
    values = (title, white, *primaries, *3 * (curve,))
    names = (b"desc", b"wtpt", b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC")
    ends = 132 + 12 * len(values) + np.cumsum([len(value) for value in values])
    entries = zip(names, ends, values, strict=True)
    table = b"".join(struct.pack(">4s2I", name, end - len(value), len(value)) for name, end, value in entries)
    header = struct.pack(">I4xI12s12x4s28x12s48x", ends[-1], 0x02100000, b"mntrRGB XYZ ", b"acsp", white[8:])
    return header + struct.pack(">I", len(values)) + table + b"".join(values)


def _aspect(a: tuple[int, int], b: tuple[int, int]) -> bool:
    return abs(a[0] * b[1] / (a[1] * b[0]) - 1.0) <= ASPECT


def _several(image: Image.Image) -> bool:
    """Whether there is a second frame.  A TIFF of many would be read to its end to count them."""
    try:
        image.seek(1)
    except EOFError:
        image.seek(0)
        return False
    return True


def _scans(path) -> int:
    """Scans of a JPEG file, without what follows its end; each passes over the whole image."""
    data = Path(path).read_bytes()
    at, scans = 2, 0
    while (marker := _MARKER.search(data, at)) and data[marker.end() - 1] != 0xD9:
        scans += data[marker.end() - 1] == 0xDA
        at = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2], "big")
    return scans


def png_bytes(pixels: Tensor | np.ndarray) -> bytes:
    """PNG file of ``(H, W)``, ``(H, W, 3)`` or ``(H, W, 4)`` pixels: uint8, or float in [0, 1] (clamped, rounded).

    Run-length compression of filtered rows: about 10 % smaller than Pillow's default at the same level, and faster.
    """
    array = pixels.detach().cpu().numpy() if isinstance(pixels, Tensor) else np.asarray(pixels)
    if array.dtype not in (np.uint8, np.float32, np.float64):
        raise TypeError(f"pixels: expected uint8 or float32, got {array.dtype}")
    if array.ndim not in (2, 3) or array.size == 0 or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise ValueError(f"pixels: expected shape (H, W), (H, W, 3) or (H, W, 4), got {array.shape}")
    if array.dtype != np.uint8:
        if not np.isfinite(array).all():
            raise ValueError("pixels: expected finite values, got NaN or infinity")
        array = np.rint(np.clip(array, 0.0, 1.0) * 255.0).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    return buffer.getvalue()


def write_png(path: str | os.PathLike, pixels: Tensor | np.ndarray) -> None:
    """Writes :func:`png_bytes` of ``pixels``, completely or not at all.  Raises OSError if writing fails."""
    write_bytes(path, png_bytes(pixels))


def write_image(path: str | os.PathLike, image: Tensor) -> None:
    """Writes a linear image as ``.png`` (sRGB, 8 bit), ``.exr`` (float) or ``.hdr`` (RGBE), by the suffix of ``path``.

    image: float32, linear Rec. 709, ``(H, W)`` gray, ``(H, W, 3)``, or ``(H, W, 4)`` with color premultiplied by alpha.
    ``.png``: color is divided by alpha, encoded as sRGB and clamped to [0, 1]; alpha is straight.  ``.exr``: values
    unchanged, premultiplied.  ``.hdr``: ``(H, W, 3)`` only.  For a rendering with ``background="environment"``, pass
    ``radiance``, not ``rgba``.  The file is written completely or not at all.  Raises TypeError for a wrong dtype;
    ValueError for an unknown suffix, a wrong shape, NaN, infinity or negative values; OSError if writing fails.

    >>> image = reli3d.render_asset(asset, camera, light)
    >>> reli3d.write_image("image.png", image.rgba)
    """
    suffix = os.path.splitext(path)[1].lower()
    if suffix not in (".png", ".exr", ".hdr"):
        raise ValueError(f"path: expected a name that ends in .png, .exr or .hdr, got {shown(os.path.basename(path))}")
    check_linear(image, [(3,)] if suffix == ".hdr" else [(), (3,), (4,)], finite=True)
    image = image.detach()
    if suffix == ".hdr":
        write_hdr(path, image)
    elif suffix == ".exr":
        write_exr(path, image, half=False)
    elif image.shape[2:] == (4,):
        color, alpha = image[..., :3], image[..., 3:]
        straight = color / alpha.clamp(min=1e-6)  # alpha below is 0 in 8 bits
        write_png(path, torch.cat([linear_to_srgb(straight), alpha], -1))
    else:
        write_png(path, linear_to_srgb(image))
