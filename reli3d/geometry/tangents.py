"""Tangent frames of a mesh with UV, and normal maps in these frames.

The convention is MikkTSpace's, as in glTF.  The tangent points along +u.  The bitangent, w * cross(normal, tangent),
points along -v, up in the image; w is +1 where the texture is not mirrored.  A normal map stores n * 0.5 + 0.5, red
along the tangent and green along the bitangent.
"""

import torch
from torch import Tensor

from reli3d._bridge import check
from reli3d.geometry.topology import weld_rows

EPS = 1.0e-6  # least length and determinant of a frame
MIN_TANGENT_LENGTH = 1.0e-12  # projected directions shorter than this are treated as zero, in float64


def _unit(v: Tensor) -> tuple[Tensor, Tensor]:
    """Normalized columns of ``v (3, N)``, 0 if shorter than MIN_TANGENT_LENGTH, and their lengths ``(N,)``."""
    length = (v * v).sum(0).sqrt()
    return v * torch.where(length > MIN_TANGENT_LENGTH, 1.0 / length.clamp(min=1e-300), 0.0), length


def _flat(v: Tensor, n: Tensor) -> Tensor:
    """The columns of ``v`` projected onto the planes with the unit normals ``n``."""
    return v - n * (n * v).sum(0)


def vertex_tangents(vertices: Tensor, faces: Tensor, normals: Tensor, uv: Tensor) -> Tensor:
    """Tangents ``(V, 4)`` float32: unit, orthogonal to the normal, w = +-1.

    The tangent of a vertex is the sum over its corners of the face's +u direction, projected onto the plane of the
    vertex normal and normalized, times the angle of the corner.  Vertices with equal position, normal and UV are
    merged.  A vertex between mirrored and unmirrored faces, which MikkTSpace splits, takes the side with the larger
    angle; :func:`unwrap` produces none.  Where all faces have zero UV area, the tangent is an arbitrary vector
    orthogonal to the normal.  No gradient.  Source: Mikkelsen 2008, Simulation of wrinkled surfaces revisited;
    mikktspace.c.
    """
    vertices, normals, uv = (x.detach() for x in (vertices, normals, uv))
    first, label = weld_rows(torch.cat([vertices, normals, uv], 1).cpu().numpy())
    same, count = torch.from_numpy(first[label]).to(vertices.device), len(vertices)
    corner = faces.T.long()
    # float64, as differences of float32 values cancel; vectors are columns: torch sums a short last axis slowly
    normal = _unit(normals.double().T.contiguous())[0]
    p, n, st = vertices.double().T[:, corner], normal[:, corner], uv.double().T[:, corner]  # (3 or 2, 3 corners, F)
    (s0, s1), (t0, t1) = st[:, 1] - st[:, 0], st[:, 2] - st[:, 0]
    area = s0 * t1 - s1 * t0  # negative unless mirrored, as v points down
    along_u = (p[:, 1] - p[:, 0]) * t1 - (p[:, 2] - p[:, 0]) * s1
    along_u = _unit(torch.where(area < 0, -along_u, along_u))[0][:, None]
    one, other = (_unit(_flat(p.roll(step, 1) - p, n))[0] for step in (-1, 1))
    angle = torch.where(area != 0, (one * other).sum(0).clamp(-1, 1).acos(), 0.0)
    weighted = torch.cat([_unit(_flat(along_u, n))[0] * angle, angle[None]]).flatten(1)
    side = (same[corner] + count * (area >= 0)).flatten()
    # unmirrored, then mirrored; index_add_ is about 10 times slower
    total = torch.stack([torch.bincount(side, part, 2 * count) for part in weighted])
    upright, mirrored = total[:, :count][:, same], total[:, count:][:, same]
    flip = mirrored[3] > upright[3]
    tangent, length = _unit(torch.where(flip, mirrored, upright)[:3])
    tangent = torch.where(length > MIN_TANGENT_LENGTH, _unit(_flat(tangent, normal))[0], _any_orthogonal(normal))
    return torch.cat([tangent, torch.where(flip, -1.0, 1.0).to(tangent)[None]]).T.to(torch.float32).contiguous()


def _any_orthogonal(n: Tensor) -> Tensor:
    axis = torch.zeros_like(n).scatter_(0, n.abs().argmin(0, keepdim=True), 1.0)
    return _unit(_flat(axis, n))[0]


def encode_normals(world: Tensor, normal: Tensor, tangent: Tensor) -> Tensor:
    """Encodes unit world-space normals ``world (..., 3)`` as normal map values ``(..., 3)`` in [0, 1].

    normal: ``(..., 3)`` unit, tangent: ``(..., 4)`` with unit direction, both interpolated at the texel.  The frame is
    inverted, not transposed, because interpolated tangents are not exactly orthogonal and renderers must decode
    ``world``.  Normals below the surface are clamped to the tangent plane.  Gradients reach ``world``.
    """
    check("normal", normal, last=3)
    check("tangent", tangent, last=4, like=normal)
    check("world", world, last=3, like=normal)
    t, n = tangent.detach()[..., :3], normal.detach()
    b = torch.linalg.cross(n, t) * tangent.detach()[..., 3:]
    tt, tn, nn, wt, wn, wb, bb = (
        (x * y).sum(-1) for x, y in ((t, t), (t, n), (n, n), (world, t), (world, n), (world, b), (b, b))
    )
    determinant = (tt * nn - tn * tn).clamp(min=EPS)
    z = ((tt * wn - tn * wt) / determinant).clamp(min=0.0)
    local = torch.stack(torch.broadcast_tensors((nn * wt - tn * wn) / determinant, wb / bb.clamp(min=EPS), z), -1)
    return torch.nn.functional.normalize(local, dim=-1, eps=EPS) * 0.5 + 0.5
