"""``reli3d-stages``: train the paper's network, one stage a call."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

from reli3d.cli.exit_codes import Parser, check_ranges, command, tell
from reli3d.errors import InputError

HELD = 3  # objects in the pictures
OVERRIDES = ("steps", "batch", "rate", "image_size", "patch", "targets", "lobes", "resolution")  # of a stage


def parser() -> argparse.ArgumentParser:
    p = Parser(
        prog="reli3d-stages",
        description="Train the paper's network, one stage a call; continues where it stopped.  Under torchrun the "
        "processes share each batch.",
    )
    p.add_argument(
        "stage",
        help="volume, gaussians, surface, monte_carlo; of official: volume, gaussians128, "
        "gaussians256, gaussians512, monte_carlo",
    )
    p.add_argument("output", type=Path, help="folder of the checkpoint, the log, curves and pictures")
    p.add_argument("data", type=Path, nargs="*", help="folders of samples, of captures, or of shards")
    p.add_argument("--preset", choices=("tiny", "official"), default="tiny")
    # torchrun reads the whole line first: an option that is the beginning of one of its own would be ambiguous
    p.add_argument("--start-from", dest="start", type=Path, help="state.pt of the stage before")
    p.add_argument(
        "--prior",
        type=Path,
        help="light prior of reli3d.train.light_prior: it stays as it is, and its "
        "latents of the samples' lights are part of the loss",
    )
    p.add_argument("--validation", type=Path, help="folder of held-back samples for the pictures")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--inputs", type=int, default=4, help="an object is read from 1 to this many views")
    p.add_argument("--perceptual", choices=("gradients", "lpips"), default="gradients")
    p.add_argument("--bfloat16", action="store_true", help="autocast of the trunk")
    p.add_argument("--checkpointing", action="store_true", help="compute the trunk's layers again in the backward pass")
    p.add_argument(
        "--shard",
        action="store_true",
        help="cut parameters, gradients and moments of the trunk among the processes of torchrun (FSDP)",
    )
    p.add_argument("--tensorboard", type=Path, metavar="DIR", help="write curves and pictures as event files there too")
    p.add_argument("--save-every", type=int, default=200, help="steps")
    p.add_argument("--export", type=Path, help="write the averaged weights of the checkpoint to this file and stop")
    p.add_argument("--licence", default="not stated", help="of the exported weights")
    p.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    own: dict[str, Any] = {"default": argparse.SUPPRESS, "help": "of the stage's own"}
    for name in OVERRIDES:
        p.add_argument(f"--{name.replace('_', '-')}", type=float if name == "rate" else int, **own)
    counts = ("LIGHT", "NORMALS", "COSINE")
    p.add_argument("--samples", type=int, nargs=3, metavar=counts, **own)
    p.add_argument("--shadows", action=argparse.BooleanOptionalAction, **own)
    return p


def run_of(args: argparse.Namespace):
    """The configuration that the arguments ask for.  Raises InputError for what would end the work later."""
    from reli3d.output.folder import check_folder
    from reli3d.train.stages.board import writer_class
    from reli3d.train.stages.config import PAPER, TINY, Run

    if not args.data and not args.export:
        raise InputError("data", "expected folders of samples, captures or shards, got none")
    stages = PAPER if args.preset == "official" else TINY
    if args.stage not in stages:
        raise InputError("stage", f"expected {', '.join(stages)} for {args.preset}, got {args.stage}")
    given = {name: getattr(args, name) for name in (*OVERRIDES, "samples", "shadows") if hasattr(args, name)}
    if "samples" in given:
        given["samples"] = tuple(given["samples"])
    check_ranges(args, steps=(0, 10**9), batch=(1, 4096), rate=(1e-9, 10.0), save_every=(1, 10**9), seed=(0, 10**9))
    check_ranges(args, image_size=(8, 2048), patch=(0, 2048), targets=(1, 16), lobes=(1, 4096), resolution=(4, 256))
    check_folder(args.export.parent if args.export else args.output)
    if args.tensorboard:
        check_folder(args.tensorboard)
        writer_class()
    return Run(
        tuple(map(str, args.data)),
        str(args.output),
        dataclasses.replace(stages[args.stage], **given),
        start=str(args.start or ""),
        seed=args.seed,
        inputs=args.inputs,
        perceptual=args.perceptual,
        save_every=args.save_every,
        bfloat16=args.bfloat16,
        checkpointing=args.checkpointing,
        shard=args.shard,
        tensorboard=str(args.tensorboard or ""),
    )


@command("reli3d-stages")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    run = run_of(args)
    import torch

    from reli3d.nn import weights
    from reli3d.nn.model import Reconstructor
    from reli3d.nn.presets import OFFICIAL, TINY
    from reli3d.train.stages.latents import fitted, load_prior
    from reli3d.train.stages.loop import averaged, drawn, load_state, train
    from reli3d.train.stages.sources import source
    from reli3d.train.stages.views import Samples
    from reli3d.train.workers import Workers

    if args.device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device", "expected a CUDA device, got none; leave it out to train on the CPU")
    preset = TINY if args.preset == "tiny" else OFFICIAL
    if args.export:
        model = Reconstructor(preset)
        model = averaged(model, load_state(args.output / "state.pt", model)["average"])
        print(weights.save(args.export, model, licence=args.licence).path)
        return 0
    sources = [source(folder) for folder in args.data]
    held = source(args.validation) if args.validation else None
    torch.manual_seed(args.seed)
    model = Reconstructor(preset)
    if args.start:
        load_state(args.start, model)
    if args.prior:
        load_prior(model, args.prior)
    workers = Workers.join()
    if args.prior:
        for one, folder in zip(sources, args.data, strict=True):
            if isinstance(one, Samples):
                cache = args.output / f"{folder.name}.{workers.rank}.latents"
                one.latents = fitted(model.environment, one.files, cache, progress=tell)
    if workers.rank == 0:
        tell(run.text())
    pictured = (
        [
            drawn(dataclasses.replace(run, stage=dataclasses.replace(run.stage, patch=0)), [held], model, 0, k)
            for k in range(HELD)
        ]
        if held
        else []
    )
    train(model.to(args.device), run, sources, workers, held_back=pictured)
    workers.leave()
    return 0


if __name__ == "__main__":
    sys.exit(main())
