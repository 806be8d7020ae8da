"""One training step of the published sizes on a CPU: forward and backward of each kind of stage, random weights.

usage: python -m bench.studies.official_step [--stages NAME ...] [--bfloat16] [--gib LIMIT]

One object, one view read, the trunk's layers computed again in the backward pass.  Adam's moments and the averaged
parameters are left out: with them it takes 30 GiB.  The surface has 32 cubes a side and the pictures 64 pixels.  A
ball is added to the raw density, as random weights show nothing.  Prints seconds, the norm of the gradients, how many
parameters have one, and the largest memory so far.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
import torch

from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import OFFICIAL
from reli3d.nn.reni import map_directions
from reli3d.synthetic.procedural import make_object
from reli3d.synthetic.samples import ObjectSurface, synthesize
from reli3d.train.stages.config import Stage
from reli3d.train.stages.losses import gradients
from reli3d.train.stages.step import checkpointed, object_losses, total
from reli3d.train.stages.views import Draw, sample_views

STAGES = (
    Stage("volume", "volume", 64, patch=64, grid=32, samples_along=64),
    Stage("gaussians", "gaussians", 64, resolution=32),
    Stage("monte_carlo", "monte_carlo", 64, resolution=32),
)
RADIUS, STEEP = 0.5, 12.0  # of the ball, model units, and of its raw density
OUTSIDE = 2.0  # raw density that the head starts below the surface's


class Ball(Reconstructor):
    """The network plus a ball in its raw density."""

    def query(self, code, points, heads=("density",)):
        values = super().query(code, points, heads)
        if "density" in values:
            values["density"] = values["density"] + OUTSIDE + STEEP * (RADIUS - points.norm(dim=-1, keepdim=True))
        return values


def peak() -> float:
    """GiB that this process has held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def drawn(size: int) -> Draw:
    """One view of an object to read, another to compare."""
    light = 0.2 + 3.0 * map_directions(32)[..., :1].clamp(min=0).expand(-1, -1, 3).contiguous()
    sample = synthesize(ObjectSurface(make_object(3)), light, np.random.default_rng(0), size=256, views=2)
    views = sample_views(sample.get, range)
    return Draw(views.select([0]).resized(OFFICIAL.image_size), views.select([1]).resized(size), True, 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", nargs="+", choices=[s.name for s in STAGES], default=[s.name for s in STAGES])
    parser.add_argument("--bfloat16", action="store_true", help="autocast of the trunk")
    parser.add_argument("--gib", type=float, help="of address space; beyond it the step ends with an error")
    args = parser.parse_args()
    if args.gib:
        resource.setrlimit(resource.RLIMIT_AS, (int(args.gib * 2**30),) * 2)
    torch.manual_seed(0)
    one = drawn(STAGES[0].image_size)
    began = time.monotonic()
    model = Ball(OFFICIAL)
    checkpointed(model)
    count = sum(p.numel() for p in model.parameters())
    print(f"{count:,} parameters in {time.monotonic() - began:.0f} s, {peak():.1f} GiB", flush=True)
    for stage in (s for s in STAGES if s.name in args.stages):
        model.zero_grad(set_to_none=True)
        began, used = time.monotonic(), time.process_time()
        terms = object_losses(model, one, stage, gradients, bfloat16=args.bfloat16)
        loss = total(terms, stage)
        forward, forward_used = time.monotonic() - began, time.process_time() - used
        loss.backward()
        seconds, used = time.monotonic() - began, time.process_time() - used
        grads = [p.grad for p in model.parameters() if p.grad is not None]
        norm = float(torch.stack([g.square().sum() for g in grads]).sum().sqrt())
        finite = all(bool(torch.isfinite(g).all()) for g in grads)
        share = sum(int((g != 0).sum()) for g in grads) / count
        print(
            f"{stage.name}: loss {float(loss):.3f}, forward {forward:.0f} s (processor {forward_used:.0f} s), with "
            f"backward {seconds:.0f} s ({used:.0f} s), gradients finite: {finite}, norm {norm:.3g}, "
            f"of {share:.1%} of the parameters not 0, {peak():.1f} GiB; {', '.join(terms)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
