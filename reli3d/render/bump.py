"""Shading normals from tangent-space bump normals, in the frame of ReLi3D."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reli3d._bridge import check, launch
from reli3d.kernels import bump as kernels

EPS = float(kernels.BUMP_EPS)  # of the published normalization; on the vertical axis there is no frame and no bump


def radial_bump(position: Tensor, normal: Tensor, bump: Tensor) -> Tensor:
    """Unit shading normal ``(..., 3)`` of a tangent-space ``bump (..., 3)``, with tangents around the +Y axis.

    position: ``(..., 3)`` model frame.  normal: ``(..., 3)`` unit, geometric.  The tangent is ``y x position``,
    orthogonalized to the normal, the bitangent ``normal x tangent``.  Gradients reach ``bump`` only, as in ReLi3D.
    Raises ValueError for a wrong shape or device.
    """
    position, normal = position.detach(), normal.detach()
    values = (position, normal, bump)
    for name, value in zip(("position", "normal", "bump"), values, strict=True):
        check(name, value, last=3, like=bump, dtype=value.dtype)
    if not (torch.is_grad_enabled() and bump.requires_grad) and all(v.dtype == torch.float32 for v in values):
        rows = [v.detach().reshape(-1, 3).contiguous() for v in torch.broadcast_tensors(*values)]
        out = torch.empty_like(rows[0])
        launch(kernels.radial_bump_kernel, len(out), [(v, kernels.wp.vec3) for v in (*rows, out)], out.device)
        return out.view(torch.broadcast_shapes(*(v.shape for v in values)))
    around = torch.stack([position[..., 2], torch.zeros_like(position[..., 0]), -position[..., 0]], -1)
    tangent = normalize(torch.linalg.cross(normal, torch.linalg.cross(around, normal)), dim=-1, eps=EPS)
    return _in_frame(tangent, normalize(torch.linalg.cross(normal, tangent), dim=-1, eps=EPS), normal, bump)


def _in_frame(tangent: Tensor, bitangent: Tensor, normal: Tensor, bump: Tensor) -> Tensor:
    return normalize(tangent * bump[..., :1] + bitangent * bump[..., 1:2] + normal * bump[..., 2:], dim=-1, eps=EPS)
