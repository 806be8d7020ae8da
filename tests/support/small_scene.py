"""A small synthetic scene for fits: a ball of two colors under a sky, rendered from all around."""

import math
from dataclasses import replace

import torch

from reli3d.geometry.bake import bake
from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.surface import extract_surface
from reli3d.geometry.uv import unwrap
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import surface_points
from reli3d.render.image import render_asset
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions
from reli3d.views.views import ViewBatch
from tests.support.reference_surface import grid
from tests.support.rigs import eyes_around

TEXELS = 64


def ball(radius: float = 0.8, cells: int = 24, squeeze: float = 1.0) -> Asset:
    """A closed ball with an atlas, gray maps and an even light; ``squeeze`` scales its height."""
    sdf = (grid(cells) / torch.tensor([1.0, squeeze, 1.0])).norm(dim=-1) - radius
    mesh = unwrap(extract_surface(sdf, radius=1.0).with_normals(), texture_size=TEXELS)
    mesh = mesh.with_tangents()
    gray = srgb_to_linear(torch.full((TEXELS, TEXELS, 3), 0.6))
    return Asset(mesh, TextureSet(gray, 0.6, 0.1), Environment(torch.full((16, 32, 3), 0.5)))


def sky() -> Environment:
    """Bright from above and from +Z, dark from below; three colors."""
    row = torch.linspace(1.6, 0.1, 16)[:, None, None]
    column = 0.6 + 0.4 * torch.sin(torch.linspace(-math.pi, math.pi, 33)[:-1])[None, :, None]
    return Environment((row * column * torch.tensor([0.9, 1.0, 1.1])).contiguous())


def two_colored(asset: Asset) -> Asset:
    """The ball with a red and a green half and the sky around it."""

    def base_color(position, normal):
        side = torch.sigmoid(40.0 * position[:, :1])
        return side * torch.tensor([0.8, 0.25, 0.2]) + (1.0 - side) * torch.tensor([0.25, 0.6, 0.3])

    color = srgb_to_linear(bake(asset.mesh, TEXELS, base_color)["value"])
    return Asset(asset.mesh, replace(asset.textures, base_color=color), sky())


def centers(asset: Asset) -> SurfacePoints:
    """Of the faces."""
    face = torch.arange(len(asset.mesh.faces), dtype=torch.int32)
    return surface_points(asset.mesh, asset.textures, face, torch.full((len(face), 2), 1 / 3))


def input_views(asset: Asset, count: int, size: int) -> ViewBatch:
    """``count`` renderings of ``asset`` in its environment, with little noise and antialiased masks."""
    eyes = eyes_around(count, 3.2).float()
    c2w = look_at(eyes, torch.zeros(3), torch.tensor([0.05, 1.0, 0.02]))
    camera = Camera.from_fov(c2w, math.radians(38.0), size, size)
    options = ShadeOptions(samples=(32, 16, 8), diffuse_model="published")
    cameras = [Camera(c2w[i], camera.intrinsics[i], size, size) for i in range(count)]
    renderings = [render_asset(asset, c, options=options, supersampling=2) for c in cameras]
    colors = [linear_to_srgb((r.radiance / r.alpha.clamp(min=1e-3)[..., None]).clamp(0, 1)) for r in renderings]
    return ViewBatch(torch.stack(colors), torch.stack([r.alpha for r in renderings]), camera.c2w, camera.intrinsics)
