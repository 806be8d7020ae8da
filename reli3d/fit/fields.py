"""Multiresolution fields: sums of grids, smoothing of gradients, and the optimizer of the surface."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from reli3d.geometry.grid import sample_grid


def space_field(grids: Sequence[Tensor], points: Tensor) -> Tensor:
    """Sum ``(N, C)``, at ``points (N, 3)``, of trilinear ``grids (n, n, n, C)`` over [-1, 1]^3, coarse to fine.

    An optimizer step on a coarse grid changes whole regions, so the coarse grids converge to the low frequencies.
    """
    return torch.stack([sample_grid(grid.contiguous(), points) for grid in grids]).sum(0)


def blurred_grid(grid: Tensor, cells: int) -> Tensor:
    """``grid (X, Y, Z)`` averaged over blocks of ``cells`` per side, interpolated between block centers."""
    small = tuple(max(1, -(-n // cells)) for n in grid.shape)
    coarse = interpolate(grid[None, None], small, mode="area")
    return interpolate(coarse, tuple(grid.shape), mode="trilinear", align_corners=False)[0, 0]


class EvenAdam:
    """Adam with one second moment for the whole tensor: the step keeps the shape of the gradient.

    Adam's own division by the size of each entry undoes a smoothed gradient, because it makes tiny entries as large as
    the others (Nicolet, Jacobson and Jakob 2021, Large Steps in Inverse Rendering of Geometry, section 3.5).
    """

    def __init__(self, value: Tensor):
        self.value = value
        self.mean, self.square, self.count = torch.zeros_like(value), 0.0, 0

    @torch.no_grad()
    def step(self, gradient: Tensor, rate: float) -> None:
        """Moves the value against ``gradient`` by at most about ``rate``."""
        one, two = 0.9, 0.99
        self.count += 1
        self.mean.mul_(one).add_(gradient, alpha=1.0 - one)
        self.square = two * self.square + (1.0 - two) * float(gradient.abs().max()) ** 2
        size = (self.square / (1.0 - two**self.count)) ** 0.5
        if size > 0.0:
            self.value.sub_(self.mean, alpha=rate / ((1.0 - one**self.count) * size))
