"""How every command ends: an exit code and at most one line, whatever comes from outside.

Ctrl-C ends with 130, SIGTERM and SIGHUP with 143 and 129, after the files half written are gone.  A stream that is
closed or full, or that cannot hold a letter, changes no exit code.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator

from reli3d.cli import collector
from reli3d.io.files import printable

FAULTS = (ValueError, TypeError, OSError, MemoryError, ImportError)  # the last: an extra is not installed


class Stopped(BaseException):
    """A signal that ends the process."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number


class _Stream:
    """A text stream that never raises for what is outside the program."""

    def __init__(self, stream):
        self._stream = stream

    def __getattr__(self, name: str):
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            try:
                self._stream.write(text)
            except UnicodeEncodeError:
                plain = text.encode(self._stream.encoding, "backslashreplace").decode(self._stream.encoding)
                self._stream.write(plain)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()


def command(name: str) -> Callable:
    """Decorator of a command's ``main``: its exit code for everything that may happen.  name: of the command.

    Without arguments of its own ``main`` is the program: the garbage collector is relaxed.
    """

    def decorate(main: Callable) -> Callable:
        @functools.wraps(main)
        def run(argv: list[str] | None = None) -> int:
            if argv is None:
                collector.relax()
            with _streams(), signals():
                try:
                    return main(argv)
                except KeyboardInterrupt:
                    return _report(name, "interrupted", 128 + signal.SIGINT)
                except Stopped as stop:
                    return _report(name, f"ended by {signal.Signals(stop.number).name}", 128 + stop.number)
                except FAULTS as error:
                    return _report(name, reason(error), 2)

        return run

    return decorate


def reason(error: BaseException) -> str:
    """What an error says, as one line."""
    if isinstance(error, OSError) and error.strerror:
        files = [os.fsdecode(f) for f in (error.filename, error.filename2) if isinstance(f, str | bytes | os.PathLike)]
        return " ".join(printable(f"{' -> '.join(files)}: {error.strerror}" if files else error.strerror).split())
    return " ".join(str(error).split()) or type(error).__name__


def check_range(name: str, value: float | None, low: float, high: float) -> None:
    """Raise ValueError where the option ``--name`` is given and not within ``low`` and ``high``."""
    if value is not None and not low <= value <= high:
        raise ValueError(f"--{name}: expected {low:g} to {high:g}, got {value}")


def check_ranges(args: argparse.Namespace, **ranges: tuple[float, float]) -> None:
    """:func:`check_range` of options by name, each with its ``(low, high)``; what ``args`` have not is not given."""
    for name, (low, high) in ranges.items():
        check_range(name.replace("_", "-"), getattr(args, name, None), low, high)


def tell(line: str) -> None:
    """Write a line of progress to stderr, at once."""
    print(line, file=sys.stderr, flush=True)


def _report(name: str, text: str, code: int) -> int:
    print(f"{name}: {text}", file=sys.stderr)
    return code


@contextlib.contextmanager
def signals() -> Iterator[None]:
    """Signals that would end the process at once raise :class:`Stopped` instead; the next ones are not heeded."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, n) for n in ("SIGTERM", "SIGHUP") if hasattr(signal, n)]
    numbers = [n for n in numbers if signal.getsignal(n) == signal.SIG_DFL]  # nohup's stays

    def stop(number: int, _) -> None:
        for other in numbers:
            signal.signal(other, signal.SIG_IGN)
        raise Stopped(number)

    for number in numbers:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


@contextlib.contextmanager
def _streams() -> Iterator[None]:
    for number in (0, 1, 2):  # a file opened later must not get the number of a closed stream
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    before = sys.stdout, sys.stderr
    with open(os.devnull, "w") as nowhere:
        sys.stdout, sys.stderr = (_Stream(s or nowhere) for s in before)
        try:
            yield
        finally:
            sys.stdout, sys.stderr = before
            for number, stream in zip((1, 2), before, strict=True):
                try:
                    if stream:
                        stream.flush()
                except OSError:  # or the interpreter would try again at its end, and exit with 120
                    os.dup2(nowhere.fileno(), number)
