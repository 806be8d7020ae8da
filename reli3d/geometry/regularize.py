"""Regularisers of a FlexiCubes surface while it is fitted (Shen et al. 2023, section 4.3).

Both are plain torch on what the surface touches: gradients reach every input, in float32 as the extraction.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from reli3d._bridge import check
from reli3d.geometry import surface
from reli3d.kernels.flexicubes import LEVEL_MIN


def vertex_deviation(
    level: Tensor,
    *,
    radius: float | Sequence[float],
    deformation: Tensor | None = None,
    alpha: Tensor | None = None,
    beta: Tensor | None = None,
    cubes: Tensor | None = None,
    closed: bool = True,
) -> Tensor:
    """L_dev of every dual vertex, ``(D,)`` in units of the radius; its mean is the loss.

    It is the mean absolute deviation of the distances between a dual vertex and the zero crossings that it averages.  A
    small one keeps the vertex inside its polygon and the faces without folds.  Arguments, checks and the order of the
    vertices (without centres) are those of :func:`reli3d.geometry.surface.extract_surface`.  Gradients reach level,
    deformation, alpha and beta; a distance of 0 gives none.  A field without surface gives an empty result, whose mean
    is NaN.
    """
    extent = surface.check_fields(level, radius, deformation, alpha, beta, None, cubes)
    t, padded, _ = surface.topology_of(level.detach().contiguous(), cubes, closed)
    if t.pad:
        padded = torch.nn.functional.pad(level, (1,) * 6, value=1.0)
    elif level.requires_grad:
        padded = level
    device, size = level.device, torch.tensor(t.cubes, dtype=torch.float64, device=level.device)
    table = surface.tables_on(device)
    group = table["group"].view(256, 12)[t.resolved.long()]
    cell, edge = (group >= 0).nonzero(as_tuple=True)
    owner = t.base.long()[cell] + group[cell, edge]
    row = t.rows.long()[cell]
    corner = surface.corner_vertices(t)
    step = torch.tensor([t.shape[1] * t.shape[2], t.shape[2], 1], device=device, dtype=torch.int64)

    def weight(values: Tensor | None, column: Tensor) -> Tensor:
        if values is None:
            return level.new_ones(len(row))
        # index_select, here and below: its gradient adds up in the order of the list, that of brackets in any
        at = row.clamp(min=0) * values.shape[1] + column
        return torch.where(row >= 0, values.reshape(-1).index_select(0, at), 1.0)

    levels, weights, positions = [], [], []
    for end in table["ends"].view(12, 2).long()[edge].unbind(1):
        offset = torch.stack([end & 1, end >> 1 & 1, end >> 2], -1)
        at_padded = t.cells.long()[cell] + (offset * step).sum(-1)
        levels.append(padded.reshape(-1).index_select(0, at_padded))
        weights.append(weight(alpha, end))
        vertex = corner[cell, end]
        nz = t.cubes[2] + 1
        at = torch.stack([vertex // ((t.cubes[1] + 1) * nz), vertex // nz % (t.cubes[1] + 1), vertex % nz], -1)
        position = at / size - 0.5
        positions.append(
            position if deformation is None else position + deformation.reshape(-1, 3).index_select(0, vertex)
        )
    tiny = torch.maximum(*(v.detach().abs() for v in levels)) < LEVEL_MIN
    # float64 from here on: levels and weights have any size, and distances are differences of positions
    values = [torch.where(tiny, v.detach(), v).double() * a for v, a in zip(levels, weights, strict=True)]
    share = values[0] / (values[0] - values[1])
    crossing = torch.lerp(positions[0], positions[1], share[:, None]) * (2.0 * size.new_tensor(extent))

    total = int(t.counts.sum())
    share, none = weight(beta, edge).double(), size.new_zeros(total)
    mass = none.index_add(0, owner, share)
    vertex = size.new_zeros(total, 3).index_add(0, owner, crossing * share[:, None]) / mass[:, None]
    if not bool(torch.isfinite(vertex.detach()).all()):
        raise ValueError("alpha, beta, deformation: expected positive weights and finite offsets, got others")
    count = torch.bincount(owner, minlength=total)
    distance = torch.linalg.vector_norm(vertex.index_select(0, owner) - crossing, dim=-1)
    mean = none.index_add(0, owner, distance) / count
    return (none.index_add(0, owner, (distance - mean.index_select(0, owner)).abs()) / count).float()


def sign_entropy(level: Tensor) -> Tensor:
    """Cross-entropy of the levels across every sign change of the grid, a scalar: the loss that removes loose pieces.

    ``H(sigmoid(a), [b > 0]) + H(sigmoid(b), [a > 0])``, mean over the grid edges (a, b) with a sign change: each end
    moves towards the other's sign, so a change that no other loss needs disappears.  0, without gradient, where there
    is none.  level: ``(X + 1, Y + 1, Z + 1)`` or with leading batch axes, float32, negative inside, 1 for a sure
    value.  Raises TypeError or ValueError on a wrong dtype or shape and on values that are not finite.  Source:
    Munkberg et al. 2022; L_sign of FlexiCubes.
    """
    check("level", level)
    if level.ndim < 3 or min(level.shape[-3:]) < 2:
        raise ValueError(f"level: expected shape (..., X + 1, Y + 1, Z + 1), got {tuple(level.shape)}")
    if not bool(torch.isfinite(level.detach()).all()):
        raise ValueError("level: expected finite values, got NaN or infinity")
    total, count = level.new_zeros(()), 0
    inside = level.detach() < 0.0
    for axis in (-3, -2, -1):
        n = level.shape[axis] - 1
        crossed = inside.narrow(axis, 0, n) != inside.narrow(axis, 1, n)
        a, b = level.narrow(axis, 0, n)[crossed], level.narrow(axis, 1, n)[crossed]
        turn = torch.where(a < 0.0, 1.0, -1.0).to(a)  # the other end's sign is the opposite of one's own
        total = total + torch.nn.functional.softplus(-turn * a).sum() + torch.nn.functional.softplus(turn * b).sum()
        count += a.numel()
    return total / max(count, 1)
