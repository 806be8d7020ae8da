"""Sparse evaluation of a signed field on a grid, only where the surface may be."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

INSIDE_DEPTH = 0.2  # a coarse cell (two grid cells a side) with all corners below -INSIDE_DEPTH is not refined


@torch.no_grad()
def sparse_sdf(known: Tensor, near: Tensor, evaluate: Callable[[Tensor], Tensor]) -> Tensor:
    """Field values ``(X, Y, Z)`` equal to a dense evaluation near the surface, and ``-INSIDE_DEPTH`` deep inside.

    known: ``(X, Y, Z)``, at least 3 points per side; its values are kept where ``near (X, Y, Z)``, bool, is False and
    no neighbor has the opposite sign.  evaluate: maps flat point indices ``(N,)`` to field values ``(N,)``.

    1. Every second point of ``near`` along each axis is evaluated.
    2. The points of ``near`` between them are, except in coarse cells with all corners below ``-INSIDE_DEPTH``.
    3. Neighbors across a sign change are, until all are known.

    A closed cavity without a point of step 1 is missed.  No gradient.  Raises ValueError for a wrong shape, TypeError
    unless ``near`` is bool.
    """
    if known.ndim != 3 or min(known.shape) < 3 or near.shape != known.shape:
        raise ValueError(
            f"known, near: expected one shape (X, Y, Z) of 3 or more, got {tuple(known.shape)}, {tuple(near.shape)}"
        )
    if near.dtype != torch.bool:
        raise TypeError(f"near: expected torch.bool, got {near.dtype}")
    sdf, near = known.clone(memory_format=torch.contiguous_format), near.contiguous()
    done = torch.zeros_like(near)

    def evaluate_at(active: Tensor) -> None:
        index = active.view(-1).nonzero()[:, 0]
        sdf.view(-1)[index] = evaluate(index)
        done.view(-1)[index] = True

    every_other = torch.zeros_like(near)
    every_other[::2, ::2, ::2] = near[::2, ::2, ::2]
    evaluate_at(every_other)
    shallow = (~(sdf[::2, ::2, ::2] < -INSIDE_DEPTH)).float()
    cells = max_pool3d(shallow[None], 2, 1)[0] > 0.0  # coarse cells with a corner that is not deep, or NaN
    inside = torch.zeros_like(near)
    inside[tuple(slice(2 * n + 1) for n in cells.shape)] = ~_points_of(cells)
    inside &= near & ~done
    sdf[inside] = -INSIDE_DEPTH
    evaluate_at(near & ~done & ~inside)
    while True:
        across = _at_sign_change(sdf < 0) & ~done
        if not bool(across.any()):
            return sdf
        evaluate_at(across)


def _points_of(cells: Tensor) -> Tensor:
    """``(2X + 1, 2Y + 1, 2Z + 1)`` points in or on the true ``cells``, which are two points wide."""
    for axis in range(3):
        twice = cells.repeat_interleave(2, axis)
        none = torch.zeros_like(cells.narrow(axis, 0, 1))
        cells = torch.cat([twice, none], axis) | torch.cat([none, twice], axis)
    return cells


def _at_sign_change(inside: Tensor) -> Tensor:
    """Points with a neighbor along an axis on the other side of the surface."""
    found = torch.zeros_like(inside)
    for axis, count in enumerate(inside.shape):
        change = inside.narrow(axis, 0, count - 1) != inside.narrow(axis, 1, count - 1)
        found.narrow(axis, 0, count - 1).logical_or_(change)
        found.narrow(axis, 1, count - 1).logical_or_(change)
    return found
