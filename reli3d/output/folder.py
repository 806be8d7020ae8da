"""Atomic replacement of a result folder: files are written to a sibling folder, which is exchanged with it.

While ``NAME`` is written, its sibling ``.NAME.partial`` contains ``lock`` (held by the writing process), ``new`` (the
files) and, during the exchange, ``old``.  A killed process leaves this sibling behind; the next process that claims
``NAME`` completes the exchange or removes the files.  Linux exchanges two folders in one step (renameat2 with
RENAME_EXCHANGE).  Elsewhere two renames are needed; between them ``NAME`` is missing and ``new`` is complete.
"""

import contextlib
import ctypes
import errno
import hashlib
import os
import shutil
import stat
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from reli3d.errors import InputError, shown

try:
    import fcntl
except ImportError:  # Windows: another process at the same folder is not noticed
    fcntl = None  # type: ignore[assignment] # of a module

PARTIAL = ".partial"
LONGEST = 255  # bytes of a name, on every usual file system
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of Linux: fcntl.h, linux/fs.h
NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)  # file systems that have none: the same


def check_folder(folder: Path) -> Path:
    """``folder``, existing or not, with links resolved; writes nothing.  Raises InputError if it cannot hold files."""
    folder = Path(os.path.realpath(folder))
    for part in folder.parts:
        if (size := len(os.fsencode(part))) > LONGEST:
            expected = f"expected a name of at most {LONGEST} bytes for the output"
            raise InputError(shown(part), f"{expected}, got {size}; rename it or give another --output")
    above = folder
    while not os.path.lexists(above):
        above = above.parent
    if not above.is_dir():
        raise InputError(above, "expected a folder for the output, got a file; give another --output")
    if not os.access(above, os.W_OK | os.X_OK):
        raise InputError(above, "expected a folder that can be written, got one that cannot; give another --output")
    return folder


def check_place(folder: Path) -> Path:
    """:func:`check_folder` of a result folder and of its parent, in which siblings are created."""
    folder = check_folder(folder)
    check_folder(folder.parent)
    if folder == Path(os.path.realpath(os.curdir)):
        raise InputError(folder, "expected a folder other than the working one, which is replaced; run from its parent")
    if os.path.ismount(folder):
        raise InputError(folder, "expected a folder that can be renamed, got a mount point; mount its parent")
    return folder


@contextlib.contextmanager
def claimed(folder: Path, ours: Collection[str]) -> Iterator[Callable]:
    """Locks ``folder`` for this process; an interrupted exchange is completed first.

    Yields ``replacing()``, a context manager for an empty folder that replaces ``folder`` on exit without an error.
    ours: names of the files that belong to a result; other files in ``folder`` are kept.  Raises InputError if the
    place is not writable, OSError if another process holds the lock.
    """
    folder = check_place(folder)
    made = [p for p in folder.parents if not p.exists()]
    folder.parent.mkdir(parents=True, exist_ok=True)
    work = sibling(folder, ".", PARTIAL)
    try:
        lock = _locked(work, folder)
        try:
            _settle(work, folder, ours)
            yield lambda: _replacing(work, folder, ours)
        finally:
            with contextlib.suppress(OSError):
                _settle(work, folder, ours)
                if fcntl:
                    (work / "lock").unlink()
                    work.rmdir()
            os.close(lock)
            if not fcntl:  # Windows removes no open file
                shutil.rmtree(work, ignore_errors=True)
    finally:
        with contextlib.suppress(OSError):
            for parent in (*([work] if work.exists() else []), *made):
                parent.rmdir()  # unless there is something in it


@contextlib.contextmanager
def _replacing(work: Path, folder: Path, ours: Collection[str]) -> Iterator[Path]:
    new, old = work / "new", work / "old"
    new.mkdir()
    yield new
    if folder.exists():
        shutil.copymode(folder, new)
        os.rename(new, old)  # kept until foreign files are moved out of it
        if not exchanged(old, folder):
            os.rename(old, new)
            os.rename(folder, old)
            os.rename(new, folder)
    else:
        os.rename(new, folder)
    _settle(work, folder, ours)


def _settle(work: Path, folder: Path, ours: Collection[str]) -> None:
    """Completes an interrupted exchange, or removes the files of one that has not begun."""
    new, old = work / "new", work / "old"
    if old.exists():
        if not folder.exists():
            os.rename(new if new.exists() else old, folder)
        for path in old.iterdir() if old.exists() else ():
            if path.name not in ours and not os.path.lexists(folder / path.name):
                os.rename(path, folder / path.name)
        shutil.rmtree(old, ignore_errors=True)
    shutil.rmtree(new, ignore_errors=True)


def exchanged(first: Path, second: Path) -> bool:
    """Exchanges the names of two files or folders atomically; if the system cannot, returns False and does nothing."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2  # of glibc 2.28 and musl on Linux
    except (AttributeError, OSError, TypeError):
        return False
    rename.argtypes = (ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint)
    if rename(AT_FDCWD, os.fsencode(first), AT_FDCWD, os.fsencode(second), RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):  # the kernel or the file system cannot
        return False
    raise OSError(code, os.strerror(code), str(first), None, str(second))


def sibling(path: Path, before: str, after: str) -> Path:
    """``path`` with its name between ``before`` and ``after``; a name that would be too long is replaced by a hash."""
    name = f"{before}{path.name}{after}"
    if len(os.fsencode(name)) > LONGEST:
        name = f"{before}{hashlib.sha256(os.fsencode(path.name)).hexdigest()[:32]}{after}"
    return path.with_name(name)


def _locked(work: Path, folder: Path) -> int:
    """Descriptor of the lock in ``work``, which this process now holds.  Raises OSError where another one does."""
    while True:
        try:
            work.mkdir(parents=True, exist_ok=True)  # another process may have removed the empty parent
        except FileExistsError:
            with contextlib.suppress(FileNotFoundError):  # another process removed it before mkdir looked what it is
                if not stat.S_ISDIR(os.lstat(work).st_mode):
                    raise
            continue
        try:
            lock = os.open(work / "lock", os.O_RDWR | os.O_CREAT)
        except FileNotFoundError:  # another process has just removed it
            continue
        try:
            if fcntl:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(lock), os.stat(work / "lock")):
                return lock
        except BlockingIOError:
            os.close(lock)
            problem = "expected no other process at this result, got one at work"
            raise OSError(f"{folder}: {problem}; wait for it or give another --output") from None
        except FileNotFoundError:
            pass
        except OSError as error:
            if error.errno in NO_LOCKS:
                return lock
            os.close(lock)
            raise
        os.close(lock)
