"""How every command ends: an exit code and at most one line, whatever comes from outside.

2 is input that the user can correct (:class:`~reli3d.errors.InputError`, also a wrong option), 1 every other exception,
whose traceback goes to a log file and, with ``--traceback``, to stderr.  Ctrl-C is 130, SIGTERM 143 and SIGHUP 129,
after half-written files are removed.  A stream that is closed or full, or that cannot encode a letter, changes no code.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import functools
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from reli3d.cli.help_format import Defaults
from reli3d.errors import InputError, printable

ENDING = {"SIGINT": "interrupted", "SIGTERM": "ended by SIGTERM", "SIGHUP": "ended by SIGHUP"}
_parsed: ContextVar[argparse.Namespace | None] = ContextVar("parsed", default=None)  # of the command at work


class Stopped(BaseException):
    """A signal that ends the process."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number


class Parser(argparse.ArgumentParser):
    """Arguments of a command: help with defaults, ``--traceback``, and InputError for wrong ones."""

    def __init__(self, **options: Any):
        super().__init__(**{"formatter_class": Defaults, **options})
        self.add_argument(
            "--traceback", action="store_true", default=argparse.SUPPRESS, help="print the traceback of an error"
        )

    def parse_args(self, args=None, namespace=None):
        found = super().parse_args(args, namespace)
        _parsed.set(found)
        return found

    def parse_intermixed_args(self, args=None, namespace=None):
        found = super().parse_intermixed_args(args, namespace)
        _parsed.set(found)
        return found

    def error(self, message: str):
        raise InputError("arguments", f"{message}; see {self.prog} --help")


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

    Without arguments of its own ``main`` is the program: its signals are handled until the interpreter has ended.
    """

    def decorate(main: Callable[[list[str] | None], int]) -> Callable[..., int]:
        @functools.wraps(main)
        def run(argv: list[str] | None = None) -> int:
            ended: list[int] = []  # its exit code: from then on a signal finds nothing to clean up
            with _streams(), signals(name if argv is None else None, ended):
                try:
                    _parsed.set(None)
                    try:
                        code = main(argv)
                    except InputError as error:
                        code = _report(name, str(error), 2)
                    except Exception as error:
                        code = _failed(name, error)
                    ended.append(code)
                except KeyboardInterrupt:
                    ended.append(_report(name, ENDING["SIGINT"], 128 + signal.SIGINT))
                except Stopped as stop:
                    ended.append(_report(name, ENDING[signal.Signals(stop.number).name], 128 + stop.number))
            return ended[0]

        return run

    return decorate


def reason(error: BaseException) -> str:
    """What an error says, as one line; the class too where no message was written for a user."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        files = [os.fsdecode(f) for f in (error.filename, error.filename2) if isinstance(f, str | bytes | os.PathLike)]
        return " ".join(printable(f"{' -> '.join(files)}: {error.strerror}" if files else error.strerror).split())
    text = " ".join(printable(line) for line in str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _failed(name: str, error: Exception) -> int:
    """One line for an exception that no input explains, and its traceback where it belongs; the exit code."""
    args = _parsed.get()
    show_traceback(error, args)
    output = getattr(args, "output", None)
    log = write_log(output, error) if isinstance(output, Path) else None
    where = f"; traceback in {printable(str(log))}" if log else "; --traceback prints where"
    return _report(name, reason(error) + where, 1)


def show_traceback(error: BaseException, args: argparse.Namespace | None) -> None:
    """Print the traceback of ``error`` on stderr where ``--traceback`` was given."""
    if getattr(args, "traceback", False):
        sys.stderr.write("".join(traceback.format_exception(error)))


def write_log(target: Path, error: BaseException) -> Path | None:
    """Write the traceback of ``error`` to :func:`log_of` the target; its path, None where it cannot be written."""
    from reli3d.io.files import write_bytes

    path = log_of(target)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, "".join(traceback.format_exception(error)).encode(errors="backslashreplace"))
    except OSError:
        return None
    return path


def log_of(target: Path) -> Path:
    """The file beside the output ``target`` that has the traceback of its failure."""
    from reli3d.output.folder import sibling

    return sibling(Path(os.path.abspath(target)), "", ".reli3d.log")


@contextlib.contextmanager
def extra(option: str) -> Iterator[None]:
    """In this block a package that an option needs and that is not installed is an InputError of the option."""
    try:
        yield
    except ImportError as error:
        raise InputError(option, str(error)) from None


def check_range(name: str, value: float | None, low: float, high: float) -> None:
    """Raise InputError where the option ``--name`` is given and not within ``low`` and ``high``."""
    if value is not None and not low <= value <= high:
        raise InputError(f"--{name}", f"expected {low:g} to {high:g}, got {value}")


def check_ranges(args: argparse.Namespace, **ranges: tuple[float, float]) -> None:
    """:func:`check_range` of options by name, each with its ``(low, high)``; what ``args`` have not is not given."""
    for name, (low, high) in ranges.items():
        check_range(name.replace("_", "-"), getattr(args, name, None), low, high)


def report(line: str) -> None:
    """Write a line of progress to stderr, at once."""
    print(line, file=sys.stderr, flush=True)


def _report(name: str, text: str, code: int) -> int:
    print(f"{name}: {text}", file=sys.stderr)
    return code


@contextlib.contextmanager
def signals(program: str | None = None, ended: list[int] | None = None) -> Iterator[None]:
    """SIGTERM and SIGHUP raise :class:`Stopped`; after the first signal the next ones are ignored.

    program: name of the command that this process is, or None to restore the handlers at the end.  Its signals stay
    handled, SIGINT too: once ``ended`` has its exit code, one prints its line and ends the process at once.  Without
    one the process ends with that code after its threads and what is registered at exit, and frees no object.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, n) for n in ENDING if hasattr(signal, n)]
    usual = (signal.SIG_DFL, signal.default_int_handler)
    before = {n: signal.getsignal(n) for n in numbers if signal.getsignal(n) in usual}  # nohup's SIG_IGN stays
    if not program:
        before.pop(signal.SIGINT, None)  # raises KeyboardInterrupt already

    def stop(number: int, _) -> None:
        for other in before:
            signal.signal(other, signal.SIG_IGN)
        if ended:
            os.write(2, f"{program}: {ENDING[signal.Signals(number).name]}\n".encode())
            os._exit(128 + number)  # the interpreter is ending: no exception would reach a handler
        raise KeyboardInterrupt if number == signal.SIGINT else Stopped(number)

    def leave() -> None:
        if ended:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, full, or None
                    stream.flush()
            os._exit(ended[0])

    if program:  # Python heeds no signal while it frees its objects, for 1.6 s with torch: the process ends before
        atexit.register(leave)  # called after all that is registered later
    for number in before:
        signal.signal(number, stop)
    try:
        yield
    finally:
        if not program:
            for number, handler in before.items():
                signal.signal(number, handler)


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
