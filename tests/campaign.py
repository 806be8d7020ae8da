"""Hostile inputs without end: ``python -m tests.campaign --minutes M --seed S``.

Every input is a good file with one to four changes drawn from its seed, or one that is made with its ground truth
(``tests.support.known``).  A forked process reads it, with limits on memory and time.  Allowed are a result, the right
one with known ground truth, and ValueError and OSError of one line.  Failing inputs are saved with as few changes
as possible.  The same seed gives the same inputs.  Runs on Linux.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import faulthandler
import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random

import torch

from reli3d.errors import printable
from tests.support.mutators import edited
from tests.support.readers import Target, targets

SECONDS = 5.0  # of the processor, of one input
MEMORY = 1 << 30  # bytes, of one input, above the use of the libraries
WALL = 120.0  # seconds after which a process that uses no processor hangs
OWN_FAULT = 70  # exit code
BATCH = 200  # inputs of one process
FAULTS = ("wrong", "slow", "memory", "crash")


@dataclass
class Outcome:
    number: int
    kind: str  # accepted, refused, or one of FAULTS
    seconds: float = 0.0
    memory: int = 0
    text: str = ""


@dataclass
class Line:
    """One row of the table."""

    accepted: int = 0
    refused: int = 0
    failed: int = 0
    slowest_refusal: float = 0.0
    memory: int = 0

    def add(self, outcome: Outcome) -> None:
        name = outcome.kind if outcome.kind in ("accepted", "refused") else "failed"
        setattr(self, name, getattr(self, name) + 1)
        self.memory = max(self.memory, outcome.memory)
        if outcome.kind == "refused":
            self.slowest_refusal = max(self.slowest_refusal, outcome.seconds)


@dataclass
class Campaign:
    seed: int
    targets: Sequence[Target]
    findings: Path
    table: dict[str, Line] = field(default_factory=dict)
    failed: list[tuple[str, Outcome]] = field(default_factory=list)

    def edits(self, number: int) -> tuple[Target, list[int]]:
        """The target of an input and the seeds of its changes."""
        rng = Random(f"{self.seed}/{number}")
        target = self.targets[number % len(self.targets)]
        return target, [rng.getrandbits(63) for _ in range(1 if target.known else rng.choice((1, 1, 2, 4)))]

    def run(self, count: int | None, until: float) -> int:
        """Try ``count`` inputs, or as many as there is time for; the number tried."""
        number = 0
        while time.monotonic() < until and (count is None or number < count):
            stop = min(number + BATCH, count or number + BATCH)
            for outcome in self._batch([(n, *self.edits(n)) for n in range(number, stop)]):
                target, edits = self.edits(outcome.number)
                self.table.setdefault(target.name, Line()).add(outcome)
                if outcome.kind in FAULTS:
                    self._save(target, edits, outcome)
                number = outcome.number + 1
        return number

    def _batch(self, inputs: list[tuple[int, Target, list[int]]]) -> Iterator[Outcome]:
        """Outcomes of ``inputs`` in their order; after one that ends its process the next has a new one."""
        while inputs:
            done = 0
            for outcome in in_fork(inputs):
                done += 1
                yield outcome
            inputs = inputs[done:]

    def _save(self, target: Target, edits: list[int], outcome: Outcome) -> None:
        """Write the input with as few changes as still fail in the same way."""
        for edit in list(edits):
            fewer = [e for e in edits if e != edit]
            if fewer and next(iter(in_fork([(0, target, fewer)]))).kind == outcome.kind:
                edits = fewer
        self.failed.append((target.name, outcome))
        folder = self.findings / f"{target.name.replace(' ', '-')}-{outcome.kind}-{self.seed}-{outcome.number}"
        folder.mkdir(parents=True, exist_ok=True)
        write(folder, applied(target, edits))
        record = {"target": target.name, "edits": edits, **asdict(outcome)}
        (folder / "finding.json").write_text(json.dumps(record, indent=1))

    def report(self) -> str:
        """The table as Markdown."""
        rows = [
            "| files | tried | accepted | refused | failed | slowest refusal [s] | highest memory [MiB] |",
            "|---|---|---|---|---|---|---|",
        ]
        for name, line in sorted(self.table.items()):
            tried = line.accepted + line.refused + line.failed
            rows.append(
                f"| {name} | {tried} | {line.accepted} | {line.refused} | {line.failed} | "
                f"{line.slowest_refusal:.2f} | {line.memory >> 20} |"
            )
        return "\n".join(rows)


def applied(target: Target, edits: Sequence[int]) -> dict[str, bytes]:
    if target.known:
        return target.known(Random(edits[0])).files
    files = target.files
    for edit in edits:
        files = edited(files, edit)
    return files


def write(folder: Path, files: dict[str, bytes]) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def in_fork(inputs: Sequence[tuple[int, Target, list[int]]]) -> Iterator[Outcome]:
    """Outcomes of ``inputs``, up to the first that ends the process or its limits."""
    ours, theirs = os.pipe()
    root = Path(tempfile.mkdtemp(prefix="campaign"))
    pid = os.fork()
    if pid == 0:
        try:
            os.close(ours)
            _read_all(inputs, theirs, root)
            os._exit(0)
        finally:
            os._exit(OWN_FAULT)
    os.close(theirs)
    given, text = 0, b""
    try:
        while given < len(inputs):
            if not select.select([ours], [], [], WALL)[0]:
                if not _asleep(pid):
                    continue
                yield Outcome(inputs[given][0], "slow", WALL, text="it waits")
                return
            part = os.read(ours, 1 << 16)
            if not part:
                code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                pid = 0
                if code == OWN_FAULT:
                    raise RuntimeError(f"input {inputs[given][0]}: the campaign failed, not the reader")
                number = signal.Signals(-code or signal.SIGABRT)
                kind = "slow" if number == signal.SIGXCPU else "crash"
                yield Outcome(inputs[given][0], kind, text=number.name)
                return
            *lines, text = (text + part).split(b"\n")
            for line in lines:
                given += 1
                yield Outcome(**json.loads(line))
    finally:
        os.close(ours)
        if pid:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        shutil.rmtree(root, ignore_errors=True)


def _asleep(pid: int) -> bool:
    """Whether no thread of a process runs or waits for its memory, as it does for minutes on a busy machine."""
    threads = Path(f"/proc/{pid}/task").glob("*/stat")
    return not any(thread.read_text().rpartition(")")[2].split()[0] in "RD" for thread in threads)


def _read_all(inputs: Sequence[tuple[int, Target, list[int]]], pipe: int, root: Path) -> None:
    """In the fork: each input in a folder of its own under ``root``."""
    faulthandler.disable()  # pytest's; the parent reports a crash
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    limit = _kilobytes("VmSize") * 1024 + 3 * MEMORY  # threads and their heaps take addresses, not memory
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for number, target, edits in inputs:
        folder = root / str(number)
        folder.mkdir()
        write(folder, applied(target, edits))
        os.write(pipe, json.dumps(asdict(_tried(number, target, edits, folder))).encode() + b"\n")
        shutil.rmtree(folder)


def _tried(number: int, target: Target, edits: list[int], folder: Path) -> Outcome:
    read = target.known(Random(edits[0])).read if target.known else target.read
    with contextlib.suppress(AttributeError):  # a C library without it
        ctypes.CDLL(None).malloc_trim(0)  # free memory that the process keeps would be taken again without a trace
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before, began = _kilobytes("VmRSS"), time.process_time()
    resource.setrlimit(resource.RLIMIT_CPU, (int(began + 4 * SECONDS) + 1, resource.RLIM_INFINITY))
    kind, text = "accepted", ""
    try:
        read(folder)
    except (ValueError, OSError) as error:
        kind, text = "refused", str(error)
        if not text or printable(text) != text or "does not fit into memory" in text:
            kind = "wrong"
    except BaseException:
        kind, text = "wrong", traceback.format_exc()
    seconds, memory = time.process_time() - began, max(0, _kilobytes("VmHWM") - before) * 1024
    if kind != "wrong" and (seconds > SECONDS or memory > MEMORY):
        kind = "slow" if seconds > SECONDS else "memory"
    return Outcome(number, kind, round(seconds, 3), memory, text[-2000:])


def _kilobytes(name: str) -> int:
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith(f"{name}:"))


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="python -m tests.campaign", description=__doc__.splitlines()[0])
    p.add_argument("--minutes", type=float, default=10.0)
    p.add_argument("--count", type=int, help="inputs, instead of as many as there is time for")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--findings", type=Path, default=Path("campaign"), help="folder of what failed")
    p.add_argument("--only", help="targets whose name begins so")
    args = p.parse_args(argv)
    torch.set_num_threads(1)  # a fork does not inherit torch's threads
    with tempfile.TemporaryDirectory() as root:
        chosen = [t for t in targets(Path(root)) if t.name.startswith(args.only or "")]
        campaign = Campaign(args.seed, chosen, args.findings)
        campaign.run(args.count, time.monotonic() + 60 * args.minutes)
    print(campaign.report())
    for name, outcome in campaign.failed:
        print(
            f"{name}: {outcome.kind}: {outcome.text.strip().splitlines()[-1:]} ({outcome.seconds} s)", file=sys.stderr
        )
    return 1 if campaign.failed else 0


if __name__ == "__main__":
    sys.exit(main())
