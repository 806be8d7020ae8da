"""Levels lowered along the rays of pixels inside a silhouette that meet no surface."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor
from torch.nn.functional import max_pool2d

from reli3d._bridge import check, launch
from reli3d.geometry.camera import Camera, check_camera
from reli3d.kernels import cover as kernels

STRIDE = 4  # pixels between rays
DEPTH = 0.05  # level below the surface that a ray reaches: enough to make one; more thickens what was right already
FIELD_MAX = 3.0  # rays whose least level is this high meet nothing: masks disagree, or a rod is thinner than a cell


def cover_silhouettes(level: Tensor, bound: Tensor, distance: Tensor, camera: Camera, *, radius: float) -> Tensor:
    """``level (X, Y, Z)``, lowered so that every ray inside the views' silhouettes meets the surface; no gradient.

    level: negative inside, on a grid over [-radius, radius]^3, in logits of occupancy or in distances over the
    softness.  bound: ``(X, Y, Z)``; neither ``level`` nor the result is below it.  distance, camera: as in
    :func:`reli3d.geometry.hull.hull_distance`, at least ``2 STRIDE`` pixels a side.  Without views nothing changes.

    A field that is not sure of a thin part stays a little above 0 along the rays that show it.  Every ``STRIDE``-th
    pixel has a ray.  What its least level is above ``-DEPTH`` is subtracted along the ray, unless it is above
    ``FIELD_MAX``.  Source: own.  Raises TypeError or ValueError.
    """
    check("level", level)
    if level.ndim != 3 or min(level.shape) < 2:
        raise ValueError(f"level: expected shape (X, Y, Z) of at least 2 points a side, got {tuple(level.shape)}")
    check("bound", bound, like=level)
    check("distance", distance, like=level)
    if bound.shape != level.shape:
        raise ValueError(f"bound: expected shape {tuple(level.shape)}, got {tuple(bound.shape)}")
    if distance.ndim != 3 or min(distance.shape[1:]) < 2 * STRIDE:
        expected = f"(V, H, W) with H and W of at least {2 * STRIDE}"
        raise ValueError(f"distance: expected shape {expected}, got {tuple(distance.shape)}")
    views, height, width = distance.shape
    check_camera(camera, like=level, views=views, size=(height, width))
    if not 0.0 < radius < float("inf"):
        raise ValueError(f"radius: expected a positive number, got {radius}")
    if views == 0:
        return level.detach().clone()
    level, bound, distance = (v.detach().contiguous() for v in (level, bound, distance))
    lowest = _lowest(level)
    lacking = level.new_empty(views, height // STRIDE, width // STRIDE)
    posed = (camera.c2w, wp.mat44), (camera.intrinsics, wp.vec4)
    cameras = [(v.detach().contiguous(), kind) for v, kind in posed]
    launch(
        kernels.lacking_kernel,
        lacking.numel(),
        [
            *((v, wp.float32) for v in (level, lowest, distance)),
            *cameras,
            radius,
            DEPTH,
            FIELD_MAX,
            STRIDE,
            (lacking, wp.float32),
        ],
        level.device,
    )
    lacking = max_pool2d(lacking, 3, 1, 1)  # as far as the silhouette's edge, between two rays
    lowered = torch.empty_like(level)
    launch(
        kernels.lower_kernel,
        level.numel(),
        [
            (level, wp.float32),
            (bound, wp.float32),
            (lacking, wp.float32),
            *cameras,
            radius,
            FIELD_MAX,
            STRIDE,
            (lowered, wp.float32),
        ],
        level.device,
    )
    return lowered


def _lowest(level: Tensor) -> Tensor:
    """Least level of each block of ``kernels.BLOCK_CELLS`` cells a side, those on its border included."""
    for axis in range(3):
        cells = level.shape[axis] - 1
        most = (
            torch.arange(-(-cells // kernels.BLOCK_CELLS), device=level.device, dtype=torch.int64) * kernels.BLOCK_CELLS
        )
        points = [level.index_select(axis, (most + k).clamp(max=cells)) for k in range(kernels.BLOCK_CELLS + 1)]
        level = torch.stack(points).amin(0)
    return level.contiguous()
