"""Cameras of a COLMAP text model: ``cameras.txt`` and ``images.txt``.

COLMAP stores world-to-camera rotations (w, x, y, z) and translations in OpenCV axes (+Y down, looking along +Z); they
become camera-to-world in OpenGL axes here.  Pixel centres lie at +0.5 there as well.
Source: https://colmap.github.io/format.html and the list of camera models there.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from reli3d.io.files import InputError, file_size, shown
from reli3d.views.shots import Lens, Shot, cleaned, inside, number

MAX_BYTES = 1 << 28  # images.txt lists every matched point
MAX_LINE = 1 << 24  # an image's points: 30 characters each
MAX_IMAGES = 100_000
PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "")
# model: numbers of focal lengths, radial and tangential parameters; the centre stands after the focal lengths
_MODELS = {"SIMPLE_PINHOLE": (1, 0, 0), "PINHOLE": (2, 0, 0), "SIMPLE_RADIAL": (1, 1, 0), "RADIAL": (1, 2, 0),
           "OPENCV": (2, 2, 2)}  # fmt: skip


def find_colmap(folder: Path) -> Path | None:
    """Folder of the text model in ``folder``, or None.  Raises InputError where there is only a binary model."""
    for place in PLACES:
        at = folder / place
        if (at / "cameras.txt").exists() and (at / "images.txt").exists():
            return at
    for place in PLACES:
        at = folder / place
        if (at / "cameras.bin").exists():
            raise InputError(at, "cameras.bin: expected a COLMAP text model, got a binary one; run "
                                 "colmap model_converter --input_path X --output_path X --output_type TXT")  # fmt: skip
    return None


def read_colmap(folder: Path, model: Path, *, outside: bool = False) -> tuple[list[Shot], list[str]]:
    """All shots by image name of the model in ``model``, image files below ``folder``, and notes.

    Raises InputError naming the line and the field.
    """
    notes = ["COLMAP models have no up direction and no scale: the mesh comes out as the cameras stand"]
    lenses = _cameras(model / "cameras.txt")
    path, entries = model / "images.txt", []
    lines = _lines(path)
    for n, line in lines:
        next(lines, None)  # the second line of each image lists its points, which are not needed
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise InputError(path, f"line {n}: expected ID, rotation (4), translation (3), camera and name, got "
                                   f"{shown(line)}; export the model again")  # fmt: skip
        entries.append((words[9], n, words))
        if len(entries) > MAX_IMAGES:
            raise InputError(path, f"expected at most {MAX_IMAGES} images; export the views to be used")
    if not entries:
        raise InputError(path, "expected at least one image, got none; export the model again")
    images = folder / "images" if (folder / "images").is_dir() else folder
    shots = []
    for name, n, words in sorted(entries):
        where = f"{path}: line {n}"
        if words[8] not in lenses:
            raise InputError(where, f"CAMERA_ID: expected one of cameras.txt, got {shown(words[8])}; export it again")
        image = inside(images, where, "NAME", name, outside=outside)
        shots.append(Shot(where, name, image, None, _pose(where, words[1:8]), lenses[words[8]]))
    return shots, notes


def _pose(where: str, words: list[str]) -> np.ndarray:
    w, x, y, z, *t = (_real(where, "QVEC TVEC", v) for v in words)
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if abs(norm - 1.0) > 1e-2:  # COLMAP writes unit quaternions with at least six digits
        raise InputError(where, f"QVEC: expected a unit quaternion, got length {norm:.4g}; export the model again")
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    c2w = np.eye(4)
    c2w[:3, :3] = rotation.T * (1, -1, -1)  # columns y and z turned: OpenCV to OpenGL axes
    c2w[:3, 3] = -rotation.T @ np.array(t)
    return cleaned(where, "QVEC TVEC", c2w)


def _cameras(path: Path) -> dict[str, Lens]:
    lenses = {}
    for n, line in _lines(path):
        where, words = f"{path}: line {n}", line.split()
        if not words:
            continue
        if len(words) < 5:
            raise InputError(where, f"expected ID, model, width, height, parameters, got {shown(line)}; export it "
                             "again")  # fmt: skip
        if words[0] in lenses:
            raise InputError(where, f"CAMERA_ID: expected every camera once, got {shown(words[0])} twice; export "
                             "it again")  # fmt: skip
        if words[1] not in _MODELS:
            raise InputError(where, f"MODEL: expected {', '.join(_MODELS)}, got {shown(words[1])}; run colmap "
                                    "image_undistorter first")  # fmt: skip
        focals, radial, tangential = _MODELS[words[1]]
        size = [_real(where, field, v) for field, v in zip(("WIDTH", "HEIGHT"), words[2:4])]
        values = [_real(where, "PARAMS", v) for v in words[4:]]
        if len(values) != focals + 2 + radial + tangential:
            raise InputError(where, f"PARAMS: expected {focals + 2 + radial + tangential} numbers for {words[1]}, got "
                                    f"{len(values)}; export it again")  # fmt: skip
        if min(values[:focals]) <= 0 or min(size) < 1 or max(size) > 1e6:
            raise InputError(where, f"PARAMS: expected a positive size and focal length, got {shown(line)}; export "
                             "it again")  # fmt: skip
        lenses[words[0]] = Lens(
            focal=(values[0], values[focals - 1]),
            centre=(values[focals], values[focals + 1]),
            size=(int(size[0]), int(size[1])),
            radial=tuple(values[focals + 2 : focals + 2 + radial]),
            tangential=tuple(values[focals + 2 + radial :]),
        )
    if not lenses:
        raise InputError(path, "expected at least one camera, got none; export the model again")
    return lenses


def _real(where: str, field: str, word: str) -> float:
    try:
        value = float(word) if "_" not in word else math.nan
    except ValueError:
        raise InputError(where, f"{field}: expected a number, got {shown(word)}; export the model again") from None
    return number(where, field, value, -1e9, 1e9)


def _lines(path: Path):
    """``(number, text)`` of the lines that are no comment; empty ones count, as images.txt needs them."""
    size = file_size(path)
    if size > MAX_BYTES:
        raise InputError(path, f"expected at most {MAX_BYTES} bytes, got {size}; export the model without points")
    try:
        with open(path, encoding="utf-8", errors="strict") as file:
            for n, line in enumerate(iter(lambda: file.readline(MAX_LINE + 1), ""), 1):
                if len(line) > MAX_LINE:
                    raise InputError(path, f"line {n}: expected at most {MAX_LINE} characters; export it again")
                if not line.startswith("#"):
                    yield n, line.strip()
    except UnicodeDecodeError:
        raise InputError(path, "expected UTF-8 text, got other bytes; export the model again") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error}); check its permissions") from None
