"""Cameras of a COLMAP model, as text (``cameras.txt`` and ``images.txt``) or binary (``cameras.bin``, ``images.bin``).

COLMAP stores world-to-camera rotations (w, x, y, z) and translations in OpenCV axes (+Y down, looking along +Z); they
become camera-to-world in OpenGL axes here.  Pixel centres lie at +0.5 there as well.
Source: https://colmap.github.io/format.html and the list of camera models there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from reli3d.io.files import InputError, file_size, shown
from reli3d.views import colmap_binary
from reli3d.views.shots import Lens, Shot, cleaned, inside, number

MAX_BYTES = 1 << 28  # images.txt lists every matched point
MAX_LINE = 1 << 24  # an image's points: 30 characters each
MAX_IMAGES = 100_000
PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "")
# model: numbers of focal lengths, radial and tangential parameters; the centre stands after the focal lengths
_MODELS = {
    "SIMPLE_PINHOLE": (1, 0, 0),
    "PINHOLE": (2, 0, 0),
    "SIMPLE_RADIAL": (1, 1, 0),
    "RADIAL": (1, 2, 0),
    "OPENCV": (2, 2, 2),
}


def find_colmap(folder: Path) -> Path | None:
    """Folder of the model in ``folder``, or None.  Of a text and a binary one the text, which people edit."""
    for ending in ("txt", "bin"):
        for place in PLACES:
            at = folder / place
            if (at / f"cameras.{ending}").exists() and (at / f"images.{ending}").exists():
                return at
    return None


def read_colmap(folder: Path, model: Path, *, outside: bool = False) -> tuple[list[Shot], list[str]]:
    """All shots by image name of the model in ``model``, image files below ``folder``, and notes.

    Raises InputError naming the line, or the entry of a binary file, and the field.
    """
    notes = ["COLMAP models have no up direction and no scale: the mesh comes out as the cameras stand"]
    text = (model / "cameras.txt").exists() and (model / "images.txt").exists()
    path = model / ("images.txt" if text else "images.bin")
    lenses = _lenses(_text_cameras(model / "cameras.txt") if text else colmap_binary.cameras(model / "cameras.bin"))
    if not lenses:
        raise InputError(model, "cameras: expected at least one camera, got none; export the model again")
    entries = []
    for entry in _text_images(path) if text else colmap_binary.images(path):
        entries.append(entry)
        if len(entries) > MAX_IMAGES:
            raise InputError(path, f"expected at most {MAX_IMAGES} images; export the views to be used")
    if not entries:
        raise InputError(path, "expected at least one image, got none; export the model again")
    images = folder / "images" if (folder / "images").is_dir() else folder
    shots = []
    for name, where, pose, camera in sorted(entries, key=lambda entry: entry[0]):
        if camera not in lenses:
            raise InputError(
                where, f"CAMERA_ID: expected one of the model's cameras, got {shown(camera)}; export it again"
            )
        image = inside(images, where, "NAME", name, outside=outside)
        shots.append(Shot(where, name, image, None, _pose(where, pose), lenses[camera]))
    return shots, notes


def _text_images(path: Path) -> Iterator[tuple[str, str, list[float], str]]:
    """``(name, where, rotation and translation, camera)`` of each image."""
    lines = _lines(path)
    for n, line in lines:
        next(lines, None)  # the second line of each image lists its points, which are not needed
        words = line.split(maxsplit=9)
        where = f"{path}: line {n}"
        if len(words) != 10:
            raise InputError(
                where,
                "expected ID, rotation (4), translation (3), camera and name, got "
                f"{shown(line)}; export the model again",
            )
        yield words[9], where, [_real(where, "QVEC TVEC", v) for v in words[1:8]], words[8]


def _pose(where: str, values: list[float]) -> np.ndarray:
    w, x, y, z, *t = (number(where, "QVEC TVEC", v, -1e9, 1e9) for v in values)
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if abs(norm - 1.0) > 1e-2:  # COLMAP writes unit quaternions with at least six digits
        raise InputError(where, f"QVEC: expected a unit quaternion, got length {norm:.4g}; export the model again")
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    c2w = np.eye(4)
    c2w[:3, :3] = rotation.T * (1, -1, -1)  # columns y and z turned: OpenCV to OpenGL axes
    c2w[:3, 3] = -rotation.T @ np.array(t)
    return cleaned(where, "QVEC TVEC", c2w)


def _text_cameras(path: Path) -> Iterator[tuple[str, str, str, list[float], list[float]]]:
    """``(where, id, model, width and height, parameters)`` of each camera."""
    for n, line in _lines(path):
        where, words = f"{path}: line {n}", line.split()
        if not words:
            continue
        if len(words) < 5:
            raise InputError(
                where, f"expected ID, model, width, height, parameters, got {shown(line)}; export it again"
            )
        if words[1] not in _MODELS:
            raise colmap_binary.no_pinhole(where, words[1], _MODELS)
        size = [_real(where, field, v) for field, v in zip(("WIDTH", "HEIGHT"), words[2:4])]
        yield where, words[0], words[1], size, [_real(where, "PARAMS", v) for v in words[4:]]


def _lenses(cameras: Iterator) -> dict[object, Lens]:
    lenses = {}
    for where, key, model, size, values in cameras:
        if key in lenses:
            raise InputError(where, f"CAMERA_ID: expected every camera once, got {shown(key)} twice; export it again")
        focals, radial, tangential = _MODELS[model]
        if len(values) != focals + 2 + radial + tangential:
            raise InputError(
                where,
                f"PARAMS: expected {focals + 2 + radial + tangential} numbers for {model}, got "
                f"{len(values)}; export it again",
            )
        values = [number(where, "PARAMS", v, -1e9, 1e9) for v in values]
        if min(values[:focals]) <= 0 or min(size) < 1 or max(size) > 1e6:
            raise InputError(
                where,
                f"PARAMS: expected a positive size and focal length, got {shown([*size, *values])}; export it again",
            )
        lenses[key] = Lens(
            focal=(values[0], values[focals - 1]),
            centre=(values[focals], values[focals + 1]),
            size=(int(size[0]), int(size[1])),
            radial=tuple(values[focals + 2 : focals + 2 + radial]),
            tangential=tuple(values[focals + 2 + radial :]),
        )
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
