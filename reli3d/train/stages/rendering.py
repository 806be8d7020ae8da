"""Renderings of the predicted object in training, and their lighting by spherical Gaussians."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from reli3d.nn.model import Code, Reconstructor
from reli3d.render.color import linear_to_srgb
from reli3d.render.gaussians import GOLDEN, OVERLAP, SphericalGaussians

DERIVATIVE_AT_WHITE = 1.055 / 2.4  # of the sRGB curve


@dataclass(frozen=True)
class Rendering:
    """One view of ``H`` by ``W`` pixels."""

    color: Tensor  # (H, W, 3) display values times coverage, above 1 where the surface is brighter than white
    coverage: Tensor  # (H, W)
    known: Tensor  # (H, W) 1 where the maps have values, else 0
    material: Tensor  # (H, W, 5) base color (sRGB), roughness, metallic
    normal: Tensor  # (H, W, 3) shading normal, world, unit
    bump: Tensor  # (N, 3) predicted tangent-space normals of the N covered pixels


def display(radiance: Tensor) -> Tensor:
    """sRGB encoding of linear radiance, continued linearly above 1 so that the gradient does not vanish there."""
    inside = linear_to_srgb(radiance.clamp(max=1.0))
    return inside + DERIVATIVE_AT_WHITE * (radiance - 1.0).clamp(min=0.0)


def lobes(model: Reconstructor, code: Code, count: int) -> SphericalGaussians:
    """The predicted environment as ``count`` equal lobes on a Fibonacci spiral, with the radiance along their axes.

    Constant lighting is exact: equal lobes of sharpness s sum to count (1 - exp(-2 s)) / (2 s).
    """
    k = torch.arange(count, dtype=torch.float64, device=code.latent.device)
    height = 1.0 - 2.0 * (k + 0.5) / count
    turn = 2.0 * math.pi * GOLDEN * k
    horizontal = (1.0 - height * height).sqrt()
    axis = torch.stack([horizontal * turn.cos(), height, horizontal * turn.sin()], -1).float()
    sharpness = OVERLAP * count / (4.0 * math.pi)
    total = count * (1.0 - math.exp(-2.0 * sharpness)) / (2.0 * sharpness)
    amplitude = model.radiance(code, axis[None])[0] / total
    return SphericalGaussians(axis, axis.new_full((count,), sharpness), amplitude)
