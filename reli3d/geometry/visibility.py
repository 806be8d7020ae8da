"""Which cameras see a point of a surface."""

from __future__ import annotations

import warp as wp
from torch import Tensor

from reli3d._bridge import check, launch
from reli3d.geometry.rays import RayScene
from reli3d.kernels.intersect import sight_kernel

GRAZING = 0.05  # cosine below which a pixel smears over 20 times its width of surface and says nothing about the point


def visible_from(
    scene: RayScene, position: Tensor, normal: Tensor, c2w: Tensor, intrinsics: Tensor, size: int
) -> Tensor:
    """``(N, V)`` bool: the point faces the camera, projects into its ``size`` by ``size`` image and nothing stands
    between.

    position, normal: ``(N, 3)`` world, the normal unit.  c2w: ``(V, 4, 4)``.  intrinsics: ``(V, 4)`` pixels.  No
    gradient.
    """
    check("position", position, last=3)
    check("normal", normal, last=3, like=position)
    check("c2w", c2w, last=4, like=position)
    check("intrinsics", intrinsics, last=4, like=position)
    n, views = len(position), len(c2w)
    origin, direction = (position.new_empty(n * views, 3) for _ in range(2))
    distance = position.new_empty(n * views)
    ins = (position, wp.vec3), (normal, wp.vec3), (c2w, wp.mat44), (intrinsics, wp.vec4)
    launch(sight_kernel, n * views, [*((v.detach().contiguous(), kind) for v, kind in ins), float(size), GRAZING,
           (origin, wp.vec3), (direction, wp.vec3), (distance, wp.float32)], position.device)  # fmt: skip
    return scene.clear(origin, direction, distance).view(n, views)
