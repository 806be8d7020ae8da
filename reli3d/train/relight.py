"""Renders the views of a sample again under another environment and with changed materials, from its G-buffers."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from reli3d.geometry.camera import Camera, camera_rays
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.material import eval_bsdf
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from reli3d.synthetic.maps import with_lamps
from reli3d.synthetic.samples import DIFFUSE_MODEL, EXPOSURE_TARGET

SAMPLES = (12, 5, 5)  # light, GGX and cosine samples per pixel: the remaining noise is that of a photograph
LAMP_PROBABILITY = 0.6  # of lamps added to an environment
SATURATES = 4.0  # a pixel's radiance, as in reli3d.synthetic.samples
TINT_SIGMA = 0.1  # standard deviation of the logarithm of the color of the lighting
EXPOSURE = 0.35  # standard deviation of the logarithm of the exposure
FLASH_PROBABILITY = 0.15  # of a light at every camera, as the flash of a phone
FLASH_RATIO = 0.5, 8.0  # of the object's mean radiance under it to that under the environment
UNCHANGED_MATERIAL_PROBABILITY = 0.3  # of the materials of a relit sample
METAL_PROBABILITY, DIELECTRIC_PROBABILITY = 0.08, 0.25  # of metallic set to 1, and to 0, everywhere
GLOSSY_PROBABILITY, GLOSSY_GAIN = 0.4, 0.45  # of dielectrics whose roughness is multiplied: glazes, varnish, plastic


@dataclass(frozen=True)
class Finish:
    """A change of all materials of an object, applied alike to its pixels and points."""

    gamma: float  # exponent of the base color, sRGB
    gain: float  # of the roughness
    shift: float  # of the roughness
    metallic: float | None  # value everywhere; None: unchanged

    @staticmethod
    def draw(rng: np.random.Generator) -> "Finish":
        """A random change; the identity with probability ``UNCHANGED_MATERIAL_PROBABILITY``."""
        if rng.random() < UNCHANGED_MATERIAL_PROBABILITY:
            return Finish(1.0, 1.0, 0.0, None)
        kind = rng.random()
        metallic = (
            1.0 if kind < METAL_PROBABILITY else 0.0 if kind < METAL_PROBABILITY + DIELECTRIC_PROBABILITY else None
        )
        gloss = GLOSSY_GAIN if metallic == 0.0 and rng.random() < GLOSSY_PROBABILITY else 1.0
        gamma, gain = (float(np.exp(rng.normal(0, sigma))) for sigma in (0.35, 0.25))
        return Finish(gamma, gloss * gain, float(rng.normal(0, 0.08)), metallic)

    def apply(self, material: Tensor) -> Tensor:
        """Changed ``material (..., 5)``: base color (sRGB), roughness, metallic."""
        base, rough, metal = material.split([3, 1, 1], -1)
        base = base.clamp(min=1e-6) ** self.gamma
        rough = (rough * self.gain + self.shift).clamp(0.03, 1.0)
        return torch.cat([base, rough, metal if self.metallic is None else torch.full_like(metal, self.metallic)], -1)


def draw_light(lights: Tensor, rng: np.random.Generator) -> Tensor:
    """A random map ``(H, 2H, 3)`` of ``lights (n, H, 2H, 3)``, rotated, mirrored, tinted, often with added lamps."""
    light = lights[int(rng.integers(len(lights)))]
    light = torch.roll(light, int(rng.integers(light.shape[1])), 1)
    if rng.random() < 0.5:
        light = light.flip(1)
    light = light * torch.as_tensor(np.exp(rng.normal(0, TINT_SIGMA, 3)), dtype=torch.float32)
    return with_lamps(light, rng) if rng.random() < LAMP_PROBABILITY else light


def draw_flash(rng: np.random.Generator) -> float:
    """Random ``flash`` of :func:`relight_views`; 0 with probability 1 - ``FLASH_PROBABILITY``."""
    return float(np.exp(rng.uniform(*np.log(FLASH_RATIO)))) if rng.random() < FLASH_PROBABILITY else 0.0


def relight_views(
    images: Tensor,
    material: Tensor,
    normal: Tensor,
    valid: Tensor,
    camera: Camera,
    light: Tensor,
    rng: np.random.Generator,
    flash: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Views ``(V, S, S, 4)`` under ``light (H, 2H, 3)``, and that map as ``(32, 64, 3)`` at the views' exposure.

    images: ``(V, S, S, 4)``, of which only alpha is used.  material, normal: of the pixels ``valid (V, S, S)``, as in
    :mod:`reli3d.synthetic.samples`.  flash: mean radiance of the object under a light at each camera, relative to that
    under ``light``.  Without shadows: the G-buffers have no geometry behind other surfaces.
    """
    views, size = images.shape[:2]
    light = light.to(images.device)
    environment = Environment(light.contiguous())
    directions = camera_rays(camera)[1]
    wo = -directions[valid]
    n = functional.normalize(normal[valid], dim=-1)
    behind = (n * wo).sum(-1, keepdim=True)
    n = functional.normalize(n + (0.02 - behind).clamp(min=0.0) * wo, dim=-1)  # an average of normals may face away
    base, rough, metal = material[valid].split([3, 1, 1], -1)
    points = SurfacePoints(torch.zeros_like(n), n, n, srgb_to_linear(base), rough[:, 0], metal[:, 0])
    options = ShadeOptions(samples=SAMPLES, seed=int(rng.integers(1 << 30)), diffuse_model=DIFFUSE_MODEL)
    radiance = shade(points, wo, environment, options=options)
    if flash:
        cosine = (points.normal * wo).sum(-1).clamp(0.0, 1.0)
        local = torch.stack([(1.0 - cosine * cosine).sqrt(), torch.zeros_like(cosine), cosine], -1)
        width = points.roughness * points.roughness
        bsdf = eval_bsdf(local, points.base_color, width, points.metallic, local, diffuse_model=DIFFUSE_MODEL)
        lit = bsdf * cosine[:, None]  # under unit irradiance from the camera
        radiance = radiance + lit * (flash * radiance.mean() / lit.mean().clamp(min=1e-6))
    first_view = int(valid[0].sum()) or len(radiance)
    bright = float(radiance[:first_view].mean(-1).quantile(0.9))
    exposure = EXPOSURE_TARGET / max(bright, 1e-3) * float(np.exp(rng.normal(0, EXPOSURE)))
    surface = images.new_zeros(views, size, size, 4)
    surface[valid] = functional.pad(radiance, (0, 1), value=1.0)
    around = functional.avg_pool2d(surface.permute(0, 3, 1, 2), 3, 1, 1).permute(0, 2, 3, 1)  # for pixels of the edge
    around = torch.where(around[..., 3:] > 0.0, around[..., :3] / around[..., 3:].clamp(min=1e-3), radiance.mean(0))
    surface = torch.where(valid[..., None], surface[..., :3], around)
    alpha = images[..., 3:]
    background = environment.lookup(directions.reshape(-1, 3)).reshape(surface.shape)
    linear = ((alpha * surface + (1 - alpha) * background) * exposure).clamp(0, SATURATES).clamp(max=1.0)
    kept = functional.interpolate((light * exposure).permute(2, 0, 1)[None], (32, 64), mode="area")
    return torch.cat([linear_to_srgb(linear), alpha], -1), kept[0].permute(1, 2, 0).clamp(max=6e4)
