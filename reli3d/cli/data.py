"""``reli3d-data``: make training samples of procedural objects, or of textured meshes; put objects into shards."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

from reli3d._bridge import present
from reli3d.cli import shards
from reli3d.cli.exit_codes import check_range, command
from reli3d.cli.help_format import Defaults


def parser() -> argparse.ArgumentParser:
    whole = argparse.ArgumentParser(
        formatter_class=Defaults,
        prog="reli3d-data",
        description="Make training samples, and put objects into shards.",
    )
    actions = whole.add_subparsers(dest="action", required=True, metavar="ACTION")
    about = "make training samples of procedural objects, or of textured meshes"
    p = actions.add_parser("render", formatter_class=Defaults, help=about, description=f"{about.capitalize()}.")
    p.add_argument("output", type=Path, help="folder for NNNNNNNNNN.safetensors; those that exist are kept")
    p.add_argument("--maps", type=Path, required=True, help=".npz of environment maps: env (n, H, 2H, 3) linear, names")
    p.add_argument("--first", type=int, default=0, help="first seed")
    p.add_argument("--count", type=int, default=1000, help="seeds, without --held-back")
    p.add_argument("--views", type=int, default=6)
    p.add_argument("--size", type=int, default=192, help="pixels")
    p.add_argument(
        "--held-back",
        choices=("validation", "test"),
        help="objects to choose by or to report on, under maps that no training sees",
    )
    p.add_argument("--meshes", type=Path, nargs="+", help="GLB files to draw from instead of procedural objects")
    p.add_argument(
        "--shapes",
        type=Path,
        nargs="+",
        help="GLB files whose shapes are put together and dressed by finishes of their own",
    )
    p.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    p.set_defaults(run=render)
    shards.add(actions)
    return whole


_LIGHTS = None  # maps of this worker process
LAMPS = 0.45  # share of the training lights that get lamps of their own


def _start(maps: Path, held: bool) -> None:
    global _LIGHTS
    import torch

    from reli3d.synthetic.maps import held_back, load_maps

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the first one ends the others
    torch.set_num_threads(1)
    lights, names = load_maps(maps)
    _LIGHTS = [m for m, h in zip(lights, held_back(names), strict=True) if h == held]


def _make(seed: int, target: Path, args: argparse.Namespace) -> str | None:
    """Write one sample; the reason instead where the object could not be made."""
    import numpy as np
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    from reli3d.io.files import replacing
    from reli3d.synthetic.maps import with_lamps
    from reli3d.synthetic.procedural import make_object
    from reli3d.synthetic.samples import ObjectSurface, Surface, synthesize
    from reli3d.synthetic.scanned import ScannedSurface
    from reli3d.synthetic.shapes import ShapeSurface

    rng = np.random.default_rng((seed, 1))
    surface: Surface
    lights = present("_LIGHTS", _LIGHTS)
    try:
        if args.shapes:
            surface = ShapeSurface(args.shapes, rng)
        elif args.meshes:
            surface = ScannedSurface(args.meshes[seed % len(args.meshes)], rng)
        else:
            surface = ObjectSurface(make_object(seed))
        light = lights[int(rng.integers(len(lights)))]
        if not args.held_back and rng.random() < LAMPS:
            light = with_lamps(light, rng)
        sample = synthesize(surface, light, rng, size=args.size, views=args.views)
    except ValueError as error:
        return f"seed {seed}: {error}"
    try:
        with replacing(target) as temporary:
            save_file(sample, temporary)
    except SafetensorError as error:  # a full disk, for one
        raise OSError(f"{target}: cannot be written ({error})") from None
    return None


def _check(args: argparse.Namespace) -> None:
    from reli3d.io.files import file_size
    from reli3d.output.folder import check_folder
    from reli3d.synthetic.maps import held_back, load_maps

    for name, low, high in (
        ("first", 0, 10**9),
        ("count", 1, 10**9),
        ("views", 1, 64),
        ("size", 16, 2048),
        ("workers", 1, 1024),
    ):
        check_range(name, getattr(args, name), low, high)
    check_folder(args.output)
    for path in (*(args.meshes or ()), *(args.shapes or ())):
        file_size(path)
    if bool(args.held_back) not in held_back(load_maps(args.maps)[1]):
        raise ValueError("--maps: expected at least six maps for --held-back, got fewer")


@command("reli3d-data")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    return args.run(args)


def render(args: argparse.Namespace) -> int:
    """Write the samples; 1 where some object could not be made."""
    _check(args)
    from tqdm import tqdm

    from reli3d.synthetic.procedural import TEST_SEEDS, VALIDATION_SEEDS

    seeds = range(args.first, args.first + args.count)
    if args.held_back:
        seeds = {"validation": VALIDATION_SEEDS, "test": TEST_SEEDS}[args.held_back]
    args.output.mkdir(parents=True, exist_ok=True)
    jobs = [(s, args.output / f"{s:010d}.safetensors") for s in seeds]
    jobs = [j for j in jobs if not j[1].exists()]
    context = get_context("spawn")
    failed = 0
    pool = ProcessPoolExecutor(args.workers, context, _start, (args.maps, bool(args.held_back)))
    try:
        wanted = argparse.Namespace(**{k: v for k, v in vars(args).items() if k != "run"})  # what a process can be sent
        futures = [pool.submit(_make, seed, target, wanted) for seed, target in jobs]
        for future in tqdm(as_completed(futures), total=len(futures), file=sys.stderr, unit="object", disable=None):
            reason = future.result()
            failed += reason is not None
            if reason:
                tqdm.write(reason, file=sys.stderr)
    except BrokenProcessPool:
        raise OSError(
            "workers: expected all to live, got one killed (too little memory?); give fewer --workers"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)  # else an error would wait for all that is left
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
