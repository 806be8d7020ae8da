"""``reli3d-data``: make training samples of procedural objects, or of textured meshes; put objects into shards."""

from __future__ import annotations

import argparse
import contextlib
import functools
import os
import sys
from pathlib import Path

from reli3d.cli import objects
from reli3d.cli.exit_codes import Parser, check_ranges, command, report
from reli3d.cli.samples import SampleJob, Wanted
from reli3d.errors import InputError

COUNT, VIEWS = 1000, 6  # seeds and views where nothing else is asked for


def parser() -> argparse.ArgumentParser:
    whole = Parser(
        prog="reli3d-data",
        description="Make training samples, and put objects into shards.",
    )
    actions = whole.add_subparsers(dest="action", required=True, metavar="ACTION")
    about = "make training samples of procedural objects, or of textured meshes"
    p = actions.add_parser("render", help=about, description=f"{about.capitalize()}.")
    p.add_argument("output", type=Path, help="folder for NNNNNNNNNN.safetensors; those that exist are kept")
    p.add_argument("--maps", type=Path, required=True, help=".npz of environment maps: env (n, H, 2H, 3) linear, names")
    p.add_argument("--first", type=int, default=0, help="first seed")
    p.add_argument(
        "--count",
        type=int,
        help=f"seeds, without --held-back; default {COUNT}, by --protocol paper one for each of --meshes",
    )
    p.add_argument("--views", type=int, help=f"default {VIEWS}; --protocol paper has its own numbers")
    p.add_argument("--size", type=int, default=192, help="pixels")
    p.add_argument(
        "--protocol",
        choices=("own", "paper"),
        default="own",
        help="paper: three lights an object in files of their own, 100 views, 30 of meshes without a "
        "metallic-roughness texture, of which there are images, cameras and light alone",
    )
    p.add_argument(
        "--held-back",
        choices=("validation", "test"),
        help="objects to choose by or to report on, under maps that no training sees",
    )
    p.add_argument(
        "--meshes", type=Path, nargs="+", help="GLB files, or folders of them, in the place of procedural objects"
    )
    p.add_argument(
        "--shapes",
        type=Path,
        nargs="+",
        help="GLB files whose shapes are put together and dressed by finishes of their own",
    )
    p.add_argument(
        "--materials",
        type=Path,
        help="folder of material sets (basecolor, roughness, metallic, normal): surfaces are divided into regions with "
        "finishes of their own",
    )
    p.add_argument(
        "--views-only",
        action="store_true",
        help="photographs and maps of the views alone, one ray a pixel: for reli3d-train --pixels, in less than "
        "half of the time",
    )
    where = p.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, help="processes of this machine; default one a core")
    where.add_argument("--ray", metavar="ADDRESS", help="render on a Ray cluster: auto, local, or its address")
    p.set_defaults(run=render)
    about = "write samples or captures as tar files (WebDataset)"
    p = actions.add_parser("pack", help=about, description=f"{about}; keeps existing ones.")
    p.add_argument("input", type=Path, help="folder of samples, or of captures with transforms.json each")
    p.add_argument("output", type=Path, help="folder for NNNNNN.tar")
    p.add_argument("--each", type=int, default=64, help="objects of a tar file")
    p.set_defaults(run=pack)
    return whole


def glb_files(paths: list[Path] | None) -> tuple[Path, ...]:
    """The files among ``paths``, and in the place of a folder all GLB files in it.  Raises InputError where there is
    none.
    """
    from reli3d.io.files import file_size

    found: list[Path] = []
    for path in paths or ():
        inside = sorted(path.rglob("*.glb")) if path.is_dir() else [path]
        if not inside:
            raise InputError(path, "expected GLB files, got none in this folder")
        found += inside
    for path in found:
        file_size(path)
    return tuple(path.absolute() for path in found)


def _wanted(args: argparse.Namespace) -> Wanted:
    """What the arguments ask for, checked."""
    from reli3d.output.folder import check_folder
    from reli3d.synthetic.dressed import material_sets
    from reli3d.synthetic.maps import held_back, load_maps
    from reli3d.synthetic.protocol import LIGHTS

    check_ranges(args, first=(0, 10**9), count=(1, 10**9), views=(1, 64), size=(16, 2048), workers=(1, 1024))
    paper = args.protocol == "paper"
    if paper and args.views is not None:
        raise InputError("--views", f"expected none with --protocol paper, got {args.views}; it has its own numbers")
    check_folder(args.output)
    meshes, shapes = glb_files(args.meshes), glb_files(args.shapes)
    fit = held_back(load_maps(args.maps)[1]).count(bool(args.held_back))
    if not fit:
        raise InputError("--maps", "expected at least six maps for --held-back, got fewer")
    if paper and fit < LIGHTS:
        raise InputError("--maps", f"expected at least {LIGHTS} for --protocol paper, got {fit} that may be taken")
    maps = args.maps.absolute()
    if paper and args.views_only:
        raise InputError("--views-only", "expected --protocol own with it, got paper")
    if paper and args.materials:
        raise InputError("--materials", "expected --protocol own with it, got paper")
    views = args.views or VIEWS
    sets = material_sets(args.materials) if args.materials else ()
    return Wanted(maps, bool(args.held_back), paper, views, args.size, meshes, shapes, args.views_only, sets)


@command("reli3d-data")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    return args.run(args)


def render(args: argparse.Namespace) -> int:
    """Write the samples; 1 where some object could not be made."""
    wanted = _wanted(args)
    from tqdm import tqdm

    from reli3d.synthetic.procedural import TEST_SEEDS, VALIDATION_SEEDS
    from reli3d.synthetic.protocol import LIGHTS

    count = args.count or (len(wanted.meshes) if wanted.paper else 0) or COUNT
    seeds = range(args.first, args.first + count)
    if args.held_back:
        seeds = {"validation": VALIDATION_SEEDS, "test": TEST_SEEDS}[args.held_back]
    args.output.mkdir(parents=True, exist_ok=True)
    ends = [f"_{k}" for k in range(LIGHTS)] if wanted.paper else [""]
    names = [f"{seed:010d}{end}" for seed in seeds for end in ends]
    items = [objects.Item(Path(), n, args.output.absolute() / f"{n}.safetensors") for n in names]
    items = [item for item in items if not item.target.exists()]
    start = functools.partial(SampleJob, wanted)
    workers = args.workers or os.cpu_count() or 1
    rows = objects.on_ray(start, items, args.ray) if args.ray else objects.in_processes(start, items, workers)
    lost = 0
    with contextlib.closing(rows), tqdm(total=len(items), file=sys.stderr, unit="sample", disable=None) as bar:
        for row in rows:
            bar.update()
            if row.result in ("done", "skipped"):
                continue
            notes = "; ".join(row.notes)
            if row.result == "failed" and objects.CRASHED not in row.notes:  # a full disk: the others would fail too
                raise OSError(f"{row.object}: {notes}")
            lost += 1
            tqdm.write(f"{row.object}: {notes}", file=sys.stderr)
    return 1 if lost else 0


def pack(args: argparse.Namespace) -> int:
    """Write the tar files; captures that are left out are reported."""
    from reli3d.output.folder import check_folder
    from reli3d.train.stages import shards
    from reli3d.train.stages.captures import Captures
    from reli3d.train.stages.sources import source
    from reli3d.train.stages.views import Samples

    check_ranges(args, each=(1, 10**6))
    check_folder(args.output)
    found = source(args.input)
    if not isinstance(found, Samples | Captures):
        raise InputError(args.input, "expected samples or captures, got tar files")
    if isinstance(found, Captures):
        for name, reason in found.refused.items():
            report(f"{name}: left out, {reason}")
    shards.pack(found, args.output, each=args.each, progress=report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
