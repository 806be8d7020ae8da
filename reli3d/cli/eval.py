"""``reli3d-eval``: metrics of the network on held-out procedural objects."""

import argparse
import json
from pathlib import Path

from reli3d.cli.exit_codes import Parser, command, report
from reli3d.errors import InputError

MAX_VIEWS = 16  # input views of the small network


def parser() -> argparse.ArgumentParser:
    p = Parser(prog="reli3d-eval", description="Evaluate the network on held-out procedural objects.")
    p.add_argument("samples", type=Path, help="folder made by reli3d-data render --held-out test --views 24")
    p.add_argument(
        "--maps", type=Path, required=True, help=".npz of the environment maps used in training, for the baseline"
    )
    p.add_argument("--weights", default="small", help="small, or a safetensors file")
    p.add_argument(
        "--views",
        type=int,
        nargs="+",
        choices=range(1, MAX_VIEWS + 1),
        metavar="N",
        default=(1, 2, 4),
        help=f"numbers of input views, 1 to {MAX_VIEWS}; the last 8 views of a sample are held out for comparison",
    )
    p.add_argument(
        "--symmetry",
        choices=("auto", "off"),
        default="auto",
        help="auto: complete objects with a detected mirror plane by their mirror image, as the pipeline does",
    )
    p.add_argument("--json", type=Path, help="also write the table to this file")
    return p


def _seeded(path: Path) -> None:
    if not (path.stem.isascii() and path.stem.isdecimal()):
        raise InputError(path, "expected a seed as the file name; give samples of procedural objects")


@command("reli3d-eval")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    from reli3d.eval.heldout import HELD_OUT_VIEWS, mean_environment, table
    from reli3d.io.files import write_bytes
    from reli3d.nn.weights import load_model
    from reli3d.output.folder import check_folder
    from reli3d.synthetic.maps import held_out, load_maps
    from reli3d.synthetic.stored import check_samples

    check_samples(args.samples, "samples", views=max(args.views) + HELD_OUT_VIEWS, also=_seeded)
    if args.json:
        if args.json.is_dir():
            raise InputError(args.json, "expected a file for --json, got a folder")
        check_folder(args.json.parent)
    maps, names = load_maps(args.maps)
    mean = mean_environment(maps[[not h for h in held_out(names)]])
    figures = table(load_model(args.weights), args.samples, mean, args.views, report, symmetry=args.symmetry)
    text = json.dumps(figures, indent=1)
    print(text)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(args.json, f"{text}\n".encode())
    return 0
