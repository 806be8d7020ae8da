"""Which cameras see a point of a surface."""

from __future__ import annotations

import warp as wp
from torch import Tensor

from reli3d._bridge import check, launch
from reli3d.geometry.camera import Camera, check_camera
from reli3d.geometry.rays import RayScene
from reli3d.kernels.intersect import sight_kernel

GRAZING = 0.05  # cosine below which a pixel smears over 20 times its width of surface and says nothing about the point


def visible_from(scene: RayScene, position: Tensor, normal: Tensor, camera: Camera) -> Tensor:
    """``(N, V)`` bool: the point faces the camera, projects into its image and nothing stands between.

    position, normal: ``(N, 3)`` world, the normal unit.  camera: of V views.  No gradient.
    """
    check("position", position, last=3)
    check("normal", normal, last=3, like=position)
    check_camera(camera, like=position)
    n, views = len(position), len(camera.c2w)
    origin, direction = (position.new_empty(n * views, 3) for _ in range(2))
    distance = position.new_empty(n * views)
    ins = (position, wp.vec3), (normal, wp.vec3), (camera.c2w, wp.mat44), (camera.intrinsics, wp.vec4)
    outs = (origin, wp.vec3), (direction, wp.vec3), (distance, wp.float32)
    arrays = [(v.detach().contiguous(), kind) for v, kind in ins]
    size = wp.vec2(float(camera.width), float(camera.height))
    launch(sight_kernel, n * views, [*arrays, size, GRAZING, *outs], position.device)
    return scene.unoccluded(origin, direction, distance).view(n, views)
