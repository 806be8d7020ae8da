"""``reli3d``: the entry point of all commands."""

import argparse
import importlib
import sys

import reli3d
from reli3d.cli.exit_codes import Parser, command

COMMANDS = {  # module of reli3d.cli, purpose
    "infer": ("infer", "photographs with cameras to a relightable asset (also reli3d-infer)"),
    "capture": ("capture", "photographs or a video without cameras to an object folder"),
    "check": ("checking", "check the cameras and masks of a folder without reconstruction"),
    "render": ("render", "views and turntables of a GLB under any light (also reli3d-render)"),
    "export": ("export", "convert a GLB to OBJ, USDZ or GLB, with fewer triangles or smaller textures"),
    "download": ("download", "fetch and convert the published ReLi3D network"),
    "data": ("data", "render training samples (also reli3d-data)"),
    "train": ("train", "train the network (also reli3d-train)"),
    "eval": ("eval", "evaluate the network on held-out objects (also reli3d-eval)"),
    "tables": ("tables", "tables of the ReLi3D paper on a folder of GLB files (also reli3d-tables)"),
    "doctor": ("doctor", "print versions and devices, and whether the package is usable"),
}


@command("reli3d")
def main(argv: list[str] | None = None) -> int:
    """Runs the named command and returns its exit code; 2 for an unknown name."""
    rows = "\n".join(f"  {name:8s} {what}" for name, (_, what) in COMMANDS.items())
    parser = Parser(
        prog="reli3d",
        description="Relightable 3D assets from a few posed photographs.",
        usage="reli3d COMMAND [OPTION ...]",
        epilog=f"commands:\n{rows}\n\n'reli3d COMMAND --help' prints its options.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"reli3d {reli3d.__version__}")
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="one of the commands below")
    parser.add_argument("options", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    if not (sys.argv[1:] if argv is None else argv):
        parser.print_help()
        return 0
    args = parser.parse_args(argv)
    module, _ = COMMANDS[args.command]
    return importlib.import_module(f"reli3d.cli.{module}").main(args.options)


if __name__ == "__main__":
    sys.exit(main())
