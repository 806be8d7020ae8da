"""Points to shade, at random, and from arrays in the order of the estimator's formulas."""

from collections.abc import Callable

import torch
import trimesh
from torch import Tensor

from reli3d.geometry.distance import signed_distance
from reli3d.geometry.hits import interpolate
from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from tests.support.meshes import mesh_from


class Ball:
    """To make samples of.  ``finish`` gives base color, roughness and metallic of positions."""

    def __init__(self, finish: Callable, subdivisions: int, radius: float):
        mesh = mesh_from(trimesh.creation.icosphere(subdivisions, radius))
        self.vertices, self.faces, self.finish = mesh.vertices, mesh.faces, finish
        self.scene = RayScene(self.vertices, self.faces)
        self.outer = torch.ones(len(self.faces), dtype=torch.bool)

    def distance(self, points):
        return signed_distance(self.vertices, self.faces, points)

    def points_at(self, face, bary):
        position = interpolate(self.vertices, self.faces, face.int(), bary)
        normal = torch.nn.functional.normalize(position, dim=-1)
        return SurfacePoints(position, normal, normal, *self.finish(position))


def at(position, normal, ng, wo, base_color, roughness, metallic) -> tuple[SurfacePoints, Tensor]:
    """The first two arguments of ``shade``."""
    return SurfacePoints(position, ng, normal, base_color, roughness, metallic), wo


def on_ball(normal, wo, base_color, roughness, metallic) -> tuple[SurfacePoints, Tensor]:
    """The same for points of the unit ball, whose three vectors are one."""
    return at(normal, normal, normal, wo, base_color, roughness, metallic)


def lit(points: tuple[SurfacePoints, Tensor], light: Environment, *, scene=None, pixels=None, **options) -> Tensor:
    """Their radiance; ``options`` of the estimator by name."""
    return shade(*points, light, scene=scene, pixels=pixels, options=ShadeOptions(**options))


def points(n, seed=1):
    """Random normals, and views at most 87 degrees from them."""
    g = torch.Generator().manual_seed(seed)
    normal = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=-1)
    wo = torch.nn.functional.normalize(normal + 0.6 * torch.randn(n, 3, generator=g), dim=-1)
    wo = torch.where((wo * normal).sum(-1, keepdim=True) < 0.05, normal, wo)
    return normal, wo


def inputs(n, device):
    """Leaves in the order of ``shade``: normal, wo, base, roughness, metallic."""
    g = torch.Generator().manual_seed(4)
    base, rough = 0.2 + 0.6 * torch.rand(n, 3, generator=g), 0.4 + 0.4 * torch.rand(n, generator=g)
    return [v.to(device) for v in (*points(n, seed=6), base, rough, torch.rand(n, generator=g))]
