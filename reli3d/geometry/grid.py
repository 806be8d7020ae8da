"""Values on grids: features of points between them, and how much they bend."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from reli3d._bridge import call, check, launch, once_differentiable
from reli3d.kernels.grid import sample_grid_kernel, weighted_laplacian_adjoint_kernel, weighted_laplacian_kernel

ROWS_MIN = 256  # fewest rows of a grid in a slice of a launch on a CPU: some 30,000 points


def sample_grid(grid: Tensor, points: Tensor) -> Tensor:
    """Trilinear values ``(N, C)`` of ``grid (X, Y, Z, C)``, which spans [-1, 1]^3, at ``points (N, 3)``.

    -1 and 1 are the outermost grid points; beyond them the border's value is taken.  At least 2 points along each
    axis.  Gradients reach both.  Raises TypeError unless float32, ValueError on wrong shapes or mixed devices.
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


def squared_laplacian(level: Tensor, share: Tensor) -> Tensor:
    """Sum ``()`` over inner points of ``share`` times the square of six neighbours less six times the point's value.

    level, share: ``(X, Y, Z)`` float32.  Points of the border count as neighbours only, and so do those where ``share``
    is 0.  Gradients reach ``level`` once; ``share`` is a constant.  Raises TypeError or ValueError.
    """
    check("level", level)
    check("share", share, like=level)
    if level.ndim != 3 or share.shape != level.shape:
        got = f"{tuple(level.shape)} and {tuple(share.shape)}"
        raise ValueError(f"level, share: expected (X, Y, Z) twice, got {got}")
    return _SquaredLaplacian.apply(level.contiguous(), share.detach().contiguous())


class _SquaredLaplacian(torch.autograd.Function):
    """Own adjoint: the operator is its own transpose, so a point gathers its slope and no slices are added up."""

    @staticmethod
    def forward(ctx, level, share):
        product, rows = torch.empty_like(level), level.shape[0] * level.shape[1]
        total = level.new_empty(rows)
        arrays = [(level, wp.float32), (share, wp.float32), (product, wp.float32), (total, wp.float32)]
        launch(weighted_laplacian_kernel, rows, arrays, level.device, slice_min=ROWS_MIN)
        ctx.save_for_backward(level, product)
        return total.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx, g_total):
        level, product = ctx.saved_tensors
        slope, rows = torch.empty_like(level), level.shape[0] * level.shape[1]
        arrays = [(product, wp.float32), (g_total.reshape(1).contiguous(), wp.float32), (slope, wp.float32)]
        launch(weighted_laplacian_adjoint_kernel, rows, arrays, level.device, slice_min=ROWS_MIN)
        return slope, None
