"""``reli3d-infer``: posed photographs to a relightable asset."""

import argparse
import functools
import json
import os
import re
import sys
from dataclasses import asdict
from pathlib import Path

from reli3d.cli import objects
from reli3d.cli.exit_codes import check_ranges, command, report, show_traceback
from reli3d.cli.options import AXES, joined, parser
from reli3d.errors import InputError, printable

EXAMPLE = Path(__file__).parents[1] / "assets" / "example"
REFINE_SECONDS = {"cpu": 60.0, "cuda": 20.0}  # without a number


@command("reli3d-infer")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(joined(argv, "--up", AXES))
    check_ranges(args, workers=(1, 1024), views=(1, 16), texture_size=(256, 4096), resolution=(16, 256))
    items = checked_items(args)
    for item in items:
        _check_kept(item)
    device = choose_device(args.device)
    budget = refinement_budget(args, device)
    from reli3d.cli import job

    made = job.FolderJob(args, device, budget)  # checks the weights and compiles the kernels
    start = functools.partial(job.worker, args, device, budget)
    if args.workers is not None:
        rows = objects.in_processes(start, items, min(args.workers, len(items)))
    elif args.ray is not None:
        rows = objects.on_ray(start, items, args.ray, gpu=device == "cuda")
    else:
        rows = (objects.make(made, item, lambda error: show_traceback(error, args)) for item in items)

    def done(row: objects.Row) -> None:
        if args.workers is not None or args.ray is not None:  # without progress bars
            took = "" if row.seconds is None else f": {row.seconds:.1f} s"  # None: complete before its worker crashed
            report(f"{printable(row.object)}{took}")
        if not args.json:
            print(args.output / row.object / "mesh.glb", flush=True)

    summary = args.output / objects.SUMMARY if len(items) > 1 else None
    ended, code = objects.collect("reli3d-infer", rows, items, done, summary)
    if args.json:
        entries = [asdict(row) | {"folder": str(args.output / row.object)} for row in ended]
        print(json.dumps({"objects": entries, "exit_code": code}))
    return code


def checked_items(args: argparse.Namespace) -> list[objects.Item]:
    """The objects of the command line.  Raises InputError if a result cannot be written."""
    from reli3d.output.folder import check_place

    items = objects.items_of(args.folder or [EXAMPLE], args.output)
    if args.masks and len(items) > 1:
        raise InputError("--masks", f"expected one object with it, got {len(items)}; put masks into each folder")
    for item in items:
        check_place(item.target)  # before minutes of work
    if (args.output / objects.SUMMARY).is_dir():
        raise InputError(args.output / objects.SUMMARY, "expected a file or none, got a folder; give another --output")
    return items


def _check_kept(item: objects.Item) -> None:
    """Raises InputError if the result would replace files of the input that have the names of a result."""
    if os.path.realpath(item.target) != os.path.realpath(item.folder) or (item.folder / "run_info.json").exists():
        return
    from reli3d.output.results import OURS  # loads torch

    if found := [name for name in OURS if os.path.lexists(item.folder / name)]:
        raise InputError("--output", f"expected a place outside the input, as its {found[0]} would be replaced")


def choose_device(requested: str) -> str:
    """``cpu`` or ``cuda`` for ``auto``, ``cpu`` or ``cuda``.  Raises InputError if cuda is requested and missing."""
    import torch

    if requested == "cuda" and not torch.cuda.is_available():
        raise InputError("--device", "expected a CUDA device for cuda, got none; use --device cpu")
    return "cuda" if requested != "cpu" and torch.cuda.is_available() else "cpu"


def refinement_budget(args: argparse.Namespace, device: str) -> dict[str, float | int]:
    """``seconds`` or ``steps`` of the refinement, empty without --refine.  Raises InputError for an invalid value."""
    if args.refine is None:
        if args.refine_cameras:
            raise InputError("--refine-cameras", "expected it together with --refine; add --refine")
        if args.light:
            raise InputError("--light", "expected it together with --refine; add --refine")
        return {}
    if not args.refine:
        return {"seconds": REFINE_SECONDS[device]}
    if steps := re.fullmatch(r"0*([1-9][0-9]{0,8}) ?steps", args.refine):
        return {"steps": int(steps[1])}
    try:
        seconds = float(args.refine)
    except ValueError:
        seconds = 0.0
    if not 0.0 < seconds < 1e6:
        raise InputError("--refine", f"expected seconds such as 60 or steps such as 300steps, got {args.refine}")
    return {"seconds": seconds}


if __name__ == "__main__":
    sys.exit(main())
