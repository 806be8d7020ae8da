"""The processes of the installed commands: their threads wait asleep, and they end at once when all is done."""

from __future__ import annotations

import atexit
import importlib
import os
import sys
from functools import partial
from typing import NoReturn

SPINS = "5000"  # some ten microseconds; libgomp's own 300,000 are a millisecond


def run(module: str) -> NoReturn:
    """Run ``main`` of a module of :mod:`reli3d.cli` as this process, which ends with its exit code.

    Between two operations torch's threads look for the next one in a loop, which takes the processor from our own and
    from other programs: they do so for ``SPINS`` turns, unless the environment says otherwise.
    Taking torch apart, module by module, would take another tenth of a second.  So the interpreter ends as ever, with
    its threads and all that is registered, after this call, to be done at its end, and leaves then.  Where ``main``
    raises, as for ``--help``, nothing is cut short.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)  # libgomp reads it when torch is imported
    code: list[int] = []
    atexit.register(_leave, code)  # before anything is imported: what is registered first is called last
    code.append(importlib.import_module(f"reli3d.cli.{module}").main())
    sys.exit(code[0])


def _leave(code: list[int]) -> None:
    """End the process with ``code``, if there is one; the interpreter does so where a stream cannot be written."""
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
    except (OSError, ValueError):
        return
    if code:
        os._exit(code[0])


reli3d = partial(run, "main")
infer = partial(run, "infer")
train = partial(run, "train")
stages = partial(run, "stages")
data = partial(run, "data")
eval = partial(run, "eval")
tables = partial(run, "tables")
render = partial(run, "render")
