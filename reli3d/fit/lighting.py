"""Lighting of the input images, by a map fixed to the object, camera or room, or one per group; shading by it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from reli3d.fit.input_images import InputImages
from reli3d.fit.unknowns import Start, Unknowns, light_maps
from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade

DIFFUSE_MODEL = "published"  # glTF's formula: that of viewers and of the shipped weights' training data


@dataclass(frozen=True)
class Lights:
    """Environments of V views.

    maps: ``(G, H, 2H, 3)`` radiance of G groups.  group: map index of each of the V views.  rotations: ``(V, 3,
    3)`` from the maps' axes to the object's; None if they are the same.
    """

    maps: Tensor
    group: Sequence[int]
    rotations: Tensor | None = None

    @classmethod
    def of(cls, unknowns: Unknowns, start: Start, images: InputImages) -> Lights:
        """The fitted lights of ``images``.  Gradients reach ``unknowns.light``."""
        maps = (start.light + light_maps(unknowns.light)).exp()
        return cls(maps, images.light_group, images.light_rotations)

    def of_view(self, view: int) -> Environment:
        """The environment of a view in the object's frame.  Gradients reach ``maps``."""
        light = Environment(self.maps[self.group[view]].contiguous())
        if self.rotations is None:
            return light
        height, width = self.maps.shape[1:3]
        world = lat_long_directions(height, width).to(self.maps)
        return Environment(light.lookup((world @ self.rotations[view]).contiguous()))

    def evaluate(
        self,
        points: SurfacePoints,
        wo: Tensor,
        view: Tensor,
        radiance: Callable[..., Tensor],
    ) -> Tensor:
        """``radiance(points, wo, environment, rotations=...)``, ``(N, 3)``, each row under the lighting of its view
        ``view (N,)``.
        """
        group = torch.tensor(self.group, device=view.device)[view]
        out = wo.new_zeros(wo.shape)
        for k in torch.unique(group).tolist():
            rows = torch.nonzero(group == k)[:, 0]
            rotations = None if self.rotations is None else self.rotations[view[rows]]
            value = radiance(points[rows], wo[rows], Environment(self.maps[k].contiguous()), rotations=rotations)
            out = out.index_copy(0, rows, value)
        return out


def radiance(
    points: SurfacePoints,
    wo: Tensor,
    light: Environment,
    *,
    rotations: Tensor | None = None,
    samples: tuple[int, int, int],
    scene: RayScene | None,
    seed: int,
) -> Tensor:
    """Linear radiance ``(N, 3)`` from ``points`` towards ``wo (N, 3)`` by direct light.  scene: None: no shadows.

    rotations: as in :func:`~reli3d.render.shading.shade`.
    """
    options = ShadeOptions(samples=samples, seed=seed, diffuse_model=DIFFUSE_MODEL)
    return shade(points, wo, light, scene=scene, options=options, rotations=rotations)
