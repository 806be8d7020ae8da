"""``reli3d-data pack``, ``check`` and ``show``: objects in shards."""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from reli3d.cli.exit_codes import check_range, tell
from reli3d.errors import InputError
from reli3d.io.shards import fault, read_index


def add(actions) -> None:
    """Add the three to the sub-commands of ``reli3d-data``."""
    p = actions.add_parser(
        "pack",
        help="write samples or captures as shards",
        description="Write a folder of samples or captures as tar files of the WebDataset form; "
        "those that are there are kept.",
    )
    p.add_argument("input", type=Path, help="folder of samples, or of captures with transforms.json each")
    p.add_argument("output", type=Path, help="folder for NNNNNN.tar and index.json")
    p.add_argument("--each", type=int, default=64, help="objects of a shard")
    p.add_argument("--workers", type=int, default=1)
    p.set_defaults(run=pack)
    p = actions.add_parser(
        "check",
        help="compare shards with their checksums",
        description="Read all shards and compare them with their index.",
    )
    p.add_argument("input", type=Path, help="folder of shards")
    p.set_defaults(run=check)
    p = actions.add_parser(
        "show",
        help="list the objects of shards",
        description="List the objects: views, size, and what is known.",
    )
    p.add_argument("input", type=Path, help="folder of shards")
    p.add_argument("--picture", type=Path, help="PNG file for the views of one object")
    p.add_argument("--object", type=int, default=0, help="which one, from 0")
    p.set_defaults(run=show)


def _write(source: Path, output: Path, each: int, part: tuple[int, int]) -> None:
    import torch

    from reli3d.train.stages import shards
    from reli3d.train.stages.captures import Captures
    from reli3d.train.stages.sources import source as reader
    from reli3d.train.stages.views import Samples

    torch.set_num_threads(1)
    found = reader(source)
    assert isinstance(found, Samples | Captures)  # shards were refused
    shards.pack(found, output, each=each, part=part, progress=tell)


def pack(args: argparse.Namespace) -> int:
    from reli3d.output.folder import check_folder
    from reli3d.train.stages.captures import Captures
    from reli3d.train.stages.shards import Shards
    from reli3d.train.stages.sources import source

    check_range("each", args.each, 1, 10**6)
    check_range("workers", args.workers, 1, 1024)
    check_folder(args.output)
    found = source(args.input)
    if isinstance(found, Shards):
        raise InputError("input", f"expected samples or captures, got shards in {args.input}")
    if isinstance(found, Captures):
        for name, reason in found.refused.items():
            tell(f"{name}: left out, {reason}")
    if args.workers == 1:
        _write(args.input, args.output, args.each, (0, 1))
        return 0
    with ProcessPoolExecutor(args.workers, get_context("spawn")) as pool:
        parts = [(k, args.workers) for k in range(args.workers)]
        jobs = [pool.submit(_write, args.input, args.output, args.each, part) for part in parts]
        for job in jobs:
            job.result()
    return 0


def check(args: argparse.Namespace) -> int:
    rows = read_index(args.input)
    wrong = [w for w in (fault(args.input, row, hashed=True) for row in rows) if w]
    for line in wrong:
        print(line)
    tell(f"{len(rows) - len(wrong)} of {len(rows)} shards are whole")
    return 1 if wrong else 0


def show(args: argparse.Namespace) -> int:
    from reli3d.io.files import write_bytes
    from reli3d.output.folder import check_folder
    from reli3d.train.stages.shards import Shards, picture

    found = Shards(args.input)
    check_range("object", args.object, 0, len(found) - 1)
    if args.picture:
        check_folder(args.picture.parent)
        write_bytes(args.picture, picture(found.tensors(args.object)))
        return 0
    for k, (path, name, _, length) in enumerate(found.places):
        images = found.tensors(k)["images"].shape
        known = [n for n in ("view_material", "view_normal", "environment", "view_valid") if n in found.tensors(k)]
        print(
            f"{k} {name} {path.name} {images[0]} views of {images[1]} pixels, {length / 1e6:.1f} MB, "
            f"{', '.join(known) or 'photographs alone'}"
        )
    return 0
