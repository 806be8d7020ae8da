"""Roughness and metallic by search: the surface is segmented into materials by similarity, and each takes the best of a
grid of values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from reli3d.fit.bounce import reflected
from reli3d.fit.input_images import InputImages
from reli3d.fit.lighting import Lights
from reli3d.fit.losses import MIN_LINEAR, display_derivative
from reli3d.fit.shading import radiance
from reli3d.fit.unknowns import (
    MATERIALS,
    Start,
    Unknowns,
    bent,
    logits_of,
    material_logits,
    surface_change,
    unit,
)
from reli3d.fit.view_colors import MIN_COVERAGE, display_planes, view_colors, view_weights
from reli3d.geometry.bake import dilate, rasterize_texels
from reli3d.geometry.hits import interpolate
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.color import srgb_to_linear
from reli3d.render.gbuffer import surface_points
from reli3d.render.points import SurfacePoints

GUIDE_TEXELS = 256  # along a side of the atlas, at which the surface is segmented
# Differences of guide features that count as 1: log chromaticity (2), log brightness, roughness, metallic, position (3)
FEATURE_SCALES = (0.15, 0.15, 0.4, 0.4, 0.4, 2.0, 2.0, 2.0)
SOFTNESS = 0.5  # standard deviation of a material's membership, in units of the features
KMEANS_STEPS, KMEANS_POINTS = 12, 8192
ROUGHNESS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0)
METALLIC = (0.03, 0.97)
DIELECTRIC_F0 = 0.04
POINTS_PER_MATERIAL = 192
SEARCH_SAMPLES = (24, 24, 4)  # of light, BSDF and cosine
DIELECTRIC_RANGE, METAL_RANGE = (0.03, 0.9), (0.35, 0.98)  # of the base color
PATTERN_STD = 0.25  # relative standard deviation of the base color within a material
NOISE_STD = 0.04  # display values, of a rendering with the fitted surface and light
ROUGHNESS_PRIOR = (0.45, 0.25, 0.03)  # mean, standard deviation, and relative increase of the error at one of them
METAL_MARGIN = 0.85  # a metal must have an error below this fraction of the best dielectric's
MIN_WEIGHT = 0.5  # of a view, from which it counts in the search
MIN_PAIRS = 64  # of points and views, from which a material is searched


@dataclass(frozen=True)
class FixedSurface:
    """Constants of a fit of maps and light.

    asset: the surface with the start's maps.  received: ``(vertices, 3)``, of :func:`~reli3d.fit.bounce.gathered`.
    used: indices of the views whose colors are used.
    """

    start: Start
    asset: Asset
    received: Tensor
    images: InputImages
    used: list[int]


@dataclass(frozen=True)
class Observed:
    """Surface points and the colors of the input images there.

    points: N texels, with the start's material.  received: ``(N, 3)``, of :func:`~reli3d.fit.bounce.gathered`.
    logits: ``(N, 5)`` of the material.  uv: ``(N, 2)``.  color: ``(N, V, 3)`` linear.  weight: ``(N, V)``, of
    :func:`~reli3d.fit.view_colors.view_weights`. material: ``(N,)`` index.
    """

    points: SurfacePoints
    received: Tensor
    logits: Tensor
    uv: Tensor
    color: Tensor
    weight: Tensor
    material: Tensor


@torch.no_grad()
def segmented(unknowns: Unknowns, data: FixedSurface, scene: RayScene, seed: int) -> Observed:
    """Segments the surface into at most ``MATERIALS`` materials and sets ``unknowns.membership``.

    k-means over guide features: chromaticity and brightness of the input images, divided by the irradiance, the
    start's roughness and metallic, and, weakly, the position.  Texels that no view shows take the material of the
    nearest observed texel in the atlas.
    """
    asset, images, size = data.asset, data.images.select(data.used), GUIDE_TEXELS
    texels = rasterize_texels(asset.mesh, size)
    index = torch.nonzero(texels.valid.reshape(-1))[:, 0]
    face, bary = texels.face.reshape(-1)[index], texels.bary.reshape(-1, 2)[index]
    at = surface_points(asset.mesh, asset.textures, face, bary)
    color, cover = view_colors(display_planes(images), at.position, images.camera)
    weight = view_weights(scene, at.position, at.normal, images.camera) * (cover > MIN_COVERAGE)
    seen = torch.nonzero(weight.sum(1) > 0.0)[:, 0]
    row, column = torch.div(index, size, rounding_mode="floor"), index % size
    uv = (torch.stack([column, row], -1).float() + 0.5) / size
    at, color, weight = at[seen], srgb_to_linear(color[seen].clamp(0.0, 1.0)), weight[seen]
    feature = _features(at, color, weight, Lights.of(unknowns, data.start, images))
    rng = torch.Generator().manual_seed(seed)
    centers = k_means(feature, MATERIALS, rng)
    distance = torch.cdist(feature, centers).square()
    member = torch.softmax(-distance / (2.0 * SOFTNESS**2), 1)
    full = member.new_zeros(size * size, MATERIALS)
    full[index[seen]] = member
    valid = torch.zeros(size * size, dtype=torch.bool, device=full.device)
    valid[index[seen]] = True
    unknowns.membership = dilate(full.reshape(size, size, -1), valid.reshape(size, size)).contiguous()
    bounced = interpolate(data.received, asset.mesh.faces, face[seen], bary[seen])
    logits, material = material_logits(at), distance.argmin(1)
    for k in range(MATERIALS):  # until it is searched, a material has the start's median roughness and metallic
        if bool((material == k).any()):
            unknowns.materials[k, 3:] = logits[material == k, 3:].median(0).values
    return Observed(at, bounced, logits, uv[seen], color, weight, material)


def _features(at: SurfacePoints, color: Tensor, weight: Tensor, lights: Lights) -> Tensor:
    logs = color.clamp(min=MIN_LINEAR).log()
    for views in lights.distinct():
        irradiance = lights.of_view(views[0]).irradiance().lookup(at.normal)
        logs[:, views] -= irradiance.clamp(min=1e-4).log()[:, None]
    mean = (weight[..., None] * logs).sum(1) / weight.sum(1, keepdim=True)
    colors = [mean[:, 0] - mean[:, 1], mean[:, 2] - mean[:, 1], mean.mean(1)]
    values = torch.cat([torch.stack([*colors, at.roughness, at.metallic], 1), at.position], 1)
    return values / values.new_tensor(FEATURE_SCALES)


def k_means(points: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """Centers ``(count, C)`` of ``points (N, C)`` by Lloyd's algorithm from k-means++ seeds, on a random subset."""
    order = torch.randperm(len(points), generator=rng, dtype=torch.int64, device="cpu")[:KMEANS_POINTS]
    points = points[order.to(points.device)]
    centers = points[:1]
    for _ in range(count - 1):
        square = torch.cdist(points, centers).amin(1).square().cpu() + 1e-12
        centers = torch.cat([centers, points[torch.multinomial(square, 1, generator=rng).to(points.device)]])
    for _ in range(KMEANS_STEPS):
        nearest = torch.cdist(points, centers).argmin(1)
        total = torch.zeros_like(centers).index_add_(0, nearest, points)
        number = torch.bincount(nearest, minlength=count)[:, None]
        centers = torch.where(number > 0, total / number.clamp(min=1), centers)
    return centers


@dataclass(frozen=True)
class Pairs:
    """M pairs of a surface point and a view that shows it.

    points: M rows; their material is not used.  wo: ``(M, 3)`` unit, to the eye.  view: ``(M,)``.  received:
    ``(M, 3)``, of :func:`~reli3d.fit.bounce.gathered`.
    """

    points: SurfacePoints
    wo: Tensor
    view: Tensor
    received: Tensor
    lights: Lights
    scene: RayScene
    seed: int

    def lit(self, base_color: float, roughness: float, metallic: float) -> Tensor:
        """Radiance ``(M, 3)`` of the pairs if all points have this material."""
        one, at = torch.ones_like(self.wo[:, 0]), self.points
        material = (base_color * torch.ones_like(self.wo), roughness * one, metallic * one)
        points = SurfacePoints(at.position, at.ng, at.normal, *material)
        shading = partial(radiance, samples=SEARCH_SAMPLES, scene=self.scene, seed=self.seed)
        return self.lights.evaluate(points, self.wo, self.view, shading) + reflected(points, self.received)


@torch.no_grad()
def searched(
    unknowns: Unknowns, data: FixedSurface, seen: Observed, scene: RayScene, seed: int, max_roughness: float = 1.0
) -> None:
    """Sets roughness, metallic and mean base color of every material in ``unknowns.materials`` by exhaustive search.

    At random points of a material, in all views that show them, radiance is affine in the base color for a dielectric
    and for a metal.  So for each roughness of ``ROUGHNESS`` and each metallic of ``METALLIC`` the base color of each
    point has a closed form, a ridge regression towards the material's mean; the best pair has the least robust
    relative error.  The light is the current one.
    """
    images = data.images.select(data.used)
    lights, exposure = Lights.of(unknowns, data.start, images), unknowns.exposure[data.used].exp()
    rng = torch.Generator().manual_seed(seed)
    for k in range(MATERIALS):
        row = torch.nonzero((seen.material == k) & ((seen.weight > MIN_WEIGHT).sum(1) >= 2))[:, 0]
        row = row[torch.randperm(len(row), generator=rng, dtype=torch.int64, device="cpu")[:POINTS_PER_MATERIAL]]
        point, view = torch.nonzero(seen.weight[row] > MIN_WEIGHT, as_tuple=True)
        if len(point) < MIN_PAIRS:
            continue
        at, bounced, weight = seen.points[row], seen.received[row][point], seen.weight[row[point], view]
        normal, _ = bent(unknowns, at.position, at.normal)
        wo = unit(images.camera.c2w[view, :3, 3] - at.position[point])
        observed = seen.color[row[point], view] / exposure[view, None]
        pairs = Pairs(replace(at, normal=normal)[point], wo, view, bounced, lights, scene, seed)
        color, roughness, metallic = best_material(pairs.lit, observed, weight, point, len(row), max_roughness)
        ones = torch.ones_like(color[:, 0])
        logits = logits_of(color, roughness * ones, metallic * ones)
        plain = surface_change(unknowns, seen.logits[row], at.position, seen.uv[row], materials=False)
        shift = (logits - seen.logits[row] - plain)[:, :3].median(0).values
        unknowns.materials[k] = torch.cat([shift, logits[0, 3:]])


def best_material(
    lit: Callable[[float, float, float], Tensor],
    target: Tensor,
    weight: Tensor,
    point: Tensor,
    count: int,
    max_roughness: float = 1.0,
) -> tuple[Tensor, float, float]:
    """Base colors ``(count, 3)``, roughness and metallic with the least error.

    lit: radiance ``(M, 3)`` with a base color, roughness and metallic.  The rest as in :func:`regression`.
    """
    diffuse = lit(1.0, 0.5, 0.0) - lit(0.0, 0.5, 0.0)
    best, chosen = float("inf"), (torch.full_like(target[:count], 0.5), 0.5, 0.0)
    for roughness in (r for r in ROUGHNESS if r <= max_roughness):
        black, white = lit(0.0, roughness, 1.0), lit(1.0, roughness, 1.0)
        tint = white - black
        for metallic in METALLIC:
            metal = metallic > 0.5
            constant, factor = (black, tint) if metal else (black + DIELECTRIC_F0 * tint, diffuse)
            error, color = regression(
                constant, factor, target, weight, point, count, METAL_RANGE if metal else DIELECTRIC_RANGE
            )
            error *= 1.0 + ROUGHNESS_PRIOR[2] * ((roughness - ROUGHNESS_PRIOR[0]) / ROUGHNESS_PRIOR[1]) ** 2
            error = error / METAL_MARGIN if metal else error
            if error < best:
                best, chosen = error, (color, roughness, metallic)
    return chosen


def regression(
    constant: Tensor,
    factor: Tensor,
    target: Tensor,
    weight: Tensor,
    point: Tensor,
    count: int,
    limits: tuple[float, float],
) -> tuple[float, Tensor]:
    """Mean error and base colors ``(count, 3)`` for radiance ``constant + factor * base color``, each ``(M, 3)``.

    target: ``(M, 3)`` observed radiance.  weight: ``(M,)``.  point: ``(M,)`` index of the point that each row shows.
    limits: of the base color.
    Errors are in display values and robust (Geman and McClure); the deviation of a point's color from the median
    counts with ``PATTERN_STD``.
    """
    scale = weight[:, None] * (display_derivative(target) / NOISE_STD).square()
    rest = target - constant
    low, high = limits

    def summed(values: Tensor) -> Tensor:
        return values.new_zeros(count, 3).index_add_(0, point, values)

    product, square = summed(scale * factor * rest), summed(scale * factor.square())
    color = (product / square.clamp(min=1e-9)).clamp(low, high)
    mean = color.median(0).values
    ridge = 1.0 / (PATTERN_STD * mean).square()
    color = ((product + ridge * mean) / (square + ridge)).clamp(low, high)
    residual = scale * (rest - factor * color[point]).square()
    error = (residual / (1.0 + 0.1 * residual)).mean() + (ridge * (color - mean).square()).mean() * count / len(point)
    return float(error), color
