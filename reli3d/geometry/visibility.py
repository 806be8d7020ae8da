"""Visibility of surface points in posed cameras."""

import torch
import warp as wp
from torch import Tensor

from reli3d._bridge import check, launch
from reli3d.geometry.camera import Camera, check_camera
from reli3d.geometry.rays import RayScene
from reli3d.kernels.rays import sight_kernel

MIN_COSINE = 0.05  # between normal and view direction: below it a pixel covers more than 20 times its width of surface


def visible_from(
    scene: RayScene, position: Tensor, normal: Tensor, camera: Camera, active: Tensor | None = None
) -> Tensor:
    """``(N, V)`` bool: whether each point faces the camera, projects into the image and is not occluded.

    position, normal: ``(N, 3)`` world, normals unit.  camera: a batch of V views.  active: ``(N, V)`` bool, the pairs
    to test; all others are False.  No gradient.  Raises TypeError for a wrong dtype, ValueError for a wrong shape or
    device.
    """
    check("position", position, last=3)
    check("normal", normal, last=3, like=position)
    check_camera(camera, like=position)
    n, views = len(position), len(camera.c2w)
    pair = torch.empty(0, dtype=torch.int32, device=position.device)  # all
    if active is not None:
        check("active", active, shape=(n, views), like=position, dtype=torch.bool)
        pair = active.T.reshape(-1).nonzero()[:, 0].int()
    count = n * views if active is None else len(pair)
    origin, direction = (position.new_empty(count, 3) for _ in range(2))
    distance = position.new_empty(count)
    arrays = [v.detach().contiguous() for v in (position, normal, camera.c2w, camera.intrinsics, pair)]
    size = wp.vec2(float(camera.width), float(camera.height))
    launch(sight_kernel, count, [*arrays, size, MIN_COSINE, scene.scale, origin, direction, distance], position.device)
    free = scene.unoccluded(origin, direction, distance)
    if active is not None:
        free = active.T.clone(memory_format=torch.contiguous_format).masked_scatter_(active.T, free)
    return free.view(views, n).T.contiguous()
