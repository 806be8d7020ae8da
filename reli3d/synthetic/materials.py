"""Layers of uniform material, blended by solid patterns, with bumps; colors linear Rec. 709, roughness perceptual."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from reli3d._bridge import check
from reli3d.synthetic.noise import fbm

ALBEDO_RANGE = (0.02, 0.9)  # coal to fresh snow
ROUGHNESS_RANGE = (0.08, 1.0)
MAX_HEIGHT_GRADIENT = 0.6  # of a bump, 31 degrees: steeper ones shade below the horizon


@dataclass(frozen=True)
class Coat:
    """One uniform layer of material."""

    color: tuple[float, float, float]  # linear base color
    roughness: float
    metallic: float = 0.0


SurfaceFunction = Callable[[Tensor, Tensor], Tensor]  # of points and normals (N, 3), see :mod:`.patterns`
Layer = tuple[Coat, SurfaceFunction]  # and its blend weight


@dataclass(frozen=True)
class Material:
    """A base layer, further layers blended over it by their patterns, low-frequency variation, and bumps."""

    base: Coat
    layers: tuple[Layer, ...] = ()
    bumps: tuple[SurfaceFunction, ...] = ()  # gradients of height fields
    drift: float = 0.0  # relative standard deviation of the color, by low-frequency noise
    drift_roughness: float = 0.0  # standard deviation of the roughness
    drift_scale: float = 3.0  # cycles per unit
    seed: int = 0

    def at(self, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Base color ``(N, 3)``, roughness ``(N,)``, metallic ``(N,)`` and bump-mapped normal ``(N, 3)``."""
        row = lambda coat: points.new_tensor([*coat.color, coat.roughness, coat.metallic]).expand(len(points), 5)
        value = row(self.base)
        for coat, weight in self.layers:
            value = torch.lerp(value, row(coat), weight(points, normals)[:, None])
        color, roughness = value[:, :3], value[:, 3]
        if self.drift > 0 or self.drift_roughness > 0:
            noise = fbm(points * self.drift_scale, octaves=3, seed=self.seed)[0] * 2
            color = color * torch.exp(self.drift * noise)[:, None]
            roughness = roughness + self.drift_roughness * noise
        bumped = normals
        if self.bumps:
            gradient = torch.stack([bump(points, normals) for bump in self.bumps]).sum(0)
            gradient = gradient - normals * (gradient * normals).sum(-1, keepdim=True)  # in the tangent plane
            size = gradient.norm(dim=-1, keepdim=True)
            limited = MAX_HEIGHT_GRADIENT * torch.tanh(size / MAX_HEIGHT_GRADIENT)
            bumped = torch.nn.functional.normalize(normals - gradient * (limited / size.clamp(min=1e-8)), dim=-1)
        return color.clamp(*ALBEDO_RANGE), roughness.clamp(*ROUGHNESS_RANGE), value[:, 4].clamp(0, 1), bumped


def evaluate(
    materials: Sequence[Material], points: Tensor, normals: Tensor, part: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Base color ``(N, 3)``, roughness, metallic ``(N,)`` and bump-mapped normal ``(N, 3)`` of surface points.

    points, normals: ``(N, 3)`` float32.  part: ``(N,)``, indices of materials.  Raises TypeError or ValueError.
    """
    check("points", points, shape=(len(part), 3))
    check("normals", normals, shape=(len(part), 3))
    if len(part) and not (int(part.min()) >= 0 and int(part.max()) < len(materials)):
        raise ValueError(f"part: expected 0 to {len(materials) - 1}, got {int(part.min())} to {int(part.max())}")
    color, bumped = torch.empty_like(points), torch.empty_like(points)
    roughness, metallic = points.new_empty(len(points)), points.new_empty(len(points))
    for k in torch.bincount(part, minlength=1).nonzero()[:, 0].tolist():
        rows = (part == k).nonzero()[:, 0]
        color[rows], roughness[rows], metallic[rows], bumped[rows] = materials[k].at(points[rows], normals[rows])
    return color, roughness, metallic, bumped
