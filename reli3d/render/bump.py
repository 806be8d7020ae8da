"""From the network's bump normal to a world-space shading normal."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

EPS = 1.0e-7  # of the published normalisation; on the vertical axis, where the frame vanishes, the bump is lost


def radial_bump(position: Tensor, normal: Tensor, bump: Tensor) -> Tensor:
    """Unit shading normal ``(..., 3)`` of a tangent-space ``bump (..., 3)`` in the frame that circles the +Y axis.

    position: ``(..., 3)`` model frame.  normal: ``(..., 3)`` unit, geometric.  The tangent is ``y x position`` made
    orthogonal to the normal, the bitangent ``normal x tangent``.  Gradients reach ``bump`` only, as published: the
    frame is data.
    """
    position, normal = position.detach(), normal.detach()
    around = torch.stack([position[..., 2], torch.zeros_like(position[..., 0]), -position[..., 0]], -1)
    tangent = normalize(torch.linalg.cross(normal, torch.linalg.cross(around, normal)), dim=-1, eps=EPS)
    bitangent = normalize(torch.linalg.cross(normal, tangent), dim=-1, eps=EPS)
    return normalize(tangent * bump[..., :1] + bitangent * bump[..., 1:2] + normal * bump[..., 2:], dim=-1, eps=EPS)
