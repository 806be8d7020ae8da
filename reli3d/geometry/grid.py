"""Regular grids: trilinear interpolation and the weighted squared Laplacian."""

import torch
from torch import Tensor

from reli3d._bridge import call, check, launch, once_differentiable
from reli3d.kernels.grid import sample_grid_kernel, weighted_laplacian_adjoint_kernel, weighted_laplacian_kernel

ROWS_MIN = 256  # fewest rows of a grid in a slice of a launch on a CPU: some 30,000 points


def sample_grid(grid: Tensor, points: Tensor) -> Tensor:
    """Trilinear interpolation ``(N, C)`` of ``grid (X, Y, Z, C)``, which spans [-1, 1]^3, at ``points (N, 3)``.

    The outermost grid points lie at -1 and 1; points outside are clamped to the border.  Each axis needs at least 2
    grid points.  Gradients reach both arguments.  Raises TypeError unless float32, ValueError for a wrong shape or
    device.
    """
    check("grid", grid)
    check("points", points, shape=("N", 3), like=grid)
    if grid.ndim != 4 or min(grid.shape[:3]) < 2:
        raise ValueError(f"grid: expected (X, Y, Z, C) of at least 2 points along each axis, got {tuple(grid.shape)}")
    n = len(points)
    (out,) = call(sample_grid_kernel, n, [grid, points], [(n, grid.shape[3])], shared=(0,))
    return out


def squared_laplacian(field: Tensor, weight: Tensor) -> Tensor:
    """Weighted sum ``()`` of the squared 7-point Laplacian over the inner points of a grid.

    field, weight: ``(X, Y, Z)`` float32.  Border points, and points whose ``weight`` is 0, contribute only as
    neighbors.  First-order gradients reach ``field``; ``weight`` is a constant.  Raises TypeError for a wrong dtype,
    ValueError for a wrong shape or device.
    """
    check("field", field)
    check("weight", weight, like=field)
    if field.ndim != 3 or weight.shape != field.shape:
        got = f"{tuple(field.shape)} and {tuple(weight.shape)}"
        raise ValueError(f"field, weight: expected one shape (X, Y, Z), got {got}")
    return _SquaredLaplacian.apply(field.contiguous(), weight.detach().contiguous())


class _SquaredLaplacian(torch.autograd.Function):
    """Analytic adjoint: the Laplacian is self-adjoint, so each point gathers its gradient without atomics."""

    @staticmethod
    def forward(ctx, field, weight):
        product, rows = torch.empty_like(field), field.shape[0] * field.shape[1]
        total = field.new_empty(rows)
        launch(weighted_laplacian_kernel, rows, [field, weight, product, total], field.device, slice_min=ROWS_MIN)
        ctx.save_for_backward(field, product)
        return total.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx, g_total):
        field, product = ctx.saved_tensors
        g_field, rows = torch.empty_like(field), field.shape[0] * field.shape[1]
        arrays = [product, g_total.reshape(1).contiguous(), g_field]
        launch(weighted_laplacian_adjoint_kernel, rows, arrays, field.device, slice_min=ROWS_MIN)
        return g_field, None
