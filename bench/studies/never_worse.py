"""Whether refinements lose: objects of ``reli3d-data`` from a few views, before and after, on input and unseen views.

usage: python -m bench.studies.never_worse SAMPLES [--views 1 2 3 4] [--steps 60] [--first K] [--count N]

SAMPLES: a folder of ``reli3d-data render ... --held-back test --views 6``.  Each object is reconstructed from its first
views with the shipped weights and refined for a number of steps; its last two views are never given.  Prints a row for
each object and number of views, then the mean changes and how many lost more than 0.1 dB on the views given or 0.3 dB
on those not given; the exit code is 1 where one did.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from reli3d.eval.metrics import psnr
from reli3d.fit.bounce import gathered
from reli3d.fit.choice import decibels, picture_error
from reli3d.fit.photographs import Photographs
from reli3d.geometry.camera import Camera
from reli3d.geometry.rays import RayScene
from reli3d.nn.weights import load_model
from reli3d.pipeline import REFINED, ReconstructOptions, reconstruct, refined
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.gbuffer import primary_hits, surface_points
from reli3d.views.views import Views

UNSEEN = 2
INPUT_LOSS, UNSEEN_LOSS = 0.1, 0.3  # dB, the most that a refinement may lose
COLUMNS = ("input", "unseen", "base colour", "as is", "IoU")


def views_of(sample: dict[str, Tensor], which: list[int]) -> Views:
    """These photographs of a sample."""
    images = sample["images"][which].float() / 255.0
    names = tuple(f"{k}.png" for k in which)
    colors, masks = tuple(images[..., :3]), tuple(images[..., 3])
    return Views(colors, masks, sample["c2w"][which], sample["intrinsics"][which], names)


@torch.no_grad()
def scores(asset: Asset, sample: dict[str, Tensor], given: list[int], unseen: list[int]) -> dict[str, float]:
    """PSNR [dB] of whole pictures, of base colour on shared pixels after the best factors and as it is, and IoU."""
    shown = {
        name: Photographs.of(views_of(sample, which).resampled(REFINED))
        for name, which in (("input", given), ("unseen", unseen))
    }
    received = gathered(asset.mesh, shown["input"], seed=0)
    row = {name: decibels(picture_error(asset, received, photographs)) for name, photographs in shown.items()}
    scene, size = RayScene(asset.mesh.vertices, asset.mesh.faces), sample["images"].shape[1]
    hits, _, _ = primary_hits(scene, Camera(sample["c2w"][unseen], sample["intrinsics"][unseen], size, size))
    hit, mask = hits.face >= 0, sample["images"][unseen][..., 3] > 127
    both = hit & mask & (sample["view_depth"][unseen] > 0)
    got = surface_points(asset.mesh, asset.textures, hits.face[both], hits.bary[both]).base_color
    want = srgb_to_linear(sample["view_material"][unseen][both][:, :3].float() / 255.0)
    factor = (got * want).sum(0) / got.square().sum(0).clamp(min=1e-9)
    for name, color in (("base colour", got * factor), ("as is", got)):
        row[name] = psnr(linear_to_srgb(color.clamp(0.0, 1.0)), linear_to_srgb(want))
    row["IoU"] = float((hit & mask).sum() / (hit | mask).sum().clamp(min=1))
    return row


def main() -> int:
    p = argparse.ArgumentParser(prog="bench.studies.never_worse", description=__doc__)
    p.add_argument("samples", type=Path)
    p.add_argument("--views", type=int, nargs="+", default=[1, 2, 3, 4])
    p.add_argument("--steps", type=int, default=60)
    p.add_argument("--first", type=int, default=0)
    p.add_argument("--count", type=int, default=32)
    args = p.parse_args()
    model, options = load_model("small"), ReconstructOptions(texture_size=512)
    files = sorted(args.samples.glob("*.safetensors"))[args.first : args.first + args.count]
    rows: list[tuple[dict[str, float], dict[str, float]]] = []
    lost, kept = [0, 0], 0
    for path in files:
        sample = load_file(path)
        count = len(sample["images"])
        for number in args.views:
            given, unseen = list(range(number)), list(range(count - UNSEEN, count))
            views = views_of(sample, given)
            asset = reconstruct(views, weights=model, options=options)
            result = refined(asset, views, steps=args.steps)
            was = scores(asset, sample, given, unseen)
            now = scores(result.asset, sample, given, unseen) if result.changed else was
            rows.append((was, now))
            kept += not result.changed
            lost[0] += now["input"] < was["input"] - INPUT_LOSS
            lost[1] += now["unseen"] < was["unseen"] - UNSEEN_LOSS
            pairs = ", ".join(f"{name} {was[name]:.3g} to {now[name]:.3g}" for name in COLUMNS)
            print(f"{path.stem}, {number} views, {result.parts}: {pairs}", flush=True)
    means = {name: sum(now[name] - was[name] for was, now in rows) / max(len(rows), 1) for name in COLUMNS}
    worst = {name: min((now[name] - was[name] for was, now in rows), default=0.0) for name in COLUMNS}
    print("mean change: " + ", ".join(f"{name} {value:+.3f}" for name, value in means.items()))
    print("worst change: " + ", ".join(f"{name} {value:+.3f}" for name, value in worst.items()))
    print(f"{len(rows)} refinements, {kept} kept the start; lost on input {lost[0]}, on unseen views {lost[1]}")
    return int(any(lost))


if __name__ == "__main__":
    sys.exit(main())
