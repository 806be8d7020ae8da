"""How bright the photographs of an object are beside its asset in its own light."""

from __future__ import annotations

import torch
from torch import Tensor

from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.camera import Camera
from reli3d.render.color import srgb_to_linear
from reli3d.render.gbuffer import primary_hits, surface_points
from reli3d.render.shading import ShadeOptions, shade

STEP = 16  # of the photographs' pixels one in STEP^2 is asked: some thousand in four photographs of 512 pixels
SAMPLES = (8, 8, 2)  # a pixel; the noise of the mean over some hundred pixels is below a percent
WHITE = 0.97  # linear; brighter pixels may be cut off
BLACK = 1e-3  # added to both means: where nothing is seen the ratio is 1


@torch.no_grad()
def photograph_ratio(asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene) -> Tensor:
    """Mean linear brightness of photographs over that of ``asset`` under its own light with shadows, ``()``.

    images: ``(V, H, W, 3)`` sRGB, at least ``STEP`` pixels a side.  inside: ``(V, H, W)`` bool, pixels that show
    nothing but the object.  camera: of all V.  scene: rays against the asset's faces.  Over a regular grid of pixels
    at which the asset is hit and the photograph is not overexposed.  No gradient.  Raises ValueError for fewer pixels.
    """
    first = STEP // 2
    seen, inside = srgb_to_linear(images[:, first::STEP, first::STEP]), inside[:, first::STEP, first::STEP]
    corner = camera.intrinsics.new_tensor([0.0, 0.0, 0.5, 0.5])  # puts the centres of the coarse pixels on those asked
    coarse = Camera(camera.c2w, (camera.intrinsics - corner) / STEP, seen.shape[2], seen.shape[1])
    hits, _, directions = primary_hits(scene, coarse)
    both = inside & (hits.face >= 0) & (seen.amax(-1) < WHITE)
    at = surface_points(asset.mesh, asset.textures, hits.face[both], hits.bary[both])
    shown = shade(at, -directions[both], asset.environment, scene=scene, options=ShadeOptions(SAMPLES))
    count = max(1, len(shown))
    return (seen[both].sum() / count + BLACK) / (shown.sum() / count + BLACK)
