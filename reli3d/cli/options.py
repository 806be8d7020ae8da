"""The options of ``reli3d-infer``."""

from __future__ import annotations

import argparse
from pathlib import Path

from reli3d.cli.help_format import Defaults

AXES = ("x", "y", "z", "-x", "-y", "-z")


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        formatter_class=Defaults,
        prog="reli3d-infer",
        description="Turn a few posed photographs of an object into a relightable GLB and an HDR environment.",
        epilog="Exit code: 0 all done, 1 some objects failed, 2 wrong input, 3 --check suspects cameras or masks, 130 "
        "interrupted.  Results go to stdout.",
    )
    p.add_argument(
        "folder",
        nargs="*",
        type=Path,
        help="object folders: transforms.json or a COLMAP model; or tar files of such folders; "
        "default the bundled example",
    )
    p.add_argument("--output", type=Path, default=Path("outputs"), help="files land in OUTPUT/<object>/")
    taken = p.add_mutually_exclusive_group()
    taken.add_argument(
        "--views",
        type=int,
        metavar="N",
        help="use the N views, 1 to 16, that lie farthest apart; "
        "default all, of more than 16 those that lie farthest apart",
    )
    taken.add_argument("--first-views", type=int, metavar="N", help="use the first N views, 1 to 16")
    p.add_argument("--masks", type=Path, help="folder of masks with the names of the images, instead of their alpha")
    p.add_argument(
        "--remove-background",
        action="store_true",
        help="make masks for photographs without, by rembg "
        "(pip install 'reli3d[masks]'), which fetches its network once",
    )
    p.add_argument("--weights", default="small", help="small (in the package), official, or a safetensors file")
    p.add_argument(
        "--download",
        action="store_true",
        help="with --weights official: fetch and convert the published "
        "checkpoint where it is not there yet; nothing else ever uses the network",
    )
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
        "--uv", choices=("project", "xatlas"), default="project", help="atlas: own projection or xatlas (slow)"
    )
    p.add_argument(
        "--normalize",
        choices=("auto", "hull", "none"),
        help="auto: centre and scale by the visual hull unless it sits in the model's cube; default auto, "
        "with official weights none: poses as stored",
    )
    p.add_argument(
        "--hero",
        default="0",
        metavar="N",
        help="view that the network takes as its main one, counted from 0 (the default), or random",
    )
    p.add_argument(
        "--background",
        choices=("auto", "masked", "visible"),
        default="masked",
        help="what the light is read from: masked (default): the object alone; visible: the background "
        "too; auto: visible where all views have one and the weights know how",
    )
    p.add_argument(
        "--symmetry",
        choices=("auto", "off"),
        default="auto",
        help="auto (default): where 3 to 8 silhouettes fit a mirror plane, the small network reads photographs as "
        "views of the other half, too",
    )
    p.add_argument(
        "--frame", choices=("input", "model"), default="input", help="frame of the mesh (default the cameras')"
    )
    p.add_argument("--up", choices=AXES, default="y", help="axis of that frame to turn to +Y")
    p.add_argument(
        "--refine",
        nargs="?",
        type=float,
        const=0.0,
        metavar="SECONDS",
        help="fit the result to all "
        "photographs of the folder; without a number 60 seconds, 20 on CUDA; stands after the "
        "folders",
    )
    p.add_argument(
        "--refine-steps",
        type=int,
        metavar="N",
        help="the same with a number of steps instead of seconds: every run of one machine gives the same",
    )
    p.add_argument("--refine-cameras", action="store_true", help="with either: correct the cameras as well")
    p.add_argument("--seed", type=int, default=0, help="of what is drawn by chance")
    p.add_argument(
        "--compatible-names",
        action="store_true",
        help="also write illumination.hdr: the published release's name and layout, -Z in the centre column",
    )
    p.add_argument("--list", type=Path, metavar="FILE", help="text file that names more of them, one a line")
    p.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="make N objects at a time, each in a process of its own "
        "with one thread and the network, 0.7 GiB with the shipped weights",
    )
    p.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="make the objects on a Ray cluster: its address, auto for that of "
        "this machine, local to start one; needs pip install reli3d[ray]",
    )
    p.add_argument(
        "--shards-out",
        type=int,
        metavar="N",
        help="write tar files of N objects, NNNNNN.tar with index.json, instead of a folder for each object",
    )
    p.add_argument("--skip-existing", action="store_true", help="leave objects alone whose files are all there")
    p.add_argument(
        "--warm", action="store_true", help="reconstruct every object twice and record the second time as well"
    )
    p.add_argument("--check", action="store_true", help="explain the cameras and draw the rig; reconstruct nothing")
    p.add_argument("-v", "--verbose", action="store_true", help="print the seconds of every stage, and the memory")
    p.add_argument(
        "--json", action="store_true", help="print one JSON object, with an entry for each object, instead of lines"
    )
    p.add_argument("--doctor", action="store_true", help="say what is installed and where it runs")
    return p
