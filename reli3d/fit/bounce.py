"""Light that the object throws on itself, read from the photographs."""

from __future__ import annotations

import torch
from torch import Tensor

from reli3d._bridge import present
from reli3d.fit.photographs import Photographs
from reli3d.fit.seen import COVERED, display_planes, seen_colors, sight
from reli3d.fit.unknowns import unit
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.render.color import srgb_to_linear
from reli3d.render.points import SurfacePoints

RAYS = 32  # of a vertex; their noise is averaged over the pixels around it
BLOCK = 8192  # vertices at once: 10 MB of rays
LIFT = 1e-3  # where rays start above the surface: a fifteenth of a cell of 128, so that they do not meet their own face


@torch.no_grad()
def gathered(mesh: Mesh, photographs: Photographs, *, seed: int) -> Tensor:
    """Radiance ``(V, 3)`` that reaches each vertex from the mesh itself: its mean over the hemisphere by the cosine.

    What leaves the surface, after all bounces, is in the photographs: a point sends what the cameras that see it show,
    on average, into every direction (a final gathering without a recursion).  A point that no camera sees sends the
    mean of the others.  Backs of faces send what their fronts do.

    mesh: with normals, in the fit's box of half side 1.  photographs: whose colours may be used; exposures count as 1.
    No gradient.  Raises ValueError without normals.
    """
    position, normal = mesh.vertices, present("mesh.normals", mesh.normals)
    scene = RayScene(position, mesh.faces)
    leaving, known = _leaving(position, normal, scene, photographs)
    if not bool(known.any()):
        return torch.zeros_like(position)
    leaving[~known] = leaving[known].mean(0)
    of_face = leaving[mesh.faces.long()].mean(1)
    rng = torch.Generator().manual_seed(seed)
    parts = []
    for at, n in zip(position.split(BLOCK), normal.split(BLOCK), strict=True):
        ball = unit(torch.randn(len(n), RAYS, 3, generator=rng, dtype=torch.float32, device="cpu")).to(n.device)
        directions = unit(n[:, None] + ball)  # their density is the cosine over pi
        face = scene.closest((at + LIFT * n)[:, None], directions).face.long()
        parts.append((of_face[face.clamp(min=0)] * (face >= 0)[..., None]).mean(1))
    return torch.cat(parts)


def _leaving(position: Tensor, normal: Tensor, scene: RayScene, photographs: Photographs) -> tuple[Tensor, Tensor]:
    """Mean linear colour ``(V, 3)`` of the photographs that see each point, and whether any does ``(V,)``."""
    planes, parts, seen = display_planes(photographs), [], []
    for at, n in zip(position.split(BLOCK), normal.split(BLOCK), strict=True):
        color, cover = seen_colors(planes, at, photographs.camera)
        weight = sight(scene, at, n, photographs.camera) * (cover > COVERED)
        total = weight.sum(1, keepdim=True)
        parts.append((weight[..., None] * srgb_to_linear(color.clamp(0.0, 1.0))).sum(1) / total.clamp(min=1e-6))
        seen.append(total[:, 0] > 0.0)
    return torch.cat(parts), torch.cat(seen)


def thrown_back(points: SurfacePoints, received: Tensor) -> Tensor:
    """Radiance ``(N, 3)`` that points return, as matt ones, of what they receive (``(N, 3)``, :func:`gathered`)."""
    return points.base_color * (1.0 - points.metallic[:, None]) * received
