"""Paint and light of an asset estimated from its photographs, which determine only their product.

A darker paint under a brighter light looks the same, in each channel.  The brightness of the paint is the mean of
three normal distributions: a prior of paint, the photographs under a prior of light, and the guess of a network.  The
light is then scaled until the asset has the photographs' colour.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

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
BLACK = 1e-3  # added to both means: where nothing is seen the ratio is 1
TINT = 1.5  # by which the light's colour may change beside its brightness

# Prior mean and standard deviation of the logarithms of mean linear paint and of the light on it (photograph over
# paint); last the standard deviation of a guess.  Chosen on 20 meshes, as they are and dark:
# docs/measurements/paint_and_light.md.
PAINT, PAINT_SPREAD = -2.1, 1.2
LIGHT, LIGHT_SPREAD = -0.3, 0.9
GUESS_SPREAD = 0.7
# Colour, as the logarithm of a channel over the mean of the channels: weights of the photographs' and of the guess.
# Lights are less coloured than paints.
SEEN_COLOR, GUESSED_COLOR = 0.8, 0.2
DARKEST = 1e-3  # linear; below it a logarithm is noise
FARTHEST = 4.0  # factor by which a guess is changed at most


@torch.no_grad()
def estimate_paint_and_light(asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene) -> Asset:
    """``asset`` with its paint times :func:`paint_factor`, and then its light times :func:`photograph_ratio`."""
    views = images, inside, camera, scene
    base_color = (asset.textures.base_color * paint_factor(asset, *views)).clamp(max=1.0)
    asset = replace(asset, textures=replace(asset.textures, base_color=base_color))
    return replace(asset, environment=Environment(asset.light.radiance * photograph_ratio(asset, *views)))


@torch.no_grad()
def photograph_ratio(asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene) -> Tensor:
    """Mean linear colour of photographs over that of ``asset`` under its own light with shadows, ``(3,)``.

    images: ``(V, H, W, 3)`` sRGB, at least ``STEP`` pixels a side.  inside: ``(V, H, W)`` bool, pixels that show
    nothing but the object.  camera: of all V.  scene: rays against the asset's faces.  Over a regular grid of pixels
    at which the asset is hit and the photograph is not overexposed.  No gradient.  Raises ValueError for fewer pixels.
    """
    seen, at, directions = _seen(asset, images, inside, camera, scene)
    shown = shade(at, -directions, asset.light, scene=scene, options=ShadeOptions(samples=SAMPLES))
    count = max(1, len(shown))
    photograph, rendered = seen.sum(0) / count + BLACK, shown.sum(0) / count + BLACK
    tint = (photograph / rendered * (rendered.sum() / photograph.sum())).clamp(1.0 / TINT, TINT)
    return tint * (photograph.sum() / (rendered * tint).sum())


@torch.no_grad()
def paint_factor(asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene) -> Tensor:
    """Factor ``(3,)`` of the linear base colour of ``asset`` that makes it the likeliest.

    The mean of three normal distributions in the logarithm of its brightness: the prior of paint, the photographs under
    the prior of light, and the guess that ``asset`` has.  The colour is a weighted mean of photographs' and guess'.
    Arguments as of :func:`photograph_ratio`; the light of ``asset`` is not used.  1 where nothing is seen.
    """
    seen, at, _ = _seen(asset, images, inside, camera, scene)
    if len(seen) == 0:
        return seen.new_ones(3)
    photograph, guess = seen.mean(0).clamp(min=DARKEST), at.base_color.mean(0).clamp(min=DARKEST)
    weights = [1.0 / spread**2 for spread in (PAINT_SPREAD, LIGHT_SPREAD, GUESS_SPREAD)]
    estimates = torch.stack([seen.new_tensor(PAINT), photograph.mean().log() - LIGHT, guess.mean().log()])
    brightness = (seen.new_tensor(weights) * estimates).sum() / sum(weights)
    color = (SEEN_COLOR * _color(photograph) + GUESSED_COLOR * _color(guess)).exp()
    return (brightness.exp() * color / color.mean() / guess).clamp(1.0 / FARTHEST, FARTHEST)


def _color(value: Tensor) -> Tensor:
    return value.log() - value.log().mean()


def _seen(
    asset: Asset, images: Tensor, inside: Tensor, camera: Camera, scene: RayScene
) -> tuple[Tensor, SurfacePoints, Tensor]:
    """Linear colours of the photographs ``(N, 3)`` on the grid, what ``asset`` has there, and the rays' directions."""
    first = STEP // 2
    seen, inside = srgb_to_linear(images[:, first::STEP, first::STEP]), inside[:, first::STEP, first::STEP]
    corner = camera.intrinsics.new_tensor([0.0, 0.0, 0.5, 0.5])  # centres of coarse pixels on those read
    coarse = Camera(camera.c2w, (camera.intrinsics - corner) / STEP, seen.shape[2], seen.shape[1])
    hits, _, directions = primary_hits(scene, coarse)
    both = inside & (hits.face >= 0) & (seen.amax(-1) < WHITE)
    return seen[both], surface_points(asset.mesh, asset.textures, hits.face[both], hits.bary[both]), directions[both]
