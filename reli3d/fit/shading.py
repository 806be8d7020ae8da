"""The one place where a fit asks the renderer for radiance."""

from __future__ import annotations

from torch import Tensor

from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import SurfacePoints
from reli3d.render.shading import shade

PAINT = "published"  # glTF's own formula: what viewers show, and what the shipped weights learned from


def radiance(points: SurfacePoints, wo: Tensor, light: Environment, *, samples: tuple[int, int, int],
             scene: RayScene | None, seed: int) -> Tensor:  # fmt: skip
    """Radiance ``(N, 3)`` that leaves ``points`` towards ``wo``: direct light with shadows, linear."""
    return shade(points.position, points.normal, points.ng, wo, points.base_color, points.roughness, points.metallic,
                 light, samples=samples, scene=scene, seed=seed, paint=PAINT)  # fmt: skip
