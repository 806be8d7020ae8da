"""Lighting that the input images show directly: their background, taken to be far away."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from reli3d.fit.input_images import SATURATED_LINEAR, InputImages
from reli3d.fit.unknowns import LIGHT_ROWS, MIN_RELATIVE_RADIANCE, Start
from reli3d.geometry.camera import camera_rays
from reli3d.render.asset import Asset
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_texels, texel_solid_angles

MAX_COVERAGE = 0.02  # of the object, up to which a pixel shows the background alone
MAX_CLIPPED = 0.05  # share of saturated pixels up to which the mean of a texel is its radiance, not a lower bound
MIN_SHARE = 0.05  # of the sphere; of less, the brightness of the whole lighting is not inferred
MAX_FACTOR = 4.0  # largest change of a channel


@dataclass(frozen=True)
class Background:
    """Radiance ``(G, h, 2h, 3)`` of G lightings, the mean over the pixels of each texel.

    seen: ``(G, h, 2h, 1)``, share of each texel that images show.  clipped: ``(G, h, 2h, 3)`` bool, where pixels are
    saturated, so that the mean is a lower bound.
    """

    radiance: Tensor
    seen: Tensor
    clipped: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, images: InputImages) -> Background:
        """The background of photographs without crop, whose lighting is not fixed to the camera."""
        groups, texels = max(images.light_group) + 1, LIGHT_ROWS * 2 * LIGHT_ROWS
        sums = images.color.new_zeros(groups * texels, 7)  # solid angle times radiance, saturation and 1
        for view, group in enumerate(images.light_group):
            index, values = _pixels(images, view)
            sums.index_add_(0, index + group * texels, values)
        sums = sums.view(groups, LIGHT_ROWS, 2 * LIGHT_ROWS, 7)
        angle = sums[..., 6:].clamp(min=1e-12)
        area = texel_solid_angles(LIGHT_ROWS, 2 * LIGHT_ROWS, sums.device).to(sums)[:, None, None]
        seen = (sums[..., 6:] / area).clamp(max=1.0)
        return cls(sums[..., :3] / angle, seen, sums[..., 3:6] > MAX_CLIPPED * angle)

    @torch.no_grad()
    def scaled(self, asset: Asset, start: Start) -> Asset:
        """``asset`` with the lighting of ``start`` as bright, per channel, as the background where that is seen.

        The base color is divided by the factor, so that diffuse colors stay the same, and clipped at 1.  Saturated
        texels do not count.  With less than MIN_SHARE of the sphere, the asset is unchanged.
        """
        area = texel_solid_angles(LIGHT_ROWS, 2 * LIGHT_ROWS, self.seen.device).to(self.seen)[:, None, None]
        weight = area * self.seen * ~self.clipped.any(-1, keepdim=True)
        total = weight.sum() / len(weight)
        if float(total) < MIN_SHARE * float(area.sum()) * 2 * LIGHT_ROWS:
            return asset
        ratio = self._log(start) - start.light
        factor = ((weight * ratio).sum((0, 1, 2)) / weight.sum()).exp().clamp(1.0 / MAX_FACTOR, MAX_FACTOR)
        base_color = (asset.textures.base_color / factor).clamp(max=1.0)
        environment = Environment(asset.light.radiance * factor)
        return replace(asset, textures=replace(asset.textures, base_color=base_color), environment=environment)

    @torch.no_grad()
    def over(self, start: Start) -> Start:
        """``start`` with the background as its lighting where that is seen; at least its own where that is clipped."""
        light = self._log(start)
        light = torch.where(self.clipped, torch.maximum(light, start.light), light)
        light = torch.lerp(start.light.expand_as(light), light, self.seen)
        return replace(start, light=light, seen=self.seen, clipped=self.clipped)

    def _log(self, start: Start) -> Tensor:
        return self.radiance.clamp(min=MIN_RELATIVE_RADIANCE * float(start.light.exp().mean())).log()


def _pixels(images: InputImages, view: int) -> tuple[Tensor, Tensor]:
    """Texels ``(4 N,)`` of a view's background pixels, and for each its share of their solid angle, ``(4 N, 7)``."""
    clear, camera = images.mask[view] < MAX_COVERAGE, images.camera[view]
    directions = camera_rays(camera)[1][clear]
    angle = 1.0 / (camera.intrinsics[0] * camera.intrinsics[1])  # of a pixel at the image center, about that of all
    if images.light_rotations is not None:
        directions = directions @ images.light_rotations[view]
    index, share = lat_long_texels(directions.contiguous(), LIGHT_ROWS)
    color = images.color[view][clear]
    pixel = torch.cat([color, (color > SATURATED_LINEAR).to(color), torch.ones_like(color[:, :1])], 1)
    return index.reshape(-1), ((angle * share)[..., None] * pixel[:, None]).reshape(-1, 7)
