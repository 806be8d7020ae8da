"""Runs a job over many objects: here, in single-threaded workers, with bitwise identical results, or on Ray."""

import contextlib
import csv
import functools
import io
import json
import logging
import os
import pickle
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, fields, replace
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import Protocol

from tqdm import tqdm

from reli3d.cli.exit_codes import Stopped, log_of, reason, report, signals, write_log
from reli3d.errors import InputError, printable
from reli3d.io.files import read_bytes, write_bytes
from reli3d.views.missing_cameras import PHOTOGRAPHS, VIDEOS

MAX_LIST = 1 << 28  # bytes of a list of folders: a million names of 250 letters
SUMMARY = "summary.csv"
CRASHED = "its worker crashed twice; is there too little memory?"
PATIENCE = 10.0  # seconds for a process to end before it is killed
POLL = 0.2  # seconds: Python handles a signal that another thread received only after a blocking wait


class Job(Protocol):
    def run(self, folder: Path, name: str, target: Path) -> str:
        """Makes ``target`` from ``folder``; returns the ``result`` of its :class:`Row`."""


@dataclass(frozen=True)
class Item:
    folder: Path
    name: str
    target: Path


@dataclass(frozen=True)
class Row:
    """The outcome of one object.  result: ``done``, ``skipped``, ``refused`` (invalid input) or ``failed``."""

    object: str
    result: str
    seconds: float | None = None  # of this command
    mask_iou: float | None = None
    faces: int | None = None
    retried: bool = False  # its worker crashed once
    notes: tuple[str, ...] = ()  # of the object, or its error


Rows = Generator[Row, None, None]
Submit = Callable[[Item], tuple[Future, object]]


def make(job: Job, item: Item, failed: Callable[[Exception], None] = lambda error: None, *, writes: bool = True) -> Row:
    """Makes one object; an error is returned as a row, and its traceback is written to a log file next to the target.

    failed: called with an error other than InputError.  writes: whether the job replaces the target with a result.
    """
    began = time.monotonic()
    try:
        row = Row(item.name, job.run(item.folder, item.name, item.target))
    except InputError as error:
        return Row(item.name, "refused", notes=(reason(error),))
    except Exception as error:
        failed(error)
        log = write_log(item.target, error)
        return Row(item.name, "failed", notes=(reason(error), *([f"traceback in {log}"] if log else [])))
    seconds = round(time.monotonic() - began, 3) if row.result == "done" else None
    if not writes:
        return replace(row, seconds=seconds)
    with contextlib.suppress(OSError):
        log_of(item.target).unlink()  # of an earlier run
    recorded = {}
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):  # missing or broken
        info = json.loads((item.target / "run_info.json").read_bytes())
        recorded = {"mask_iou": info["mask_iou"], "faces": info["mesh"]["faces"], "notes": tuple(info["notes"])}
    return replace(row, seconds=seconds, **recorded)


def collect(
    name: str, rows: Rows, items: Sequence[Item], done: Callable[[Row], None], summary: Path | None = None
) -> tuple[list[Row], int]:
    """Collects all rows; returns them and the exit code.

    done: called with the row of each object that is done.  summary: CSV file of the rows in the order of ``items``.
    """
    ended: list[Row] = []
    try:
        with contextlib.closing(rows):
            for row in rows:
                ended.append(row)
                if row.result in ("refused", "failed"):
                    which = "" if row.result == "refused" and len(items) == 1 else f"{printable(row.object)}: "
                    report(f"{name}: {which}{'; '.join(row.notes)}")
                elif row.result == "skipped":
                    report(f"{printable(row.object)}: all files are there, skipped")
                else:
                    done(row)
    finally:
        if summary:
            order = {item.name: k for k, item in enumerate(items)}
            write_summary(summary, sorted(ended, key=lambda row: order[row.object]))
    results = {row.result for row in ended}
    if {"refused", "failed"} & results:
        return ended, 2 if results == {"refused"} else 1
    return ended, 0


def items_of(paths: Sequence[Path], output: Path) -> list[Item]:
    """The folders among ``paths`` and in their list files, with unique targets in ``output``.  Raises InputError."""
    folders: list[Path] = []
    for path in paths:
        is_list = path.is_file() and path.suffix.lower() not in (*VIDEOS, *PHOTOGRAPHS)
        folders += listed(path) if is_list else [path]
    taken = {SUMMARY}
    last: dict[str, int] = {}
    items = []
    for folder in folders:
        base = name = Path(os.path.abspath(folder)).name or "object"
        while name in taken:
            last[base] = last.get(base, 1) + 1
            name = f"{base}-{last[base]}"
        taken.add(name)
        items.append(Item(folder, name, output / name))
    return items


def listed(path: Path) -> list[Path]:
    """The folders named in a text file, one per line, relative to the working directory.  Raises InputError."""
    if path.suffix.lower() == ".json" or path.name in ("cameras.txt", "images.txt"):
        raise InputError(path, f"expected a folder or a list of folders, got a camera file; give {path.parent}")
    try:
        lines = re.split(r"[\r\n]+", read_bytes(path, MAX_LIST).decode("utf-8-sig"))  # names may have other separators
    except UnicodeDecodeError as error:
        problem = f"expected a folder or UTF-8 text that lists folders, got other bytes at {error.start}"
        raise InputError(path, f"{problem}; give a folder with cameras and images") from None
    folders = [Path(line.strip()) for line in lines if line.strip()]
    if not folders:
        raise InputError(path, "expected a folder on each line, got none; name the objects")
    if any("\0" in str(folder) for folder in folders):
        raise InputError(path, "expected a text file that names folders, got a zero byte; name a folder")
    return folders


def in_processes(start: Callable[[], Job], items: Sequence[Item], count: int) -> Rows:
    """Runs objects in ``count`` processes; rows in order of completion.  start: creates the job, is pickled."""
    job, pool = pickle.dumps((os.getcwd(), start)), _pool(count)

    def submit(item: Item) -> tuple[Future, object]:
        nonlocal pool
        with _blocked_interrupts():
            try:
                return pool.submit(_made, job, item), pool
            except BrokenProcessPool:  # a worker crashed before
                for process in active_children():  # Python 3.11 waits forever for one started while the pool broke
                    process.terminate()
                pool = _pool(count)
                return pool.submit(_made, job, item), pool

    try:
        yield from _rows(submit, items, lambda: count, BrokenProcessPool, alone=True)
        pool.shutdown()
    except BaseException:  # also if the caller closes the generator
        pool.shutdown(wait=False, cancel_futures=True)
        children = active_children()
        for process in children:
            process.terminate()  # removes partially written files
        for process in children:
            process.join(PATIENCE)
            process.kill()
        raise


def on_ray(start: Callable[[], Job], items: Sequence[Item], address: str, *, gpu: bool = False) -> Rows:
    """As :func:`in_processes`, on a Ray cluster.

    address: of the cluster, ``auto`` for the one of this machine, ``local`` to start one.  All its machines must have
    this package and see the folders at the same paths.  Raises InputError if the connection fails, before any row.
    """
    try:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
        import ray
    except ImportError:
        raise InputError("--ray", "expected Ray, got none; install it with pip install reli3d[ray]") from None
    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # of many kinds
        raise InputError("--ray", f"expected a cluster at {address}, got {reason(error)}") from None
    finally:
        signal.signal(signal.SIGTERM, before)
    return _on_ray(ray, start, items, gpu)


def _on_ray(ray, start: Callable[[], Job], items: Sequence[Item], gpu: bool) -> Rows:
    task = ray.remote(num_cpus=1, num_gpus=int(gpu), max_retries=0)(_made)
    job = pickle.dumps((os.getcwd(), start))

    def ahead() -> int:  # submitted objects: keeps all workers busy
        return 2 * int(ray.cluster_resources().get("CPU", 1)) + 2

    try:
        submit = lambda item: (task.remote(job, item).future(), None)
        yield from _rows(submit, items, ahead, ray.exceptions.WorkerCrashedError, alone=False)
    finally:
        ray.shutdown()


def _rows(
    submit: Submit, items: Sequence[Item], limit: Callable[[], int], crash: type[Exception], *, alone: bool
) -> Rows:
    """Keeps ``limit()`` objects submitted; one that raises ``crash`` is retried.

    submit: returns a future and its pool.  alone: a crash breaks all futures of a pool, and an object is retried while
    no other runs.
    """
    left, again, running = deque(items), deque[Item](), dict[Future, tuple[Item, bool, object]]()
    while left or again or running:
        if again and not (alone and running):
            item = again.popleft()
            future, pool = submit(item)
            running[future] = item, True, pool
        while left and len(running) < limit() and not (alone and (again or any(r for _, r, _ in running.values()))):
            item = left.popleft()
            future, pool = submit(item)
            running[future] = item, False, pool
        done = wait(running, POLL, FIRST_COMPLETED).done
        broken = [running[future][2] for future in done if alone and isinstance(future.exception(), crash)]
        # Python 3.11 never ends a future that was submitted while its pool broke
        for future in done | {future for future, (_, _, pool) in running.items() if pool in broken}:
            item, retried, _ = running.pop(future)
            try:
                if not future.done():
                    raise crash
                row = future.result()
                made = "done" if retried and row.result == "skipped" else row.result  # before another worker crashed
                yield replace(row, result=made, retried=retried)
            except crash:
                if retried:
                    yield Row(item.name, "failed", retried=True, notes=(CRASHED,))
                    continue
                report(f"{printable(item.name)}: its worker crashed; retrying")
                again.append(item)
            except Exception as error:  # the job of the worker could not be made
                yield Row(item.name, "failed", retried=retried, notes=(reason(error),))


def _pool(count: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_begin)


def _begin() -> None:
    """Initializes a worker: no progress bars, and termination when the parent process ends."""
    os.environ["TQDM_DISABLE"] = "1"
    tqdm.set_lock(threading.RLock())  # the default is a semaphore, which a killed process would leak
    parent = parent_process()

    def watch() -> None:
        if parent:
            parent.join()
            os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _blocked_interrupts():
    """Processes started in the block ignore Ctrl-C; the command terminates them itself."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _made(job: bytes, item: Item) -> Row:
    """Makes one object in a worker; SIGTERM ends the process after partially written files are removed."""
    try:
        with signals():
            return make(_kept(job), item)
    except Stopped as stop:
        signal.signal(stop.number, signal.SIG_DFL)
        signal.raise_signal(stop.number)
        raise


@functools.lru_cache(1)
def _kept(job: bytes) -> Job:
    """The job of this worker, created once for all its objects."""
    folder, start = pickle.loads(job)
    os.chdir(folder)
    return start()


def write_summary(path: Path, rows: Sequence[Row]) -> None:
    """Writes a CSV table with one line per object and creates its folder.  Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(field.name for field in fields(Row))
    for row in rows:
        values = ["" if v is None else v for v in (row.seconds, row.mask_iou, row.faces)]
        name, notes = printable(row.object), printable("; ".join(row.notes))
        table.writerow([name, row.result, *values, "yes" if row.retried else "", notes])
    write_bytes(path, text.getvalue().encode())
