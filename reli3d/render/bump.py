"""From the network's bump normal to a world-space shading normal."""

from __future__ import annotations

import torch
from torch import Tensor

EPS = 1.0e-7  # of the published normalisation; on the vertical axis, where the frame vanishes, the bump is lost


def _unit(v: Tensor) -> Tensor:
    """Of vectors along the first axis."""
    return v / torch.linalg.vector_norm(v, dim=0).clamp(min=EPS)


def radial_bump(position: Tensor, normal: Tensor, bump: Tensor) -> Tensor:
    """Unit shading normal ``(..., 3)`` of a tangent-space ``bump (..., 3)`` in the frame that circles the +Y axis.

    position: ``(..., 3)`` model frame.  normal: ``(..., 3)`` unit, geometric.  The tangent is ``y x position`` made
    orthogonal to the normal, the bitangent ``normal x tangent``.  Gradients reach ``bump`` only, as published: the
    frame is data.
    """
    # vectors are columns: torch takes several times as long along so short a last axis
    p, n, b = (v.movedim(-1, 0).contiguous() for v in (position.detach(), normal.detach(), bump))
    around = torch.stack([p[2], torch.zeros_like(p[0]), -p[0]])
    tangent = _unit(around - n * (n * around).sum(0))
    bitangent = _unit(torch.linalg.cross(n, tangent, dim=0))
    shaded = tangent * b[0] + bitangent * b[1] + n * b[2]
    return _unit(shaded).movedim(0, -1).contiguous()
