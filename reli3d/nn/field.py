"""Neural field of one object: signed field values in its volume, material on its surface, and its lighting.

:class:`TriplaneField` is decoded from the triplane of the published network, :class:`reli3d.nn.local.LocalField` from
the volume and the pixel maps of the convolutional one.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from reli3d.geometry.hull import hull_distance, hull_grid
from reli3d.geometry.surface import CubeWeights, surface_cubes, surface_points
from reli3d.nn.heads import deformation
from reli3d.nn.model import Code, Reconstructor
from reli3d.nn.view_features import ViewMaps
from reli3d.render.bump import radial_bump
from reli3d.render.color import srgb_to_linear

CHUNK = 1 << 17  # points per query: 200 MB of features
MATERIAL = ("base_color", "roughness", "metallic", "normal")


@dataclass(frozen=True)
class PointMaterial:
    """Material at N surface points."""

    base_color: Tensor  # (N, 3) linear; the decoder heads give sRGB
    roughness: Tensor  # (N,) perceptual
    metallic: Tensor  # (N,)
    normal: Tensor  # (N, 3) unit shading normal, world


def bound_sdf(maps: ViewMaps, points: Tensor, softness: float, far: float = math.inf) -> Tensor:
    """Signed distance ``(N,)`` to the visual hull at ``points (N, 3)``, in units of ``softness``; no gradient.

    Negative inside.  Where the distance exceeds ``far``, the result is any value above ``far``.
    """
    return -hull_distance(points, maps.silhouette, maps.camera, far=far * softness) / softness


def grid_bound_sdf(maps: ViewMaps, axis: Tensor, softness: float, far: float = math.inf) -> Tensor:
    """:func:`bound_sdf` at the points ``(axis[i], axis[j], axis[k])``, ``(n, n, n)``; axis: ``(n,)`` ascending."""
    return -hull_grid(axis, maps.silhouette, maps.camera, far=far * softness) / softness


@dataclass(frozen=True)
class Field(ABC):
    """Network output for one object, and its input views, in the model's frame."""

    reads_views: ClassVar[bool]  # whether the material depends on the visibility of a point in the views

    maps: ViewMaps

    @abstractmethod
    def free_sdf(self, points: Tensor) -> Tensor:
        """Predicted field values ``(N,)`` at ``points (N, 3)``: negative inside, zero on the surface.

        Not clamped to the visual hull.  Gradients reach the network.
        """

    @abstractmethod
    def material(self, position: Tensor, normal: Tensor, visible: Tensor) -> PointMaterial:
        """Material at surface points: ``position``, geometric ``normal`` ``(N, 3)`` unit, ``visible (N, V)``, 1 where
        the view sees the point.
        """

    @abstractmethod
    def radiance_map(self, height: int | None = None) -> Tensor:
        """Linear radiance ``(H, 2H, 3)``, upper edge +Y, horizontal center +X; default height: the preset's."""


@dataclass(frozen=True)
class TriplaneField(Field):
    """Output of a :class:`~reli3d.nn.model.Reconstructor` for one object."""

    model: Reconstructor
    code: Code  # of one object

    reads_views: ClassVar[bool] = False

    def free_sdf(self, points: Tensor) -> Tensor:
        return self.model.sdf(self.model.query(self.code, points[None], ("density",))["density"][0, :, 0])

    @torch.no_grad()
    def grid_sdf(self, axis: Tensor) -> Tensor:
        """:meth:`free_sdf` on the grid ``(axis[i], axis[j], axis[k])``, ``(n, n, n)``, by
        :meth:`Reconstructor.grid_density`.
        """
        return self.model.sdf(self.model.grid_density(self.code, axis))

    @torch.no_grad()
    def cube_weights(self, points: Tensor, sdf: Tensor) -> CubeWeights:
        """Deformation and weights for ``extract_surface``, evaluated only at the surface cubes.

        points: ``(N, 3)``, the grid points in the order of ``sdf``.
        """
        model, cubes = self.model, surface_cubes(sdf)
        at, rows = surface_points(sdf, cubes)
        raw = [model.query(self.code, points[part][None], ("deformation", "flexicubes")) for part in at.split(CHUNK)]
        offset = points.new_zeros(len(points), 3)
        offset[at] = deformation(torch.cat([r["deformation"][0] for r in raw]), sdf.shape[0] - 1)
        corner = torch.cat([r["flexicubes"][0] for r in raw])
        merged = [model.merger(corner[part]) for part in rows.split(CHUNK)]
        weights = {name: torch.cat([getattr(m, name) for m in merged]) for name in ("alpha", "beta", "gamma")}
        return CubeWeights(offset.reshape(*sdf.shape, 3), cubes=cubes, **weights)

    def material(self, position: Tensor, normal: Tensor, visible: Tensor) -> PointMaterial:
        values = {k: v[0] for k, v in self.model.query(self.code, position[None], MATERIAL).items()}
        return PointMaterial(
            srgb_to_linear(values["base_color"]),
            values["roughness"][:, 0],
            values["metallic"][:, 0],
            radial_bump(position, normal, values["normal"]),
        )

    def radiance_map(self, height: int | None = None) -> Tensor:
        return self.model.decode_environment(self.code, height)[0].contiguous()
