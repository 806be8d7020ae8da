"""The entries of COLMAP's binary files ``cameras.bin`` and ``images.bin``: little-endian, without alignment.

Source: https://colmap.github.io/format.html#binary-file-format.  Unused data, such as the points of an image, is
skipped.
"""

import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

from reli3d.errors import InputError, shown
from reli3d.io.files import file_size, opened
from reli3d.views.frames import MAX_PATH

# in the order of their numbers; the pinhole cameras and those with a polynomial lens have so many parameters
_NAMES = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
)
_PARAMETERS = (3, 4, 4, 5, 8)
_POINT = 24  # bytes: x, y, the number of the point


def cameras(path: Path) -> Iterator[tuple[str, int, str, list[float], list[float]]]:
    """``(where, id, model, width and height, parameters)`` of each camera.  Raises InputError."""
    with opened(path) as content:
        file = _Entries(path, content)
        for where in file.each():
            key, model, width, height = file.take("<IiQQ")
            if not 0 <= model < len(_PARAMETERS):
                name = _NAMES[model] if 0 <= model < len(_NAMES) else f"number {model}"
                raise no_pinhole(where, name, _NAMES[: len(_PARAMETERS)])
            yield where, key, _NAMES[model], [width, height], list(file.take(f"<{_PARAMETERS[model]}d"))


def images(path: Path) -> Iterator[tuple[str, str, list[float], int]]:
    """``(name, where, rotation and translation, camera)`` of each image.  Raises InputError."""
    with opened(path) as content:
        file = _Entries(path, content)
        for where in file.each():
            _, *pose, camera = file.take("<I7dI")
            name = file.text(where)
            (points,) = file.take("<Q")
            file.skip(points * _POINT)
            yield name, where, pose, camera


def no_pinhole(where: str, name: str, known: Collection[str]) -> InputError:
    """The error for a camera whose lens has no polynomial."""
    expected = f"expected {', '.join(known)}, got {shown(name)}"
    return InputError(where, f"MODEL: {expected}; run colmap image_undistorter first")


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

    def text(self, where: str) -> str:
        """The bytes up to the next NUL, which are UTF-8."""
        start = self.file.tell()
        data, end, _ = self.file.read(4 * MAX_PATH + 1).partition(b"\0")
        if not end:
            expected = f"expected a name of at most {4 * MAX_PATH} bytes"
            raise InputError(where, f"NAME: {expected}, got no end of it; export the model again")
        self.file.seek(start + len(data) + 1)
        try:
            return data.decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(where, "NAME: expected UTF-8, got other bytes; export the model again") from None

    def _short(self):
        expected = f"expected more than the {self.size} bytes of the file"
        raise InputError(self.where, f"{expected}; it is cut off or no COLMAP model, export it again")
