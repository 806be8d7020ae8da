"""A result folder changes at once: its files are written beside it, then two renames put them in its place.

While ``NAME`` is made, ``.NAME.partial`` lies beside it.  It holds ``lock`` (the process at work has it), ``new`` (the
files) and, during the exchange, ``old``.  A process that is killed leaves it behind; the next one that claims ``NAME``
ends the exchange or throws the files away.  Between the two renames ``NAME`` is missing, and ``new`` is whole.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from reli3d.io.files import InputError, shown

try:
    import fcntl
except ImportError:  # Windows: another process at the same folder is not noticed
    fcntl = None  # type: ignore[assignment] # of a module

PARTIAL = ".partial"
LONGEST = 255  # bytes of a name, on every usual file system
NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)  # file systems that have none: the same


def check_folder(folder: Path, *, longest: int = LONGEST) -> Path:
    """``folder``, there or not, with links resolved; nothing is written.  Raises InputError where it takes no file.

    longest: bytes of its own name.
    """
    folder = Path(os.path.realpath(folder))
    try:
        str(folder).encode()
    except UnicodeEncodeError:
        raise InputError(folder, "expected an output folder with a name in UTF-8; give another --output") from None
    for part, limit in (*((p, LONGEST) for p in folder.parts[:-1]), (folder.name, longest)):
        if len(part.encode()) > limit:
            raise InputError(
                shown(part),
                f"expected a name of at most {limit} bytes for the output, got "
                f"{len(part.encode())}; rename the folder or give another --output",
            )
    above = folder
    while not os.path.lexists(above):
        above = above.parent
    if not above.is_dir():
        raise InputError(above, "expected a folder for the output, got a file; give another --output")
    if not os.access(above, os.W_OK | os.X_OK):
        raise InputError(above, "expected a folder that can be written, got one that cannot; give another --output")
    return folder


def check_place(folder: Path) -> Path:
    """:func:`check_folder` of a result folder, which others of its name must fit beside."""
    folder = check_folder(folder, longest=LONGEST - len(".") - len(PARTIAL))
    check_folder(folder.parent)
    if os.path.ismount(folder):
        raise InputError(folder, "expected a folder that can be renamed, got a mount point; mount its parent")
    return folder


@contextlib.contextmanager
def claimed(folder: Path, ours: Collection[str]) -> Iterator[Callable]:
    """Hold ``folder`` for this process alone; an exchange that was interrupted is ended first.

    Yields ``replacing()``, a context that gives an empty folder: when it ends without an error, that one takes the
    place of ``folder``.  ours: names of the files that belong to a result; others in ``folder`` are kept.
    Raises InputError for a place where nothing can be written, OSError where another process holds it.
    """
    folder = check_place(folder)
    made = [p for p in folder.parents if not p.exists()]
    folder.parent.mkdir(parents=True, exist_ok=True)
    work = _work(folder)
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
    new = work / "new"
    new.mkdir()
    yield new
    if folder.exists():
        shutil.copymode(folder, new)
        os.rename(folder, work / "old")
    os.rename(new, folder)
    _settle(work, folder, ours)


def _settle(work: Path, folder: Path, ours: Collection[str]) -> None:
    """End an exchange that has begun, and remove what one that has not begun left."""
    new, old = work / "new", work / "old"
    if old.exists():
        if not folder.exists():
            os.rename(new if new.exists() else old, folder)
        for path in old.iterdir() if old.exists() else ():
            if path.name not in ours and not os.path.lexists(folder / path.name):
                os.rename(path, folder / path.name)
        shutil.rmtree(old, ignore_errors=True)
    shutil.rmtree(new, ignore_errors=True)


def _work(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}{PARTIAL}")


def _locked(work: Path, folder: Path) -> int:
    """Descriptor of the lock in ``work``, which this process now holds.  Raises OSError where another one does."""
    while True:
        work.mkdir(exist_ok=True)
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
            raise OSError(
                f"{folder}: expected no other process at this result, got one at work; wait for it or give "
                "another --output"
            ) from None
        except FileNotFoundError:
            pass
        except OSError as error:
            if error.errno in NO_LOCKS:
                return lock
            os.close(lock)
            raise
        os.close(lock)
