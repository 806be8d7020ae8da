"""Environment estimation from surface radiance: splatting into lat-long maps, completed by a U-Net on the sphere.

Glossy pixels reflect the light from their mirror direction, diffuse ones the light around their normal.  Both are
splatted bilinearly into lat-long maps.  The U-Net completes unobserved directions, equivariant to rotation about +Y by
multiples of the coarsest texel.  It was trained on maps with -Z at the horizontal center and +X to its right; the
result has the layout of :mod:`reli3d.render.latlong`.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.nn.presets import LightMapSizes
from reli3d.render.latlong import lat_long_directions, lat_long_texels

LOG_OFFSET = 0.01  # added to a radiance before its logarithm
MIN_ALBEDO = 0.04  # added to the albedo that a radiance is divided by: the normal reflectance of a dielectric
CHANNELS = 14
MAX_LOG_RADIANCE = 12.0


def trained_texels(directions: Tensor, height: int) -> tuple[Tensor, Tensor]:
    """:func:`lat_long_texels` of unit world ``directions (N, 3)`` in the layout of the training maps."""
    x, y, z = directions.unbind(-1)
    return lat_long_texels(torch.stack([-z, y, x], -1), height)


def splat(values: Tensor, weight: Tensor, footprint: tuple[Tensor, Tensor], height: int) -> tuple[Tensor, Tensor]:
    """Weighted mean ``(C, H, 2H)`` of ``values (N, C)`` in each texel, and log(1 + total weight) ``(1, H, 2H)``.

    footprint: of :func:`trained_texels`.
    """
    texels, coverage = footprint
    weight = weight[:, None] * coverage
    total = weight.new_zeros(2 * height * height).index_add(0, texels.flatten(), weight.flatten())
    weighted = (weight[..., None] * values[:, None]).flatten(0, 1)
    summed = values.new_zeros(len(total), values.shape[1]).index_add(0, texels.flatten(), weighted)
    mean = summed / total.clamp(min=1e-4)[:, None]
    shape = (height, 2 * height)
    return mean.T.reshape(-1, *shape), torch.log1p(total).reshape(1, *shape)


class _Block(nn.Module):
    """3x3 convolution on a lat-long map: circular padding in azimuth, replicated rows at the poles."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1):
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride=stride)
        self.norm = nn.GroupNorm(max(1, outputs // 8), outputs)

    def forward(self, x: Tensor) -> Tensor:
        x = functional.pad(functional.pad(x, (1, 1, 0, 0), mode="circular"), (0, 0, 1, 1), mode="replicate")
        return functional.silu(self.norm(self.conv(x)))


class LightMap(nn.Module):
    """Log radiance ``(3, H, 2H)`` of the environment from pixels of all views."""

    def __init__(self, sizes: LightMapSizes):
        super().__init__()
        widths = sizes.widths
        self.height = sizes.height
        self.first = _Block(CHANNELS, widths[0])
        self.down = nn.ModuleList(
            nn.Sequential(_Block(a, b, 2), _Block(b, b)) for a, b in zip(widths[:-1], widths[1:], strict=True)
        )
        self.across = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.up = nn.ModuleList(_Block(a, a) for a in widths[:-1])
        self.out = nn.Conv2d(widths[0], 3, 1)
        for value in self.out.parameters():
            nn.init.zeros_(value)

    def forward(self, radiance: Tensor, albedo: Tensor, gloss: Tensor, normal: Tensor, wo: Tensor) -> Tensor:
        """radiance, albedo: ``(N, 3)`` linear.  gloss: ``(N,)`` in [0, 1].  normal, wo: ``(N, 3)`` unit, world."""
        facing = (normal * wo).sum(-1).clamp(min=0.0)
        mirror = functional.normalize(2.0 * facing[:, None] * normal - wo, dim=-1)
        log = (radiance + LOG_OFFSET).log()
        demodulated = log - (albedo + MIN_ALBEDO).log()
        mean = (demodulated * facing[:, None]).sum(0) / facing.sum().clamp(min=1e-4)
        scale = 256.0 / max(1, len(radiance))  # makes weights independent of the views' resolution
        reflected, weight = torch.cat([log - mean, demodulated - mean], -1), facing * (0.05 + gloss) * scale
        shown = splat(reflected, weight, trained_texels(mirror, self.height), self.height)
        under = splat(demodulated - mean, facing * scale, trained_texels(normal, self.height), self.height)
        y = lat_long_directions(self.height, device=radiance.device)[..., 1][None]
        x = torch.cat([*shown, *under, y, y.square(), torch.ones_like(y) * mean.mean()])
        levels = [self.first(x[None])]
        for down in self.down:
            levels.append(down(levels[-1]))
        x = levels[-1]
        for across, up, finer in zip(reversed(self.across), reversed(self.up), reversed(levels[:-1]), strict=True):
            wrapped = functional.pad(across(x), (1, 1, 0, 0), mode="circular")
            coarse = functional.interpolate(wrapped, scale_factor=2, mode="bilinear", align_corners=False)
            x = up(finer + coarse[..., 2:-2])
        log = (self.out(x)[0] + mean[:, None, None]).clamp(max=MAX_LOG_RADIANCE)
        return log.roll(-(self.height // 2), 2)  # by a quarter of the width: +X at the horizontal center
