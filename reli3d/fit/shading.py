"""The one place where a fit asks the renderer for radiance."""

from __future__ import annotations

from torch import Tensor

from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade

DIFFUSE_MODEL = "published"  # glTF's own formula: what viewers show, and what the shipped weights learned from


def radiance(
    points: SurfacePoints,
    wo: Tensor,
    light: Environment,
    *,
    samples: tuple[int, int, int],
    scene: RayScene | None,
    seed: int,
) -> Tensor:
    """Radiance ``(N, 3)`` that leaves ``points`` towards ``wo``: direct light with shadows, linear."""
    options = ShadeOptions(samples=samples, seed=seed, diffuse_model=DIFFUSE_MODEL)
    return shade(points, wo, light, scene=scene, options=options)
