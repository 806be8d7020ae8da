"""Soft visual hull of posed masks: a bound on the density that any reconstruction has to keep."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from reli3d._bridge import check, launch
from reli3d.kernels.hull import hull_distance_kernel

PARTIAL = 0.02  # alpha within this of 0 or 1 is a full pixel


def mask_distance(masks: Tensor) -> Tensor:
    """Signed distance in pixels ``(V, H, W)`` to the contour alpha = 0.5 of ``masks (V, H, W)`` in [0, 1], positive inside.

    Partly covered pixels give their own coverage less one half; the others the exact Euclidean distance to the nearest pixel of the
    other side, corrected by that pixel's coverage.  A mask without a contour is everywhere as far as the image is wide.
    No gradient.  Raises TypeError unless float32, ValueError on another shape.
    """
    check("masks", masks)
    if masks.ndim != 3 or masks.numel() == 0:
        raise ValueError(f"masks: expected (V, H, W), got {tuple(masks.shape)}")
    return torch.as_tensor(np.stack([_signed(m) for m in masks.detach().cpu().numpy()]), device=masks.device)


def _signed(alpha: np.ndarray) -> np.ndarray:
    inside = alpha > 0.5
    if inside.all() or not inside.any():
        return np.full_like(alpha, max(alpha.shape) if inside.all() else -max(alpha.shape))
    out = np.empty_like(alpha)
    for side, sign in ((inside, 1.0), (~inside, -1.0)):
        distance, (row, column) = distance_transform_edt(side, return_indices=True)
        reach = distance - np.abs(alpha[row, column] - 0.5)
        out[side] = sign * reach[side]
    partial = (np.abs(alpha - 0.5) < 0.5 - PARTIAL) & (np.abs(out) < 1.5)
    out[partial] = alpha[partial] - 0.5
    return out


def hull_distance(points: Tensor, distance: Tensor, c2w: Tensor, intrinsics: Tensor) -> Tensor:
    """Signed distance ``(N,)`` to the visual hull in world units, positive inside, as the least over the views.

    points: ``(N, 3)`` world.  distance: ``(V, H, W)`` of :func:`mask_distance`.  c2w: ``(V, 4, 4)`` OpenGL.  intrinsics: ``(V, 4)`` pixels.
    A pixel distance becomes a length at the point's depth, so it is exact at the hull and approximate away from it.  Beyond the
    border of an image its border value holds: an object cut by the border stays unbounded there.  Behind a camera it is -1000.
    No gradient.  Raises TypeError unless float32, ValueError on wrong shapes or mixed devices.
    """
    check("points", points, last=3), check("distance", distance, like=points)
    check("c2w", c2w, last=4, like=points), check("intrinsics", intrinsics, last=4, like=points)
    views = distance.shape[0]
    if points.ndim != 2 or distance.ndim != 3 or distance.numel() == 0:
        raise ValueError(f"points, distance: expected (N, 3) and (V, H, W), got {tuple(points.shape)}, {tuple(distance.shape)}")
    if c2w.shape != (views, 4, 4) or intrinsics.shape != (views, 4):
        raise ValueError(f"c2w, intrinsics: expected {views} cameras, got {tuple(c2w.shape)} and {tuple(intrinsics.shape)}")
    out = points.new_empty(len(points))
    inputs = zip((points, distance, c2w, intrinsics), (wp.vec3, wp.float32, wp.mat44, wp.vec4), strict=True)
    args = [(t.detach().contiguous(), kind) for t, kind in inputs]
    launch(hull_distance_kernel, len(points), [*args, (out, wp.float32)], points.device)
    return out
