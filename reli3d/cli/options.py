"""The options of ``reli3d-infer``, and those in common with ``reli3d check``."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from reli3d.cli.exit_codes import Parser

AXES = ("x", "y", "z", "-x", "-y", "-z")


def joined(argv: Sequence[str] | None, option: str, values: Sequence[str]) -> list[str]:
    """The arguments with ``option value`` joined by ``=`` for ``values``, which may begin with a dash."""
    words = list(sys.argv[1:] if argv is None else argv)
    for k in range(len(words) - 2, -1, -1):
        if words[k] == option and words[k + 1] in values:
            words[k : k + 2] = [f"{option}={words[k + 1]}"]
    return words


def parser() -> argparse.ArgumentParser:
    p = Parser(
        prog="reli3d-infer",
        description="Reconstruct a relightable GLB and an HDR environment from a few photographs of an object with "
        "known cameras.",
        epilog="Exit code: 0 all done, 1 some objects failed, 2 invalid input, 130 interrupted.  Prints the paths of "
        "the results.",
    )
    add_reading(p)
    p.add_argument(
        "--weights",
        default="small",
        help="small: the bundled network (default); official: the published ReLi3D network, after reli3d download; or "
        "a safetensors file",
    )
    p.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="auto: cuda if available")
    p.add_argument(
        "--precision",
        choices=("float32", "bfloat16", "auto"),
        help="compute dtype of the network's trunk; default float32, for the published network on CUDA bfloat16; auto: "
        "bfloat16 if the processor has instructions for it",
    )
    p.add_argument("--texture-size", type=int, default=1024, help="texels per side, 256 to 4096 (default 1024)")
    p.add_argument(
        "--resolution", type=int, help="cubes per side of the FlexiCubes grid, 16 to 256 (default: set by the preset)"
    )
    p.add_argument(
        "--normalize",
        choices=("auto", "hull", "none"),
        help="hull: center and scale by the visual hull; none: camera poses as stored; auto: by object_box of "
        "transforms.json, else none if the visual hull fits the network's cube in size and position, else hull; "
        "default auto, for the published network none",
    )
    p.add_argument(
        "--hero",
        type=int,
        default=0,
        metavar="N",
        help="index of the reference view of the published network (default 0)",
    )
    p.add_argument(
        "--background",
        choices=("auto", "masked", "visible"),
        default="masked",
        help="input of the lighting estimate: masked: the object only; visible: also the background, which must be far "
        "away (published network, --refine); auto: visible to the network if all views have a background and it was "
        "trained with them (default masked)",
    )
    p.add_argument("--up", choices=AXES, default="y", help="axis of the cameras' world frame that becomes +Y")
    p.add_argument(
        "--refine",
        nargs="?",
        const="",
        metavar="SECONDS",
        help="fit the result to all images of the folder for SECONDS (default 60, on CUDA 20) or, as 300steps, for a "
        "number of steps, which is reproducible on one machine; place it after the folders",
    )
    p.add_argument(
        "--light",
        choices=("object", "camera", "turntable", "per-group"),
        help="with --refine: the lighting is fixed to the object, to the camera (flash) or to the room in which the "
        "object turns about +Y (turntable), or differs between sub-folders of images; default: lighting in "
        "transforms.json, else object; --light of reli3d-render is an environment file instead",
    )
    p.add_argument("--refine-cameras", action="store_true", help="with --refine: optimize the cameras as well")
    where = p.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="process N objects in parallel, each in a single-threaded process of 0.7 GiB with the bundled network",
    )
    where.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="process the objects on a Ray cluster: auto for the cluster running on this machine, local to start "
        "one, or an address; needs pip install 'reli3d[ray]'",
    )
    p.add_argument("--skip-existing", action="store_true", help="skip objects whose files are complete")
    return p


def add_reading(p: argparse.ArgumentParser) -> None:
    """Options of the input and output folders."""
    p.add_argument(
        "folder",
        nargs="*",
        type=Path,
        help="object folders with cameras: transforms.json (also transforms_train.json and other splits), a COLMAP "
        "model, cameras_sphere.npz (IDR, NeuS) or poses_bounds.npy (LLFF); photographs without cameras first need "
        "reli3d capture; or text files that name such folders, one per line; default: the bundled example",
    )
    p.add_argument("--output", type=Path, default=Path("outputs"), help="results are written to OUTPUT/<object>/")
    p.add_argument(
        "--views",
        type=int,
        metavar="N",
        help="use N views, 1 to 16, selected by farthest-point sampling; default all, at most 16",
    )
    p.add_argument("--masks", type=Path, help="folder of masks named like the images, instead of the alpha channel")
    p.add_argument(
        "--remove-background",
        action="store_true",
        help="segment images without a mask by rembg (pip install 'reli3d[masks]'), which downloads its network once",
    )
    p.add_argument("--json", action="store_true", help="print one JSON object with an entry per object")
