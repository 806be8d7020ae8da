"""Loss terms of a fit, one function each, and their :class:`Weights`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from reli3d.fit.input_images import SATURATED_LINEAR
from reli3d.fit.unknowns import Start, Unknowns, light_maps
from reli3d.render.latlong import texel_solid_angles

MIN_LINEAR = 0.02  # linear radiance below which the display's derivative is constant: there images contain mostly noise
HUBER_DELTA = 0.25  # display values; larger residuals count linearly: reflected surroundings, glare, wrong masks
AGREEMENT_SIGMA = 0.1  # display values; larger differences at one point come from other surfaces or highlights
BASE_COLOR_SCALE = 0.25  # logits; a larger change of base color corrects a wrong start, a smaller one may be shading
PALETTE_SCALE = 0.5  # log base color; points that differ by more have different materials, not different shading
LIGHT_PRIOR_VIEWS = 14  # views per lighting up to which the priors of the lighting have their full weight
CHROMATICITY_SIGMA = 0.25  # log color without brightness: variation that colored light causes on one material


@dataclass(frozen=True)
class Weights:
    """Weights of all terms; lengths in cells of the grid, colors in display values."""

    outline: float = 30.0  # of the silhouettes
    agreement: float = 0.3  # of :func:`agreement`
    shading: float = 30.0  # of :func:`display_error` while the surface is fitted
    curvature: float = 0.5  # of the squared Laplacian of the signed distance, where silhouettes and colors say little
    sdf_change: float = 2e-3  # of the squared change of the signed distance; divided by the number of views
    image: float = 1.0  # of :func:`display_error` in the fit of the maps and the lighting
    palette: float = 0.01  # of :func:`palette`
    base_coarse: float = 0.005  # pulls the base color's coarse field to the start; divided by the number of views
    base_color: float = 20.0  # of :func:`near_base_color`; over the 4th power of the number of views with used colors
    finish: float = 0.05  # pulls roughness and metallic to the start; divided by the number of views
    light: float = 3e-3  # pulls the lighting to the start
    light_variation: float = 2e-3  # of :func:`total_variation` of the lighting
    background: float = 0.05  # of :func:`near_background`
    exposure: float = 0.1  # of squared log exposures; their mean is ambiguous with the scale of the lighting
    free_bend: float = 2e-3  # of the squared bend while the material is fitted; multiplied by the number of views
    bend: float = 20.0  # of the squared bend that is kept; divided by the squared number of views


def display_error(image: Tensor, other: Tensor, target: Tensor, bright: Tensor) -> Tensor:
    """Huber loss of ``image (N, 3)`` in display values, mean over all; unbiased value and gradient of noisy images.

    image, other: two independent estimates of the same linear radiance.  The gradient of (I - T)^2 is 2 (I - T) dI: one
    estimate gives the residual I - T, the other dI, so that their noise is uncorrelated.  The display curve is replaced
    by its tangent at ``target``, because a nonlinear function of a noisy value is biased.  Residuals above
    ``HUBER_DELTA`` count linearly.

    target: ``(N, 3)`` linear radiance of the input images.  bright: ``(N, 3)`` bool, saturated values of ``target``,
    where only a negative residual counts.
    """
    derivative = (1.0 / 2.2) * target.clamp(min=MIN_LINEAR) ** (1.0 / 2.2 - 1.0)  # of x^(1/2.2)
    residual = ((other - target) * derivative).detach()
    residual = torch.where(bright, residual.clamp(max=0.0), residual)
    full, residual = residual, residual * (HUBER_DELTA / residual.abs().clamp(min=HUBER_DELTA))
    difference = (image.detach() - target) * derivative
    difference = torch.where(bright, difference.clamp(max=0.0), difference)
    value = residual * difference + residual * (full - residual)  # quadratic, then linear
    surrogate = 2.0 * residual * derivative * image  # has the gradient
    return (value + surrogate - surrogate.detach()).mean()


def estimated_error(lit: Callable[[int], Tensor], target: Tensor, seed: int, independent: bool) -> Tensor:
    """:func:`display_error` of the estimates ``lit(2 seed)`` and ``lit(2 seed + 1)``, which has no gradient.

    independent: False: the second is the first, so that the gradient is that of the returned value, for tests.
    """
    other = image = lit(2 * seed)
    if independent:
        with torch.no_grad():
            other = lit(2 * seed + 1)
    return display_error(image, other, target, target > SATURATED_LINEAR)


def agreement(color: Tensor, weight: Tensor) -> Tensor:
    """Photo-consistency: weighted variance of a point's color over the views, robust, mean over points.

    color: ``(N, V, 3)`` display values at the projections of each point.  weight: ``(N, V)``, 0 where it is occluded.
    The term needs neither lighting nor material.  Points visible in fewer than two views do not count.
    """
    total = weight.sum(1)
    valid = (weight > 0.0).sum(1) >= 2
    weight = weight / total.clamp(min=1e-6)[:, None]
    mean = (weight[..., None] * color).sum(1, keepdim=True)
    square = (color - mean).square().sum(-1)
    variance = AGREEMENT_SIGMA**2
    robust = variance * (1.0 - torch.exp(-square / (2.0 * variance)))  # bounded: outliers have no gradient
    return ((weight * robust).sum(1) * valid).sum() / valid.sum().clamp(min=1) / variance


def total_variation(values: Tensor) -> Tensor:
    """Total variation of a map ``(H, W, C)``, periodic along W: mean absolute difference of neighbors."""
    return values.diff(dim=0).abs().mean() + (values - values.roll(1, 1)).abs().mean()


def near_start(grids: Sequence[Tensor]) -> Tensor:
    """Sum over grids of the mean squared change; keeps unconstrained parameters at their initial values."""
    return torch.stack([grid.square().mean() for grid in grids]).sum()


def near_base_color(change: Tensor, weights: Weights, views: int) -> Tensor:
    """Robust prior that pulls the base color to the start, mean over points; change: ``(N, 3)`` in logits.

    With few views, residual shading would be baked into the base color as a small change at most points; a wrong
    initial color needs a large change, so the gradient decreases above ``BASE_COLOR_SCALE``.  The weight is divided by
    ``views**4``: 0.25 at 3 views and 5e-4 at 14.
    """
    square = change.square().mean(1)
    return weights.base_color / views**4 * (square / (1.0 + square / (BASE_COLOR_SCALE * BASE_COLOR_SCALE))).mean()


def palette(color: Tensor, tint: Tensor) -> Tensor:
    """Sparsity of base colors: mean robust color distance over random pairs of points.

    color: ``(N, 3)`` logarithms of base color at points in random order, each paired with the next.  tint: ``(N, 3)``
    linear color in the input images, at any scale; pairs of different chromaticity count less.  Variation within one
    material is reduced, so that the lighting explains it; pairs that differ by much more than ``PALETTE_SCALE`` have
    almost no gradient (the global sparsity of reflectances of Barron and Malik 2015, Shape, Illumination, and
    Reflectance from Shading, section 4.1.2, on pairs).
    """
    logs = tint.clamp(min=MIN_LINEAR).log()
    logs = logs - logs.mean(1, keepdim=True)
    similarity = torch.exp(-(logs - logs.roll(1, 0)).square().sum(1) / (2.0 * CHROMATICITY_SIGMA * CHROMATICITY_SIGMA))
    square = (color - color.roll(1, 0)).square().mean(1)
    return (similarity * square / (square + PALETTE_SCALE * PALETTE_SCALE)).mean()


def priors(unknowns: Unknowns, weights: Weights, views: int) -> Tensor:
    """Priors that pull material, lighting and exposures to the start.

    The material's are divided by ``views``.  The lighting's are multiplied by ``(LIGHT_PRIOR_VIEWS / n)**2`` if the
    number n of views per lighting exceeds it: a lighting smoother than the true one biases roughness upwards.
    """
    base, finish = ([grid[..., part] for grid in unknowns.material] for part in (slice(0, 3), slice(3, 5)))
    loss = weights.base_coarse / views * near_start(base) + weights.finish / views * near_start(finish)
    variation = torch.stack([total_variation(m) for m in light_maps(unknowns.light)]).sum()
    light = weights.light * near_start(unknowns.light) + weights.light_variation * variation
    loss = loss + min(1.0, LIGHT_PRIOR_VIEWS * len(unknowns.light[0]) / views) ** 2 * light
    return loss + weights.exposure * unknowns.exposure.square().mean()


def near_background(unknowns: Unknowns, start: Start) -> Tensor:
    """Squared change of log radiance times ``start.observed``, mean over the sphere, channels and lightings.

    Where the background is saturated, only a decrease counts.  0 without a background.
    """
    if start.observed is None or start.clipped is None:
        return unknowns.exposure.new_zeros(())
    change = light_maps(unknowns.light)
    change = torch.where(start.clipped, change.clamp(max=0.0), change)
    groups, rows, _, channels = change.shape
    area = texel_solid_angles(rows, 2 * rows, change.device).to(change)[:, None, None]
    return (start.observed * area * change.square()).sum() / (4.0 * math.pi * channels * groups)
