"""What the photographs show at points of a surface."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from reli3d.fit.photographs import Photographs
from reli3d.fit.unknowns import unit
from reli3d.geometry.camera import Camera, project
from reli3d.geometry.rays import RayScene
from reli3d.geometry.visibility import visible_from
from reli3d.render.color import linear_to_srgb

COVERED = 0.9  # coverage from which a colour counts: less of it is the object's rim
LEAST = 0.2  # cosine of the view from which a colour counts in full


def seen_colors(display: Tensor, position: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Colours ``(N, V, 3)`` and coverage ``(N, V)`` of the photographs where ``position (N, 3)`` projects.

    display: ``(V, 4, S, S)``, display values times coverage, and coverage.  camera: of all V.  Gradients reach the
    points and the cameras.
    """
    pixels, _ = project(position[None], camera.c2w[:, None], camera.intrinsics[:, None])
    where = 2.0 * pixels[:, :, None] / camera.width - 1.0
    values = grid_sample(display, where, mode="bilinear", padding_mode="zeros", align_corners=False)[..., 0]
    cover = values[:, 3]
    return (values[:, :3] / cover.clamp(min=1e-2)[:, None]).permute(2, 0, 1), cover.T


def display_planes(photographs: Photographs) -> Tensor:
    """What :func:`seen_colors` reads, ``(V, 4, S, S)``: display values times coverage, and coverage."""
    shown = linear_to_srgb(photographs.color.clamp(0.0, 1.0)) * photographs.mask[..., None]
    return torch.cat([shown, photographs.mask[..., None]], -1).permute(0, 3, 1, 2).contiguous()


@torch.no_grad()
def sight(scene: RayScene, position: Tensor, normal: Tensor, camera: Camera) -> Tensor:
    """How well each camera sees the points, ``(N, V)`` in [0, 1]: 0 where they are hidden, less where they are grazed.

    No gradient: no surface shall turn away to be seen less.
    """
    seen = visible_from(scene, position, normal, camera)
    to_eye = unit(camera.c2w[None, :, :3, 3] - position[:, None])
    return seen * ((to_eye * normal[:, None]).sum(-1) / LEAST).clamp(0.0, 1.0)
