"""``reli3d capture``: photographs or a video without cameras to an object folder."""

import argparse
import json
import os
import sys
from pathlib import Path

from reli3d.cli.exit_codes import Parser, command
from reli3d.errors import InputError, printable

FAILED_CHECKS = 3  # exit code
LEAST_IOU = 0.9  # of the asset's silhouettes with the masks


def parser() -> Parser:
    p = Parser(
        prog="reli3d capture",
        description="Find the cameras and the masks of photographs or a video of one object, and write an object "
        "folder that reli3d-infer reads.  Needs the extra: pip install 'reli3d[capture]'.",
        epilog="Exit code: 0 all checks passed, 2 invalid input, 3 a check failed (the folder is written), 130 "
        "interrupted.  The folder's path goes to stdout.",
    )
    p.add_argument("source", type=Path, help="folder of JPEG, HEIC or PNG photographs, or a video (mp4, mov)")
    p.add_argument("output", type=Path, help="object folder to write, with capture.json and capture.png")
    p.add_argument("--masks", type=Path, help="folder of masks named like the photographs, instead of --mask-method")
    p.add_argument(
        "--mask-method",
        choices=("grabcut", "key", "rembg"),
        default="grabcut",
        help="grabcut: from the points of the object and of its support; key: pixels that differ from a uniform "
        "background; rembg: a network (pip install 'reli3d[masks]'), fetched once",
    )
    p.add_argument(
        "--turntable",
        action=argparse.BooleanOptionalAction,
        help="the object rotates in front of a camera that is fixed at one or several heights (default: detected)",
    )
    p.add_argument(
        "--size", type=float, metavar="MM", help="longest side of the object in millimeters; units become meters"
    )
    p.add_argument("--infer", action="store_true", help="also reconstruct the asset, in OUTPUT/asset")
    return p


@command("reli3d capture")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    try:
        from reli3d.capture.capture import CaptureOptions, capture
        from reli3d.capture.report import summary
    except ModuleNotFoundError as error:
        raise InputError(str(error.name), "is not installed: pip install 'reli3d[capture]'") from None

    from tqdm import tqdm

    bar = tqdm(file=sys.stderr, disable=None, bar_format="{desc}: {bar:20} {n_fmt}/{total_fmt} {elapsed}")

    def progress(stage: str, done: int, total: int) -> None:
        bar.set_description_str(stage, refresh=False)
        bar.n, bar.total = done, total
        bar.refresh()

    try:
        options = CaptureOptions(args.masks, args.mask_method, args.turntable, args.size)
        report = capture(args.source, args.output, options, progress)
    finally:
        bar.close()
    lines = [*report.notes, *(f"left out {name}: {why}" for name, why in report.left_out.items())]
    lines += [f"not registered: {', '.join(report.lost)}"] if report.lost else []
    for line in [*lines, summary(report), *(f"check failed: {text}" for text in report.failed)]:
        print(f"reli3d capture: {printable(line)}", file=sys.stderr)
    print(args.output)
    code = FAILED_CHECKS if report.failed else 0
    return _infer(args.output) or code if args.infer else code


def _infer(folder: Path) -> int:
    """Reconstructs ``folder`` and returns the exit code: 3 where the asset's silhouettes differ from the masks."""
    from reli3d.cli import infer

    if code := infer.main([str(folder), "--output", str(folder / "asset")]):
        return code
    info = folder / "asset" / Path(os.path.abspath(folder)).name / "run_info.json"
    iou = json.loads(info.read_text())["mask_iou"]
    if iou >= LEAST_IOU:
        return 0
    text = f"mask IoU of the asset {iou:.3f}, at least {LEAST_IOU} expected"
    print(f"reli3d capture: check failed: {text}", file=sys.stderr)
    return FAILED_CHECKS


if __name__ == "__main__":
    sys.exit(main())
