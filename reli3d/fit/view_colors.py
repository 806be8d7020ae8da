"""Colors of the input images at surface points, and the weights of the views there."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from reli3d.fit.input_images import InputImages
from reli3d.fit.unknowns import unit
from reli3d.geometry.camera import Camera, project
from reli3d.geometry.rays import RayScene
from reli3d.geometry.visibility import visible_from
from reli3d.render.color import linear_to_srgb

MIN_COVERAGE = 0.9  # of the mask, from which a color is used: pixels at the rim contain background
FULL_WEIGHT_COSINE = 0.2  # between normal and direction to the eye, from which a view has its full weight


def view_colors(display: Tensor, position: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Samples colors ``(N, V, 3)`` and coverage ``(N, V)`` of the images at the projections of ``position (N, 3)``.

    display: ``(V, 4, S, S)``, from :func:`display_planes`.  camera: batch of V.  Bilinear.  Gradients reach
    ``position`` and the cameras.
    """
    pixels, _ = project(position[None], camera.c2w[:, None], camera.intrinsics[:, None])
    where = 2.0 * pixels[:, :, None] / camera.width - 1.0
    values = grid_sample(display, where, mode="bilinear", padding_mode="zeros", align_corners=False)[..., 0]
    cover = values[:, 3]
    return (values[:, :3] / cover.clamp(min=1e-2)[:, None]).permute(2, 0, 1), cover.T


def display_planes(images: InputImages) -> Tensor:
    """``(V, 4, S, S)``: display values times coverage, and coverage."""
    planes = images.color.new_empty(len(images), 4, images.size, images.size)
    for k, (color, mask) in enumerate(zip(images.color, images.mask, strict=True)):  # one at a time: less memory
        planes[k, :3] = (linear_to_srgb(color.clamp(0.0, 1.0)) * mask[..., None]).permute(2, 0, 1)
        planes[k, 3] = mask
    return planes


@torch.no_grad()
def view_weights(scene: RayScene, position: Tensor, normal: Tensor, camera: Camera) -> Tensor:
    """View weights ``(N, V)`` in [0, 1]: visibility times the cosine of the viewing angle over ``FULL_WEIGHT_COSINE``.

    The quotient is clamped to [0, 1].  No gradient: otherwise the loss could be reduced by turning the surface away
    from the cameras.
    """
    visible = visible_from(scene, position, normal, camera)
    to_eye = unit(camera.c2w[None, :, :3, 3] - position[:, None])
    return visible * ((to_eye * normal[:, None]).sum(-1) / FULL_WEIGHT_COSINE).clamp(0.0, 1.0)
