"""``reli3d-train``: trains one stage of a network."""

import argparse
import dataclasses
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reli3d.cli.exit_codes import Parser, check_ranges, command, report
from reli3d.cli.infer import choose_device
from reli3d.errors import InputError

if TYPE_CHECKING:
    from reli3d.nn.local import LocalReconstructor
    from reli3d.nn.model import Reconstructor
    from reli3d.train.stage import Stage

SMALL_STAGES = ("pixels", "small")
LIGHT_PRIOR = "light_prior"
SIDES = 64, 128, 256  # of the images of stage pixels
OF_LOOP = ("steps", "minutes", "batch", "rate", "seed", "save_every", "tensorboard")
OF_NETWORK = ("weights", "validation", "export", "license", "max_views", "bfloat16", "device")
OF_SMALL = (*OF_NETWORK, "points", "pyramid_rate", "maps")
OF_CONFIG = ("image_size", "patch", "targets", "lobes", "resolution", "samples", "shadows")  # of a StageConfig
OF_PAPER = (*OF_NETWORK, *OF_CONFIG, "preset", "prior", "perceptual", "checkpointing")


def parser() -> argparse.ArgumentParser:
    p = Parser(
        prog="reli3d-train",
        description="Train one stage of a network, or resume it.  Under torchrun the processes divide each batch.",
        argument_default=argparse.SUPPRESS,
    )
    # torchrun reads the whole line first: an option that is the beginning of one of its own would be ambiguous
    p.add_argument(
        "data",
        type=Path,
        nargs="*",
        default=[],
        help="folders of samples; for the stages of the ReLi3D paper also captures, shards; for light_prior "
        "environment maps, .npz",
    )
    p.add_argument("output", type=Path, help="folder of the checkpoint, the log and validation images")
    p.add_argument(
        "--stage",
        default="small",
        help="pixels, small: the small network, its 2D U-Net alone or all of it; volume, gaussians, surface, "
        "monte_carlo: the paper's network of preset tiny; volume, gaussians128, gaussians256, gaussians512, "
        "monte_carlo: of preset official; light_prior: the environment decoder alone",
    )
    p.add_argument(
        "--weights",
        help="initial weights: the averaged weights of a checkpoint (state.pt of this or the previous stage), a "
        "safetensors file, or small (default: random)",
    )
    p.add_argument("--validation", type=Path, help="folder of held-out objects, reconstructed at every checkpoint")
    p.add_argument("--export", type=Path, help="write the averaged weights of the checkpoint to this file and exit")
    p.add_argument("--license", help="license of the exported weights, stored in the file")
    loop = p.add_argument_group("schedule (default: of the stage)")
    loop.add_argument("--steps", type=int)
    loop.add_argument("--minutes", type=float, help="end training after this time, if before --steps")
    loop.add_argument("--batch", type=int, help="objects per step, over all processes")
    loop.add_argument("--rate", type=float, help="peak learning rate")
    loop.add_argument("--max-views", type=int, help="upper limit of the random number of input views")
    loop.add_argument("--seed", type=int)
    loop.add_argument("--save-every", type=int, metavar="STEPS")
    loop.add_argument("--bfloat16", action="store_true", help="compute the convolutions or the trunk in bfloat16")
    loop.add_argument("--device", choices=("cpu", "cuda"))
    loop.add_argument("--tensorboard", type=Path, metavar="DIR", help="also write event files to this folder")
    small = p.add_argument_group("stages pixels and small")
    small.add_argument("--points", type=int, help="volume points per object")
    small.add_argument(
        "--pyramid-rate",
        type=float,
        metavar="TIMES",
        help="multiplier of the learning rate of the 2D U-Net; 0.1 after stage pixels",
    )
    small.add_argument("--maps", type=Path, help="environment maps, .npz, under which 60 %% of the samples are relit")
    paper = p.add_argument_group("stages of the ReLi3D paper's network, and --image-size of pixels")
    paper.add_argument("--image-size", type=int, help="pixels per side; for stage pixels 64 (default), 128 or 256")
    paper.add_argument("--preset", choices=("tiny", "official"))
    paper.add_argument(
        "--prior", type=Path, help="checkpoint of stage light_prior; adds a loss with its frozen environment decoder"
    )
    paper.add_argument("--perceptual", choices=("gradients", "lpips"))
    paper.add_argument("--checkpointing", action="store_true", help="recompute the trunk's layers in the backward pass")
    for name in ("patch", "targets", "lobes", "resolution"):
        paper.add_argument(f"--{name}", type=int)
    paper.add_argument("--samples", type=int, nargs=3, metavar=("LIGHT", "NORMALS", "COSINE"))
    paper.add_argument("--shadows", action=argparse.BooleanOptionalAction)
    return p


def parsed(argv: list[str] | None) -> argparse.Namespace:
    """The arguments, validated without reading data.  Raises InputError."""
    from reli3d.output.folder import check_folder
    from reli3d.train.log import summary_writer

    args = parser().parse_intermixed_args(argv)
    own = ("preset",) if args.stage == LIGHT_PRIOR else OF_SMALL if args.stage in SMALL_STAGES else OF_PAPER
    own = (*own, "image_size") if args.stage == "pixels" else own
    for name in vars(args):
        if name not in ("data", "output", "stage", "traceback", *OF_LOOP, *own):
            raise InputError(f"--{name.replace('_', '-')}", f"expected none for stage {args.stage}; leave it out")
    check_ranges(args, steps=(0, 10**9), minutes=(1e-3, math.inf), batch=(1, 4096), rate=(1e-9, 10.0), seed=(0, 10**9))
    check_ranges(args, save_every=(1, 10**9), max_views=(1, 16), points=(2, 16384), pyramid_rate=(1e-6, 10.0))
    check_ranges(args, image_size=(8, 2048), patch=(0, 2048), targets=(1, 16), lobes=(1, 4096), resolution=(4, 256))
    check_folder(args.output)
    if "export" in args:
        if args.export.is_dir():
            raise InputError("--export", f"expected a file, got the folder {args.export}; add a name")
        check_folder(args.export.parent)
    if "tensorboard" in args:
        check_folder(args.tensorboard)
        summary_writer()
    return args


def given(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """The options ``names`` that are given, by name."""
    return {name: getattr(args, name) for name in names if name in args}


def small_stage(args: argparse.Namespace) -> "Stage":
    from reli3d.nn.presets import CALIBRATED_VIEWS
    from reli3d.synthetic.stored import check_samples
    from reli3d.train.pixels import reduced_model
    from reli3d.train.small import PixelStage, SmallOptions, SmallStage

    pixels = args.stage == "pixels"
    calibrated = CALIBRATED_VIEWS + 1  # views of a sample for calibration: one is compared
    exporting = "export" in args
    if pixels and exporting:
        raise InputError("--export", "expected stage small, got pixels; train --stage small from it first")
    if not (exporting and "validation" in args):
        if not args.data:
            raise InputError("data", "expected folders of samples, got none; make them with reli3d-data")
        for folder in args.data:
            check_samples(folder, "data", views=calibrated if exporting else 1, points=not pixels)
    if "validation" in args:
        check_samples(args.validation, "validation", views=calibrated)
    side = getattr(args, "image_size", SIDES[0])
    if pixels and side not in SIDES:
        raise InputError("--image-size", f"expected {', '.join(map(str, SIDES))} for stage pixels, got {side}")
    model = small_network(getattr(args, "weights", None), args.output / "state.pt")
    finest = SIDES[::-1].index(side) if pixels else 0
    model = reduced_model(model, finest).train() if finest else model
    options = SmallOptions(**given(args, "max_views", "points", "pyramid_rate", "bfloat16"))
    make = PixelStage if pixels else SmallStage
    device = choose_device(getattr(args, "device", "cpu"))
    return make(model.to(device), args.data, options, **given(args, "seed", "maps", "validation"))


def small_network(start: str | None, resumed: Path) -> "LocalReconstructor":
    """The small network with the weights of ``start``, or with random ones.  A checkpoint may lack the finer levels.

    resumed: the checkpoint that the run continues from if it exists; without ``start`` its preset is used.
    """
    from reli3d.nn import weights
    from reli3d.nn.local import LocalReconstructor
    from reli3d.nn.presets import SMALL, LocalPreset, from_json
    from reli3d.train import checkpoint
    from reli3d.train.pixels import missing_parameters

    if start is None or start.endswith(".pt"):
        known = Path(start) if start else resumed
        state = checkpoint.load(known) if known.exists() or start else {}
        preset = from_json(state["preset"]) if "preset" in state else SMALL
        model = LocalReconstructor(preset if isinstance(preset, LocalPreset) else SMALL)
        if start:
            missing = missing_parameters(model.preset, state["average"])
            checkpoint.load_average(known, model, state, missing)
        return model.train()
    found = weights.load_model(start, "cpu")
    if not isinstance(found, LocalReconstructor):
        raise InputError("--weights", f"expected the small network, got the preset {found.preset.name}")
    return found.train().requires_grad_(True)


def light_prior_stage(args: argparse.Namespace) -> "Stage":
    from reli3d.nn.presets import OFFICIAL, TINY
    from reli3d.train.light_prior import LightPriorStage

    if len(args.data) != 1:
        raise InputError("data", f"expected one .npz of environment maps, got {len(args.data)} paths")
    preset = OFFICIAL if getattr(args, "preset", "") == "official" else TINY
    return LightPriorStage(preset, args.data[0], **given(args, "seed"))


def paper_stage(args: argparse.Namespace) -> "Stage":
    from reli3d.nn.model import Reconstructor
    from reli3d.nn.presets import OFFICIAL, TINY
    from reli3d.train.stages import config
    from reli3d.train.stages.latents import fitted, load_prior
    from reli3d.train.stages.shards import source
    from reli3d.train.stages.stage import PaperOptions, PaperStage
    from reli3d.train.stages.views import Samples

    preset, stages = (OFFICIAL, config.PAPER) if getattr(args, "preset", "") == "official" else (TINY, config.TINY)
    if args.stage not in stages:
        known = ", ".join((*SMALL_STAGES, LIGHT_PRIOR, *stages))
        raise InputError("--stage", f"expected {known} for preset {preset.name}, got {args.stage}")
    if not args.data and "export" not in args:
        raise InputError("data", "expected folders of samples, captures or shards, got none")
    device = choose_device(getattr(args, "device", "cpu"))
    numbers = given(args, *OF_CONFIG)
    if "samples" in numbers:
        numbers["samples"] = tuple(numbers["samples"])
    one = dataclasses.replace(stages[args.stage], **numbers)
    sources = [source(folder) for folder in args.data]
    held_out = source(args.validation) if "validation" in args and "export" not in args else None
    model = Reconstructor(preset)
    if "weights" in args:
        start_from(args.weights, model)
    if "prior" in args:
        load_prior(model, args.prior)
        for folder, samples in zip(args.data, sources, strict=True):
            if isinstance(samples, Samples):
                cache = args.output / f"{folder.name}.latents"
                samples.latents = fitted(model.environment, samples.files, cache, progress=report)
    names = ("max_views", "bfloat16", "checkpointing")
    options = PaperOptions(distance=getattr(args, "perceptual", "gradients"), **given(args, *names))
    folders = [str(folder) for folder in args.data]
    return PaperStage(
        model.to(device), one, sources, options, validation=held_out, folders=folders, **given(args, "seed")
    )


def start_from(start: str, model: "Reconstructor") -> None:
    """Loads the averaged weights of a checkpoint or a weights file into ``model``.  Raises InputError."""
    from reli3d.nn import weights
    from reli3d.train import checkpoint

    if start.endswith(".pt"):
        checkpoint.load_average(Path(start), model)
        return
    found = weights.load_model(start, "cpu")
    if found.preset != model.preset:
        raise InputError("--weights", f"expected preset {model.preset.name}, got {found.preset.name}")
    model.load_state_dict(found.state_dict())


def export(args: argparse.Namespace, stage: "Stage") -> "LocalReconstructor | Reconstructor":
    """The network with the averaged weights of the checkpoint, calibrated if it is the small one; or InputError."""
    from reli3d.nn.local import LocalReconstructor
    from reli3d.train import checkpoint
    from reli3d.train.calibrate import calibrate
    from reli3d.train.stages.stage import no_surface

    model: Any = stage.model.cpu()
    path = args.output / "state.pt"
    state = checkpoint.load_average(path, model)
    model.eval()
    if state["measures"].get("surface", 1.0) == 0.0:
        raise no_surface(path)
    if isinstance(model, LocalReconstructor):
        samples = args.validation if "validation" in args else args.data[0]
        if "validation" not in args:
            report("surface offsets chosen on training samples, where the network is too certain; give --validation")
        for views, tried in calibrate(model, samples, progress=report).items():
            row = ", ".join(f"{offset:g}: {iou:.4f}" for offset, iou in tried.items())
            report(f"silhouette IoU by surface offset, {views} views: {row}")
        report(f"chosen: {model.preset.offset_one_view:g}, of many views {model.preset.offset_many_views:g}")
    return model


@command("reli3d-train")
def main(argv: list[str] | None = None) -> int:
    args = parsed(argv)
    import torch

    from reli3d.nn import weights
    from reli3d.train.loop import train
    from reli3d.train.workers import Workers

    torch.manual_seed(getattr(args, "seed", 0))
    workers = Workers.join()  # before the stage: it chooses the process's CUDA device
    makers = {LIGHT_PRIOR: light_prior_stage, **dict.fromkeys(SMALL_STAGES, small_stage)}
    stage = makers.get(args.stage, paper_stage)(args)
    if "export" in args:
        model = export(args, stage)
        args.export.parent.mkdir(parents=True, exist_ok=True)
        print(weights.save(args.export, model, license=getattr(args, "license", "not stated")).path)
        return 0
    settings = given(args, *OF_LOOP)
    if "tensorboard" in settings:
        settings["tensorboard"] = str(settings["tensorboard"])
    train(stage, stage.options(str(args.output), **settings), workers)
    workers.leave()
    return 0


if __name__ == "__main__":
    sys.exit(main())
