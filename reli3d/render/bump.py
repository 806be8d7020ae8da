"""Shading normals from tangent-space bump normals, in the frame of ReLi3D."""

from __future__ import annotations

import torch
from torch import Tensor

from reli3d._bridge import call, check
from reli3d.kernels.bump import radial_bump_kernel


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
    ins = [v.float().reshape(-1, 3) for v in torch.broadcast_tensors(*values)]
    n = len(ins[0])
    (out,) = call(radial_bump_kernel, n, ins, [(n,)])
    return out.view(torch.broadcast_shapes(*(v.shape for v in values)))
