"""Shading normals from tangent-space bump normals, in the frame of ReLi3D."""

import torch
from torch import Tensor
from torch.linalg import cross
from torch.nn.functional import normalize

from reli3d._bridge import check

EPS = 1.0e-7  # least length of an axis


def radial_bump(position: Tensor, normal: Tensor, bump: Tensor) -> Tensor:
    """Unit shading normals ``(..., 3)`` from tangent-space ``bump (..., 3)``, with tangents that circle the +Y axis.

    position: ``(..., 3)``, model frame.  normal: ``(..., 3)``, unit geometric normals.  The tangent is ``y x position``
    orthogonalized to the normal, the bitangent ``normal x tangent``; on the +Y axis neither exists, and the bump is
    ignored.  Computed in float32.  Gradients reach ``bump`` only, as in ReLi3D.  Raises ValueError for a wrong shape or
    device.
    """
    values = (position.detach(), normal.detach(), bump)
    for name, value in zip(("position", "normal", "bump"), values, strict=True):
        check(name, value, last=3, like=bump, dtype=value.dtype)
    p, n, b = (v.float() for v in torch.broadcast_tensors(*values))
    around = torch.stack([p[..., 2], torch.zeros_like(p[..., 0]), -p[..., 0]], -1)
    tangent = normalize(cross(n, cross(around, n)), dim=-1, eps=EPS)
    bitangent = normalize(cross(n, tangent), dim=-1, eps=EPS)
    return normalize(tangent * b[..., :1] + bitangent * b[..., 1:2] + n * b[..., 2:], dim=-1, eps=EPS)
