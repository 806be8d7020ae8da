"""Cameras of a COLMAP model, as text (``cameras.txt`` and ``images.txt``) or binary (``cameras.bin``, ``images.bin``).

COLMAP stores world-to-camera rotations (w, x, y, z) and translations in OpenCV axes (+Y down, looking along +Z); they
are converted to camera-to-world in OpenGL axes.  COLMAP's pixel centers are at +0.5 too.  Binary files are
little-endian, without alignment.  Source: https://colmap.github.io/format.html and the list of camera models there.
"""

import math
import os
import re
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path, PurePath
from typing import BinaryIO

import numpy as np

from reli3d.errors import InputError, shown
from reli3d.io.files import file_size, opened
from reli3d.io.gltf import rotation_of
from reli3d.views.file_names import FolderIndex, images_below, images_in
from reli3d.views.frames import MAX_PATH, Frame, Lens, file_within, nearest_rigid, number

MAX_BYTES = 1 << 28  # images.txt lists every matched point
MAX_LINE = 1 << 24  # an image's points: 30 characters each
MAX_IMAGES = 100_000
PLACES = ("sparse/0", "sparse", "sparse/*", "colmap/sparse/0", "colmap/sparse", "colmap/sparse/*", "")
_POINTS = re.compile(r"(?:[-+.0-9eE]+\s+[-+.0-9eE]+\s+-?\d+(?:\s+|$))+")  # x, y, number of the 3D point or -1
_POINT = 24  # bytes of a point in a binary file
# model: numbers of focal lengths, radial and tangential parameters; the principal point follows the focal lengths
_MODELS = {
    "SIMPLE_PINHOLE": (1, 0, 0),
    "PINHOLE": (2, 0, 0),
    "SIMPLE_RADIAL": (1, 1, 0),
    "RADIAL": (1, 2, 0),
    "OPENCV": (2, 2, 2),
}
_NAMES = (  # in the order of their numbers
    *(*_MODELS, "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
)


def find_colmap(folder: Path) -> list[Path]:
    """The ``images.txt`` and ``images.bin`` of the models in ``folder``; of both, the text, which users edit, first."""
    places = [at for place in PLACES for at in (sorted(folder.glob(place)) if place else [folder])]
    found = [at / f"images.{ending}" for at in dict.fromkeys(places) for ending in ("txt", "bin")]
    return [path for path in found if os.path.lexists(path) and os.path.lexists(_cameras_of(path))]


def _cameras_of(images: Path) -> Path:
    return images.with_name("cameras" + images.suffix)


def read_colmap(folder: Path, models: Sequence[Path]) -> tuple[list[Frame], list[str]]:
    """All frames by image name of the model with most images, image files below ``folder``, and notes.

    models: from :func:`find_colmap`; the first of the largest is read.  Images missing from the folder are omitted,
    with a note.  Raises InputError naming the line, or the entry of a binary file, and the field.
    """
    notes = ["COLMAP models have no up direction and no scale: the mesh is in the frame of the cameras"]
    entries = [_entries(path) for path in models]
    best = max(range(len(models)), key=lambda k: len(entries[k]))
    path = models[best]
    if len(models) > 1:
        names = [p.relative_to(folder).as_posix() for p in models]
        sizes = ", ".join(f"{name} {len(e)}" for name, e in zip(names, entries))
        notes.append(f"{len(models)} COLMAP models, with numbers of images {sizes}: {names[best]} is used")
    if not entries[best]:
        raise InputError(path, "expected at least one image, got none; export the model again")
    cameras = _cameras_of(path)
    lenses = _lenses(_text_cameras(cameras) if path.suffix == ".txt" else _binary_cameras(cameras))
    if not lenses:
        raise InputError(cameras, "expected at least one camera, got none; export the model again")
    index, listed = FolderIndex(), [PurePath(name) for name, *_ in entries[best]]
    name, count = Counter(name for name, *_ in entries[best]).most_common(1)[0]
    if count > 1:
        raise InputError(path, f"NAME: expected each image once, got {shown(name)} {count} times; export it again")
    places = [at for at in (folder / "images", folder) if at.is_dir()]
    images = max(places, key=lambda at: sum(index.find(at, name) is not None for name in listed))
    frames, missing = [], []
    for name, where, pose, camera in sorted(entries[best], key=lambda entry: entry[0]):
        if camera not in lenses:
            raise InputError(where, f"CAMERA_ID: expected one of its cameras, got {shown(camera)}; export it again")
        image = file_within(images, where, "NAME", name)
        found = image if os.path.isfile(image) else index.find(images, PurePath(name))
        c2w = _pose(where, pose)
        if found is None:
            missing.append(name)
        else:
            frames.append(Frame(where, name, found, None, c2w, lenses[camera]))
    if not frames:
        got = f"{shown(missing[0])} which does not exist"
        raise InputError(path, f"NAME: expected images in {images}, got {got}; copy them in")
    return frames, notes + _counted(folder, images, frames, missing)


def _counted(folder: Path, images: Path, frames: list[Frame], missing: list[str]) -> list[str]:
    """Notes on images that the model does not list, and on listed ones that are missing."""
    used = {os.path.realpath(frame.image) for frame in frames}
    there = images_below(images) if images != folder else images_in(folder)
    notes = []
    if any(os.path.realpath(p) not in used for p in there):
        notes.append(f"the model lists {len(frames)} of the {len(there)} images in the folder")
    if missing:
        names = ", ".join(shown(name) for name in missing[:4]) + (", ..." if len(missing) > 4 else "")
        count = len(frames) + len(missing)
        notes.append(f"of the {count} images that the model lists {len(missing)} are missing in the folder: {names}")
    return notes


def _entries(path: Path) -> list[tuple]:
    """``(name, where, pose, camera)`` of each image."""
    read = _text_images if path.suffix == ".txt" else _binary_images
    entries = list(islice(read(path), MAX_IMAGES + 1))
    if len(entries) > MAX_IMAGES:
        raise InputError(path, f"expected at most {MAX_IMAGES} images; export the views to be used")
    return entries


def _text_images(path: Path) -> Iterator[tuple[str, str, list[float], str]]:
    """See :func:`_entries`; lines of points, which some programs leave out, are recognized by their form."""
    for n, line in _lines(path):
        if _POINTS.fullmatch(line):
            continue
        words = line.split(maxsplit=9)
        where = f"{path}: line {n}"
        if len(words) != 10:
            expected = "expected ID, rotation (4), translation (3), camera and name"
            raise InputError(where, f"{expected}, got {shown(line)}; export the model again")
        yield words[9], where, [_real(where, "QVEC TVEC", v) for v in words[1:8]], words[8]


def _pose(where: str, values: list[float]) -> np.ndarray:
    w, x, y, z, *t = (number(where, "QVEC TVEC", v, -1e9, 1e9) for v in values)
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if abs(norm - 1.0) > 1e-2:  # COLMAP writes unit quaternions with at least six digits
        raise InputError(where, f"QVEC: expected a unit quaternion, got length {norm:.4g}; export the model again")
    rotation = rotation_of(w, x, y, z)
    c2w = np.eye(4)
    c2w[:3, :3] = rotation.T * (1, -1, -1)  # columns y and z turned: OpenCV to OpenGL axes
    c2w[:3, 3] = -rotation.T @ np.array(t)
    return nearest_rigid(where, "QVEC TVEC", c2w)


def _text_cameras(path: Path) -> Iterator[tuple[str, str, str, list[float], list[float]]]:
    """``(where, id, model, width and height, parameters)`` of each camera."""
    for n, line in _lines(path):
        where, words = f"{path}: line {n}", line.split()
        if len(words) < 5:
            raise InputError(where, f"expected ID, model, width, height, parameters, got {shown(line)}; export again")
        size = [_real(where, field, v) for field, v in zip(("WIDTH", "HEIGHT"), words[2:4])]
        yield where, words[0], words[1], size, [_real(where, "PARAMS", v) for v in words[4:]]


def _lenses(cameras: Iterator) -> dict[object, Lens]:
    lenses = {}
    for where, key, model, size, values in cameras:
        if key in lenses:
            raise InputError(where, f"CAMERA_ID: expected every camera once, got {shown(key)} twice; export it again")
        if model not in _MODELS:
            expected = f"expected {', '.join(_MODELS)}, got {shown(model)}"
            raise InputError(where, f"MODEL: {expected}; run colmap image_undistorter first")
        focals, radial, tangential = _MODELS[model]
        if len(values) != (count := focals + 2 + radial + tangential):
            raise InputError(where, f"PARAMS: expected {count} numbers for {model}, got {len(values)}; export it again")
        values = [number(where, "PARAMS", v, -1e9, 1e9) for v in values]
        if min(values[:focals]) <= 0 or min(size) < 1 or max(size) > 1e6:
            got = shown([*size, *values])
            raise InputError(where, f"PARAMS: expected a positive size and focal length, got {got}; export it again")
        lenses[key] = Lens(
            focal=(values[0], values[focals - 1]),
            center=(values[focals], values[focals + 1]),
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
    """``(number, text)`` of the lines that are neither empty nor a comment."""
    size = file_size(path)
    if size > MAX_BYTES:
        raise InputError(path, f"expected at most {MAX_BYTES} bytes, got {size}; export the model without points")
    try:
        with opened(path, "r", encoding="utf-8-sig", errors="strict") as file:
            for n, line in enumerate(iter(lambda: file.readline(MAX_LINE + 1), ""), 1):
                if len(line) > MAX_LINE:
                    raise InputError(path, f"line {n}: expected at most {MAX_LINE} characters; export it again")
                line = line.strip()
                if line and not line.startswith("#"):
                    yield n, line
    except UnicodeDecodeError:
        raise InputError(path, "expected UTF-8 text, got other bytes; export the model again") from None


def _binary_cameras(path: Path) -> Iterator[tuple[str, int, str, list[float], list[float]]]:
    """See :func:`_text_cameras`."""
    with opened(path) as content:
        file = _Entries(path, content)
        for where in file.each():
            key, model, *size = file.take("<IiQQ")
            name = _NAMES[model] if 0 <= model < len(_NAMES) else f"number {model}"
            count = sum(_MODELS[name]) + 2 if name in _MODELS else 0  # others are refused
            yield where, key, name, size, list(file.take(f"<{count}d"))


def _binary_images(path: Path) -> Iterator[tuple[str, str, list[float], int]]:
    """See :func:`_entries`."""
    with opened(path) as content:
        file = _Entries(path, content)
        for where in file.each():
            _, *pose, camera = file.take("<I7dI")
            name = file.text()
            file.skip(file.take("<Q")[0] * _POINT)
            yield name, where, pose, camera


class _Entries:
    """A file that begins with the number of its entries; nothing is read beyond its end."""

    def __init__(self, path: Path, file: BinaryIO):
        self.path, self.file, self.size, self.where = path, file, file_size(path), str(path)

    def each(self) -> Iterator[str]:
        """Names of the entries for messages, as many as the file declares."""
        for k in range(self.take("<Q")[0]):
            self.where = f"{self.path}: entry {k}"
            yield self.where

    def take(self, layout: str) -> tuple:
        data = self.file.read(struct.calcsize(layout))
        if len(data) < struct.calcsize(layout):
            self._short()
        return struct.unpack(layout, data)

    def skip(self, count: int) -> None:
        if count > self.size - self.file.tell():
            self._short()
        self.file.seek(count, 1)

    def text(self) -> str:
        """The bytes up to the next NUL, which are UTF-8."""
        start = self.file.tell()
        data, end, _ = self.file.read(4 * MAX_PATH + 1).partition(b"\0")
        if not end:
            expected = f"expected a name of at most {4 * MAX_PATH} bytes"
            raise InputError(self.where, f"NAME: {expected}, got no end of it; export the model again")
        self.file.seek(start + len(data) + 1)
        try:
            return data.decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(self.where, "NAME: expected UTF-8, got other bytes; export the model again") from None

    def _short(self):
        expected = f"expected more than the {self.size} bytes of the file"
        raise InputError(self.where, f"{expected}; it is cut off or no COLMAP model, export it again")
