"""Exit codes and error messages of all commands: at most one line on stderr.

2: input that the user can correct (:class:`~reli3d.errors.InputError`, also wrong options).  1: any other exception,
whose traceback goes to a log file and, with ``--traceback``, to stderr.  130, 143, 129: Ctrl-C, SIGTERM, SIGHUP, after
removing partially written files.  Closed or full output streams and unencodable characters do not change the code.
"""

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

from reli3d.errors import InputError, printable

ENDING = {"SIGINT": "interrupted", "SIGTERM": "ended by SIGTERM", "SIGHUP": "ended by SIGHUP"}
_parsed: ContextVar[argparse.Namespace | None] = ContextVar("parsed", default=None)  # of the command at work


class Stopped(BaseException):
    """Raised by a signal that terminates the process."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number


class Defaults(argparse.HelpFormatter):
    """Appends the default of an option to its help unless the help mentions it."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        silent = action.default is None or action.default is False or not action.option_strings
        if silent or action.default == argparse.SUPPRESS or "default" in (action.help or "default"):
            return action.help
        return f"{action.help} (default %(default)s)"


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
    """A text stream that ignores write errors and escapes unencodable characters."""

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
    """Decorator of a command's ``main`` that turns exceptions and signals into exit codes.  name: of the command.

    Called without arguments, ``main`` is the whole program, and signals stay handled until the interpreter exits.
    """

    def decorate(main: Callable[[list[str] | None], int]) -> Callable[..., int]:
        @functools.wraps(main)
        def run(argv: list[str] | None = None) -> int:
            ended: list[int] = []  # the exit code once known: from then on a signal has nothing to clean up
            with _streams(), signals(name if argv is None else None, ended):
                try:
                    _parsed.set(None)
                    try:
                        code = main(argv)
                    except InputError as error:
                        code = _report(name, str(error), 2)
                    except Exception as error:
                        args = _parsed.get()
                        show_traceback(error, args)
                        output = getattr(args, "file", None) or getattr(args, "output", None)
                        log = write_log(output, error) if isinstance(output, Path) else None
                        where = f"traceback in {printable(str(log))}" if log else "--traceback prints where"
                        code = _report(name, f"{reason(error)}; {where}", 1)
                    ended.append(code)
                except KeyboardInterrupt:
                    ended.append(_report(name, ENDING["SIGINT"], 128 + signal.SIGINT))
                except Stopped as stop:
                    ended.append(_report(name, ENDING[signal.Signals(stop.number).name], 128 + stop.number))
            return ended[0]

        return run

    return decorate


def reason(error: BaseException) -> str:
    """The message of an error on one line, with the class name unless it is an InputError or an OSError."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        files = [os.fsdecode(f) for f in (error.filename, error.filename2) if isinstance(f, str | bytes | os.PathLike)]
        return " ".join(printable(f"{' -> '.join(files)}: {error.strerror}" if files else error.strerror).split())
    text = " ".join(printable(line) for line in str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def show_traceback(error: BaseException, args: argparse.Namespace | None) -> None:
    """Prints the traceback of ``error`` on stderr if ``--traceback`` is given."""
    if getattr(args, "traceback", False):
        sys.stderr.write("".join(traceback.format_exception(error)))


def write_log(target: Path, error: BaseException) -> Path | None:
    """Writes the traceback of ``error`` to :func:`log_of` the target; returns its path, None if that fails."""
    from reli3d.io.files import write_bytes

    try:
        path = log_of(target)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, "".join(traceback.format_exception(error)).encode(errors="backslashreplace"))
    except OSError:
        return None
    return path


def log_of(target: Path) -> Path:
    """The path of the log file of ``target``, in the same folder."""
    from reli3d.output.folder import sibling

    return sibling(Path(os.path.abspath(target)), "", ".reli3d.log")


@contextlib.contextmanager
def extra(option: str) -> Iterator[None]:
    """Turns the ImportError of a missing package in the block into an InputError of ``option``."""
    try:
        yield
    except ImportError as error:
        if (error.name or "reli3d").split(".")[0] == "reli3d":  # an error of this package
            raise
        raise InputError(option, str(error)) from None


def check_ranges(args: argparse.Namespace, **ranges: tuple[float, float]) -> None:
    """Raises InputError if an option, or a value of its list, is given and not within its ``(low, high)``."""
    for name, (low, high) in ranges.items():
        given = getattr(args, name, None)
        for value in given if isinstance(given, list | tuple) else [given]:
            if value is not None and not low <= value <= high:
                raise InputError(f"--{name.replace('_', '-')}", f"expected {low:g} to {high:g}, got {value}")


def report(line: str) -> None:
    """Writes a line of progress to stderr, unbuffered."""
    print(line, file=sys.stderr, flush=True)


def _report(name: str, text: str, code: int) -> int:
    print(f"{name}: {text}", file=sys.stderr)
    return code


@contextlib.contextmanager
def signals(program: str | None = None, ended: list[int] | None = None) -> Iterator[None]:
    """In the block SIGTERM and SIGHUP raise :class:`Stopped`; signals after the first one are ignored.

    program: name of the command if it is the whole process; its handlers, also that of SIGINT, then stay installed.
    Once ``ended`` has the exit code, a signal prints its line and exits immediately; without a signal the process exits
    with that code after its threads and exit handlers, without freeing its objects.  None: the previous handlers are
    restored after the block.
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
