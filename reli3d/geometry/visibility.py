"""Which cameras see a point of a surface."""

from __future__ import annotations

import torch
from torch import Tensor

from reli3d.geometry.rays import RayScene, offset_origin
from reli3d.render.camera import project

GRAZING = 0.05  # cosine below which a pixel smears over 20 times its width of surface and says nothing about the point


def visible_from(
    scene: RayScene, position: Tensor, normal: Tensor, c2w: Tensor, intrinsics: Tensor, size: int
) -> Tensor:
    """``(N, V)`` bool: the point faces the camera, projects into its ``size`` by ``size`` image and nothing stands
    between.

    position, normal: ``(N, 3)`` world, the normal unit.  c2w: ``(V, 4, 4)``.  intrinsics: ``(V, 4)`` pixels.  No
    gradient.
    """
    columns = []
    for pose, camera in zip(c2w, intrinsics, strict=True):
        to_camera = pose[:3, 3] - position
        distance = to_camera.norm(dim=-1)
        direction = to_camera / distance[:, None]
        pixel, depth = project(position, pose, camera)
        seen = ((direction * normal).sum(-1) > GRAZING) & (depth > 0) & (pixel > 0).all(-1) & (pixel < size).all(-1)
        index = seen.nonzero()[:, 0]
        start = offset_origin(position[index], normal[index], direction[index])
        seen[index] = ~scene.occluded(start, direction[index], t_max=distance[index])
        columns.append(seen)
    return torch.stack(columns, -1)
