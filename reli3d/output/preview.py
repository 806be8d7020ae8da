"""One picture of a reconstruction: what went in beside what comes out."""

from __future__ import annotations

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn.functional import interpolate

from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.camera import Camera
from reli3d.render.color import linear_to_srgb
from reli3d.render.render import render
from reli3d.render.shading import ShadeOptions
from reli3d.views.views import Views

TILE = 192  # pixels
COLUMNS = 4
SAMPLES = (24, 16, 4)  # light, GGX and cosine samples a pixel: little noise for a quarter of a second a view
PAPER = 0.93  # background of the tiles, sRGB
MEAN = 0.25  # of the environment as it is drawn, linear


def preview(asset: Asset, views: Views) -> np.ndarray:
    """Picture ``(H, W, 3)`` uint8: up to four input views, the asset rendered from the same cameras under its own
    light, the maps of the first view, and the environment (row 0 up, centre -Z), exposed so that its mean is ``MEAN``.

    views: in the frame of ``asset``.
    """
    batch = views.select(min(len(views), COLUMNS)).resampled(TILE, crop=True)
    scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
    shots = [
        render(asset, Camera(batch.c2w[i], batch.intrinsics[i], TILE, TILE), options=ShadeOptions(SAMPLES), scene=scene)
        for i in range(len(batch))
    ]
    hero = shots[0]
    maps = [linear_to_srgb(hero.base_color), hero.roughness[..., None].expand(-1, -1, 3),
            hero.metallic[..., None].expand(-1, -1, 3), hero.normal * 0.5 + 0.5]  # fmt: skip
    rows = [
        ("input", [_on_paper(i, m) for i, m in zip(batch.images, batch.masks, strict=True)]),
        ("reconstruction, own light", [_on_paper(_display(s.radiance, s.alpha), s.alpha) for s in shots]),
        ("base colour, roughness, metallic, normal", [_on_paper(m, hero.alpha) for m in maps]),
    ]
    height = 14 + TILE
    sheet = Image.new("RGB", (COLUMNS * TILE, len(rows) * height + 14 + 2 * TILE), "white")
    draw = ImageDraw.Draw(sheet)
    for r, (title, tiles) in enumerate(rows):
        draw.text((3, r * height + 1), title, fill="black")
        for c, tile in enumerate(tiles):
            sheet.paste(_image(tile), (c * TILE, r * height + 14))
    draw.text((3, len(rows) * height + 1), "environment, its mean at a quarter", fill="black")
    light = asset.environment.radiance
    light = linear_to_srgb((light * (MEAN / light.mean().clamp(min=1e-6))).clamp(0, 1)).permute(2, 0, 1)[None]
    light = interpolate(light, (2 * TILE, 4 * TILE), mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
    sheet.paste(_image(light), (0, len(rows) * height + 14))
    return np.asarray(sheet)


def comparison(before: Asset, after: Asset, views: Views) -> np.ndarray:
    """Picture ``(H, W, 3)`` uint8 of three views: photographs, ``before`` and ``after`` in their own light."""
    count = min(len(views), 3)
    batch = views.select([k * len(views) // count for k in range(count)]).resampled(TILE, crop=True)
    rows = [("input", [_on_paper(i, m) for i, m in zip(batch.images, batch.masks, strict=True)])]
    for title, asset in (("before", before), ("after refinement", after)):
        scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
        cameras = [Camera(batch.c2w[i], batch.intrinsics[i], TILE, TILE) for i in range(count)]
        shots = [render(asset, c, options=ShadeOptions(samples=SAMPLES), scene=scene) for c in cameras]
        rows.append((title, [_on_paper(_display(s.radiance, s.alpha), s.alpha) for s in shots]))
    height = 14 + TILE
    sheet = Image.new("RGB", (count * TILE, len(rows) * height), "white")
    draw = ImageDraw.Draw(sheet)
    for r, (title, tiles) in enumerate(rows):
        draw.text((3, r * height + 1), title, fill="black")
        for c, tile in enumerate(tiles):
            sheet.paste(_image(tile), (c * TILE, r * height + 14))
    return np.asarray(sheet)


def _display(radiance: Tensor, alpha: Tensor) -> Tensor:
    """sRGB of premultiplied linear radiance, straight."""
    return linear_to_srgb((radiance / alpha.clamp(min=1e-3)[..., None]).clamp(0, 1))


def _on_paper(color: Tensor, alpha: Tensor) -> Tensor:
    return torch.lerp(torch.full_like(color, PAPER), color, alpha[..., None])


def _image(pixels: Tensor) -> Image.Image:
    return Image.fromarray((pixels.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy())
