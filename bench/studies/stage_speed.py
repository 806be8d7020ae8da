"""Where the time of a training step goes, by stage: ``python -m bench.studies.stage_speed SAMPLES [--start STATE]``.

One process with one thread, the preset ``tiny``.  Times are those of the processor, so that other programs change them
little.  ``backward`` is of all parts before it.  Memory is the most that a process has held after one step of
each size, from the left to the right, less what it held before the first.  Prints two tables in Markdown.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import torch

from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import TINY
from reli3d.train.loop import update_average
from reli3d.train.sharded import clip_gradients
from reli3d.train.stages import config, step
from reli3d.train.stages.loop import averaged, drawn, load_state
from reli3d.train.stages.losses import gradients
from reli3d.train.stages.step import object_losses, total
from reli3d.train.stages.views import Samples

PARTS = {  # functions that reli3d.train.stages.step calls, by what the table calls them
    "network": ("encode",),
    "geometry": ("occupied", "surface"),
    "light": ("lobes", "shader_of"),
    "render": ("render_volume", "render_surface"),
}
OTHERS = ("data", "losses", "backward", "optimizer")
VIEWS = (1, 4)  # that are compared of an object
SIZES = ((1, 1), (8, 1), (1, 4), (8, 4))  # objects a step and views of each, in the order of the table of memory


class Clock:
    """Processor seconds by the name of a part; a part within another counts for itself alone."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.name, self.since = "", time.process_time()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        before = self.switch(name)
        try:
            yield
        finally:
            self.switch(before)

    def switch(self, name: str) -> str:
        """Count for ``name`` from now on; the name until now."""
        now, before = time.process_time(), self.name
        self.seconds[before] += now - self.since
        self.name, self.since = name, now
        return before

    def around(self, name: str, function: Callable) -> Callable:
        def timed(*values, **named):
            with self.part(name):
                return function(*values, **named)

        return timed


def network(start: Path | None) -> Reconstructor:
    """The averaged one of a stage's checkpoint, else a new one."""
    torch.manual_seed(0)
    model = Reconstructor(TINY)
    if start:
        model = averaged(model, load_state(start, model)["average"])
    model.environment.requires_grad_(False)
    return model.train()


def steps(model: Reconstructor, stage: config.Stage, source: Samples, count: int, clock: Clock) -> None:
    """``count`` steps as :func:`reli3d.train.stages.loop.train` takes them."""
    run = config.Run((), "", stage)
    trained = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=1e-5)
    average = {k: v.detach().clone() for k, v in model.state_dict().items()}
    for at in range(count):
        optimizer.zero_grad(set_to_none=True)
        for k in range(stage.batch):
            with clock.part("data"):
                one = drawn(run, [source], model, at, k)
            with clock.part("losses"):
                loss = total(object_losses(model, one, stage, gradients), stage)
            with clock.part("backward"):
                (loss / stage.batch).backward()
        with clock.part("optimizer"):
            clip_gradients(trained, 1.0)
            optimizer.step()
            update_average(average, model, 0.999)


def measured(model: Reconstructor, stage: config.Stage, source: Samples, count: int) -> dict[str, float]:
    """Processor seconds of a step by part, mean of ``count``; the first step is not counted."""
    steps(model, stage, source, 1, Clock())
    clock = Clock()
    with patch.multiple(
        step, **{f: clock.around(name, getattr(step, f)) for name, functions in PARTS.items() for f in functions}
    ):
        steps(model, stage, source, count, clock)
    return {name: clock.seconds[name] / count for name in (*PARTS, *OTHERS)}


def most() -> float:
    """MiB that this process has held at most since it began.  Linux; ``ru_maxrss`` counts the process before it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def held(name: str, samples: Path, start: Path | None, pipe) -> None:
    """Send the MiB that this process has held at most after a step of each of :data:`SIZES`, less those before."""
    torch.set_num_threads(1)
    model, source = network(start), Samples(samples)
    before = most()
    for batch, targets in SIZES:
        steps(model, replace(config.TINY[name], batch=batch, targets=targets), source, 1, Clock())
        pipe.send(most() - before)


def memory(name: str, args: argparse.Namespace) -> list[float]:
    """What :func:`held` sends from a process of its own."""
    context = get_context("spawn")
    mine, theirs = context.Pipe(duplex=False)
    process = context.Process(target=held, args=(name, args.samples, args.start, theirs))
    process.start()
    theirs.close()
    found = [mine.recv() for _ in SIZES]
    process.join()
    return found


def row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("samples", type=Path)
    parser.add_argument("--start", type=Path, help="checkpoint of a network that shows surfaces")
    parser.add_argument("--steps", type=int, default=8, help="that the times are means of")
    parser.add_argument("--stages", nargs="+", choices=config.TINY, default=list(config.TINY))
    args = parser.parse_args()
    torch.set_num_threads(1)
    source = Samples(args.samples)
    head = ["stage", "views of an object", "s a step", "objects a s", "views a s", *PARTS, *OTHERS]
    print(row(head), "|" + "---|" * len(head), sep="\n", flush=True)
    for name in args.stages:
        stage = config.TINY[name]
        for targets in VIEWS:
            found = measured(network(args.start), replace(stage, targets=targets), source, args.steps)
            whole = sum(found.values())
            rates = [f"{whole:.2f}", f"{stage.batch / whole:.1f}", f"{stage.batch * targets / whole:.1f}"]
            print(row([name, str(targets), *rates, *(f"{v / whole:.0%}" for v in found.values())]), flush=True)
    head = ["stage", *(f"objects: {b}, views: {t}" for b, t in SIZES)]
    print("", row(head), "|" + "---|" * len(head), sep="\n", flush=True)
    for name in args.stages:
        print(row([name, *(f"{value:.0f}" for value in memory(name, args))]), flush=True)


if __name__ == "__main__":
    main()
