"""Levels of a surface grid, evaluated only where the surface may pass."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

INSIDE_DEPTH = (
    0.2  # depth of the level at all corners of a cell of two points a side in which nothing more is evaluated
)


@torch.no_grad()
def sparse_level(known: Tensor, near: Tensor, evaluate: Callable[[Tensor], Tensor]) -> Tensor:
    """Levels ``(X, Y, Z)`` as of a dense evaluation, but ``-INSIDE_DEPTH`` deep inside.

    known: ``(X, Y, Z)``, at least 3 a side, kept where ``near (X, Y, Z)``, bool, is false and no neighbour has another
    sign.  evaluate: levels ``(N,)`` of points with flat indices ``(N,)``.  Every other point of ``near`` along each
    axis is evaluated first, then what lies between them outside the cells whose corners are all below
    ``-INSIDE_DEPTH``, then,
    until none is left, what lies across a change of sign.  A closed hollow that no point of the first kind meets is
    missed.  No gradient.  Raises ValueError for other shapes, TypeError for another kind of ``near``.
    """
    if known.ndim != 3 or min(known.shape) < 3 or near.shape != known.shape:
        raise ValueError(
            f"known, near: expected one shape (X, Y, Z) from 3, got {tuple(known.shape)}, {tuple(near.shape)}"
        )
    if near.dtype != torch.bool:
        raise TypeError(f"near: expected torch.bool, got {near.dtype}")
    level, done = known.clone(), torch.zeros_like(near)

    def ask(wanted: Tensor) -> None:
        index = wanted.view(-1).nonzero()[:, 0]
        level.view(-1)[index] = evaluate(index)
        done.view(-1)[index] = True

    every_other = torch.zeros_like(near)
    every_other[::2, ::2, ::2] = near[::2, ::2, ::2]
    ask(every_other)
    deep = _all_corners(level[::2, ::2, ::2] < -INSIDE_DEPTH)
    inside = torch.zeros_like(near)
    inside[tuple(slice(2 * n + 1) for n in deep.shape)] = ~_points_of(~deep)
    inside &= near & ~done
    level[inside] = -INSIDE_DEPTH
    ask(near & ~done & ~inside)
    while True:
        across = _beside_other_sign(level < 0) & ~done
        if not bool(across.any()):
            return level
        ask(across)


def _all_corners(points: Tensor) -> Tensor:
    """``(X - 1, Y - 1, Z - 1)`` cells whose eight corners are all true."""
    for axis, count in enumerate(points.shape):
        points = points.narrow(axis, 0, count - 1) & points.narrow(axis, 1, count - 1)
    return points


def _points_of(cells: Tensor) -> Tensor:
    """``(2X + 1, 2Y + 1, 2Z + 1)`` points in or on the true ``cells``, which are two points wide."""
    for axis in range(3):
        twice = cells.repeat_interleave(2, axis)
        none = torch.zeros_like(cells.narrow(axis, 0, 1))
        cells = torch.cat([twice, none], axis) | torch.cat([none, twice], axis)
    return cells


def _beside_other_sign(inside: Tensor) -> Tensor:
    """Points with a neighbour along an axis on the other side of the surface."""
    found = torch.zeros_like(inside)
    for axis, count in enumerate(inside.shape):
        change = inside.narrow(axis, 0, count - 1) != inside.narrow(axis, 1, count - 1)
        found.narrow(axis, 0, count - 1).logical_or_(change)
        found.narrow(axis, 1, count - 1).logical_or_(change)
    return found
