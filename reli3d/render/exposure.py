"""Scale of an asset's base color and lighting; images determine only the product of both.

The log brightness of the base color is the precision-weighted mean of three normal distributions: an albedo prior, the
observed colors under a lighting prior, and the network's prediction.  The lighting is then scaled so that rendering and
images have the same mean color.
"""

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

STEP = 16  # pixel stride: about a thousand pixels in four images of 512 pixels per side
SAMPLES = (8, 8, 2)  # per pixel; the noise of the mean over several hundred pixels is below a percent
MIN_CLIPPED_LINEAR = 0.97  # linear; brighter pixels may be clipped
BLACK = 1e-3  # added to both means: without a visible pixel the ratio is 1
MAX_TINT = 1.5  # largest change of the color of the lighting, as a factor of a channel

# Prior mean and standard deviation of the logarithms of mean linear base color and of the lighting (observed color over
# base color); last the standard deviation of a prediction.  Chosen on 20 meshes, original and darkened.
ALBEDO, ALBEDO_SPREAD = -2.1, 1.2
LIGHT, LIGHT_SPREAD = -0.3, 0.9
PREDICTION_SPREAD = 0.7
# Weights of observation and prediction in the chromaticity (logarithms relative to their mean over the channels):
# lighting is less saturated than base colors.
PHOTOGRAPH_COLOR, PREDICTED_COLOR = 0.8, 0.2
DARKEST = 1e-3  # linear, floor of logarithms
FARTHEST = 4.0  # largest factor on a prediction


@torch.no_grad()
def estimate_base_color_and_light(
    asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene
) -> Asset:
    """``asset`` with base color scaled by :func:`base_color_factor`, then lighting by :func:`photograph_ratio`."""
    views = images, inside, camera, scene
    base_color = (asset.textures.base_color * base_color_factor(asset, *views)).clamp(max=1.0)
    asset = replace(asset, textures=replace(asset.textures, base_color=base_color))
    return replace(asset, environment=Environment(asset.light.radiance * photograph_ratio(asset, *views)))


@torch.no_grad()
@full_precision
def photograph_ratio(asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene) -> Tensor:
    """Ratio ``(3,)`` of mean linear colors: the images over renderings of ``asset`` in its environment, with shadows.

    images: ``(V, H, W, 3)`` sRGB, at least ``STEP`` pixels per side.  inside: ``(V, H, W)`` bool, pixels inside the
    silhouette.  camera: a batch of V.  scene: rays against the asset's mesh.  The means are over a regular grid of
    pixels at which the asset is hit and the image is not overexposed.  No gradient.
    """
    seen, at, directions = _seen(asset, images, inside, camera, scene)
    shown = shade(at, -directions, asset.light, scene=scene, options=ShadeOptions(samples=SAMPLES))
    count = max(1, len(shown))
    photograph, rendered = seen.sum(0) / count + BLACK, shown.sum(0) / count + BLACK
    tint = (photograph / rendered * (rendered.sum() / photograph.sum())).clamp(1.0 / MAX_TINT, MAX_TINT)
    return tint * (photograph.sum() / (rendered * tint).sum())


@torch.no_grad()
def base_color_factor(asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene) -> Tensor:
    """Maximum a posteriori factor ``(3,)`` on the linear base color of ``asset``; 1 if no pixel is visible.

    The brightness is that of the module's text, the chromaticity a weighted mean of the observed one and the asset's.
    Arguments as in :func:`photograph_ratio`; the environment of ``asset`` is not used.
    """
    seen, at, _ = _seen(asset, images, inside, camera, scene)
    if len(seen) == 0:
        return seen.new_ones(3)
    photograph, prediction = seen.mean(0).clamp(min=DARKEST), at.base_color.mean(0).clamp(min=DARKEST)
    weights = [1.0 / spread**2 for spread in (ALBEDO_SPREAD, LIGHT_SPREAD, PREDICTION_SPREAD)]
    estimates = torch.stack([seen.new_tensor(ALBEDO), photograph.mean().log() - LIGHT, prediction.mean().log()])
    brightness = (seen.new_tensor(weights) * estimates).sum() / sum(weights)
    logs = [color.log() - color.log().mean() for color in (photograph, prediction)]
    color = (PHOTOGRAPH_COLOR * logs[0] + PREDICTED_COLOR * logs[1]).exp()
    return (brightness.exp() * color / color.mean() / prediction).clamp(1.0 / FARTHEST, FARTHEST)


def _seen(
    asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene
) -> tuple[Tensor, SurfacePoints, Tensor]:
    """Linear colors ``(N, 3)`` of the images on the grid, the points of ``asset`` there, and the ray directions."""
    first = STEP // 2
    seen, inside = srgb_to_linear(images[:, first::STEP, first::STEP]), inside[:, first::STEP, first::STEP]
    corner = camera.intrinsics.new_tensor([0.0, 0.0, 0.5, 0.5])  # centers of coarse pixels on those read
    coarse = Camera(camera.c2w, (camera.intrinsics - corner) / STEP, seen.shape[2], seen.shape[1])
    hits, _, directions = primary_hits(scene, coarse)
    both = inside & (hits.face >= 0) & (seen.amax(-1) < MIN_CLIPPED_LINEAR)
    return seen[both], surface_points(asset.mesh, asset.textures, hits.face[both], hits.bary[both]), directions[both]
