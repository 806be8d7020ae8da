"""Time and step budget of a fit, its progress and its loss curve."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from tqdm import tqdm


@dataclass(frozen=True)
class Part:
    """A part of a fit, which ends once the fraction ``until`` of the whole budget is used.

    min_steps: with fewer steps it may take half as much time again.
    """

    name: str
    until: float
    min_steps: int = 0


@dataclass
class Budget:
    """Budget in seconds or steps for the parts of a fit; only ``steps`` gives the same result on every run.

    show: whether to show a progress bar on stderr.  curve: one entry every ``CURVE_STEPS`` steps, ``{part, step,
    seconds, loss}``.  counts: steps of each part.  interrupt: called before every step.  interrupted: whether
    ``interrupt`` returned True; the current part then ends, and later parts take no step.
    """

    seconds: float | None = None
    steps: int | None = None
    show: bool = False
    interrupt: Callable[[], bool] | None = None
    interrupted: bool = False
    curve: list[dict] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    began: float = field(default_factory=time.perf_counter)
    limit: float = field(init=False)
    bar: tqdm | None = field(init=False, default=None)

    CURVE_STEPS = 10

    def __post_init__(self):
        if (self.seconds is None) == (self.steps is None):
            raise ValueError(f"seconds, steps: expected one of the two, got {self.seconds} and {self.steps}")
        if self.seconds is not None and not 0.0 < self.seconds < 1e6:
            raise ValueError(f"seconds: expected a positive number, got {self.seconds}")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps: expected at least 1, got {self.steps}")
        self.limit = self.seconds or self.steps or 0
        if self.show:
            layout = "refine: {bar:20} {n:.0f}/{total:.0f} {unit} {postfix} {remaining}"
            style = {"unit": "s" if self.seconds else "steps", "bar_format": layout, "leave": False}
            self.bar = tqdm(total=self.limit, file=sys.stderr, disable=None, **style)

    def take(self, part: Part) -> Iterator[tuple[int, float]]:
        """Yields ``(step, progress)`` of a part, progress in [0, 1].

        With a budget in seconds, progress follows the clock.  A part that would begin after its end takes no step.
        """
        count = self.counts[part.name] = 0
        start, end = self.spent(), self.limit * part.until
        end = round(end) if self.steps else end
        while True:
            self.interrupted |= self.interrupt is not None and self.interrupt()
            now = self.spent()
            late = now >= end and (count >= part.min_steps or now >= end + 0.5 * (end - start))
            if self.interrupted or late:
                return
            yield count, min((now - start) / (end - start), 1.0)
            count += 1
            self.counts[part.name] = count

    def spent(self) -> float:
        """Steps, or seconds with a budget in seconds."""
        return sum(self.counts.values()) if self.steps else time.perf_counter() - self.began

    def used(self) -> float:
        """Fraction of the budget that is used."""
        return self.spent() / self.limit

    def record(self, name: str, step: int, loss: float) -> None:
        """Records the loss of a step in the curve and on the progress bar."""
        if step % self.CURVE_STEPS == 0:
            seconds = round(time.perf_counter() - self.began, 3)
            self.curve.append({"part": name, "step": step, "seconds": seconds, "loss": round(loss, 6)})
        if self.bar is not None:
            self.bar.n = min(self.spent(), self.bar.total)
            self.bar.set_postfix_str(f"{name} {loss:.4f}")
