"""Photographs of a sample made anew under another light and with another finish, from the maps of its views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from reli3d.geometry.camera import Camera, camera_rays
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from reli3d.synthetic.maps import with_lamps
from reli3d.synthetic.samples import DIFFUSE_MODEL, EXPOSED

SAMPLES = (12, 5, 5)  # light, GGX and cosine samples a pixel: what noise is left, a photograph in poor light has
LAMPS = 0.6  # share of the lights that get lamps
SATURATES = 4.0  # a pixel's radiance, as in reli3d.synthetic.samples
TINT = 0.1  # standard deviation of the logarithm of the light's color
EXPOSURE = 0.35  # the same of the exposure
METAL, PLAIN = 0.08, 0.05  # shares of the objects made all of metal, and without any


@dataclass(frozen=True)
class Finish:
    """One change of all materials of an object, the same in its pixels and at its points."""

    gamma: float  # of the base color, sRGB
    gain: float  # of the roughness
    shift: float
    metallic: float | None  # everywhere, or as it is

    @staticmethod
    def draw(rng: np.random.Generator) -> Finish:
        """Half of the objects stay as they are."""
        if rng.random() < 0.5:
            return Finish(1.0, 1.0, 0.0, None)
        kind = rng.random()
        metallic = 1.0 if kind < METAL else 0.0 if kind < METAL + PLAIN else None
        return Finish(
            float(np.exp(rng.normal(0, 0.35))), float(np.exp(rng.normal(0, 0.25))), float(rng.normal(0, 0.08)), metallic
        )

    def apply(self, material: Tensor) -> Tensor:
        """Of ``material (..., 5)``: base color (sRGB), roughness, metallic."""
        base, rough, metal = material.split([3, 1, 1], -1)
        base = base.clamp(min=1e-6) ** self.gamma
        rough = (rough * self.gain + self.shift).clamp(0.03, 1.0)
        return torch.cat([base, rough, metal if self.metallic is None else torch.full_like(metal, self.metallic)], -1)


def draw_light(lights: Tensor, rng: np.random.Generator) -> Tensor:
    """One of ``lights (n, H, 2H, 3)``, turned, mirrored, tinted, most often with lamps: ``(H, 2H, 3)``."""
    light = lights[int(rng.integers(len(lights)))]
    light = torch.roll(light, int(rng.integers(light.shape[1])), 1)
    if rng.random() < 0.5:
        light = light.flip(1)
    light = light * torch.as_tensor(np.exp(rng.normal(0, TINT, 3)), dtype=torch.float32)
    return with_lamps(light, rng) if rng.random() < LAMPS else light


def relit(
    images: Tensor,
    material: Tensor,
    normal: Tensor,
    valid: Tensor,
    c2w: Tensor,
    intrinsics: Tensor,
    light: Tensor,
    rng: np.random.Generator,
) -> tuple[Tensor, Tensor]:
    """Views ``(V, S, S, 4)`` under ``light (H, 2H, 3)``, and that light as ``(32, 64, 3)`` at the views' exposure.

    images: ``(V, S, S, 4)``, of which the alpha is kept.  material, normal: of the pixels ``valid (V, S, S)``, as in
    :mod:`reli3d.synthetic.samples`.  Objects cast no shadow on themselves here; the stored images have shadows.
    """
    views, size = images.shape[:2]
    environment = Environment(light.contiguous())
    directions = torch.stack([camera_rays(Camera(c2w[k], intrinsics[k], size, size))[1] for k in range(views)])
    directions = directions.reshape(views, size, size, 3)
    wo = -directions[valid]
    n = functional.normalize(normal[valid], dim=-1)
    behind = (n * wo).sum(-1, keepdim=True)
    n = functional.normalize(n + (0.02 - behind).clamp(min=0.0) * wo, dim=-1)  # a mean of normals may face away
    paint = material[valid]
    points = SurfacePoints(torch.zeros_like(n), n, n, srgb_to_linear(paint[:, :3]), paint[:, 3], paint[:, 4])
    options = ShadeOptions(samples=SAMPLES, seed=int(rng.integers(1 << 30)), diffuse_model=DIFFUSE_MODEL)
    radiance = shade(points, wo, environment, options=options)
    first_view = int(valid[0].sum()) or len(radiance)
    bright = float(radiance[:first_view].mean(-1).quantile(0.9))
    exposure = EXPOSED / max(bright, 1e-3) * float(np.exp(rng.normal(0, EXPOSURE)))
    surface = torch.zeros(views, size, size, 4)
    surface[valid] = functional.pad(radiance, (0, 1), value=1.0)
    around = functional.avg_pool2d(surface.permute(0, 3, 1, 2), 3, 1, 1).permute(0, 2, 3, 1)  # for pixels of the edge
    surface = torch.where(valid[..., None], surface[..., :3], around[..., :3] / around[..., 3:].clamp(min=1e-3))
    alpha = images[..., 3:]
    background = environment.lookup(directions.reshape(-1, 3)).reshape(surface.shape)
    linear = ((alpha * surface + (1 - alpha) * background) * exposure).clamp(0, SATURATES).clamp(max=1.0)
    kept = functional.interpolate((light * exposure).permute(2, 0, 1)[None], (32, 64), mode="area")
    return torch.cat([linear_to_srgb(linear), alpha], -1), kept[0].permute(1, 2, 0).clamp(max=6e4)
