"""``reli3d-train``: train the small network on samples that ``reli3d-data`` made."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from reli3d.cli.exit_codes import Parser, check_ranges, command, tell
from reli3d.errors import InputError

if TYPE_CHECKING:
    from reli3d.nn.local import LocalReconstructor
    from reli3d.train.loop import TrainConfig

LICENCE = "Apache-2.0; trained by the reli3d authors, see docs/model.md for the data"
SIDES = 64, 128, 256  # of the pictures for the 2D U-Net alone
CALIBRATED = 5  # views of a sample: four are input, one is looked at


def parser() -> argparse.ArgumentParser:
    p = Parser(
        prog="reli3d-train",
        description="Train the small network; continues where it stopped.  Under torchrun the processes share "
        "each batch.",
    )
    p.add_argument("samples", type=Path, help="folder of samples made by reli3d-data")
    p.add_argument("output", type=Path, help="folder of the checkpoint, the log, the curves and validation pictures")
    p.add_argument("--steps", type=int, default=20000)
    p.add_argument("--minutes", type=float, default=float("inf"), help="end of the schedule in minutes of training")
    p.add_argument("--batch", type=int, default=4, help="objects a step")
    p.add_argument("--points", type=int, default=2048, help="volume points an object")
    p.add_argument("--max-views", type=int, default=6)
    p.add_argument("--rate", type=float, default=1.5e-3, help="peak learning rate")
    p.add_argument(
        "--pyramid-rate",
        type=float,
        default=1.0,
        metavar="TIMES",
        help="of the 2D U-Net, in units of --rate: 0.1 keeps what --pixels taught it",
    )
    p.add_argument("--seed", type=int, default=0)
    p.add_argument(
        "--pixels",
        type=int,
        choices=SIDES,
        default=0,
        metavar="SIDE",
        help="train the 2D U-Net alone, on what the pixels of all views show, in pictures of 64, 128 or 256 "
        "pixels (of samples of 256): first the coarse levels on small pictures, many of them in an hour, then finer "
        "ones; then go on without",
    )
    p.add_argument("--bfloat16", action="store_true", help="of the convolutions: faster where the processor has it")
    p.add_argument(
        "--weights",
        type=Path,
        help="begin with these weights, not with random ones: small, "
        "a safetensors file, or the averaged ones of another run's state.pt",
    )
    p.add_argument("--maps", type=Path, help="environment maps, .npz, under which about half of the draws are relit")
    p.add_argument(
        "--validation",
        type=Path,
        help="folder of held-back samples: drawn at every checkpoint; what --export calibrates on",
    )
    p.add_argument(
        "--export",
        type=Path,
        help="write the averaged weights of the checkpoint, calibrated on --validation or else the samples, to this "
        "file and stop",
    )
    return p


def _check(args: argparse.Namespace) -> None:
    """Raise InputError for what would end the work later."""
    from reli3d.output.folder import check_folder
    from reli3d.synthetic.stored import check_samples

    check_ranges(args, steps=(1, 10**9), minutes=(1e-3, math.inf), batch=(1, 4096), points=(2, 16384))
    check_ranges(args, max_views=(1, 16), rate=(1e-9, 10.0), pyramid_rate=(1e-6, 10.0))
    check_ranges(args, seed=(0, 10**9))
    check_folder(args.output)
    if args.pixels and (args.maps or args.export):
        raise InputError("--pixels", f"expected neither --maps nor --export with it, got {args.maps or args.export}")
    if args.export:
        check_folder(args.export.parent)
    if not args.export or not args.validation:
        check_samples(args.samples, "samples", views=CALIBRATED if args.export else 1, points=not args.pixels)
    if args.validation:
        check_samples(args.validation, "validation", views=CALIBRATED)


def _check_state(path: Path, model, config: TrainConfig | None = None, *, partly: bool = False) -> None:
    """Raise InputError where ``path`` is not a whole checkpoint of ``model``, or where ``config`` cannot go on from
    it.  partly: it may be one of small pictures.
    """
    import torch

    from reli3d.errors import shown
    from reli3d.io.files import file_size
    from reli3d.nn.weights import check_keys
    from reli3d.train.loop import parameter_groups
    from reli3d.train.pixels import lacking

    def sizes(groups: list[dict]) -> list[tuple]:
        return [(len(group["params"]), group.get("times")) for group in groups]

    file_size(path)
    try:
        state = torch.load(path, weights_only=True, mmap=True)
        shapes = [{k: tuple(v.shape) for k, v in state[name].items()} for name in ("model", "average")]
        found_sizes, step, seconds = sizes(state["optimizer"]["param_groups"]), state["step"], state["seconds"]
        whole = isinstance(step, int) and step >= 0 and seconds >= 0
    except Exception as error:  # of a broken file torch, pickle and zipfile raise almost anything
        reason = shown(" ".join(str(error).split()))
        raise InputError(
            path, f"expected a checkpoint of this training, got a broken file ({reason}); remove it to start again"
        ) from None
    if config and found_sizes != sizes(parameter_groups(model, config)):
        raise InputError(
            path,
            "expected a checkpoint of the same training, got one of other parameters or an earlier version; "
            "name another output folder, and this file by --weights",
        )
    wanted = {k: tuple(v.shape) for k, v in model.state_dict().items()}
    for found in shapes:
        begun_anew = lacking(model.preset, found) if partly else set()
        check_keys(path, found, {k: shape for k, shape in wanted.items() if k not in begun_anew})
    if not whole:
        raise InputError(path, "expected a checkpoint of this training, got another one; remove it to start again")


def _begun(start: Path | None, pixels: int) -> LocalReconstructor:
    """The network with the weights of ``start``, or with random ones; the one for pictures of ``pixels`` a side.
    Raises InputError for another network's.
    """
    from reli3d.train.pixels import for_small_pictures

    model = _whole(start)
    finest = SIDES[::-1].index(pixels) if pixels else 0
    return for_small_pictures(model, finest).train() if finest else model


def _whole(start: Path | None) -> LocalReconstructor:
    import torch

    from reli3d.nn import weights
    from reli3d.nn.local import LocalReconstructor
    from reli3d.nn.presets import SMALL
    from reli3d.train.pixels import take_levels

    if start is None or start.suffix == ".pt":
        model = LocalReconstructor(SMALL)
        if start:
            _check_state(start, model, partly=True)
            take_levels(model, torch.load(start, weights_only=True)["average"])
        return model.train()
    found = weights.load_model(str(start), "cpu")
    if not isinstance(found, LocalReconstructor):
        raise InputError("--weights", f"expected a network of convolutions, got the preset {found.preset.name}")
    return found.train().requires_grad_(True)


@command("reli3d-train")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    _check(args)
    import torch

    from reli3d.nn import weights
    from reli3d.train.calibrate import calibrate
    from reli3d.train.loop import TrainConfig, averaged_model, train
    from reli3d.train.workers import Workers

    torch.manual_seed(args.seed)
    model = _begun(args.weights, args.pixels)
    state = args.output / "state.pt"
    config = TrainConfig(
        samples=str(args.samples),
        output=str(args.output),
        steps=args.steps,
        minutes=args.minutes,
        batch=args.batch,
        points=args.points,
        max_views=args.max_views,
        rate=args.rate,
        pyramid_rate=args.pyramid_rate,
        seed=args.seed,
        pixels=args.pixels,
        bfloat16=args.bfloat16,
        maps=str(args.maps or ""),
        validation=str(args.validation or ""),
    )
    if args.export or state.exists():
        _check_state(state, model, None if args.export else config)
    if args.export:
        averaged_model(state, model)
        for views, tried in calibrate(model, args.validation or args.samples, progress=tell).items():
            row = ", ".join(f"{offset:g}: {iou:.4f}" for offset, iou in tried.items())
            tell(f"silhouette IoU by surface offset, {views} views: {row}")
        tell(f"chosen: {model.preset.offset_one_view:g}, of many views {model.preset.offset_many_views:g}")
        print(weights.save(args.export, model, licence=LICENCE).path)
        return 0
    workers = Workers.join()
    train(model, config, workers)
    workers.leave()
    return 0


if __name__ == "__main__":
    sys.exit(main())
