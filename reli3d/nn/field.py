"""The field of one object: surface level at points of its volume, material at points of its surface.

This is where the aids of a small preset meet the network: features of the views at the points, colours seen there,
and the bound that the silhouettes put on the density.  Without them (``official``) a point's triplane features are
all there is.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from reli3d._bridge import over_rows
from reli3d.geometry.hull import hull_distance
from reli3d.nn.blocks import ROWS, in_rows
from reli3d.nn.light_features import Shading, brightness_at, brightness_over_normal, palette_of, unshaded
from reli3d.nn.model import Code, Reconstructor
from reli3d.nn.view_features import ViewMaps
from reli3d.render.color import srgb_to_linear
from reli3d.render.environment import Environment

LIGHT_ROWS = 16  # of the decoded map from which the material is told its irradiance
MATERIAL = ("base_color", "roughness", "metallic", "normal")


def surface_level(model: Reconstructor, code: Code, maps: ViewMaps, points: Tensor) -> Tensor:
    """Level ``(N,)`` that the network gives ``points (N, 3)`` [model frame]: negative inside, zero on the surface.

    Gradients reach the network.  Where the preset has ``silhouette_bound`` the object's level is the greater one of
    this and :func:`bound_level`: no point is further inside than its worst silhouette has it.
    """

    def density(points: Tensor) -> dict[str, Tensor]:
        features = None
        if model.preset.view_feature_width:
            features = model.view_features(maps, points)[0][None]
            features = functional.pad(features, (0, model.preset.point_features - features.shape[-1]))  # no surface yet
        return {"density": model.query(code, points[None], ("density",), features)["density"][0, :, 0]}

    return model.level(in_rows(density, points)["density"] + _offset(model, maps))


@torch.no_grad()
def grid_level(model: Reconstructor, code: Code, maps: ViewMaps, axis: Tensor) -> Tensor:
    """:func:`surface_level` at ``(axis[i], axis[j], axis[k])``, ``(n, n, n)``, of a preset without point features.

    In a fifth of the time: see :meth:`Reconstructor.grid_density`.  axis: ``(n,)``.  No gradient.
    """
    n, ask = len(axis), model.grid_density(code, axis)
    lines = n if axis.is_cuda else max(1, ROWS // n)
    blocks = [(i, slice(j, j + lines)) for i in range(n) for j in range(0, n, lines)]

    def density(start: int, _stop: int) -> Tensor:
        return ask(*blocks[start])

    every = range(len(blocks))
    parts = [density(k, k + 1) for k in every] if axis.is_cuda else over_rows(len(blocks), 1, density)
    return model.level(torch.cat(parts).view(n, n, n) + _offset(model, maps))


def _offset(model: Reconstructor, maps: ViewMaps) -> float:
    """Added to the raw density: moves the surface outward."""
    preset, views = model.preset, len(maps.c2w)
    return preset.offset_many_views + (preset.offset_one_view - preset.offset_many_views) / views


def bound_level(model: Reconstructor, maps: ViewMaps, points: Tensor) -> Tensor:
    """Level ``(N,)`` of the soft visual hull of the views' silhouettes at ``points``; no gradient."""
    silhouette = maps.images[..., 3].contiguous()
    return -hull_distance(points, silhouette, maps.c2w, maps.intrinsics) / model.preset.softness


def object_shading(model: Reconstructor, light: Tensor, maps: ViewMaps, position: Tensor, normal: Tensor,
                   visible: Tensor) -> Shading | None:  # fmt: skip
    """What is known of the light on the object's surface; None where the preset asks for none.  No gradient.

    light: ``(H, 2H, 3)`` the predicted environment, about ``LIGHT_ROWS`` high.  position, normal, visible: of some
    thousand points all over the surface, as :func:`surface_material` takes them.
    """
    if not model.preset.shading_features:
        return None
    with torch.no_grad():
        color, seen = model.view_features(maps, position, visible, normal)[1], visible.amax(1)
        observed = brightness_over_normal(srgb_to_linear(color), seen, normal)
        plain = unshaded(color, brightness_at(normal, observed))
        irradiance = Environment(light.detach().contiguous()).irradiance()
        return Shading(irradiance, observed, palette_of(color, plain, seen))


def surface_material(model: Reconstructor, code: Code, maps: ViewMaps, position: Tensor, normal: Tensor,
                     visible: Tensor, shading: Shading | None) -> dict[str, Tensor]:  # fmt: skip
    """Base colour (sRGB-encoded), roughness, metallic and bump normal, ``{name: (N, k)}``, at surface points.

    position, normal: ``(N, 3)``, the geometric normal unit.  visible: ``(N, V)``, 1 where a view sees the point.
    shading: :func:`object_shading`.
    """

    def material(position: Tensor, normal: Tensor, visible: Tensor) -> dict[str, Tensor]:
        features = color = None
        if model.preset.view_feature_width:
            features, color = (x[None] for x in model.view_features(maps, position, visible, normal))
            if shading is not None:
                features = torch.cat([features, shading.features(normal, color[0])[None]], -1)
        values = model.query(code, position[None], MATERIAL, features, color)
        return {name: value[0] for name, value in values.items()}

    return in_rows(material, position, normal, visible)
