"""Regularizers for fitting a FlexiCubes surface (Shen et al. 2023, section 4.3).

Both are plain torch operations on the surface cubes only; gradients reach every input, in float32 as in the extraction.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from reli3d._bridge import check
from reli3d.geometry import surface
from reli3d.geometry.surface import UNIT_WEIGHTS, CubeWeights
from reli3d.kernels.flexicubes import SDF_MIN


def vertex_deviation(
    sdf: Tensor, *, radius: float | Sequence[float], weights: CubeWeights = UNIT_WEIGHTS, closed: bool = True
) -> Tensor:
    """L_dev ``(D,)`` of the dual vertices, in units of ``radius``; the mean is the loss.

    L_dev is the mean absolute deviation of the distances from a dual vertex to the zero crossings that it averages.  A
    small value keeps the vertex inside its polygon and the faces free of folds.  Arguments, checks and vertex order
    (without centers) are those of :func:`reli3d.geometry.surface.extract_surface`.  Gradients reach sdf, deformation,
    alpha and beta, except through distances of 0.  A field without surface gives an empty tensor, whose mean is NaN.
    """
    extent = surface.check_fields(sdf, radius, weights)
    deformation = weights.deformation
    t, padded, _ = surface.topology_of(sdf.detach().contiguous(), weights.cubes, closed)
    if t.pad:
        padded = torch.nn.functional.pad(sdf, (1,) * 6, value=1.0)
    elif sdf.requires_grad:
        padded = sdf
    device, size = sdf.device, torch.tensor(t.cubes, dtype=torch.float64, device=sdf.device)
    table = surface.tables_on(device)
    group = table["group"].view(256, 12)[t.resolved.long()]
    cell, edge = (group >= 0).nonzero(as_tuple=True)
    owner = t.base.long()[cell] + group[cell, edge]
    row = t.rows.long()[cell]
    corner, padded_corner = surface.corner_vertices(t), surface.corners_of(t.cells, t.shape)

    def weight(values: Tensor | None, column: Tensor) -> Tensor:
        if values is None:
            return sdf.new_ones(len(row))
        # index_select, here and below: its backward sums in index order, that of advanced indexing in any order
        at = row.clamp(min=0) * values.shape[1] + column
        return torch.where(row >= 0, values.reshape(-1).index_select(0, at), 1.0)

    ends, alphas, positions = [], [], []
    for end in table["ends"].view(12, 2).long()[edge].unbind(1):
        ends.append(padded.reshape(-1).index_select(0, padded_corner[cell, end]))
        alphas.append(weight(weights.alpha, end))
        vertex = corner[cell, end]
        position = torch.stack(torch.unravel_index(vertex, sdf.shape), -1) / size - 0.5
        if deformation is not None:
            position = position + deformation.reshape(-1, 3).index_select(0, vertex)
        positions.append(position)
    tiny = torch.maximum(*(v.detach().abs() for v in ends)) < SDF_MIN
    # float64 from here on: field values and weights have any magnitude, and distances are differences of positions
    values = [torch.where(tiny, v.detach(), v).double() * a for v, a in zip(ends, alphas, strict=True)]
    fraction = values[0] / (values[0] - values[1])
    crossing = torch.lerp(positions[0], positions[1], fraction[:, None]) * (2.0 * size.new_tensor(extent))

    total = int(t.counts.sum())
    of_edge, none = weight(weights.beta, edge).double(), size.new_zeros(total)
    mass = none.index_add(0, owner, of_edge)
    vertex = size.new_zeros(total, 3).index_add(0, owner, crossing * of_edge[:, None]) / mass[:, None]
    if not bool(torch.isfinite(vertex.detach()).all()):
        raise ValueError("alpha, beta, deformation: expected positive weights and finite offsets, got others")
    count = torch.bincount(owner, minlength=total)
    distance = torch.linalg.vector_norm(vertex.index_select(0, owner) - crossing, dim=-1)
    mean = none.index_add(0, owner, distance) / count
    return (none.index_add(0, owner, (distance - mean.index_select(0, owner)).abs()) / count).float()


def sign_entropy(sdf: Tensor) -> Tensor:
    """Binary cross-entropy across sign changes of the grid, a scalar loss that removes floating components.

    ``H(sigmoid(a), [b > 0]) + H(sigmoid(b), [a > 0])``, averaged over the grid edges (a, b) with a sign change: each
    end is pulled to the sign of the other, so sign changes that no other loss supports vanish.  0, without gradient, if
    there is no sign change.  sdf: ``(X + 1, Y + 1, Z + 1)`` or with leading batch axes, float32, negative inside,
    logits.  Raises TypeError for a wrong dtype, ValueError for a wrong shape or non-finite values.  Source: Munkberg et
    al. 2022; L_sign of FlexiCubes.
    """
    check("sdf", sdf)
    if sdf.ndim < 3 or min(sdf.shape[-3:]) < 2:
        raise ValueError(f"sdf: expected shape (..., X + 1, Y + 1, Z + 1), got {tuple(sdf.shape)}")
    if not bool(torch.isfinite(sdf.detach()).all()):
        raise ValueError("sdf: expected finite values, got NaN or infinity")
    total, count = sdf.new_zeros(()), 0
    inside = sdf.detach() < 0.0
    for axis in (-3, -2, -1):
        n = sdf.shape[axis] - 1
        crossed = inside.narrow(axis, 0, n) != inside.narrow(axis, 1, n)
        a, b = sdf.narrow(axis, 0, n)[crossed], sdf.narrow(axis, 1, n)[crossed]
        turn = torch.where(a < 0.0, 1.0, -1.0).to(a)  # sign of the other end, the opposite of this one's
        total = total + torch.nn.functional.softplus(-turn * a).sum() + torch.nn.functional.softplus(turn * b).sum()
        count += a.numel()
    return total / max(count, 1)
