"""Neural field of one object from a triplane: signed field values, material on its surface, and its lighting."""

from dataclasses import dataclass

import torch
from torch import Tensor

from reli3d.geometry.surface import CubeWeights, surface_cubes, surface_points
from reli3d.nn.heads import deformation
from reli3d.nn.model import Code, Reconstructor
from reli3d.nn.view_features import ViewMaps
from reli3d.render.bump import radial_bump
from reli3d.render.color import srgb_to_linear
from reli3d.render.points import SurfacePoints

CHUNK = 1 << 17  # points per query: 200 MB of features
MATERIAL = ("base_color", "roughness", "metallic", "normal")


@dataclass(frozen=True)
class TriplaneField:
    """Output of a :class:`~reli3d.nn.model.Reconstructor` for one object, in the model's frame."""

    maps: ViewMaps
    model: Reconstructor
    code: Code  # of one object

    @torch.no_grad()
    def grid_sdf(self, axis: Tensor) -> Tensor:
        """Field values on the grid ``(axis[i], axis[j], axis[k])``, ``(n, n, n)``: negative inside."""
        return self.model.sdf(self.model.grid_density(self.code, axis))

    @torch.no_grad()
    def cube_weights(self, points: Tensor, sdf: Tensor) -> CubeWeights:
        """Deformation and weights at the surface cubes of ``sdf``, whose grid points are ``points (N, 3)``."""
        model, cubes = self.model, surface_cubes(sdf)
        at, rows = surface_points(sdf, cubes)
        raw = [model.query(self.code, points[part][None], ("deformation", "flexicubes")) for part in at.split(CHUNK)]
        offset = points.new_zeros(len(points), 3)
        offset[at] = deformation(torch.cat([r["deformation"][0] for r in raw]), sdf.shape[0] - 1)
        corner = torch.cat([r["flexicubes"][0] for r in raw])
        merged = [model.merger(corner[part]) for part in rows.split(CHUNK)]
        weights = {name: torch.cat([getattr(m, name) for m in merged]) for name in ("alpha", "beta", "gamma")}
        return CubeWeights(offset.reshape(*sdf.shape, 3), cubes=cubes, **weights)

    def material(self, position: Tensor, normal: Tensor) -> SurfacePoints:
        """Surface points with material; ``position``, geometric ``normal``: ``(N, 3)``, unit."""
        values = {k: v[0] for k, v in self.model.query(self.code, position[None], MATERIAL).items()}
        shading_normal = radial_bump(position, normal, values["normal"])
        color, rough, metal = srgb_to_linear(values["base_color"]), values["roughness"][:, 0], values["metallic"][:, 0]
        return SurfacePoints(position, normal, shading_normal, color, rough, metal)

    def radiance_map(self, height: int | None = None) -> Tensor:
        """Linear radiance ``(H, 2H, 3)``, upper edge +Y, horizontal center +X; default height: the preset's."""
        return self.model.decode_environment(self.code, height)[0].contiguous()
