"""Lighting that the input images show directly: their background, assumed far away."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from reli3d.fit.input_images import SATURATED_LINEAR, InputImages
from reli3d.fit.light_hue import with_scaled_light
from reli3d.fit.unknowns import LIGHT_ROWS, MIN_RELATIVE_RADIANCE, Start
from reli3d.geometry.camera import camera_rays
from reli3d.render.asset import Asset
from reli3d.render.latlong import lat_long_texels, texel_solid_angles

MAX_COVERAGE = 0.02  # of the object in a pixel of the background
MAX_CLIPPED = 0.002  # fraction of saturated pixels in a texel whose mean is not a lower bound; a lamp is small
MIN_FRACTION = 0.05  # of the sphere; if less is observed, it does not scale the whole lighting
MAX_SCALE = 4.0  # of a channel


@dataclass(frozen=True)
class Background:
    """Mean radiance ``(G, h, 2h, 3)`` of the background pixels in each texel, for G lightings.

    observed: ``(G, h, 2h, 1)``, fraction of each texel that the pixels cover.  clipped: ``(G, h, 2h, 3)`` bool, where
    some are saturated, so that the mean is a lower bound.
    """

    radiance: Tensor
    observed: Tensor
    clipped: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, images: InputImages) -> Background:
        """The background of uncropped images.  Raises ValueError if their lighting is fixed to the camera."""
        if images.light_frame == "camera":
            raise ValueError("surroundings: expected lighting that does not move with the camera, got light camera")
        groups, texels = max(images.light_group) + 1, LIGHT_ROWS * 2 * LIGHT_ROWS
        rotations = images.light_rotations
        sums = images.color.new_zeros(groups * texels, 7)  # solid angle times radiance, saturation and 1
        for view, group in enumerate(images.light_group):
            index, values = _pixels(images, view, None if rotations is None else rotations[view])
            sums.index_add_(0, index + group * texels, values)
        sums = sums.view(groups, LIGHT_ROWS, 2 * LIGHT_ROWS, 7)
        angle = sums[..., 6:].clamp(min=1e-12)
        observed = (sums[..., 6:] / _texel_angles(sums)).clamp(max=1.0)
        return cls(sums[..., :3] / angle, observed, sums[..., 3:6] > MAX_CLIPPED * angle)

    @torch.no_grad()
    def scaled(self, asset: Asset, start: Start) -> Asset:
        """``asset`` with its lighting scaled per channel to the background's mean radiance where that is observed.

        start: of ``asset``.  The base color is divided by the factor, so that diffuse colors do not change.  If less
        than MIN_FRACTION of the sphere is observed, the asset is unchanged.
        """
        weight = _texel_angles(self.observed) * self.observed
        if float(weight.sum()) < MIN_FRACTION * 4.0 * math.pi * len(weight):
            return asset
        own = start.light.exp()
        background, before = ((weight * value).sum((0, 1, 2)) for value in (self._bounded(own), own))
        factor = background / before.clamp(min=1e-12)
        return with_scaled_light(asset, factor.clamp(1.0 / MAX_SCALE, MAX_SCALE))

    @torch.no_grad()
    def over(self, start: Start) -> Start:
        """``start`` with the background as its lighting where that is observed."""
        own = start.light.exp()
        light = self._bounded(own).clamp(min=MIN_RELATIVE_RADIANCE * float(own.mean())).log()
        light = torch.lerp(start.light.expand_as(light), light, self.observed)
        return replace(start, light=light, observed=self.observed, clipped=self.clipped)

    def _bounded(self, own: Tensor) -> Tensor:
        """The radiance; at least ``own`` where it is a lower bound."""
        return torch.where(self.clipped, torch.maximum(self.radiance, own), self.radiance)


def _texel_angles(like: Tensor) -> Tensor:
    return texel_solid_angles(LIGHT_ROWS, 2 * LIGHT_ROWS, like.device).to(like)[:, None, None]


def _pixels(images: InputImages, view: int, rotation: Tensor | None) -> tuple[Tensor, Tensor]:
    """Texels ``(4 N,)`` of a view's background pixels and, weighted with their solid angles there, 7 values each."""
    clear, camera = images.mask[view] < MAX_COVERAGE, images.camera[view]
    directions = camera_rays(camera)[1][clear]
    angle = (directions @ -camera.c2w[:3, 2]).pow(3) / (camera.intrinsics[0] * camera.intrinsics[1])
    if rotation is not None:
        directions = directions @ rotation
    index, weight = lat_long_texels(directions.contiguous(), LIGHT_ROWS)
    color = images.color[view][clear]
    pixel = torch.cat([color, (color > SATURATED_LINEAR).to(color), torch.ones_like(color[:, :1])], 1)
    return index.reshape(-1), ((angle[:, None] * weight)[..., None] * pixel[:, None]).reshape(-1, 7)
