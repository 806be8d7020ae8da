"""``reli3d-train``: train the small network on samples that ``reli3d-data`` made."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

LICENCE = "Apache-2.0; trained by the reli3d authors, see docs/weights.md for the data"


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
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
    p.add_argument("--seed", type=int, default=0)
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


def report(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(argv)
    import torch

    from reli3d.nn import weights
    from reli3d.nn.local import LocalReconstructor
    from reli3d.nn.presets import LOCAL
    from reli3d.train.calibrate import calibrate
    from reli3d.train.loop import TrainConfig, averaged_model, train
    from reli3d.train.workers import Workers

    torch.manual_seed(args.seed)
    model = LocalReconstructor(LOCAL)
    try:
        if args.export:
            averaged_model(args.output / "state.pt", model)
            for views, tried in calibrate(model, args.validation or args.samples, progress=report).items():
                row = ", ".join(f"{offset:g}: {iou:.4f}" for offset, iou in tried.items())
                report(f"silhouette IoU by surface offset, {views} views: {row}")
            report(f"chosen: {model.preset.offset_one_view:g}, of many views {model.preset.offset_many_views:g}")
            print(weights.save(args.export, model, licence=LICENCE).path)
            return 0
        workers = Workers.join()
        train(model, TrainConfig(samples=str(args.samples), output=str(args.output), steps=args.steps,
                                 minutes=args.minutes, batch=args.batch, points=args.points, max_views=args.max_views,
                                 rate=args.rate, seed=args.seed,
                                 validation=str(args.validation or "")), workers)  # fmt: skip
        workers.leave()
    except (ValueError, OSError) as error:
        print(f"reli3d-train: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
