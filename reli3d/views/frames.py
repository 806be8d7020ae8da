"""Frames of a camera file, checked before the image is read: image file, pose and lens."""

import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

import numpy as np

from reli3d.errors import InputError, shown

MAX_PATH = 1024
ORTHONORMAL = 1e-3  # largest entry of R^T R - 1: four digits in a text file; beyond it is a shear or a scale
MAX_POSE_DISTANCE = 1e6  # float32 poses keep a tenth of a unit there
MAX_DISTORTION_PIXELS = 1.0  # displacement of a pixel up to which a lens is used as a pinhole
MAX_SKEW = 1e-3  # of the focal length: half a pixel across an image
RADII = 32  # of an image's diagonal at which distortion is evaluated


@dataclass(frozen=True)
class Lens:
    """Either a field of view in radians, or focal lengths in pixels of an image of ``size`` (None: as stored)."""

    fov: tuple[float, float] | None = None  # (x, y); y is NaN if the focal lengths are equal
    focal: tuple[float, float] | None = None
    center: tuple[float, float] | None = None  # None or NaN: the middle
    size: tuple[int, int] | None = None
    radial: tuple[float, ...] = ()  # k1, k2, ... of OpenCV's polynomial; accepted if negligible
    tangential: tuple[float, ...] = ()  # p1, p2


@dataclass(frozen=True)
class Frame:
    """A posed image file.  where: camera file and frame, for error messages."""

    where: str
    name: str
    image: Path
    mask: Path | None
    c2w: np.ndarray  # (4, 4) float64, OpenGL axes
    lens: Lens
    notes: tuple[str, ...] = ()  # assumptions about it
    lighting: str = "object"  # as in reli3d.fit.input_images: object, camera or turntable
    object_box: tuple[tuple[float, ...], ...] | None = None  # lower and upper corner, of all frames of the file


def number(where: str, field: str, value: object, low: float = -math.inf, high: float = math.inf) -> float:
    """``value`` as a finite float strictly between ``low`` and ``high``.  Raises InputError."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(where, f"{field}: expected a number, got {shown(value)}; write it without quotes")
    if not abs(value) <= sys.float_info.max:  # an integer may have any number of digits
        raise InputError(where, f"{field}: expected a finite number, got {shown(value)}; correct the camera file")
    if not low < value < high:
        hint = "give radians" if high == math.pi else "correct the camera file"
        raise InputError(where, f"{field}: expected a number between {low:g} and {high:g}, got {shown(value)}; {hint}")
    return float(value)


def rigid(where: str, field: str, value: object) -> np.ndarray:
    """``(4, 4)`` float64 rotation and translation from nested lists.  Raises InputError; rounding is cleaned up."""
    if not isinstance(value, list) or len(value) != 4 or any(not isinstance(r, list) or len(r) != 4 for r in value):
        raise InputError(where, f"{field}: expected four lists of four numbers, got {shown(value)}; write it by rows")
    matrix = np.array([[number(where, field, v) for v in row] for row in value], dtype=np.float64)
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        transposed = np.abs(matrix[:, 3] - (0, 0, 0, 1)).max() <= 1e-6
        fix = "transpose it" if transposed else "write the camera-to-world matrix row by row"
        raise InputError(where, f"{field}: expected the last row 0 0 0 1, got {shown(matrix[3].tolist())}; {fix}")
    return nearest_rigid(where, field, matrix)


def nearest_rigid(where: str, field: str, matrix: np.ndarray) -> np.ndarray:
    """``matrix`` with its upper left block replaced by the nearest rotation.  Raises InputError if they differ much."""
    block = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        determinant, gram = float(np.linalg.det(block)), block.T @ block
    if not np.isfinite(gram).all() or not determinant > 0:
        expected = "expected a rotation, not a mirrored or flat camera"
        raise InputError(where, f"{field}: {expected}, got determinant {determinant:.3g}; export it again")
    if np.abs(gram - np.eye(3)).max() > ORTHONORMAL:
        scale = determinant ** (1 / 3)
        skew = np.abs(gram / scale**2 - np.eye(3)).max()
        got, fix = "axes not at right angles or not of length 1", "export rotation and translation only"
        if skew <= ORTHONORMAL and abs(scale**2 - 1) > skew:
            got, fix = f"scale {scale:.4g}", "divide the 3x3 block by it"
        raise InputError(where, f"{field}: expected a rotation, got {got}; {fix}")
    if np.abs(matrix[:3, 3]).max() > MAX_POSE_DISTANCE:
        expected = f"expected a position within {MAX_POSE_DISTANCE:g} of the origin"
        raise InputError(where, f"{field}: {expected}, got {shown(matrix[:3, 3].tolist())}; shift or scale the cameras")
    u, _, vt = np.linalg.svd(block)
    result = matrix.copy()
    result[:3, :3] = u @ vt
    return result


def file_within(root: Path, where: str, field: str, value: object) -> Path:
    """Path of the file that ``value`` names relative to ``root``.  Raises InputError if it leaves ``root``.

    Errors are non-text values, text with NUL, URLs, absolute paths, and files outside ``root`` (through ``..`` or a
    link).  The file need not exist.
    """
    expected, got = f"{field}: expected the path of a file", shown(value)
    if not isinstance(value, str) or not value.strip() or len(value) > MAX_PATH or "\0" in value:
        raise InputError(where, f"{expected}, 1 to {MAX_PATH} characters without NUL, got {got}; correct it")
    if "://" in value or value.lower().startswith(("file:", "data:")):
        raise InputError(where, f"{expected} in the folder, got the URL {got}; download it first")
    if Path(value).is_absolute() or PureWindowsPath(value).drive or value.startswith(("\\", "~")):
        raise InputError(where, f"{expected} within the folder, got the absolute {got}; copy the file in")
    try:
        within = is_within(root, root / value)
    except (OSError, ValueError):
        raise InputError(where, f"{expected}, got {got}; correct it") from None
    if not within:
        raise InputError(where, f"{expected} within the folder, got {got} which leads out of it; copy the file in")
    return root / value


def is_within(root: Path, path: Path) -> bool:
    """Whether ``path`` is below ``root`` after links are followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(root))


def check_distortion(where: str, lens: Lens, focal: float, reach: tuple[float, float]) -> list[str]:
    """A note if ``lens`` displaces pixels by at most MAX_DISTORTION_PIXELS (OpenCV's polynomial), else InputError.

    reach: largest distance [px] of pixels from the principal point, in x and y.  The displacement is evaluated from the
    principal point to there, as coefficients of opposite sign cancel at the corner and not before it.
    """
    if not any(lens.radial + lens.tangential):
        return []
    p1, p2 = lens.tangential or (0.0, 0.0)
    with np.errstate(all="ignore"):  # a focal length next to nothing gives infinity or NaN
        x, y = np.outer(np.divide(reach, focal), np.arange(1, RADII + 1) / RADII)
        r2 = x * x + y * y
        factor = np.abs(np.polyval((*lens.radial[::-1], 0.0), r2))
        dx = x * factor + abs(2 * p1) * x * y + abs(p2) * (r2 + 2 * x * x)
        dy = y * factor + abs(p1) * (r2 + 2 * y * y) + abs(2 * p2) * x * y
        moved = float((focal * np.hypot(dx, dy)).max())
    if not moved <= MAX_DISTORTION_PIXELS:
        got = f"expected an undistorted lens, got a displacement of {moved:.3g} pixels"
        raise InputError(where, f"distortion: {got}; undistort the images (colmap image_undistorter)")
    return [f"{where}: lens distortion of at most {moved:.2g} pixels ignored"]
