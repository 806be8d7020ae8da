"""Feature-preserving denoising of an extracted surface: flattens grid artifacts and shallow ridges, keeps edges."""

from __future__ import annotations

import torch

from reli3d.fit.unknowns import unit
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.topology import face_neighbors

NORMAL_SIGMA = 0.2  # standard deviation of the range kernel: distance of unit normals, 11 degrees
NORMAL_ITERATIONS = 10  # of the filter of the normals; its support in faces
VERTEX_ITERATIONS = 20  # that move the vertices towards their faces' planes


@torch.no_grad()
def flattened(mesh: Mesh) -> Mesh:
    """``mesh`` denoised by bilateral filtering of its face normals; vertices and faces only.

    The normals are averaged over neighbors, weighted by area and by the distance between normals (Zheng, Fu, Au and Tai
    2011, Bilateral normal filtering for mesh denoising); then the vertices are moved to match the filtered normals
    (Sun, Rosin, Martin and Langbein 2007, Fast and effective feature-preserving mesh denoising, section 4).  Unlike
    smoothing of positions, this keeps sharp edges and the thickness of thin parts.
    """
    vertices, corners = mesh.vertices.detach(), mesh.faces.long()
    across = torch.from_numpy(face_neighbors(mesh.faces.cpu().numpy())).to(corners)
    own = torch.arange(len(corners), device=corners.device, dtype=torch.int64)[:, None]
    across = torch.where(across < 0, own, across)  # an edge without exactly one face across it gives the face itself
    a, b, c = (vertices.index_select(0, k) for k in corners.unbind(1))
    doubled = torch.linalg.cross(b - a, c - a)
    area = doubled.norm(dim=1, keepdim=True)
    normal = doubled / area.clamp(min=1e-20)
    for _ in range(NORMAL_ITERATIONS):
        total = area * normal
        for side in across.unbind(1):
            other = normal.index_select(0, side)
            near = torch.exp(-(other - normal).square().sum(1, keepdim=True) / (2.0 * NORMAL_SIGMA**2))
            total = total + area.index_select(0, side) * near * other
        normal = unit(total)
    count = vertices.new_zeros(len(vertices), 1)
    count.index_add_(0, corners.reshape(-1), count.new_ones(corners.numel(), 1))
    for _ in range(VERTEX_ITERATIONS):
        ends = [vertices.index_select(0, k) for k in corners.unbind(1)]
        middle, step = sum(ends) / 3.0, torch.zeros_like(vertices)
        for k, end in zip(corners.unbind(1), ends, strict=True):
            step.index_add_(0, k, normal * (normal * (middle - end)).sum(1, keepdim=True))
        vertices = vertices + step / count.clamp(min=1.0)
    return Mesh(vertices, mesh.faces)
