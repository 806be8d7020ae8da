"""Random hostile inputs: ``python -m tests.campaign --count 10000 --seed 0``.

Every input is a good file with one to four changes drawn from its seed, or one that is made with its ground truth
(``tests.support.known``).  A forked process reads it, with limits on memory and time.  Allowed are a result, the right
one with known ground truth, and ValueError and OSError of one line.  Failing inputs are saved.  The same seed gives the
same inputs.  Runs on Linux.
"""

import argparse
import contextlib
import ctypes
import faulthandler
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, TimeoutError
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from random import Random

import torch

from reli3d.errors import printable
from tests.support.mutators import edited
from tests.support.readers import Target, targets

SECONDS = 5.0  # of the processor, of one input
MEMORY = 1 << 30  # bytes, of one input, above the use of the libraries
WALL = 120.0  # seconds after which a process hangs


@dataclass
class Outcome:
    """fault: why the input failed, empty if it was accepted or refused."""

    name: str  # of the target
    files: dict[str, bytes]
    fault: str


def drawn(found: Sequence[Target], seed: int, number: int) -> tuple[Target, int, dict[str, bytes]]:
    """Target, seed of its ground truth, and files of input ``number``."""
    rng = Random(f"{seed}/{number}")
    target = found[number % len(found)]
    edits = [rng.getrandbits(63) for _ in range(1 if target.known else rng.choice((1, 1, 2, 4)))]
    files = target.files
    for edit in edits if not target.known else ():
        files = edited(files, edit)
    return target, edits[0], target.known(Random(edits[0])).files if target.known else files


def outcomes(inputs: Sequence[tuple[Target, int, dict[str, bytes]]]) -> Iterator[Outcome]:
    """Outcomes of ``inputs`` in their order; after one that ends its process the next has a new one."""
    pool, root = None, Path(tempfile.mkdtemp(prefix="campaign"))

    def read(number: int) -> str:
        target, seed, files = inputs[number]
        return _fault(target.known(Random(seed)).read if target.known else target.read, files, root)

    for number, (target, _, files) in enumerate(inputs):
        pool = pool or ProcessPoolExecutor(1, get_context("fork"), initializer=_limited, initargs=(read,))
        try:
            fault = pool.submit(_read, number).result(WALL)
        except BrokenProcessPool:
            fault, pool = f"crash: the process ended, or took more than {4 * SECONDS:g} s of the processor", None
        except TimeoutError:
            for process in pool._processes.values():
                process.kill()
            fault, pool = f"slow: no answer after {WALL:g} s", None
        yield Outcome(target.name, files, fault)
    if pool:
        pool.shutdown()
    shutil.rmtree(root)


def _read(number: int) -> str:
    """In the fork: calls the function of its parent, which cannot be pickled."""
    return _called(number)


def _limited(read) -> None:
    """In the fork: no output and limited memory."""
    global _called
    _called = read
    faulthandler.disable()  # pytest's; the parent reports a crash
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    limit = _kilobytes("VmSize") * 1024 + 3 * MEMORY  # threads and their heaps take addresses, not memory
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _fault(read, files: dict[str, bytes], root: Path) -> str:
    """In the fork: the fault of ``read`` of a folder with ``files`` below ``root``."""
    with contextlib.suppress(AttributeError):  # a C library without it
        ctypes.CDLL(None).malloc_trim(0)  # free memory that the process keeps would be taken again without a trace
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before, began = _kilobytes("VmRSS"), time.process_time()
    resource.setrlimit(resource.RLIMIT_CPU, (int(began + 4 * SECONDS) + 1, resource.RLIM_INFINITY))
    folder = Path(tempfile.mkdtemp(dir=root))
    try:
        write(folder, files)
        read(folder)
    except (ValueError, OSError) as error:
        if not str(error) or printable(str(error)) != str(error) or "does not fit into memory" in str(error):
            return f"wrong: {error!r}"
    except BaseException:
        return f"wrong: {traceback.format_exc()[-2000:]}"
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    seconds, memory = time.process_time() - began, (_kilobytes("VmHWM") - before) * 1024
    if seconds > SECONDS or memory > MEMORY:
        return f"slow: {seconds:.1f} s" if seconds > SECONDS else f"memory: {memory >> 20} MiB"
    return ""


def write(folder: Path, files: dict[str, bytes]) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def _kilobytes(name: str) -> int:
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith(f"{name}:"))


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="python -m tests.campaign", description=__doc__.splitlines()[0])
    p.add_argument("--count", type=int, default=10_000, help="inputs")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--findings", type=Path, default=Path("campaign"), help="folder of what failed")
    args = p.parse_args(argv)
    torch.set_num_threads(1)  # a fork does not inherit torch's threads
    failed = 0
    with tempfile.TemporaryDirectory() as root:
        found = targets(Path(root))
        for first in range(0, args.count, 200):
            numbers = range(first, min(first + 200, args.count))
            some = outcomes([drawn(found, args.seed, number) for number in numbers])
            for number, outcome in zip(numbers, some, strict=True):
                if outcome.fault:
                    failed += 1
                    write(args.findings / f"{outcome.name.replace(' ', '-')}-{args.seed}-{number}", outcome.files)
                    print(f"{number} {outcome.name}: {outcome.fault}", file=sys.stderr)
    print(f"{args.count} inputs, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
