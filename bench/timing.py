"""Wall-clock time and memory of a step: a function without arguments, warmed up, synchronized, repeated.

Several steps are timed in turn (A B A B ...), so that whatever else the machine does falls on all of them alike and the
ratio of their medians holds where a single time does not.
"""

from __future__ import annotations

import ctypes
import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch

MIN_RUNS = 5  # below that a decile is a guess
MIN_SLOW = 3  # of steps above a second, which vary little and would make a full run very long
MAX_RUNS = 200


@dataclass(frozen=True)
class Timing:
    """Seconds of ``runs`` repetitions, and bytes at the highest point above the memory held before."""

    median: float
    p10: float
    p90: float
    runs: int
    peak_bytes: int | None  # None where the system does not report it
    stages: dict[str, float]  # medians, for a step that returns ``{stage: seconds}``


def time_steps(steps: Sequence[Callable], device: torch.device, *, seconds: float) -> list[Timing]:
    """Time every step within about ``seconds`` each, at least :data:`MIN_RUNS` times, in turn, after a warm-up."""
    for step in steps:
        step()  # compiles
    least = MIN_RUNS if max(_clock(step, device)[0] for step in steps) < 1.0 else MIN_SLOW
    runs: list[list[float]] = [[] for _ in steps]
    returned: list[list] = [[] for _ in steps]
    gc.collect()
    begin = time.perf_counter()
    while len(runs[0]) < least or (len(runs[0]) < MAX_RUNS and time.perf_counter() - begin < seconds * len(steps)):
        for k, step in enumerate(steps):
            elapsed, value = _clock(step, device)
            runs[k].append(elapsed)
            returned[k].append(value if _is_stages(value) else None)
            del value
    peaks = [peak_bytes(step, device) for step in steps]  # last: giving memory back would slow the next runs
    return [summary(r, peak, values) for r, peak, values in zip(runs, peaks, returned, strict=True)]


def _clock(step: Callable, device: torch.device) -> tuple[float, object]:
    synchronize(device)
    start = time.perf_counter()
    value = step()
    synchronize(device)
    return time.perf_counter() - start, value


def summary(runs: list[float], peak: int | None, returned: list) -> Timing:
    ordered = sorted(runs)
    last = len(ordered) - 1
    stages = {}
    if returned and None not in returned:
        stages = {key: median(value[key] for value in returned) for key in returned[0]}
    return Timing(median(ordered), ordered[round(0.1 * last)], ordered[round(0.9 * last)], len(ordered), peak, stages)


def _is_stages(value: object) -> bool:
    return isinstance(value, dict) and all(isinstance(v, float) for v in value.values())


def synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class Clock:
    """Seconds of named stages; a stage may come twice."""

    def __init__(self, device: torch.device):
        self.device, self.seconds, self.last = device, {}, time.perf_counter()

    def __call__(self, stage: str) -> None:
        synchronize(self.device)
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now


def peak_bytes(step: Callable, device: torch.device) -> int | None:
    """Memory that one call of ``step`` needs beyond what is held before it; None where the system does not report it.

    On CUDA the allocator of torch counts it.  On Linux the kernel does, in pages of the process, after free memory is
    returned and the mark is reset.
    """
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        held = torch.cuda.memory_allocated(device)
        step()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - held
    try:
        ctypes.CDLL(None).malloc_trim(0)  # glibc keeps freed blocks of up to 32 MiB
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, AttributeError, TypeError):
        return None
    held = _status("VmRSS")
    step()
    return max(0, _status("VmHWM") - held)


def _status(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    return 0
