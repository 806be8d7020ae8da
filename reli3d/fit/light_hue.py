"""Chromaticity of a start's lighting: reduced, because part of it belongs to the object."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from reli3d.render.asset import Asset
from reli3d.render.environment import Environment
from reli3d.render.latlong import texel_solid_angles

# Slope of the true against the predicted mean log chromaticity of the lighting on 20 validation samples: 0.12 between
# green and magenta, 0.27 between red and blue.
CHROMATICITY_WEIGHT = 0.25
MAX_FACTOR = 1.5  # largest change of a channel; lightings with a stronger color are not in the samples
MIN_RADIANCE = 1e-6  # the logarithm must be finite


@torch.no_grad()
def with_neutral_light(asset: Asset, weight: float = CHROMATICITY_WEIGHT) -> Asset:
    """``asset`` with less saturated lighting: log chromaticity of its mean radiance times ``weight``.

    The factor of a channel is limited to [1 / MAX_FACTOR, MAX_FACTOR].  The base color is divided by it and clipped at
    1; below, diffuse colors in images do not change.
    Highlights of dielectrics have the color of the lighting, so images are less saturated than base colors; a
    prediction from images therefore assigns part of the object's color to the lighting.
    """
    radiance = asset.light.radiance
    angle = texel_solid_angles(*radiance.shape[:2]).to(radiance)[:, None, None]
    color = ((angle * radiance).sum((0, 1)) / (4.0 * math.pi)).clamp(min=MIN_RADIANCE).log()
    factor = ((weight - 1.0) * (color - color.mean())).exp().clamp(1.0 / MAX_FACTOR, MAX_FACTOR)
    return with_scaled_light(asset, factor)


@torch.no_grad()
def with_scaled_light(asset: Asset, factor: Tensor) -> Asset:
    """``asset`` with its lighting times ``factor (3,)`` and its base color divided by it, clipped at 1."""
    textures = replace(asset.textures, base_color=(asset.textures.base_color / factor).clamp(max=1.0))
    return replace(asset, textures=textures, environment=Environment(asset.light.radiance * factor))
