"""Environment maps and other linear images, in OpenEXR (``exr.py``) or Radiance RGBE (``rgbe.py``).

Pixels are linear Rec. 709 radiance.  The upper edge of an environment is +Y, the horizontal center +X, and +Z is right
of the center, in files and in memory: the convention of three.js, model-viewer and Blender.
"""

import os
from collections.abc import Sequence

import numpy as np
import OpenEXR
import torch
from torch import Tensor

from reli3d._bridge import expect
from reli3d.errors import InputError, shown
from reli3d.io.exr import read_exr
from reli3d.io.files import opened, replacing, write_bytes
from reli3d.io.rgbe import read_rgbe, rgbe_bytes
from reli3d.render.environment import Environment

HALF_MAX = 65504.0  # largest finite half
MAX_PIXELS = 1 << 25  # 8192 x 4096


def read_environment(path: str | os.PathLike, *, notes: list[str] | None = None) -> Environment:
    """Reads a lat-long environment ``(H, 2H, 3)``, linear radiance, from an ``.hdr`` or ``.exr`` file.

    The format is detected from the content.  The upper edge is +Y, the horizontal center +X, and +Z is right of the
    center.  notes: receives one line for every conversion, clamping or ignored header field.  Raises InputError for a
    broken file, NaN, a shape other than 2:1, or more than 8192 x 4096 pixels.

    >>> light = reli3d.read_environment("studio.hdr").rotated(1.57)
    >>> image = reli3d.render_asset(asset, camera, light)
    """
    image = read_hdr_image(path, notes=notes)
    height, width = image.shape[:2]
    if width != 2 * height:
        raise InputError(path, f"size: expected a map twice as wide as high, got {width} x {height}; convert it")
    return Environment(image)


def write_environment(path: str | os.PathLike, environment: Environment) -> int:
    """Writes ``environment (H, 2H, 3)`` as ``.exr`` (half precision) or ``.hdr`` (RGBE), by the suffix of ``path``.

    Returns the number of values that were clamped to the format's maximum (65504 in ``.exr``).  The file is written
    completely or not at all.  Raises TypeError for a wrong type; ValueError for NaN, negative values, a wrong shape or
    an unknown suffix; OSError if writing fails.

    >>> reli3d.write_environment("light.exr", asset.environment)
    >>> again = reli3d.read_environment("light.exr")
    """
    write = {".exr": write_exr, ".hdr": write_hdr}.get(os.path.splitext(path)[1].lower())
    if write is None:
        raise ValueError(f"path: expected a name that ends in .exr or .hdr, got {shown(os.path.basename(path))}")
    expect("environment", environment, Environment)
    height, width = environment.radiance.shape[:2]
    if width != 2 * height:
        raise ValueError(f"environment: expected a map (H, 2H, 3), got {tuple(environment.radiance.shape)}")
    return write(path, environment.radiance)


def environment_bytes(radiance: Tensor) -> bytes:
    """Bytes of an ``.hdr`` file with ``radiance (H, 2H, 3)``; errors as in :func:`write_environment`."""
    pixels, _ = _writable(radiance, float(np.finfo(np.float32).max) / 2)
    return rgbe_bytes(pixels)


def read_hdr_image(path: str | os.PathLike, *, notes: list[str] | None = None) -> Tensor:
    """Reads a linear Rec. 709 image ``(H, W, 3)``, float32, finite and not negative, from an ``.hdr`` or ``.exr`` file.

    For OpenEXR, the image is the display window, black outside the data window.  Colors in other primaries are
    converted.  Negative values are set to 0, infinity to 65504.  ``notes`` and errors as in :func:`read_environment`.
    """
    with opened(path) as file:
        start = file.read(4)
    found: list[str] = []
    pixels, matrix = (read_exr if start == b"\x76\x2f\x31\x01" else read_rgbe)(path, MAX_PIXELS, found)
    if np.isnan(pixels).any():
        count = int(np.isnan(pixels).any(-1).sum())
        raise InputError(path, f"pixels: expected numbers, got NaN at {count} pixels; render it again")
    infinite = np.isinf(pixels)
    high = infinite & (pixels > 0)
    pixels[infinite] = np.copysign(np.float32(HALF_MAX), pixels[infinite])  # finite before channels are mixed
    if matrix is not None:
        pixels = (pixels @ matrix.T).astype(np.float32)
    low = pixels < 0
    pixels[low] = 0.0
    if high.any() or low.any():
        counts = f"{int(high.sum())} infinite values set to 65504, {int(low.sum())} negative to 0"
        found.append(f"{os.path.basename(path)}: {counts}")
    if notes is not None:
        notes += found
    return torch.from_numpy(pixels)


def write_exr(path: str | os.PathLike, image: Tensor, *, half: bool = True) -> int:
    """Writes ``image`` as OpenEXR with ZIP compression, in half or float, completely or not at all.

    image: ``(H, W)`` luminance Y, ``(H, W, 3)`` RGB or ``(H, W, 4)`` RGBA, premultiplied by alpha.  Returns the number
    of values clamped to 65504.  Raises ValueError for NaN or negative values, OSError if writing fails.
    """
    pixels, clamped = _writable(image, HALF_MAX if half else float(np.finfo(np.float32).max), layouts=((), (3,), (4,)))
    name = "Y" if pixels.ndim == 2 else "RGBA"[: pixels.shape[2]]
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(path) as temporary:
        temporary.touch()  # an unwritable folder gives an OSError here instead of the library's own exception
        with OpenEXR.File(header, {name: pixels.astype(np.float16) if half else pixels}) as file:
            file.write(os.fsencode(temporary))  # bytes: a name need not be UTF-8
    return clamped


def write_hdr(path: str | os.PathLike, image: Tensor) -> int:
    """Writes ``image (H, W, 3)`` as run-length-encoded Radiance RGBE, completely or not at all.

    The relative error of a pixel's largest channel is at most 1/256; the other channels have the same absolute error.
    Returns the number of values clamped to 65504.  Raises ValueError for NaN or negative values, OSError if writing
    fails.
    """
    pixels, clamped = _writable(image, float(np.finfo(np.float32).max) / 2)
    write_bytes(path, rgbe_bytes(pixels))
    return clamped


def check_linear(image: Tensor, layouts: Sequence[tuple[int, ...]], *, finite: bool = False) -> None:
    """Raises TypeError unless float32, ValueError unless ``(H, W, *layout)``, not negative and (``finite``) finite."""
    if not isinstance(image, Tensor) or image.dtype != torch.float32:
        got = image.dtype if isinstance(image, Tensor) else type(image).__name__
        raise TypeError(f"image: expected a float32 tensor, as Render.rgba, got {got}")
    if image.ndim < 2 or image.shape[2:] not in layouts or image.numel() == 0:
        expected = " or ".join(f"(H, W{''.join(f', {n}' for n in layout)})" for layout in layouts)
        raise ValueError(f"image: expected shape {expected}, got {tuple(image.shape)}")
    valid = (image >= 0.0) & (image.isfinite() if finite else True)
    if not bool(valid.all()):
        expected = "finite values >= 0" if finite else "values >= 0"
        raise ValueError(f"image: expected {expected}, got others at {int((~valid).sum())} places")


def _writable(image: Tensor, limit: float, layouts: Sequence[tuple[int, ...]] = ((3,),)) -> tuple[np.ndarray, int]:
    check_linear(image, layouts)
    pixels = image.detach().cpu().numpy()
    over = pixels > limit
    return np.ascontiguousarray(np.where(over, np.float32(HALF_MAX), pixels)), int(over.sum())
