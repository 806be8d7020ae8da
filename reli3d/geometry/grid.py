"""Features of points from a grid that spans the cube [-1, 1]^3."""

from __future__ import annotations

import warp as wp
from torch import Tensor

from reli3d._bridge import call, check
from reli3d.kernels.grid import sample_grid_kernel


def sample_grid(grid: Tensor, points: Tensor) -> Tensor:
    """Trilinear values ``(N, C)`` of ``grid (X, Y, Z, C)`` at ``points (N, 3)``.

    -1 and 1 are the outermost grid points; beyond them the border's value is taken.  At least 2 points along each
    axis.  Gradients reach both.  Raises
    TypeError unless float32, ValueError on wrong shapes or mixed devices.
    """
    check("grid", grid)
    check("points", points, last=3, like=grid)
    if grid.ndim != 4 or min(grid.shape[:3]) < 2:
        raise ValueError(f"grid: expected (X, Y, Z, C) of at least 2 points along each axis, got {tuple(grid.shape)}")
    if points.ndim != 2:
        raise ValueError(f"points: expected (N, 3), got {tuple(points.shape)}")
    n = len(points)
    outs = [((n, grid.shape[3]), wp.float32)]
    (out,) = call(sample_grid_kernel, n, [(grid, wp.float32), (points, wp.vec3)], outs, device=grid.device, shared=(0,))
    return out
