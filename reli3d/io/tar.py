"""Objects in a tar file from anywhere: nothing in it is trusted, and nothing is written outside a folder of our own.

The entry ``shoe/rgba/0.png`` is the file ``rgba/0.png`` of the object ``shoe``; without a folder, as in samples of
WebDataset, ``shoe.mesh.glb`` is its file ``mesh.glb``.  The files of an object stand one after another.  Entries with a
name that begins with a dot are passed over.
"""

from __future__ import annotations

import os
import re
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import BinaryIO

from reli3d.io.files import InputError, file_size, shown

MAX_FILE = 1 << 29  # bytes, as of an image
MAX_OBJECT = 1 << 32  # bytes of its files: they lie in the temporary folder while they are read
MAX_FILES = 10_000  # of an object: 4,096 photographs, which is the most that cameras are read of, with masks
MAX_OBJECTS = 1 << 20  # of a tar file
MAX_NAME, MAX_PART = 1024, 255  # characters of a path, bytes of a name
MAX_HEADER = 1 << 16  # bytes of what stands before an entry: a long name, times, attributes
MAX_PADDING = 1 << 20  # bytes of zeros after the last entry; usual are 10 KiB
_BLOCK = tarfile.BLOCKSIZE
_KINDS = {
    tarfile.LNKTYPE: "a link",
    tarfile.SYMTYPE: "a link",
    tarfile.GNUTYPE_LONGLINK: "a link",
    tarfile.CHRTYPE: "a device",
    tarfile.BLKTYPE: "a device",
    tarfile.FIFOTYPE: "a pipe",
    tarfile.GNUTYPE_SPARSE: "a sparse file",
}
_PAX = (tarfile.XHDTYPE, tarfile.SOLARIS_XHDTYPE)
_RECORD = re.compile(rb"([0-9]{1,5}) ([^=\n]+)=")


@dataclass(frozen=True)
class _Entry:
    """A regular file.  start: of its headers, in bytes of the tar file."""

    start: int
    object: str
    file: str
    offset: int
    size: int


@dataclass(frozen=True)
class Packed:
    """An object in a tar file: what stands from ``start`` to ``stop``."""

    shard: Path
    name: str
    start: int
    stop: int

    def files(self) -> dict[str, tuple[int, int]]:
        """Offset and size of each file of the object, by its name.  Raises InputError."""
        with _opened(self.shard) as (file, size):
            found = list(_entries(self.shard, file, size, self.start, self.stop))
        if any(entry.object != self.name for entry in found):
            raise InputError(self.shard, "expected the objects that it held before, got others; run the command again")
        return {entry.file: (entry.offset, entry.size) for entry in found}

    @contextmanager
    def unpacked(self) -> Iterator[Path]:
        """A temporary folder of the object.  What a ValueError of the block says of it is said of the tar file."""
        with tempfile.TemporaryDirectory(prefix="reli3d-") as root:
            with _opened(self.shard) as (file, _):
                for name, (offset, size) in self.files().items():
                    target = Path(root, name)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    file.seek(offset)
                    with open(target, "xb") as out:
                        _copy(file, out, size)
            try:
                yield Path(root)
            except ValueError as error:
                told = str(error).replace(os.path.realpath(root), root).replace(root, f"{self.shard}/{self.name}")
                raise ValueError(told) from error


def packed_objects(path: Path) -> list[Packed]:
    """The objects of a tar file.  Raises InputError for a file that is cut, compressed, or holds what no object has:

    links, devices, names that lead elsewhere, a file twice, more than ``MAX_FILE``, ``MAX_OBJECT`` or ``MAX_FILES``.
    """
    found: dict[str, Packed] = {}
    files: set[str] = set()  # of the object at hand
    folders: set[str] = set()
    with _opened(path) as (file, size):
        last = None
        for entry in _entries(path, file, size, 0, None):
            if entry.object != last:
                if entry.object in found:
                    raise _refused(path, entry.object, "the files of an object one after another", "others between")
                if len(found) == MAX_OBJECTS:
                    raise InputError(path, f"expected at most {MAX_OBJECTS} objects, got more; pack them in several")
                files, folders, last = set(), set(), entry.object
                found[last] = Packed(path, last, entry.start, entry.start)
            above = _above(entry.file)
            if entry.file in files or entry.file in folders or any(name in files for name in above):
                raise _refused(path, f"{last}/{entry.file}", "each file once", "it twice")
            files.add(entry.file)
            folders.update(above)
            if len(files) > MAX_FILES:
                raise _refused(path, last, f"at most {MAX_FILES} files of an object", "more")
            stop = entry.offset + _padded(entry.size)
            if stop - found[last].start > MAX_OBJECT:
                raise _refused(path, last, f"at most {MAX_OBJECT} bytes of an object", "more")
            found[last] = Packed(path, last, found[last].start, stop)
    if not found:
        raise InputError(path, "expected objects, got an empty tar file; pack folders with transforms.json")
    return list(found.values())


@contextmanager
def _opened(path: Path) -> Iterator[tuple[BinaryIO, int]]:
    size = file_size(path)  # refuses a pipe
    with open(path, "rb") as file:
        yield file, size


def _entries(path: Path, file: BinaryIO, size: int, at: int, stop: int | None) -> Iterator[_Entry]:
    """Files from ``at`` to ``stop``, or to the end of the archive.

    tarfile would follow a negative size without end, and take memory for what a header claims.
    """
    while stop is None or at < stop:
        start, named, stated = at, None, None
        while True:
            file.seek(at)
            block = file.read(_BLOCK)
            if len(block) < _BLOCK:
                raise InputError(path, f"expected a whole tar file, got one that is cut at {at}; copy it again")
            if block.count(0) == _BLOCK:
                _check_end(path, file)
                return
            head = _header(path, at, block)
            length = head.size if stated is None else stated
            at += _BLOCK
            if head.type in _KINDS:
                raise _refused(path, named or head.name, "files and folders", _KINDS[head.type])
            if not 0 <= length <= size - at:
                raise _refused(path, named or head.name, f"at most {size - at} bytes, which follow", f"{length}")
            if head.type not in (*_PAX, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME):
                break
            if length > MAX_HEADER:
                raise _refused(path, head.name, f"a header of at most {MAX_HEADER} bytes", f"{length}")
            data = file.read(length)
            if head.type in _PAX:
                named, stated = _pax(path, head.name, data, named)
            elif head.type == tarfile.GNUTYPE_LONGNAME:
                named = data.rstrip(b"\0").decode("utf-8", "surrogateescape")
            at += _padded(length)
        name = head.name if named is None else named
        if head.type == tarfile.DIRTYPE:
            _parts(path, name)
            continue
        if head.type not in (tarfile.REGTYPE, tarfile.AREGTYPE):
            raise _refused(path, name, "files and folders", f"an entry of type {head.type!r}")
        if length > MAX_FILE:
            raise _refused(path, name, f"at most {MAX_FILE} bytes", f"{length}")
        parts, offset, at = _parts(path, name), at, at + _padded(length)
        if any(part.startswith(".") for part in parts):
            continue
        if len(parts) == 1:
            parts = parts[0].split(".", 1)
        if len(parts) < 2 or not parts[1]:
            raise _refused(path, name, "OBJECT/FILE or OBJECT.FILE", "neither")
        yield _Entry(start, parts[0], "/".join(parts[1:]), offset, length)


def _header(path: Path, at: int, block: bytes) -> tarfile.TarInfo:
    try:
        return tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
    except (tarfile.TarError, ValueError, OverflowError):
        what = "another file, a compressed one or a broken one" if at == 0 else f"something else at {at}"
        raise InputError(path, f"expected a plain tar file, got {what}; pack it again") from None


def _pax(path: Path, name: str, data: bytes, named: str | None) -> tuple[str | None, int | None]:
    """Name and size that the records of a PAX header state for the next entry."""
    at, stated = 0, None
    while at < len(data):
        record = _RECORD.match(data, at)
        end = at + int(record[1]) if record else at
        if not record or not record.end() < end <= len(data) or data[end - 1 : end] != b"\n":
            raise _refused(path, name, "a PAX header", "a broken one")
        key, value = record[2], data[record.end() : end - 1]
        if key == b"path":
            named = value.decode("utf-8", "surrogateescape")
        elif key == b"size":
            stated = int(value) if value.isdigit() and len(value) < 20 else -1
        elif key.startswith(b"GNU.sparse"):
            raise _refused(path, name, "files and folders", "a sparse file")
        at = end
    return named, stated


def _check_end(path: Path, file: BinaryIO) -> None:
    """Raise InputError where a second archive, which tar files put together have, follows the end of the first."""
    rest = file.read(MAX_PADDING + 1)
    if len(rest) > MAX_PADDING or rest.count(0) != len(rest):
        raise InputError(path, "expected the end of the tar file, got more after it; give the tar files one by one")


def _parts(path: Path, name: str) -> list[str]:
    """The names of a path.  Raises InputError where it leads elsewhere, or cannot be written everywhere."""
    parts = [part for part in name.split("/") if part not in ("", ".")]
    elsewhere = name.startswith("/") or ".." in parts or PureWindowsPath(name).anchor or PureWindowsPath(name).drive
    if elsewhere or "\\" in name:
        raise _refused(path, name, "a path within the object", "one that leads elsewhere")
    if not name.isprintable():  # a lone surrogate, from bytes that are no UTF-8, is none of the printable ones
        raise _refused(path, name, "a name of printable letters in UTF-8", "others")
    if len(name) > MAX_NAME or any(len(part.encode()) > MAX_PART for part in parts):
        raise _refused(path, name, f"at most {MAX_NAME} characters of a path and {MAX_PART} bytes of a name", "more")
    return parts


def _above(name: str) -> list[str]:
    parts = name.split("/")
    return ["/".join(parts[:k]) for k in range(1, len(parts))]


def _padded(size: int) -> int:
    return -(-size // _BLOCK) * _BLOCK


def _copy(file: BinaryIO, out: BinaryIO, size: int) -> None:
    while size:
        part = file.read(min(size, 1 << 20))
        if not part:
            raise OSError("the tar file was cut while it was read")
        out.write(part)
        size -= len(part)


def _refused(path: Path, name: str, expected: str, got: str) -> InputError:
    return InputError(path, f"{shown(name)}: expected {expected}, got {got}")
