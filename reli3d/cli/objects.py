"""Many objects: the function that makes the folder of one, and the places where it is called for each.

A place is this process, other processes of this machine, or a Ray cluster.  Where a process dies its object is made
once more; who dies of it again has failed.  Other processes have one thread each: the same bits for any number.
"""

from __future__ import annotations

import csv
import functools
import importlib
import io
import json
import logging
import os
import pickle
import signal
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol, cast

from reli3d.cli.exit_codes import Stopped, reason, signals
from reli3d.io.files import InputError, printable, read_bytes, write_bytes
from reli3d.io.tar import Packed, packed_objects

MAX_LIST = 1 << 28  # bytes of a list of folders: a million names of 250 letters
SUMMARY = "summary.csv"
KILLED = "expected its process to live, got one that died twice; is there too little memory?"
PATIENCE = 10.0  # seconds for a process to end before it is killed


class Job(Protocol):
    def run(self, folder: Path | Packed, name: str, target: Path) -> str:
        """Make ``target`` from ``folder``; the result of its row."""


@dataclass(frozen=True)
class Item:
    folder: Path | Packed
    name: str
    target: Path


@dataclass(frozen=True)
class Row:
    """What became of one object.  result: ``done``, ``skipped``, ``refused`` (wrong input) or ``failed``."""

    object: str
    result: str
    seconds: float | None = None  # of this command
    mask_iou: float | None = None
    faces: int | None = None
    notes: tuple[str, ...] = ()  # of the object, or its error


Rows = Generator[Row, None, None]


def make(job: Job, item: Item) -> Row:
    """Make one object; an error becomes its row."""
    began = time.monotonic()
    try:
        row = Row(item.name, job.run(item.folder, item.name, item.target))
    except ValueError as error:
        return Row(item.name, "refused", notes=(reason(error),))
    except (OSError, RuntimeError, MemoryError) as error:
        return Row(item.name, "failed", notes=(reason(error),))
    seconds = round(time.monotonic() - began, 3) if row.result == "done" else None
    return replace(row, seconds=seconds, **_recorded(item.target))


def _recorded(target: Path) -> dict:
    try:
        return recorded((target / "run_info.json").read_bytes())
    except OSError:
        return {}


def recorded(data: bytes) -> dict:
    """What ``run_info.json`` says that a summary holds; nothing where it is broken."""
    try:
        info = json.loads(data)
        return {"mask_iou": info["mask_iou"], "faces": info["mesh"]["faces"], "notes": tuple(info["notes"])}
    except (ValueError, LookupError, TypeError):
        return {}


def opened(folder: Path | Packed) -> AbstractContextManager[Path]:
    """The folder of an object, a temporary one where it stands in a tar file."""
    return folder.unpacked() if isinstance(folder, Packed) else nullcontext(folder)


def sources(paths: Sequence[Path]) -> list[Path | Packed]:
    """The folders among ``paths``, and the objects of the tar files.  Raises InputError for a file that is none."""
    found: list[Path | Packed] = []
    for path in paths:
        if path.suffix == ".tar" and not path.is_dir():
            found += packed_objects(path)
        else:
            found.append(path)
    return found


def items_of(folders: Sequence[Path | Packed], output: Path, *, dots: bool = True) -> list[Item]:
    """Each folder with a name of its own in ``output``: that of the folder, with a number where two are alike.

    dots: leave them in names; in a name of WebDataset what follows the first is no longer the object's.
    """
    taken = {SUMMARY}
    last: dict[str, int] = {}
    items = []
    for folder in folders:
        base = folder.name if isinstance(folder, Packed) else Path(os.path.abspath(folder)).name or "object"
        base = name = base if dots else base.replace(".", "_")
        while name in taken:
            last[base] = last.get(base, 1) + 1
            name = f"{base}-{last[base]}"
        taken.add(name)
        items.append(Item(folder, name, output / name))
    return items


def listed(path: Path) -> list[Path]:
    """What a text file names, one folder or tar file a line, relative to where the command runs.  Raises InputError."""
    try:
        lines = read_bytes(path, MAX_LIST).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(path, f"expected UTF-8 text, got other bytes at {error.start}; save it as UTF-8") from None
    folders = [Path(line.strip()) for line in lines if line.strip()]
    if not folders:
        raise InputError(path, "expected a folder on each line, got none; name the objects")
    return folders


def in_processes(start: Callable[[], Job], items: Sequence[Item], count: int) -> Rows:
    """Rows in the order of their ends.  start: makes the job of a process; it is pickled, and must leave one thread.

    A process has one object at a time, so that one which dies takes no other with it.
    """
    context, left, again = get_context("spawn"), deque(items), set()
    busy: dict = {}  # end of the pipe: process, item
    idle: list = []

    def give(pipe, process) -> None:
        """The next object, or None where there is no more."""
        try:
            pipe.send(left[0] if left else None)
        except OSError:  # it died between two objects
            idle.append(process)
            return
        if left:
            busy[pipe] = process, left.popleft()
        else:
            idle.append(process)

    try:
        while left or busy:
            while left and len(busy) < count:
                pipe, theirs = context.Pipe()
                process = context.Process(target=_serve, args=(theirs, start), daemon=True)
                process.start()
                theirs.close()
                give(pipe, process)
            for ready in cast(list[Connection], wait(list(busy))):
                process, item = busy.pop(ready)
                try:
                    row = ready.recv()
                except (EOFError, OSError):
                    idle.append(process)
                    if item.name not in again:
                        again.add(item.name)
                        left.append(item)
                        continue
                    row = Row(item.name, "failed", notes=(KILLED,))
                else:
                    give(ready, process)
                yield row
    finally:
        for process, _ in busy.values():
            process.terminate()  # it removes what is half written
            idle.append(process)
        for process in idle:
            process.join(PATIENCE)
            process.kill()


def _serve(pipe, start: Callable[[], Job]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command ends its processes itself
    with signals():
        try:
            os.environ["TQDM_DISABLE"] = "1"  # bars of several processes in one terminal
            job = start()
            for item in iter(pipe.recv, None):
                pipe.send(make(job, item))
        except (Stopped, EOFError, BrokenPipeError):  # the command has ended
            pass


def on_ray(start: Callable[[], Job], items: Sequence[Item], address: str, *, gpu: bool = False) -> Rows:
    """As :func:`in_processes` on a Ray cluster.  address: of it, ``auto`` for the one of this machine, ``local`` to
    start one.  All its machines must see the folders by the same paths, and have this package.

    The connection is made at once.  Raises ValueError where there is none.
    """
    try:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
        import ray
    except ImportError:
        raise ValueError("--ray: expected Ray, got none; install it with pip install reli3d[ray]") from None
    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # of many kinds
        raise ValueError(f"--ray: expected a cluster at {printable(address)}, got {reason(error)}") from None
    finally:
        signal.signal(signal.SIGTERM, before)
    return _on_ray(ray, start, items, gpu)


def _on_ray(ray, start: Callable[[], Job], items: Sequence[Item], gpu: bool) -> Rows:
    task = ray.remote(num_cpus=1, num_gpus=int(gpu), max_retries=1)(_made)
    job, left = pickle.dumps((os.getcwd(), start)), deque(items)
    running: dict[Any, Item] = {}
    try:
        while left or running:
            ahead = 2 * int(ray.cluster_resources().get("CPU", 1)) + 2  # enough that no worker waits, and few to keep
            while left and len(running) < ahead:
                item = left.popleft()
                running[task.remote(job, item)] = item
            for done in ray.wait(list(running))[0]:
                item = running.pop(done)
                try:
                    yield ray.get(done)
                except ray.exceptions.WorkerCrashedError:
                    yield Row(item.name, "failed", notes=(KILLED,))
                except ray.exceptions.RayError as error:
                    said = [line for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
                    yield Row(item.name, "failed", notes=(printable(said[-1].strip()),))
    finally:
        ray.shutdown()


def _made(job: bytes, item: Item) -> Row:
    return make(_kept(job), item)


@functools.lru_cache(1)
def _kept(job: bytes) -> Job:
    """The job of this worker, made once for all its objects."""
    folder, start = pickle.loads(job)
    os.chdir(folder)
    return start()


def called(module: str, name: str, *args) -> Any:
    """What the function ``name`` of ``module`` gives: in another process ``__main__`` is another module."""
    return getattr(importlib.import_module(module), name)(*args)


def write_summary(path: Path, rows: Sequence[Row]) -> None:
    """Write a CSV table, a line an object; its folder is made.  Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["object", "result", "seconds", "mask_iou", "faces", "notes"])
    for row in rows:
        values = [row.seconds, row.mask_iou, row.faces]
        table.writerow(
            [
                printable(row.object),
                row.result,
                *("" if v is None else v for v in values),
                printable("; ".join(row.notes)),
            ]
        )
    write_bytes(path, text.getvalue().encode())
