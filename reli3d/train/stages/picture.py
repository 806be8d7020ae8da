"""What a stage shows of the predicted object, and the light that it shows it in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from reli3d.nn.model import Code, Reconstructor
from reli3d.render.color import linear_to_srgb
from reli3d.render.gaussians import GOLDEN, OVERLAP, SphericalGaussians

SLOPE_AT_WHITE = 1.055 / 2.4  # of the sRGB curve


@dataclass(frozen=True)
class Picture:
    """One view of ``H`` by ``W`` pixels.

    color: ``(H, W, 3)`` display values times coverage, above 1 where the surface is brighter than white.  cover:
    ``(H, W)``.  known: ``(H, W)`` 1 where the maps have values, else 0.  material: ``(H, W, 5)`` base color (sRGB),
    roughness, metallic.  normal: ``(H, W, 3)`` of shading, world, unit.
    bump: ``(N, 3)`` tangent-space normals that were asked for, of the pixels that show something.
    """

    color: Tensor
    cover: Tensor
    known: Tensor
    material: Tensor
    normal: Tensor
    bump: Tensor


def display(radiance: Tensor) -> Tensor:
    """sRGB of linear radiance; beyond 1 along the tangent, so that what is too bright still has a slope."""
    inside = linear_to_srgb(radiance.clamp(max=1.0))
    return inside + SLOPE_AT_WHITE * (radiance - 1.0).clamp(min=0.0)


def lobes(model: Reconstructor, code: Code, count: int) -> SphericalGaussians:
    """The predicted light as ``count`` even lobes on a spiral, each as bright as the light at its axis.

    Constant light stays constant: the sum of even lobes of sharpness s is count (1 - exp(-2 s)) / (2 s).  Gradients
    reach all that makes the light.  Detail finer than a lobe, such as a sun, is met or missed, as axes fall.
    """
    k = torch.arange(count, dtype=torch.float64, device=code.latent.device)
    height = 1.0 - 2.0 * (k + 0.5) / count
    turn = 2.0 * math.pi * GOLDEN * k
    level = (1.0 - height * height).sqrt()
    axis = torch.stack([level * turn.cos(), height, level * turn.sin()], -1).float()
    sharpness = OVERLAP * count / (4.0 * math.pi)
    total = count * (1.0 - math.exp(-2.0 * sharpness)) / (2.0 * sharpness)
    amplitude = model.radiance(code, axis[None])[0] / total
    return SphericalGaussians(axis, axis.new_full((count,), sharpness), amplitude)
