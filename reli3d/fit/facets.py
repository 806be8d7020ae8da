"""The end of a surface: the grid's ripple and the hull's shallow ridges go, edges stay."""

from __future__ import annotations

import torch
from torch import Tensor

from reli3d.fit.unknowns import unit
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.topology import face_neighbours

SAME_FACET = 0.2  # distance of unit normals, 11 degrees: faces that differ by much more lie on two sides of an edge
ROUNDS = 10  # of the filter of the normals: reaches as many faces far
MOVES = 20  # of the vertices towards their faces' planes


def neighbours(faces: Tensor) -> Tensor:
    """``(F, 3)`` int64: the face across each edge ``(0, 1), (1, 2), (2, 0)`` of ``faces (F, 3)``, the face itself where
    there is not exactly one."""
    across = torch.from_numpy(face_neighbours(faces.cpu().numpy())).to(faces.device).long()
    own = torch.arange(len(faces), device=faces.device, dtype=torch.int64)[:, None]
    return torch.where(across < 0, own, across)


@torch.no_grad()
def flattened(mesh: Mesh, *, rounds: int = ROUNDS, moves: int = MOVES) -> Mesh:
    """``mesh`` with its faces turned towards the mean normal of the facet that they lie on; positions and faces.

    A bilateral filter of the faces' normals, weighed by area and by how near two normals are (Zheng, Fu, Au and Tai
    2011, Bilateral normal filtering for mesh denoising), then vertices moved until their faces have these normals (Sun,
    Rosin, Martin and Langbein 2007, Fast and effective feature-preserving mesh denoising, section 4).  Unlike smoothing
    of positions it leaves edges sharp and thin parts as thick as they were.
    """
    vertices, corners, across = mesh.vertices.detach(), mesh.faces.long(), neighbours(mesh.faces)
    a, b, c = (vertices.index_select(0, k) for k in corners.unbind(1))
    doubled = torch.linalg.cross(b - a, c - a)
    area = doubled.norm(dim=1, keepdim=True)
    normal = doubled / area.clamp(min=1e-20)
    for _ in range(rounds):
        total = area * normal
        for side in across.unbind(1):
            beside = normal.index_select(0, side)
            near = torch.exp(-(beside - normal).square().sum(1, keepdim=True) / (2.0 * SAME_FACET**2))
            total = total + area.index_select(0, side) * near * beside
        normal = unit(total)
    count = vertices.new_zeros(len(vertices), 1)
    count.index_add_(0, corners.reshape(-1), count.new_ones(corners.numel(), 1))
    for _ in range(moves):
        ends = [vertices.index_select(0, k) for k in corners.unbind(1)]
        middle, step = sum(ends) / 3.0, torch.zeros_like(vertices)
        for k, end in zip(corners.unbind(1), ends, strict=True):
            step.index_add_(0, k, normal * (normal * (middle - end)).sum(1, keepdim=True))
        vertices = vertices + step / count.clamp(min=1.0)
    return Mesh(vertices, mesh.faces)
