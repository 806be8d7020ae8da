"""Tangent frames of a mesh with UV, and normals written in them.

The convention is MikkTSpace's, as in glTF.  The tangent follows +u.  The bitangent, w * cross(normal, tangent), points
up on the image, which is -v; w is +1 where the texture is not mirrored.  A normal map holds n * 0.5 + 0.5, red along
the tangent and green along the bitangent.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import warp as wp
from torch import Tensor

from reli3d._bridge import check, expect, launch, present
from reli3d.geometry.mesh import Mesh, weld_rows
from reli3d.kernels.bump import ENCODE_EPS, encode_normals_kernel
from reli3d.kernels.tangents import corner_shares_kernel

EPS = float(ENCODE_EPS)
PARALLEL = 1.0e-12  # length of a projected direction below which it has no direction in float64


def _unit(v: Tensor) -> tuple[Tensor, Tensor]:
    """The columns of ``v (3, N)`` with unit length, 0 where shorter than PARALLEL, and their lengths ``(N,)``."""
    length = (v * v).sum(0).sqrt()
    return v * torch.where(length > PARALLEL, 1.0 / length.clamp(min=1e-300), 0.0), length


def _flat(v: Tensor, n: Tensor) -> Tensor:
    """The columns of ``v`` without their parts along the unit columns of ``n``."""
    return v - n * (n * v).sum(0)


def vertex_tangents(mesh: Mesh) -> Tensor:
    """Tangents ``(V, 4)`` float32: unit, orthogonal to the normal, w = +-1.

    Every corner adds the direction of +u of its face, projected onto the plane of the vertex normal and made unit,
    times the angle of the corner.  Corners are one vertex where position, normal and UV are equal.  A vertex that joins
    mirrored and plain faces, which MikkTSpace splits, takes the side with the larger angle; :func:`unwrap` makes none.
    Without any direction (no UV area) the tangent is some vector orthogonal to the normal.  No gradient.  Raises
    ValueError without normals or UV.  Source: Mikkelsen 2008, Simulation of wrinkled surfaces revisited; mikktspace.c.
    """
    expect("mesh", mesh, Mesh)
    if mesh.normals is None:
        raise ValueError("mesh.normals: expected a tensor, got None (see Mesh.with_normals)")
    if mesh.uv is None:
        raise ValueError("mesh.uv: expected a tensor, got None (see unwrap)")
    vertices, uv, normals = (x.detach().contiguous() for x in (mesh.vertices, mesh.uv, mesh.normals))
    same, count = _merged(mesh), len(mesh.vertices)
    share = torch.empty(3, len(mesh.faces), 4, dtype=torch.float64, device=vertices.device)
    side = torch.empty(3, len(mesh.faces), dtype=torch.int32, device=vertices.device)
    ins = [(vertices, wp.vec3), (normals, wp.vec3), (uv, wp.vec2), (mesh.faces.contiguous(), wp.int32)]
    outs = [(same.int(), wp.int32), (share, wp.vec4d), (side, wp.int32)]
    launch(corner_shares_kernel, len(mesh.faces), [*ins, *outs], vertices.device)
    side, shares = side.flatten(), share.flatten(0, 1).T.contiguous()
    # plain, mirrored; index_add_ takes ten times as long
    total = torch.stack([torch.bincount(side, part, 2 * count) for part in shares])
    n = _unit(normals.double().T.contiguous())[0]  # vectors are columns: torch sums a short last axis slowly
    plain, mirrored = total[:, :count][:, same], total[:, count:][:, same]
    flip = mirrored[3] > plain[3]
    tangent, length = _unit(torch.where(flip, mirrored, plain)[:3])
    tangent = torch.where(length > PARALLEL, _unit(_flat(tangent, n))[0], _any_orthogonal(n))
    return torch.cat([tangent, torch.where(flip, -1.0, 1.0).to(tangent)[None]]).T.to(torch.float32).contiguous()


def _merged(mesh: Mesh) -> Tensor:
    """First vertex with the same position, normal and UV, for every vertex, ``(V,)``."""
    first, label = weld_rows(
        torch.cat([mesh.vertices, present("mesh.normals", mesh.normals), present("mesh.uv", mesh.uv)], 1)
        .detach()
        .cpu()
        .numpy()
    )
    return torch.from_numpy(first[label]).to(mesh.vertices.device)


def _any_orthogonal(n: Tensor) -> Tensor:
    axis = torch.zeros_like(n).scatter_(0, n.abs().argmin(0, keepdim=True), 1.0)
    return _unit(_flat(axis, n))[0]


def with_tangents(mesh: Mesh) -> Mesh:
    """The same mesh with :func:`vertex_tangents`."""
    return replace(mesh, tangents=vertex_tangents(mesh))


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Products of vectors along the last axis, ``(...)``; a sum over so short an axis takes three times as long."""
    product = a * b
    return product[..., 0] + product[..., 1] + product[..., 2]


def _check_frame(normal: Tensor, tangent: Tensor) -> None:
    check("normal", normal, last=3)
    check("tangent", tangent, last=4, like=normal)


def _frame(normal: Tensor, tangent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    t, n = tangent[..., :3], normal
    b = torch.linalg.cross(n, t) * tangent[..., 3:]
    return t, b, n


def encode_normals(world: Tensor, normal: Tensor, tangent: Tensor) -> Tensor:
    """Normal map values ``(..., 3)`` in [0, 1] of the unit world-space normals ``world (..., 3)``.

    normal: ``(..., 3)`` unit, tangent: ``(..., 4)`` with unit direction, both interpolated at the texel.  The frame is
    inverted, not transposed: interpolated tangents are not quite orthogonal, and :func:`decode_normals` must give
    ``world`` back.  A normal below the surface is bent up to it, since viewers expect none there.  Gradients reach
    ``world``.
    """
    _check_frame(normal, tangent)
    check("world", world, last=3, like=normal)
    same = world.shape[:-1] == normal.shape[:-1] == tangent.shape[:-1]
    asked = torch.is_grad_enabled() and any(v.requires_grad for v in (world, normal, tangent))
    if same and not asked:
        rows = [v.detach().reshape(-1, v.shape[-1]).contiguous() for v in (world, normal, tangent)]
        out = torch.empty_like(rows[1])
        arrays = list(zip((*rows, out), (wp.vec3, wp.vec3, wp.vec4, wp.vec3), strict=True))
        launch(encode_normals_kernel, len(out), arrays, out.device)
        return out.view(normal.shape)
    t, b, n = _frame(normal, tangent)
    tt, tn, nn = _dot(t, t), _dot(t, n), _dot(n, n)
    wt, wn = _dot(world, t), _dot(world, n)
    determinant = (tt * nn - tn * tn).clamp(min=EPS)  # b is orthogonal to both, so that two equations remain
    x = (nn * wt - tn * wn) / determinant
    z = (tt * wn - tn * wt) / determinant
    y = _dot(world, b) / _dot(b, b).clamp(min=EPS)
    local = torch.stack([x, y, z.clamp(min=0.0)], -1)
    return torch.nn.functional.normalize(local, dim=-1, eps=EPS) * 0.5 + 0.5


def decode_normals(encoded: Tensor, normal: Tensor, tangent: Tensor) -> Tensor:
    """Unit world-space normals ``(..., 3)`` of normal map values ``(..., 3)``: inverse of :func:`encode_normals`."""
    _check_frame(normal, tangent)
    check("encoded", encoded, last=3, like=normal)
    t, b, n = _frame(normal, tangent)
    local = encoded * 2.0 - 1.0
    world = local[..., :1] * t + local[..., 1:2] * b + local[..., 2:] * n
    return torch.nn.functional.normalize(world, dim=-1, eps=EPS)
