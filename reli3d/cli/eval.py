"""``reli3d-eval``: figures of the network on held-back procedural objects."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from reli3d.cli.helping import Defaults


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        formatter_class=Defaults, prog="reli3d-eval", description="Measure the network on held-back procedural objects."
    )
    p.add_argument("samples", type=Path, help="folder made by reli3d-data --held-back test --views 12")
    p.add_argument("--maps", type=Path, required=True, help=".npz of environment maps that the training drew from")
    p.add_argument("--weights", default="small", help="small, or a safetensors file")
    p.add_argument(
        "--views", type=int, nargs="+", choices=(1, 2, 3, 4), default=(1, 2, 4), help="numbers of input views"
    )
    p.add_argument("--json", type=Path, help="also write the table to this file")
    return p


def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    from reli3d.eval.heldout import mean_environment, table
    from reli3d.nn.weights import load_model
    from reli3d.synthetic.maps import held_back, load_maps

    try:
        maps, names = load_maps(args.maps)
        mean = mean_environment(maps[[not h for h in held_back(names)]])
        model = load_model(args.weights)
        figures = table(model, args.samples, mean, args.views, lambda line: print(line, file=sys.stderr))
    except (ValueError, OSError) as error:
        print(f"reli3d-eval: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    text = json.dumps(figures, indent=1)
    print(text)
    if args.json:
        args.json.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
