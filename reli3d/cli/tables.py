"""``reli3d-tables``: the tables of the ReLi3D paper on a folder of textured GLB files."""

import argparse
from pathlib import Path

from reli3d.cli.exit_codes import Parser, check_ranges, command, report
from reli3d.errors import InputError

MAX_VIEWS = 16  # input views


def parser() -> argparse.ArgumentParser:
    p = Parser(
        prog="reli3d-tables",
        description="Render objects, reconstruct them from some views, and compare in held-out views.",
    )
    p.add_argument("objects", type=Path, nargs="+", help="GLB files with textures")
    p.add_argument("--maps", type=Path, required=True, help=".npz of environment maps; only held-out maps are used")
    p.add_argument("--weights", default="small", help="small, or a safetensors file")
    p.add_argument("--views", type=int, nargs="+", default=(1, 2, 4, 8, 16), help="numbers of input views")
    p.add_argument("--size", type=int, default=128, help="pixels per side of a view")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--output", type=Path, default=Path("tables"), help="folder of table.md, objects.csv and sheet.png")
    return p


@command("reli3d-tables")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    from reli3d.eval.objects import as_csv, markdown, table
    from reli3d.io.files import file_size, write_bytes
    from reli3d.io.images import write_png
    from reli3d.nn.weights import load_model
    from reli3d.output.folder import check_folder
    from reli3d.render.environment import Environment
    from reli3d.synthetic.maps import held_out, load_maps

    check_ranges(args, size=(16, 2048), seed=(0, 10**9), views=(1, MAX_VIEWS))
    check_folder(args.output)
    for path in args.objects:
        file_size(path)
    maps, names = load_maps(args.maps)
    lights = [Environment(m) for m, held in zip(maps, held_out(names), strict=True) if held]
    if len(lights) < 2:
        raise InputError("--maps", "expected at least two held-out maps, got fewer; give twelve maps or more")
    given = load_model(args.weights), args.objects, lights, args.views
    tables, rows, sheet = table(*given, size=args.size, seed=args.seed, progress=report)
    args.output.mkdir(parents=True, exist_ok=True)
    text = markdown(tables)
    write_bytes(args.output / "table.md", text.encode())
    write_bytes(args.output / "objects.csv", as_csv(rows).encode())
    write_png(args.output / "sheet.png", sheet)
    print(text, end="")
    return 0
