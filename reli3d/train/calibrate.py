"""The one number that training leaves open: at which density the surface is drawn.

Trained on a soft occupancy, a network that is not sure says a little less than one half where it means a surface, and
the shape comes out thin.  A constant on the density, chosen on whole objects, takes that back.
"""

from __future__ import annotations

from pathlib import Path

import torch

from reli3d.nn.field import bound_level, surface_level
from reli3d.nn.model import Reconstructor
from reli3d.train.losses import maps_of
from reli3d.train.samples import batches

OFFSETS = tuple(k / 10 for k in range(-5, 21))  # in units of the logit


@torch.no_grad()
def calibrate(model: Reconstructor, samples: Path, *, steps: int = 40, seed: int = 1) -> dict[float, float]:
    """Add to the density's bias the offset with the best mean IoU of the volume over random objects and view counts.

    Returns the mean IoU of every offset tried.  The volume's uniform points alone are counted: they measure the shape.
    """
    source = batches(samples, size=4, points=4096, max_views=4, seed=seed)
    totals = torch.zeros(len(OFFSETS), dtype=torch.float64)
    for _, batch in zip(range(steps), source):
        code = model.encode(batch.images, batch.masks, batch.c2w, batch.intrinsics)
        for b in range(len(batch.images)):
            own = code.of(b)
            maps = maps_of(own, batch.images[b], batch.silhouette[b], batch.c2w[b], batch.intrinsics[b])
            half = batch.points.shape[1] // 2
            points, inside = batch.points[b, half:].contiguous(), batch.distance[b, half:] < 0
            level = surface_level(model, own, maps, points)
            bound = bound_level(model, maps, points)
            for k, offset in enumerate(OFFSETS):
                got = torch.maximum(level - offset, bound) < 0
                totals[k] += float((got & inside).sum() / (got | inside).sum().clamp(min=1))
    best = OFFSETS[int(totals.argmax())]
    model.heads["density"][-1].bias += best
    return dict(zip(OFFSETS, (totals / (4 * steps)).tolist(), strict=True))
