"""Cameras stored as NumPy arrays: LLFF's ``poses_bounds.npy``, IDR's and NeuS's ``cameras_sphere.npz``.

Both are matched to images only by the order of the file names, as in the reference readers of these formats.
"""

import io
from pathlib import Path

import numpy as np
from scipy.linalg import rq

from reli3d.errors import InputError, shown
from reli3d.io.files import read_bytes
from reli3d.views.file_names import images_in, named
from reli3d.views.frames import MAX_SKEW, Frame, Lens, nearest_rigid

NEUS = ("cameras_sphere.npz", "cameras.npz")
MAX_BYTES = 1 << 26  # 4,096 cameras in two matrices each take 1 MB
LLFF_IMAGES = ("images", "images_2", "images_4", "images_8")  # the last ones scaled down


def read_llff(folder: Path, path: Path) -> tuple[list[Frame], list[str]]:
    """Frames of ``poses_bounds.npy``: ``(V, 17)``, 3x5 [rotation | position | height, width, focal] and two depths.

    The columns of the rotation are down, right, back (https://github.com/Fyusion/LLFF).  Raises InputError.
    """
    table = _load(path)
    if isinstance(table, dict) or table.ndim != 2 or table.shape[1] != 17:
        got = f"{len(table)} named arrays" if isinstance(table, dict) else str(table.shape)
        raise InputError(path, f"expected an array of shape (V, 17), got {got}; run LLFF's imgs2poses again")
    place = next((at for at in LLFF_IMAGES if images_in(folder / at)), LLFF_IMAGES[0])
    images = _as_many(path, folder / place, len(table))
    frames = []
    for k, (row, image) in enumerate(zip(_finite(path, table), images)):
        where, pose = f"{path}: row {k}", row[:15].reshape(3, 5)
        height, width, focal = pose[:, 4]
        if not (height >= 1 and width >= 1 and focal > 0):
            got = shown(pose[:, 4].tolist())
            raise InputError(where, f"hwf: expected a positive size and focal length, got {got}; run imgs2poses again")
        c2w = np.eye(4)
        c2w[:3] = np.stack([pose[:, 1], -pose[:, 0], pose[:, 2], pose[:, 3]], -1)
        lens = Lens(focal=(focal, focal), size=(round(width), round(height)))
        name = image.relative_to(folder).as_posix()
        frames.append(Frame(where, name, image, None, nearest_rigid(where, "rotation", c2w), lens))
    return frames, []


def read_neus(folder: Path, path: Path) -> tuple[list[Frame], list[str]]:
    """Frames of ``world_mat_i`` and ``scale_mat_i``, 4x4 each: ``world_mat_i @ scale_mat_i`` projects the unit sphere
    about the object to pixels (https://github.com/lioryariv/idr, DATA_CONVENTION.md).

    Images are in ``image``, masks in ``mask``.  Raises InputError.
    """
    arrays = _load(path)
    if not isinstance(arrays, dict) or "world_mat_0" not in arrays:
        raise InputError(path, "expected arrays world_mat_0, scale_mat_0, ..., got none; export the cameras again")
    place = next((at for at in ("image", "images") if images_in(folder / at)), "image")
    images = _as_many(path, folder / place, sum(key.startswith("world_mat_") and "inv" not in key for key in arrays))
    masks = [at for at in (images_in(folder / at) for at in named(folder, ("mask", "masks"))) if at]
    if masks and len(masks[0]) != len(images):
        expected = f"expected {len(images)} masks, one for each image"
        raise InputError(masks[0][0].parent, f"{expected}, got {len(masks[0])}; add or remove")
    frames = []
    for k, image in enumerate(images):
        where = f"{path}: world_mat_{k}, scale_mat_{k}"
        pair = [arrays[key] for key in (f"world_mat_{k}", f"scale_mat_{k}") if key in arrays]
        if [m.shape for m in pair] != [(4, 4), (4, 4)]:
            raise InputError(where, "expected a 4x4 array each, got none or another shape; export the cameras again")
        world, scale = (_finite(path, m) for m in pair)
        lens, c2w = _decomposed(where, (world @ scale)[:3])
        name, mask = image.relative_to(folder).as_posix(), masks[0][k] if masks else None
        frames.append(Frame(where, name, image, mask, nearest_rigid(where, "rotation", c2w), lens))
    return frames, []


def _decomposed(where: str, projection: np.ndarray) -> tuple[Lens, np.ndarray]:
    """Lens, and camera-to-world ``(4, 4)`` in OpenGL axes, of a ``(3, 4)`` matrix.

    ``projection`` is K [R | t] times any factor but 0, in OpenCV axes.  RQ decomposition of its left 3x3 block (Hartley
    and Zisserman 2004, section 6.2.4).  Raises InputError for a singular block or a skew.
    """
    block = projection[:, :3]
    determinant = float(np.linalg.det(block))
    if not np.isfinite(determinant) or abs(determinant) <= 1e-12 * np.linalg.norm(block) ** 3:
        raise InputError(where, "expected a projection, got a singular matrix; export the cameras again")
    upper, rotation = rq(np.sign(determinant) * block)  # the factor's sign is free; a rotation has determinant 1
    signs = np.sign(np.diag(upper))
    upper, rotation = upper * signs, signs[:, None] * rotation
    upper = upper / upper[2, 2]
    if abs(upper[0, 1]) > MAX_SKEW * upper[0, 0]:
        raise InputError(where, f"expected a camera without skew, got {upper[0, 1]:.3g} pixels; undistort the images")
    c2w = np.eye(4)
    c2w[:3, :3] = rotation.T * (1, -1, -1)  # columns y and z turned: OpenCV to OpenGL axes
    c2w[:3, 3] = -np.linalg.solve(block, projection[:, 3])
    (fx, _, cx), (_, fy, cy), _ = upper.tolist()
    return Lens(focal=(fx, fy), center=(cx + 0.5, cy + 0.5)), c2w  # pixel centers at whole numbers there


def _load(path: Path) -> np.ndarray | dict[str, np.ndarray]:
    data = read_bytes(path, MAX_BYTES)
    try:
        loaded = np.load(io.BytesIO(data), allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        if sum(entry.file_size for entry in loaded.zip.infolist()) > MAX_BYTES:
            raise InputError(path, f"expected at most {MAX_BYTES} bytes of arrays; keep the matrices of the cameras")
        return {key: loaded[key] for key in loaded.files if key.startswith(("world_mat_", "scale_mat_"))}
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib and numpy raise almost anything on a broken file
        raise InputError(path, f"expected NumPy arrays of numbers ({shown(str(error))}); save the file again") from None


def _finite(path: Path, array: np.ndarray) -> np.ndarray:
    """``array`` in float64.  Raises InputError unless it holds finite real numbers."""
    if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise InputError(path, f"expected finite numbers, got others in an array of {array.dtype}; save the file again")
    return array.astype(np.float64)


def _as_many(path: Path, folder: Path, count: int) -> list[Path]:
    images = images_in(folder)
    if len(images) != count or not images:
        expected = f"expected {count} images in {folder.name}, one for each camera in the order of their names"
        raise InputError(path, f"{expected}, got {len(images)}; add or remove images")
    return images
