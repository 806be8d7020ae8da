"""Time and step budget of a fit, its progress and its loss curve."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from tqdm import tqdm

from reli3d._bridge import present


@dataclass
class Budget:
    """Budget in seconds or steps for the parts of a fit; only ``steps`` gives the same result on every run.

    curve: one entry every ``CURVE_STEPS`` steps, ``{part, step, seconds, loss}``.  interrupt: called before every
    step.  interrupted: whether ``interrupt`` returned True; the current part then ends, and later parts take no step.
    """

    seconds: float | None = None
    steps: int | None = None
    bar: tqdm | None = None
    curve: list[dict] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    interrupt: Callable[[], bool] | None = None
    interrupted: bool = False
    began: float = field(default_factory=time.perf_counter)

    CURVE_STEPS = 10

    def __post_init__(self):
        if (self.seconds is None) == (self.steps is None):
            raise ValueError(f"seconds, steps: expected one of the two, got {self.seconds} and {self.steps}")
        if self.seconds is not None and not 0.0 < self.seconds < 1e6:
            raise ValueError(f"seconds: expected a positive number, got {self.seconds}")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps: expected at least 1, got {self.steps}")

    def part(self, name: str, until: float) -> Iterator[tuple[int, float]]:
        """Yields ``(step, progress)``, progress in [0, 1), until the fraction ``until`` of the whole budget is used.

        With a budget in seconds, progress follows the clock.  A part that would begin after its end takes no step.
        """
        started = time.perf_counter() - self.began
        done = sum(self.counts.values())
        count = self.counts[name] = 0
        while True:
            self.interrupted |= self.interrupt is not None and self.interrupt()
            if self.interrupted:
                return
            if self.steps is not None:
                total = round(self.steps * until) - done
                progress = count / max(total, 1)
                if count >= total:
                    return
            elif self.seconds is not None:
                now = time.perf_counter() - self.began
                if now >= self.seconds * until:
                    return
                progress = (now - started) / (self.seconds * until - started)
            yield count, progress
            count += 1
            self.counts[name] = count

    def used(self) -> float:
        """Fraction of the budget that is used."""
        if self.steps is not None:
            return sum(self.counts.values()) / self.steps
        return (time.perf_counter() - self.began) / present("seconds", self.seconds)

    def record(self, name: str, step: int, loss: float) -> None:
        """Records the loss of a step in the curve and on the progress bar."""
        if step % self.CURVE_STEPS == 0:
            seconds = round(time.perf_counter() - self.began, 3)
            self.curve.append({"part": name, "step": step, "seconds": seconds, "loss": round(loss, 6)})
        if self.bar is not None:
            used = sum(self.counts.values()) if self.steps is not None else time.perf_counter() - self.began
            self.bar.n = min(used, self.bar.total)
            self.bar.set_postfix_str(f"{name} {loss:.4f}")


def progress_bar(budget_total: float, unit: str) -> tqdm:
    """Progress bar on stderr, in seconds or steps."""
    layout = "refine: {bar:20} {n:.0f}/{total:.0f} {unit} {postfix} {remaining}"
    return tqdm(total=budget_total, unit=unit, file=sys.stderr, bar_format=layout, leave=False, disable=None)
