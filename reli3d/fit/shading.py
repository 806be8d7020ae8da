"""Direct lighting with the BRDF of a fit."""

from __future__ import annotations

from torch import Tensor

from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade

DIFFUSE_MODEL = "published"  # glTF's formula: that of viewers and of the shipped weights' training data


def radiance(
    points: SurfacePoints,
    wo: Tensor,
    light: Environment,
    *,
    samples: tuple[int, int, int],
    scene: RayScene | None,
    seed: int,
) -> Tensor:
    """Linear radiance ``(N, 3)`` from ``points`` towards ``wo (N, 3)`` by direct light.  scene: None: no shadows."""
    options = ShadeOptions(samples=samples, seed=seed, diffuse_model=DIFFUSE_MODEL)
    return shade(points, wo, light, scene=scene, options=options)
