"""``reli3d-render``: still images and turntables of a GLB under an environment map."""

import argparse
import io
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from reli3d.cli.exit_codes import Parser, check_ranges, command, extra
from reli3d.errors import InputError

FORMATS = ("png", "exr", "webp", "gif", "mp4")
UNSUPPORTED = (".mov", ".avi", ".mkv", ".webm", ".m4v", ".apng", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".hdr")
MOVING = ("webp", "gif", "mp4")  # one file of all frames
RATE = 24  # frames a second
QUALITIES = {"draft": ((6, 12, 2), 1), "good": ((20, 40, 4), 2), "best": ((64, 128, 16), 4)}  # samples, supersampling


def parser() -> argparse.ArgumentParser:
    p = Parser(
        prog="reli3d-render",
        description="Render a GLB with direct lighting and shadows under an HDR environment.",
        epilog="Exit code: 0 done, 2 invalid input.  Prints the names of the files; progress goes to stderr.",
    )
    p.add_argument("glb", type=Path)
    p.add_argument(
        "--light",
        type=Path,
        help="environment: lat-long .hdr or .exr, upper edge +Y, horizontal center +X, +Z right of it, as in three.js, "
        "model-viewer and Blender; default uniform white",
    )
    p.add_argument(
        "--output",
        type=Path,
        default=Path("renders"),
        help="folder, or a file: one view as .png or .exr, or an animation as .webp, .gif or .mp4 (default renders)",
    )
    p.add_argument(
        "--format",
        choices=FORMATS,
        help="png (default), exr (linear radiance), or an animation: webp, gif "
        "(256 colors), mp4 (on white; pip install 'reli3d[video]')",
    )
    p.add_argument(
        "--frames",
        type=int,
        help="number of frames of a full turn about +Y (default 1; 72 if --output is an animation)",
    )
    p.add_argument("--turn", choices=("camera", "light"), default="camera", help="rotate the camera or the environment")
    p.add_argument("--azimuth", type=float, default=30.0, help="azimuth of the first view in degrees, from +Z to +X")
    p.add_argument("--elevation", type=float, default=20.0, help="camera elevation in degrees, -89 to 89")
    p.add_argument("--fov", type=float, default=32.0, help="horizontal field of view in degrees")
    p.add_argument(
        "--distance", type=float, help="camera distance to the object's center (default: the object fills the view)"
    )
    p.add_argument("--size", type=int, default=512, help="pixels per side (default 512)")
    p.add_argument(
        "--quality",
        choices=tuple(QUALITIES),
        default="good",
        help="preset of --samples and --supersampling: draft 6 12 2 and 1, good 20 40 4 and 2, best 64 128 16 and 4",
    )
    counts = p.add_mutually_exclusive_group()
    counts.add_argument(
        "--samples",
        type=int,
        nargs=3,
        metavar=("ENV", "GGX", "COS"),
        help="samples per subpixel of the environment, GGX and cosine strategies (default: set by --quality)",
    )
    counts.add_argument(
        "--plan",
        type=int,
        metavar="TOTAL",
        help="TOTAL samples per subpixel, divided among the strategies to minimize the noise of the first view "
        "(relative noise; with exr absolute); prints the counts to stderr",
    )
    p.add_argument("--supersampling", type=int, help="subpixels per side of a pixel (default: set by --quality)")
    p.add_argument(
        "--diffuse-model",
        choices=("conserving", "published"),
        default="conserving",
        help="energy transmitted to the diffuse layer: conserving (default; conserves energy) or published (formula of "
        "glTF viewers; a white diffuse base gains energy at grazing angles)",
    )
    p.add_argument("--background", choices=("transparent", "environment"), default="transparent")
    p.add_argument(
        "--tone",
        choices=("srgb", "agx", "none"),
        default="srgb",
        help="display transform, for all formats but exr; none: linear values",
    )
    p.add_argument("--exposure", type=float, default=0.0, help="in stops, -32 to 32, for all files but AOVs")
    p.add_argument(
        "--aovs",
        action="store_true",
        help="also write EXR files of base color, material (0, roughness, metallic), normal (n / 2 + 1 / 2) and depth "
        "(depth, depth, alpha)",
    )
    p.add_argument("--no-shadows", action="store_true", help="do not trace shadow rays")
    p.add_argument("--seed", type=int, default=0, help="seed of the Monte Carlo samples")
    p.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    p.add_argument("--json", action="store_true", help="print one JSON object instead of the file names")
    return p


@command("reli3d-render")
def main(argv: list[str] | None = None) -> int:
    args = _completed(parser().parse_args(argv))
    files = [str(path) for path in render_files(args)]
    record = {name: getattr(args, name) for name in ("frames", "size", "samples", "supersampling")}
    print(json.dumps({"files": files, **record}) if args.json else "\n".join(files))
    return 0


def _completed(args: argparse.Namespace) -> argparse.Namespace:
    """The arguments, checked, with defaults that depend on others; ``args.file``: the file of ``--output``, or None."""
    from reli3d.cli.infer import choose_device
    from reli3d.output.folder import check_folder

    ending = args.output.suffix.lower().removeprefix(".")
    args.file = args.output if ending in FORMATS and not args.output.is_dir() else None
    if args.file is not None:
        if args.format not in (None, ending):
            raise InputError("--format", f"expected {ending} as in the name of the output, got {args.format}")
        args.format, args.output = ending, args.file.parent
    args.format = args.format or "png"
    moves = args.file is not None and args.format in MOVING
    args.frames = args.frames if args.frames is not None else 72 if moves else 1
    if args.file is not None and not moves and args.frames > 1:
        raise InputError("--frames", f"expected 1 where --output names one {ending}, got {args.frames}; name a folder")
    samples, supersampling = QUALITIES[args.quality]
    args.samples = tuple(args.samples or samples)
    args.supersampling = args.supersampling if args.supersampling is not None else supersampling
    check_ranges(args, frames=(1, 3600), size=(1, 8192), supersampling=(1, 16), plan=(1, 65536), seed=(0, 10**9))
    check_ranges(args, fov=(1, 150), elevation=(-89, 89), azimuth=(-3600, 3600), exposure=(-32, 32))
    if not all(0 <= k <= 65536 for k in args.samples) or sum(args.samples) == 0:
        raise InputError("--samples", f"expected three counts of 0 to 65536, one above 0, got {tuple(args.samples)}")
    if args.output.suffix.lower() in UNSUPPORTED and not args.output.is_dir():
        types = ", ".join(f".{kind}" for kind in FORMATS)
        raise InputError("--output", f"expected a folder or a file of type {types}, got {args.output}")
    if args.format == "mp4":
        if args.size % 2:
            raise InputError("--size", f"expected an even number of pixels for mp4, got {args.size}")
        from reli3d.output import video

        with extra("--format mp4"):
            video.library()  # before minutes of work
    if args.distance is not None and not 0.0 < args.distance < math.inf:
        raise InputError("--distance", f"expected a positive length, got {args.distance}")
    choose_device(args.device)
    check_folder(args.output)
    return args


def render_files(args: argparse.Namespace) -> list[Path]:
    """Renders and writes all frames; returns the paths of the files."""
    import torch
    from tqdm import tqdm

    from reli3d.geometry.camera import Camera, look_at
    from reli3d.io.files import write_bytes
    from reli3d.io.glb import read_glb
    from reli3d.io.hdr import read_environment, write_exr
    from reli3d.render.environment import Environment
    from reli3d.render.image import joined_scene, plan_render, render_asset
    from reli3d.render.shading import ShadeOptions

    device = torch.device(args.device)
    notes: list[str] = []
    parts = [part.to(device) for part in read_glb(args.glb, notes=notes, origin=[])]
    light = Environment(torch.ones(8, 16, 3)) if args.light is None else read_environment(args.light, notes=notes)
    for note in notes:
        print(f"reli3d-render: {note}", file=sys.stderr)
    environment = light.to(device)
    scene = joined_scene(parts)
    low, high = scene.vertices.amin(0), scene.vertices.amax(0)
    center, radius = (low + high) / 2, float((high - low).norm()) / 2
    distance = args.distance or 1.02 * radius / math.sin(math.radians(args.fov) / 2)
    up = torch.tensor([0.0, 1.0, 0.0], device=device)
    args.output.mkdir(parents=True, exist_ok=True)
    written, animation = [], []
    options = ShadeOptions(samples=tuple(args.samples), seed=args.seed, diffuse_model=args.diffuse_model)
    shown: Any = {"scene": scene, "shadows": not args.no_shadows}
    bar = tqdm(total=args.frames, unit="frame", file=sys.stderr, disable=None)
    for frame in range(args.frames):
        turn = 2.0 * math.pi * frame / args.frames
        azimuth = math.radians(args.azimuth) + (turn if args.turn == "camera" else 0.0)
        lift = math.radians(args.elevation)
        offset = [math.cos(lift) * math.sin(azimuth), math.sin(lift), math.cos(lift) * math.cos(azimuth)]
        eye = center + distance * torch.tensor(offset, device=device)
        camera = Camera.from_fov(look_at(eye, center, up), math.radians(args.fov), args.size, args.size)
        if args.plan is not None and frame == 0:
            given: Any = {"total": args.plan, "relative": args.format != "exr", "options": options, **shown}
            try:
                plan = plan_render(parts, camera, environment, **given)
            except ValueError as error:  # no ray hits the object
                raise InputError("--plan", f"{error}; bring the camera nearer") from None
            args.samples = plan.samples
            options = replace(options, samples=plan.samples, antithetic="none")
            print("reli3d-render: samples by strategy", *plan.samples, file=sys.stderr)
        turned = environment if args.turn == "camera" else environment.rotated(turn)
        sampling: Any = {"options": replace(options, seed=args.seed + frame), "supersampling": args.supersampling}
        image = render_asset(parts, camera, turned, background=args.background, **sampling, **shown)
        still = None if args.format in MOVING else args.file
        name = args.glb.stem if still is None else still.stem
        stem = args.output / (name if args.frames == 1 else f"{name}_{frame:04d}")
        if args.format in MOVING:
            animation.append(_display_image(image, args))
        else:
            written.append(still or stem.with_name(f"{stem.name}.{args.format}"))
            if args.format == "exr":
                write_exr(written[-1], (image.radiance * 2.0**args.exposure).cpu())
            else:
                write_bytes(written[-1], _encoded([_display_image(image, args)], "png"))
        if args.aovs:
            written += _write_aovs(stem, image)
        bar.update(1)
    bar.close()
    if animation:
        written.append(args.file or args.output / f"{args.glb.stem}.{args.format}")
        write_bytes(written[-1], _encoded(animation, args.format))
    return written


def _display_image(image, args):
    """Display image of Pillow: RGBA with straight alpha, or RGB over the environment."""
    import torch
    from PIL import Image

    from reli3d.render.color import agx, linear_to_srgb

    tone = {"srgb": linear_to_srgb, "agx": agx, "none": lambda v: v}[args.tone]
    shown = image.display(exposure=args.exposure, tone=tone, transparent=args.background == "transparent")
    return Image.fromarray((shown * 255.0 + 0.5).to(torch.uint8).cpu().numpy())


def _encoded(images: list, kind: str) -> bytes:
    """A file of one image, or a looping animation of ``images`` at RATE frames per second."""
    if kind == "mp4":
        from reli3d.output.video import mp4_bytes

        return mp4_bytes(images, RATE)
    options: Any = {}
    if kind != "png":
        options = {"save_all": True, "append_images": images[1:], "duration": round(1000 / RATE), "loop": 0}
        # disposal 2: clear to transparent before each frame
        options |= {"lossless": False} if kind == "webp" else {"disposal": 2}
    data = io.BytesIO()
    images[0].save(data, format=kind.upper(), **options)
    return data.getvalue()


def _write_aovs(stem: Path, image) -> list[Path]:
    import torch

    from reli3d.io.hdr import write_exr

    zero = torch.zeros_like(image.alpha)
    depth = torch.where(torch.isinf(image.depth), 0.0, image.depth)
    layers = {
        "base_color": image.base_color,
        "material": torch.stack([zero, image.roughness, image.metallic], -1),
        "normal": (image.normal * 0.5 + 0.5) * image.alpha.gt(0.0)[..., None],
        "depth": torch.stack([depth, depth, image.alpha], -1),
    }
    paths = []
    for name, layer in layers.items():
        paths.append(stem.with_name(f"{stem.name}_{name}.exr"))
        write_exr(paths[-1], layer.cpu(), half=False)
    return paths
