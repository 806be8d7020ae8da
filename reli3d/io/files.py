"""Reading and writing files safely: one-line errors, size limits, whole files or none."""

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from reli3d.errors import InputError


def read_bytes(path: str | os.PathLike, limit: int) -> bytes:
    """Content of a regular file of at most ``limit`` bytes, else InputError; never blocks on a pipe."""
    size = file_size(path)
    if size > limit:
        raise InputError(path, f"expected at most {limit} bytes, got {size}; give a smaller file")
    with opened(path) as file:
        return file.read(size)  # not the limit: Python would allocate it


@contextlib.contextmanager
def opened(path: str | os.PathLike, mode: str = "rb", **options) -> Iterator[Any]:
    """A regular file, open for reading; an OSError of the block becomes an InputError.  options: of ``open``."""
    file_size(path)  # raises for a pipe, which would block
    try:
        with open(path, mode, **options) as file:
            yield file
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error}); check its permissions") from None


def file_size(path: str | os.PathLike) -> int:
    """Size of a regular file in bytes.  Raises InputError if there is none, TypeError unless ``path`` is a path."""
    try:
        info = os.stat(os.fspath(path))
    except FileNotFoundError:
        raise InputError(path, "file not found; check the path") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(path, f"cannot be opened ({reason}); check the path") from None
    if not stat.S_ISREG(info.st_mode):
        raise InputError(path, "expected a regular file, got a folder, pipe or device; check the path")
    return info.st_size


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Writes a file atomically: a temporary file in the same folder, then a rename.  Raises OSError."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


@contextlib.contextmanager
def replacing(path: str | os.PathLike):
    """Yields a temporary path in the folder of ``path``; it replaces ``path`` if the block ends without an error."""
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "the folder does not exist", str(path.parent))
    temporary = path.with_name(f".{os.getpid()}.{os.urandom(4).hex()}{path.suffix[-8:]}")  # short: none cuts it
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
