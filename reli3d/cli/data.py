"""``reli3d-data``: renders training samples of procedural objects or meshes, and packs objects into shards."""

import argparse
import contextlib
import functools
import os
import sys
from pathlib import Path

from tqdm import tqdm

from reli3d.cli import objects
from reli3d.cli.exit_codes import Parser, check_ranges, command, report
from reli3d.errors import InputError

COUNT, VIEWS = 1000, 6  # default numbers of seeds and views


def parser() -> argparse.ArgumentParser:
    whole = Parser(prog="reli3d-data", description="Render training samples, and pack objects into shards.")
    actions = whole.add_subparsers(dest="action", required=True, metavar="ACTION")
    about = "render training samples of procedural objects or textured meshes"
    p = actions.add_parser("render", help=about, description=f"{about.capitalize()}.")
    p.add_argument("output", type=Path, help="folder for NNNNNNNNNN.safetensors; existing files are kept")
    p.add_argument("--maps", type=Path, required=True, help=".npz of environment maps: env (n, H, 2H, 3) linear, names")
    p.add_argument("--first", type=int, default=0, help="first seed")
    p.add_argument(
        "--count",
        type=int,
        help=f"number of seeds, ignored with --held-out; default {COUNT}, with --protocol paper one per --meshes file",
    )
    p.add_argument("--views", type=int, help=f"views per object; default {VIEWS}, fixed by --protocol paper")
    p.add_argument("--size", type=int, default=256, help="pixels per side of a view")
    p.add_argument(
        "--protocol",
        choices=("own", "paper"),
        default="own",
        help="paper: three environments per object, one file each; 100 views in total; for meshes without a "
        "metallic-roughness texture 30 views, with images, cameras and environment only",
    )
    p.add_argument(
        "--held-out", choices=("validation", "test"), help="objects of the validation or test set, under held-out maps"
    )
    source = p.add_mutually_exclusive_group()
    source.add_argument(
        "--meshes", type=Path, nargs="+", help="GLB files or folders of them, instead of procedural objects"
    )
    source.add_argument(
        "--shapes",
        type=Path,
        nargs="+",
        help="GLB files or folders of them, whose shapes are combined and get procedural materials",
    )
    p.add_argument(
        "--materials",
        type=Path,
        help="folder of material sets (basecolor, roughness, metallic, normal): surfaces are divided into regions with "
        "different materials",
    )
    p.add_argument(
        "--views-only",
        action="store_true",
        help="only images and maps of the views, one ray per pixel, for reli3d-train --stage pixels; more than 2 times "
        "faster",
    )
    where = p.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, help="number of processes; default one per core")
    where.add_argument("--ray", metavar="ADDRESS", help="render on a Ray cluster: auto, local, or its address")
    p.set_defaults(run=render)
    about = "write samples or captures as WebDataset tar files"
    p = actions.add_parser("pack", help=about, description=f"{about.capitalize()}; existing files are kept.")
    p.add_argument("input", type=Path, help="folder of samples, or of captures with transforms.json each")
    p.add_argument("output", type=Path, help="folder for NNNNNN.tar")
    p.add_argument("--each", type=int, default=64, help="objects per tar file")
    p.set_defaults(run=pack)
    return whole


def glb_files(paths: list[Path] | None) -> tuple[Path, ...]:
    """The files among ``paths`` and all GLB files in the folders among them.  Raises InputError for an empty folder."""
    from reli3d.io.files import file_size

    found: list[Path] = []
    for path in paths or ():
        below = (p for p in path.rglob("*") if p.suffix.lower() == ".glb" and not p.name.startswith("."))
        inside = sorted(below) if path.is_dir() else [path]
        if not inside:
            raise InputError(path, "expected GLB files, got none in this folder")
        found += inside
    for path in found:
        file_size(path)
    return tuple(path.absolute() for path in found)


@command("reli3d-data")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    return args.run(args)


def render(args: argparse.Namespace) -> int:
    """Writes the samples; returns 1 if some objects failed."""
    from reli3d.output.folder import check_folder

    check_ranges(args, first=(0, 10**9), count=(1, 10**9), views=(1, 64), size=(16, 2048), workers=(1, 1024))
    paper = args.protocol == "paper"
    if paper and args.views is not None:
        raise InputError("--views", f"expected none with --protocol paper, got {args.views}; leave it out")
    check_folder(args.output)
    from reli3d.cli.samples import SampleJob, SampleSpec
    from reli3d.synthetic.maps import held_out, load_maps
    from reli3d.synthetic.procedural import TEST_SEEDS, VALIDATION_SEEDS
    from reli3d.synthetic.protocol import LIGHTS
    from reli3d.synthetic.refinished import material_sets

    meshes, shapes = glb_files(args.meshes), glb_files(args.shapes)
    fit = held_out(load_maps(args.maps)[1]).count(bool(args.held_out))
    if not fit:
        raise InputError("--maps", "expected at least six maps for --held-out, got fewer")
    if paper and fit < LIGHTS:
        raise InputError("--maps", f"expected at least {LIGHTS} for --protocol paper, got {fit} usable maps")
    for option in ("views_only", "materials") if paper else ():
        if getattr(args, option):
            raise InputError(f"--{option.replace('_', '-')}", "expected --protocol own, got paper")
    maps, views = args.maps.absolute(), args.views or VIEWS
    sets = material_sets(args.materials) if args.materials else ()
    spec = SampleSpec(maps, bool(args.held_out), paper, views, args.size, meshes, shapes, args.views_only, sets)
    count = args.count or (len(meshes) if paper else 0) or COUNT
    seeds = range(args.first, args.first + count)
    if args.held_out:
        seeds = {"validation": VALIDATION_SEEDS, "test": TEST_SEEDS}[args.held_out]
    elif seeds.stop > VALIDATION_SEEDS.start:
        raise InputError("--first", f"expected seeds below {VALIDATION_SEEDS.start}, got {seeds.stop - 1}")
    args.output.mkdir(parents=True, exist_ok=True)
    ends = [f"_{k}" for k in range(LIGHTS)] if paper else [""]
    names = [f"{seed:010d}{end}" for seed in seeds for end in ends]
    items = [objects.Item(Path(), n, args.output.absolute() / f"{n}.safetensors") for n in names]
    items = [item for item in items if not item.target.exists()]
    start = functools.partial(SampleJob, spec)
    workers = args.workers or os.cpu_count() or 1
    rows = objects.on_ray(start, items, args.ray) if args.ray else objects.in_processes(start, items, workers)
    lost = 0
    with contextlib.closing(rows), tqdm(total=len(items), file=sys.stderr, unit="sample", disable=None) as bar:
        for row in rows:
            bar.update()
            if row.result in ("done", "skipped"):
                continue
            notes = "; ".join(row.notes)
            if row.result == "failed" and objects.CRASHED not in row.notes:  # such as a full disk
                raise OSError(f"{row.object}: {notes}")
            lost += 1
            tqdm.write(f"{row.object}: {notes}", file=sys.stderr)
    return 1 if lost else 0


def pack(args: argparse.Namespace) -> int:
    """Writes the tar files and reports captures that are left out."""
    from reli3d.output.folder import check_folder
    from reli3d.train.stages import shards
    from reli3d.train.stages.captures import Captures
    from reli3d.train.stages.views import Samples

    check_ranges(args, each=(1, 10**6))
    check_folder(args.output)
    found = shards.source(args.input)
    if not isinstance(found, Samples | Captures):
        raise InputError(args.input, "expected samples or captures, got tar files")
    if isinstance(found, Captures):
        for name, reason in found.rejected.items():
            report(f"{name}: left out, {reason}")
    shards.pack(found, args.output, each=args.each, progress=report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
