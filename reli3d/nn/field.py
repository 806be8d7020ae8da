"""The field of one object as the paper's network gives it: level in its volume, material on its surface, its light.

This is where the aids of a small preset meet the network: features of the views at the points, colours seen there,
and the bound that the silhouettes put on the density.  Without them (``official``) a point's triplane features are
all there is.  :class:`reli3d.nn.local.LocalField` is the same for the network of convolutions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from reli3d._bridge import over_rows
from reli3d.geometry.hull import hull_distance
from reli3d.geometry.surface import surface_cubes
from reli3d.nn.blocks import ROWS, in_rows
from reli3d.nn.heads import deformation
from reli3d.nn.light_features import Shading, brightness_at, brightness_over_normal, palette_of, unshaded
from reli3d.nn.model import Code, Reconstructor
from reli3d.nn.view_features import ViewMaps
from reli3d.render.bump import radial_bump
from reli3d.render.color import srgb_to_linear
from reli3d.render.environment import Environment

LIGHT_ROWS = 16  # of the decoded map from which the material is told its irradiance
CHUNK = 1 << 17  # points a query: 200 MB of features
MATERIAL = ("base_color", "roughness", "metallic", "normal")


@dataclass(frozen=True)
class PointMaterial:
    """Material at N surface points."""

    base_color: Tensor  # (N, 3) sRGB-encoded
    roughness: Tensor  # (N,) perceptual
    metallic: Tensor  # (N,)
    normal: Tensor  # (N, 3) unit, world: of shading


def bound_level(maps: ViewMaps, points: Tensor, softness: float) -> Tensor:
    """Level ``(N,)`` of the hull of the views' silhouettes at ``points (N, 3)``, in units of ``softness``; no
    gradient.
    """
    return -hull_distance(points, maps.images[..., 3].contiguous(), maps.c2w, maps.intrinsics) / softness


@dataclass(frozen=True)
class Field:
    """What a :class:`~reli3d.nn.model.Reconstructor` knows of one object, with the views it was told."""

    model: Reconstructor
    code: Code  # of one object
    maps: ViewMaps
    shading: Shading | None = None

    @property
    def bounded(self) -> bool:
        """Whether the silhouettes bound the surface."""
        return self.model.preset.silhouette_bound

    @property
    def reads_views(self) -> bool:
        """Whether the material asks which view sees a point."""
        return bool(self.model.preset.view_feature_width)

    def bound(self, points: Tensor) -> Tensor:
        """Level ``(N,)`` of the silhouettes' hull: no point is further inside than this; no gradient."""
        return bound_level(self.maps, points, self.model.preset.softness)

    def free_level(self, points: Tensor) -> Tensor:
        """Level ``(N,)`` that the network gives ``points (N, 3)`` [model frame], without the hull's bound: negative
        inside, zero on the surface.  Gradients reach the network.
        """
        model, width = self.model, self.model.preset.point_features

        def density(points: Tensor) -> dict[str, Tensor]:
            features = None
            if self.reads_views:
                features = model.view_features(self.maps, points)[0][None]
                features = functional.pad(features, (0, width - features.shape[-1]))  # no surface yet
            return {"density": model.query(self.code, points[None], ("density",), features)["density"][0, :, 0]}

        return model.level(in_rows(density, points)["density"] + self._offset())

    def level(self, points: Tensor) -> Tensor:
        """Level ``(N,)``: negative inside, zero on the surface."""
        free = self.free_level(points)
        return torch.maximum(free, self.bound(points)) if self.bounded else free

    @torch.no_grad()
    def grid_level(self, axis: Tensor) -> Tensor | None:
        """:meth:`free_level` at ``(axis[i], axis[j], axis[k])``, ``(n, n, n)``, in a fifth of the time; None where the
        preset has features of points, which belong to no plane.  See :meth:`Reconstructor.grid_density`.
        """
        if self.model.preset.point_features:
            return None
        n, ask = len(axis), self.model.grid_density(self.code, axis)
        lines = n if axis.is_cuda else max(1, ROWS // n)
        blocks = [(i, slice(j, j + lines)) for i in range(n) for j in range(0, n, lines)]

        def density(start: int, _stop: int) -> Tensor:
            return ask(*blocks[start])

        every = range(len(blocks))
        parts = [density(k, k + 1) for k in every] if axis.is_cuda else over_rows(len(blocks), 1, density)
        return self.model.level(torch.cat(parts).view(n, n, n) + self._offset())

    def _offset(self) -> float:
        """Added to the raw density: moves the surface outward."""
        preset, views = self.model.preset, len(self.maps.c2w)
        return preset.offset_many_views + (preset.offset_one_view - preset.offset_many_views) / views

    @torch.no_grad()
    def cube_weights(self, points: Tensor, level: Tensor) -> dict[str, Tensor]:
        """Deformation and weights for ``extract_surface``, asked for only where the surface passes.

        points: ``(N, 3)`` the grid's, in the order of ``level``.  Empty where the preset's level is a distance.
        """
        model = self.model
        if model.preset.log_level:
            return {}
        cubes, (y, z) = surface_cubes(level), level.shape[1:]
        i, rest = cubes // ((y - 1) * (z - 1)), cubes % ((y - 1) * (z - 1))
        lowest = (i * y + rest // (z - 1)) * z + rest % (z - 1)
        k = torch.arange(8, device=points.device)
        corners = lowest[:, None] + ((k & 1) * y + (k >> 1 & 1)) * z + (k >> 2)
        needed = torch.zeros_like(level, dtype=torch.bool)
        for side in range(3):  # where the inside reaches the box, the cap stands on the border's vertices
            for end in (0, -1):
                needed.select(side, end)[level.select(side, end) < 0] = True
        needed.view(-1)[corners] = True
        at = needed.view(-1).nonzero()[:, 0]
        raw = [model.query(self.code, points[part][None], ("deformation", "flexicubes")) for part in at.split(CHUNK)]
        offset = points.new_zeros(len(points), 3)
        offset[at] = deformation(torch.cat([r["deformation"][0] for r in raw]), level.shape[0] - 1)
        corner = torch.cat([r["flexicubes"][0] for r in raw])
        row = torch.cumsum(needed.view(-1), 0) - 1
        merged = [model.merger(corner[row[part]]) for part in corners.split(CHUNK)]
        alpha, beta, gamma = (torch.cat([getattr(m, name) for m in merged]) for name in ("alpha", "beta", "gamma"))
        return {"deformation": offset.reshape(*level.shape, 3), "alpha": alpha, "beta": beta, "gamma": gamma,
                "cubes": cubes}  # fmt: skip

    def with_shading(self, position: Tensor, normal: Tensor, visible: Tensor) -> Field:
        """The field that knows the light on its surface, from some thousand points all over it; no gradient."""
        if not self.model.preset.shading_features:
            return self
        with torch.no_grad():
            color, seen = self.model.view_features(self.maps, position, visible, normal)[1], visible.amax(1)
            observed = brightness_over_normal(srgb_to_linear(color), seen, normal)
            plain = unshaded(color, brightness_at(normal, observed))
            irradiance = Environment(self.radiance_map(LIGHT_ROWS).detach().contiguous()).irradiance()
            return replace(self, shading=Shading(irradiance, observed, palette_of(color, plain, seen)))

    def material(self, position: Tensor, normal: Tensor, visible: Tensor) -> PointMaterial:
        """Material at surface points: ``position``, ``normal`` ``(N, 3)``, the geometric normal unit; ``visible (N,
        V)``, 1 where a view sees the point; after :meth:`with_shading` where the preset asks for it.
        """
        model = self.model

        def ask(position: Tensor, normal: Tensor, visible: Tensor) -> dict[str, Tensor]:
            features = color = None
            if self.reads_views:
                features, color = (x[None] for x in model.view_features(self.maps, position, visible, normal))
                if self.shading is not None:
                    features = torch.cat([features, self.shading.features(normal, color[0])[None]], -1)
            values = {k: v[0] for k, v in model.query(self.code, position[None], MATERIAL, features, color).items()}
            return {"base_color": values["base_color"], "roughness": values["roughness"][:, 0],
                    "metallic": values["metallic"][:, 0],
                    "normal": radial_bump(position, normal, values["normal"])}  # fmt: skip

        return PointMaterial(**in_rows(ask, position, normal, visible))

    def radiance_map(self, height: int | None = None) -> Tensor:
        """Linear radiance ``(H, 2H, 3)``, row 0 is +Y, the centre column -Z; default height the preset's."""
        return self.model.decode_environment(self.code, height)[0].contiguous()
