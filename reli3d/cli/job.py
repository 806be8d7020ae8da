"""What ``reli3d-infer`` does with each object: the loaded network, and a bar on stderr."""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path

import torch
from tqdm import tqdm

from reli3d._bridge import load_modules
from reli3d.errors import printable
from reli3d.kernels import cache
from reli3d.nn import weights
from reli3d.output import results
from reli3d.pipeline import FolderOptions, Progress, ReconstructOptions, reconstruct_folder

STAGES = (
    "reading",
    "normalize",
    "prepare",
    "symmetry",
    "network",
    "surface",
    "textures",
    "light",
    "frame",
    "refine",
    "preview",
    "writing",
)


class FolderJob:
    """What all objects of one command share: options and the loaded network."""

    def __init__(self, args: argparse.Namespace, device: str, budget: dict[str, float | int]):
        self.options = ReconstructOptions(
            args.texture_size,
            args.resolution,
            args.normalize,
            args.up,
            hero=args.hero,
            background=args.background,
        )
        self.reading = FolderOptions(
            args.views, args.masks, args.remove_background, budget, args.refine_cameras, pressed
        )
        path = weights.locate(args.weights)
        trunk = args.precision if args.precision in (None, "auto") else getattr(torch, args.precision)
        self.model, manifest = weights.load(path, trunk=trunk, device=device)
        self.weights = results.weights_record(manifest, weights.known_sha256(path))
        self.skip = args.skip_existing
        if budget:
            import reli3d.fit.refine  # noqa: F401 # its kernels are compiled with the others
        ready_kernels(device)  # takes half a minute the first time: not before the weights are known to be good

    def run(self, folder: Path, name: str, target: Path) -> str:
        """Reconstruct one object and write its files, unless they are there; the bar ends before an error is raised."""
        pressed.clear()
        with results.claim(target) as replacing:
            if self.skip and results.complete(target, refined=bool(self.reading.budget)):
                return "skipped"
            with Bar(name) as bar:
                reconstruct_folder(
                    folder,
                    name,
                    replacing,
                    self.model,
                    self.weights,
                    reading=self.reading,
                    options=self.options,
                    progress=bar,
                )
        return "done"


def worker(args: argparse.Namespace, device: str, budget: dict[str, float | int]) -> FolderJob:
    """The job of a process that runs beside others."""
    torch.set_num_threads(1)
    return FolderJob(args, device, budget)


class Bar(Progress):
    """A bar over the stages of one object, on stderr where that is a terminal; elsewhere lines alone are written.

    While a refinement runs the first Ctrl-C ends it, with the best so far; the second one ends the command.
    """

    def __init__(self, name: str):
        self.name = printable(name)
        layout = "{desc}: {bar:20} {postfix} {elapsed}"
        self.bar = tqdm(total=len(STAGES), desc=self.name, file=sys.stderr, bar_format=layout, disable=None)
        self.heeded = contextlib.ExitStack()

    def __call__(self, stage: str) -> None:
        self.heeded.close()
        if stage == "refine":
            self.heeded.enter_context(pressed.heeded())
        if not self.bar.disable:
            self.bar.set_postfix_str(stage, refresh=False)
            self.bar.n = STAGES.index(stage)
            self.bar.refresh()

    def report(self, notes: Iterable[str]) -> None:
        for note in notes:
            self.bar.write(f"{self.name}: {printable(note)}", file=sys.stderr)

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.heeded.close()
        self.bar.leave = error is None
        if error is None and not self.bar.disable:
            self.bar.n = len(STAGES)
            self.bar.set_postfix_str("done", refresh=True)
        self.bar.close()


class Pressed:
    """Whether Ctrl-C was pressed while it is :meth:`heeded`; called, it says so."""

    def __init__(self) -> None:
        self._flag = False

    def __call__(self) -> bool:
        return self._flag

    def clear(self) -> None:
        self._flag = False

    @contextlib.contextmanager
    def heeded(self) -> Iterator[None]:
        """In this block the first Ctrl-C is noted; the second one does what it did before."""
        before = signal.getsignal(signal.SIGINT)
        if threading.current_thread() is not threading.main_thread() or before == signal.SIG_IGN:
            yield
            return

        def note(number: int, frame) -> None:
            self._flag = True
            signal.signal(signal.SIGINT, before)

        signal.signal(signal.SIGINT, note)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)


pressed = Pressed()


def ready_kernels(device: str) -> None:
    """Compile several kernel modules at once that a first run would compile one by one; says so on stderr."""
    modules = cache.imported(device)
    if not cache.compiled(modules, device):
        print("compiling kernels (first run only)", file=sys.stderr)
        load_modules(modules, torch.device(device))
