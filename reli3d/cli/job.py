"""The job of ``reli3d-infer`` for each object, with a progress bar on stderr."""

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
from reli3d.output.folder import claimed
from reli3d.pipeline import FolderOptions, Progress, ReconstructOptions, reconstruct_folder

STAGES = (
    "reading", "normalize", "prepare", "symmetry", "network", "surface", "textures", "light", "frame", "refine",
    "detail", "preview", "writing",
)  # fmt: skip


class FolderJob:
    """The options and the loaded network, common to all objects of one command."""

    def __init__(self, args: argparse.Namespace, device: str, budget: dict[str, float | int]):
        self.options = ReconstructOptions(
            args.texture_size, args.resolution, args.normalize, args.up, hero=args.hero, background=args.background
        )
        self.reading = FolderOptions(
            args.views, args.masks, args.remove_background, budget, args.refine_cameras, interrupted.is_set, args.light
        )
        path = weights.locate(args.weights)
        trunk = args.precision if args.precision in (None, "auto") else getattr(torch, args.precision)
        self.model, manifest = weights.load(path, trunk=trunk, device=device)
        digest = weights.known_sha256(path)
        self.weights = {"file": Path(manifest.path).name, "sha256": digest, "license": manifest.license}
        self.skip = args.skip_existing
        if budget:
            import reli3d.fit.refine  # noqa: F401 # its kernels are compiled with the others
        modules = cache.imported(device)
        if not cache.compiled(modules, device):  # half a minute the first time, so after the weights are checked
            print("compiling kernels (first run only)", file=sys.stderr)
            load_modules(modules, torch.device(device))

    def run(self, folder: Path, name: str, target: Path) -> str:
        """Reconstructs one object and writes its files; with --skip-existing only if they are missing."""
        interrupted.clear()
        with claimed(target, results.OURS) as replacing:
            if self.skip and results.complete(target, folder, refined=bool(self.reading.budget)):
                return "skipped"
            with Bar(name) as bar:
                made = folder, name, replacing, self.model, self.weights
                reconstruct_folder(*made, reading=self.reading, options=self.options, progress=bar)
        return "done"


def worker(args: argparse.Namespace, device: str, budget: dict[str, float | int]) -> FolderJob:
    """The job of a worker process, with one thread."""
    torch.set_num_threads(1)
    return FolderJob(args, device, budget)


class Bar(Progress):
    """Progress bar over the stages of one object, on stderr; without a terminal only notes are written.

    During refinement the first Ctrl-C ends the refinement with the best result so far, the second ends the command.
    """

    def __init__(self, name: str):
        self.name = printable(name)
        layout = "{desc}: {bar:20} {postfix} {elapsed}"
        self.bar = tqdm(total=len(STAGES), desc=self.name, file=sys.stderr, bar_format=layout, disable=None)
        self.catching = contextlib.ExitStack()

    def __call__(self, stage: str) -> None:
        self.catching.close()
        if stage == "refine":
            self.catching.enter_context(catching_interrupt())
        if not self.bar.disable:
            self.bar.set_postfix_str(stage, refresh=False)
            self.bar.n = STAGES.index(stage)
            self.bar.refresh()

    def report(self, notes: Iterable[str]) -> None:
        for note in notes:
            self.bar.write(f"{self.name}: {printable(note)}", file=sys.stderr)

    def __enter__(self) -> "Bar":
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.catching.close()
        self.bar.leave = error is None
        if error is None and not self.bar.disable:
            self.bar.n = len(STAGES)
            self.bar.set_postfix_str("done", refresh=True)
        self.bar.close()


interrupted = threading.Event()


@contextlib.contextmanager
def catching_interrupt() -> Iterator[None]:
    """In the block the first Ctrl-C sets :data:`interrupted`; the second one has its usual effect."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before == signal.SIG_IGN:
        yield
        return

    def note(number: int, frame) -> None:
        interrupted.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
