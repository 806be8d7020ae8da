"""Base color and light of an asset estimated from its photographs, which determine only their product.

A darker albedo under brighter light looks the same, in each channel.  The brightness of the base color is the mean of
three normal distributions: a prior of albedo, the photographs under a prior of light, and the network's prediction.
The light is then scaled until the rendering has the photographs' color.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from reli3d._bridge import full_precision
from reli3d.geometry.camera import Camera
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.color import srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import primary_hits, surface_points
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade

STEP = 16  # of the photographs' pixels one in STEP^2 is read: some thousand in four photographs of 512 pixels
SAMPLES = (8, 8, 2)  # a pixel; the noise of the mean over some hundred pixels is below a percent
WHITE = 0.97  # linear; brighter pixels may be cut off
BLACK = 1e-3  # added to both means: without a visible pixel the ratio is 1
TINT = 1.5  # largest change of the light's color, as a factor of a channel

# Prior mean and standard deviation of the logarithms of mean linear base color and of the light on it (photograph over
# base color); last the standard deviation of a prediction.  Chosen on 20 meshes, as they are and dark:
# docs/results.md.
ALBEDO, ALBEDO_SPREAD = -2.1, 1.2
LIGHT, LIGHT_SPREAD = -0.3, 0.9
PREDICTION_SPREAD = 0.7
# Color, as the logarithm of a channel over the mean of the channels: weights of photographs and prediction.  Lights are
# less colored than base colors.
PHOTOGRAPH_COLOR, PREDICTED_COLOR = 0.8, 0.2
DARKEST = 1e-3  # linear; below it a logarithm is noise
FARTHEST = 4.0  # largest factor on a prediction


@torch.no_grad()
def estimate_base_color_and_light(
    asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene
) -> Asset:
    """``asset`` with its base color times :func:`base_color_factor`, then its light times :func:`photograph_ratio`."""
    views = images, inside, camera, scene
    base_color = (asset.textures.base_color * base_color_factor(asset, *views)).clamp(max=1.0)
    asset = replace(asset, textures=replace(asset.textures, base_color=base_color))
    return replace(asset, environment=Environment(asset.light.radiance * photograph_ratio(asset, *views)))


@torch.no_grad()
@full_precision
def photograph_ratio(asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene) -> Tensor:
    """Mean linear color of photographs over that of ``asset`` under its own light with shadows, ``(3,)``.

    images: ``(V, H, W, 3)`` sRGB, at least ``STEP`` pixels a side.  inside: ``(V, H, W)`` bool, pixels inside the
    silhouette.  camera: of all V.  scene: rays against the asset's faces.  Over a regular grid of pixels
    at which the asset is hit and the photograph is not overexposed.  No gradient.  Raises ValueError for fewer pixels.
    """
    seen, at, directions = _seen(asset, images, inside, camera, scene)
    shown = shade(at, -directions, asset.light, scene=scene, options=ShadeOptions(samples=SAMPLES))
    count = max(1, len(shown))
    photograph, rendered = seen.sum(0) / count + BLACK, shown.sum(0) / count + BLACK
    tint = (photograph / rendered * (rendered.sum() / photograph.sum())).clamp(1.0 / TINT, TINT)
    return tint * (photograph.sum() / (rendered * tint).sum())


@torch.no_grad()
def base_color_factor(asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene) -> Tensor:
    """Maximum-likelihood factor ``(3,)`` on the linear base color of ``asset``.

    The mean of three normal distributions of the logarithm of its brightness: the prior of albedo, the photographs
    under the prior of light, and the prediction that ``asset`` has.  The color is a weighted mean of photographs and
    prediction.  Arguments as of :func:`photograph_ratio`; the light of ``asset`` is not used.  1 without a visible
    pixel.
    """
    seen, at, _ = _seen(asset, images, inside, camera, scene)
    if len(seen) == 0:
        return seen.new_ones(3)
    photograph, prediction = seen.mean(0).clamp(min=DARKEST), at.base_color.mean(0).clamp(min=DARKEST)
    weights = [1.0 / spread**2 for spread in (ALBEDO_SPREAD, LIGHT_SPREAD, PREDICTION_SPREAD)]
    estimates = torch.stack([seen.new_tensor(ALBEDO), photograph.mean().log() - LIGHT, prediction.mean().log()])
    brightness = (seen.new_tensor(weights) * estimates).sum() / sum(weights)
    color = (PHOTOGRAPH_COLOR * _color(photograph) + PREDICTED_COLOR * _color(prediction)).exp()
    return (brightness.exp() * color / color.mean() / prediction).clamp(1.0 / FARTHEST, FARTHEST)


def _color(value: Tensor) -> Tensor:
    return value.log() - value.log().mean()


def _seen(
    asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene
) -> tuple[Tensor, SurfacePoints, Tensor]:
    """Linear colors of the photographs ``(N, 3)`` on the grid, ``asset`` there and the directions."""
    first = STEP // 2
    seen, inside = srgb_to_linear(images[:, first::STEP, first::STEP]), inside[:, first::STEP, first::STEP]
    corner = camera.intrinsics.new_tensor([0.0, 0.0, 0.5, 0.5])  # centers of coarse pixels on those read
    coarse = Camera(camera.c2w, (camera.intrinsics - corner) / STEP, seen.shape[2], seen.shape[1])
    hits, _, directions = primary_hits(scene, coarse)
    both = inside & (hits.face >= 0) & (seen.amax(-1) < WHITE)
    return seen[both], surface_points(asset.mesh, asset.textures, hits.face[both], hits.bary[both]), directions[both]
