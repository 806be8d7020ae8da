"""One-bounce interreflection, with the radiosity of the surface read from the input images."""

from __future__ import annotations

import torch
from torch import Tensor

from reli3d._bridge import present
from reli3d.fit.input_images import InputImages
from reli3d.fit.unknowns import unit
from reli3d.fit.view_colors import MIN_COVERAGE, display_planes, view_colors, view_weights
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.render.color import srgb_to_linear
from reli3d.render.points import SurfacePoints

RAYS_PER_VERTEX = 32  # their noise is averaged over the pixels around a vertex
VERTICES_PER_BATCH = 8192  # 10 MB of rays
RAY_OFFSET = 1e-3  # of ray origins along the normal: 1/15 of a cell at 128 cells, against self-intersection


@torch.no_grad()
def gathered(mesh: Mesh, images: InputImages, *, seed: int) -> Tensor:
    """Cosine-weighted mean ``(V, 3)`` of the radiance that each vertex receives from the mesh itself.

    Final gathering: the outgoing radiance of a surface point, taken as Lambertian, is the mean color of the images in
    which it is visible, else the mean of the other points.  Faces emit on both sides.

    mesh: with normals, in the fit's box [-1, 1]^3.  images: input images whose colors may be used; exposures are taken
    as 1.  seed: of the ray directions.  No gradient.  Raises ValueError without normals.
    """
    position, normal = mesh.vertices, present("mesh.normals", mesh.normals)
    scene = RayScene(position, mesh.faces)
    leaving, known = _leaving(position, normal, scene, images)
    if not bool(known.any()):
        return torch.zeros_like(position)
    leaving[~known] = leaving[known].mean(0)
    of_face = leaving[mesh.faces.long()].mean(1)
    rng = torch.Generator().manual_seed(seed)
    parts = []
    for at, n in zip(position.split(VERTICES_PER_BATCH), normal.split(VERTICES_PER_BATCH), strict=True):
        ball = torch.randn(len(n), RAYS_PER_VERTEX, 3, generator=rng, dtype=torch.float32, device="cpu")
        directions = unit(n[:, None] + unit(ball).to(n.device))  # their density is the cosine over pi
        face = scene.closest((at + RAY_OFFSET * n)[:, None], directions).face.long()
        parts.append((of_face[face.clamp(min=0)] * (face >= 0)[..., None]).mean(1))
    return torch.cat(parts)


def _leaving(position: Tensor, normal: Tensor, scene: RayScene, images: InputImages) -> tuple[Tensor, Tensor]:
    """Mean linear color ``(V, 3)`` of each point over the images that see it, and whether any does ``(V,)``."""
    planes, parts, visible = display_planes(images), [], []
    for at, n in zip(position.split(VERTICES_PER_BATCH), normal.split(VERTICES_PER_BATCH), strict=True):
        color, cover = view_colors(planes, at, images.camera)
        weight = view_weights(scene, at, n, images.camera) * (cover > MIN_COVERAGE)
        total = weight.sum(1, keepdim=True)
        parts.append((weight[..., None] * srgb_to_linear(color.clamp(0.0, 1.0))).sum(1) / total.clamp(min=1e-6))
        visible.append(total[:, 0] > 0.0)
    return torch.cat(parts), torch.cat(visible)


def reflected(points: SurfacePoints, received: Tensor) -> Tensor:
    """Radiance ``(N, 3)`` reflected by Lambertian points that receive ``received (N, 3)``, from :func:`gathered`."""
    return points.base_color * (1.0 - points.metallic[:, None]) * received
