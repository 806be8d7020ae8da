"""Python's garbage collector in a process that runs one command."""

from __future__ import annotations

import atexit
import contextlib
import gc
from collections.abc import Iterator

OBJECTS = 100_000  # allocations between two collections; Python's own 700 to 2,000 make thousands of them


def relax() -> None:
    """Collect seldom, and not at the end of the process.

    Importing torch and Warp makes about a million objects that all stay.  Looking through them again and again takes
    as long as the imports, and at the end of the process, whose memory goes back anyway, another half second.
    """
    gc.set_threshold(OBJECTS, *gc.get_threshold()[1:])
    atexit.register(gc.freeze)


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Import in this block without any collection; what is there at its end is never looked at again.

    In a process that :func:`relax` was called in; any other is left as it is.
    """
    if gc.get_threshold()[0] != OBJECTS:
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
