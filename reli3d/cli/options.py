"""The options of ``reli3d-infer``, and those that ``reli3d check`` shares."""

from __future__ import annotations

import argparse
from pathlib import Path

from reli3d.cli.exit_codes import Parser

AXES = ("x", "y", "z", "-x", "-y", "-z")


def parser() -> argparse.ArgumentParser:
    p = Parser(
        prog="reli3d-infer",
        description="Turn a few posed photographs of an object into a relightable GLB and an HDR environment.",
        epilog="Exit code: 0 all done, 1 some objects failed, 2 wrong input, 130 interrupted.  Paths go to stdout.",
    )
    add_reading(p)
    p.add_argument("--weights", default="small", help="small (in the package), official, or a safetensors file")
    p.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="auto: cuda where there is one")
    p.add_argument(
        "--precision",
        choices=("float32", "bfloat16", "auto"),
        help="of the network's large parts; default float32, for official weights on CUDA bfloat16; auto: bfloat16 "
        "wherever the processor has instructions for it",
    )
    p.add_argument("--texture-size", type=int, default=1024, help="texels, 256 to 4096 (default 1024)")
    p.add_argument(
        "--resolution", type=int, help="cubes along a side of the surface grid, 16 to 256 (default the preset's)"
    )
    p.add_argument(
        "--normalize",
        choices=("auto", "hull", "none"),
        help="auto: center and scale by the visual hull unless it sits in the model's cube; default auto, "
        "with official weights none: poses as stored",
    )
    p.add_argument(
        "--hero", type=int, default=0, metavar="N", help="reference view of the official network, counted from 0"
    )
    p.add_argument(
        "--background",
        choices=("auto", "masked", "visible"),
        default="masked",
        help="what the light is read from: masked: the object alone; visible: the background too; auto: visible where "
        "all views have one and the weights were trained on it (default masked)",
    )
    p.add_argument("--up", choices=AXES, default="y", help="axis of the cameras' frame to turn to +Y")
    p.add_argument(
        "--refine",
        nargs="?",
        const="",
        metavar="SECONDS",
        help="fit the result to all photographs of the folder; without a number 60 seconds, 20 on CUDA; 300steps: that "
        "many steps, which give the same result in every run of one machine; stands after the folders",
    )
    p.add_argument("--refine-cameras", action="store_true", help="with --refine: correct the cameras as well")
    where = p.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="make N objects at a time, each in a process of one thread that loads the network: 0.7 GiB with the "
        "shipped weights",
    )
    where.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="make the objects on a Ray cluster: its address, auto for that of this machine, local to start one; "
        "needs pip install 'reli3d[ray]'",
    )
    p.add_argument("--skip-existing", action="store_true", help="leave objects alone whose files are all there")
    return p


def add_reading(p: argparse.ArgumentParser) -> None:
    """Options of what is read, and where results go."""
    p.add_argument(
        "folder",
        nargs="*",
        type=Path,
        help="object folders: transforms.json or a COLMAP model; or text files that name such folders, one a line; "
        "default the bundled example",
    )
    p.add_argument("--output", type=Path, default=Path("outputs"), help="files land in OUTPUT/<object>/")
    p.add_argument(
        "--views",
        type=int,
        metavar="N",
        help="use the N views, 1 to 16, that lie farthest apart; default all, of more than 16 those that lie farthest "
        "apart",
    )
    p.add_argument("--masks", type=Path, help="folder of masks with the names of the images, instead of their alpha")
    p.add_argument(
        "--remove-background",
        action="store_true",
        help="make masks for photographs without, by rembg (pip install 'reli3d[masks]'), which fetches its network "
        "once",
    )
    p.add_argument("--json", action="store_true", help="print one JSON object, with an entry for each object")
