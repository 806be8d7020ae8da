"""What a fit makes small: one function a term with its reason, and all weights in :class:`Weights`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from reli3d.fit.fields import light_field
from reli3d.fit.unknowns import LIGHT_ROWS, Unknowns
from reli3d.geometry.grid import squared_laplacian

DARK = 0.02  # linear; below it errors count as at it: there photographs hold noise and eyes see little
ROBUST = 0.25  # of the display range; an error beyond it counts linearly: mirrored surroundings, glare, wrong masks
SAME = 0.1  # of the display range; colours of one point that differ by more are another surface or a highlight
REPAINT = 0.25  # of the logits of base colour: a point that changes by more had the wrong paint at the start
PALETTE = 0.5  # of the logarithm of base colour: beyond it two points are of two paints rather than of two shades
TINT = 0.25  # of the logarithm of colour without brightness: what the light's own colours do to one paint


@dataclass(frozen=True)
class Weights:
    """Weights of all terms; lengths in cells of the grid, colours in the display's range."""

    outline: float = 30.0  # of :func:`outline`
    agreement: float = 0.3  # of :func:`agreement`
    shading: float = 30.0  # of :func:`display_error` while the surface moves
    curvature: float = 0.5  # of :func:`curvature`
    stay: float = 2e-3  # of the level's distance from the start, over the number of views
    picture: float = 1.0  # of :func:`display_error` in the fit of the maps and the light
    palette: float = 0.01  # of :func:`palette`
    hue: float = 0.1  # of :func:`hue_drift`
    base_coarse: float = 0.02  # prior of the base colour's coarse field towards the start, over the number of views
    paint: float = 20.0  # of :func:`near_paint`, over the fourth power of the number of views whose colours are used
    finish: float = 0.05  # prior of roughness and metallic towards the start, over the number of views
    light: float = 2e-3  # prior of the light's maps towards the start
    light_slope: float = 2e-3  # of :func:`slopes` of the light
    exposure: float = 0.1  # of exposures, whose mean the light already has
    demodulation: float = 0.3  # of :func:`shared_pattern`
    free_bend: float = 2e-3  # of the squared bend of the normals while the paint is fitted, times the number of views
    bend: float = 20.0  # the same afterwards, of the bend that is kept, over the square of the number of views


def display_slope(target: Tensor) -> Tensor:
    """Slope of the display's curve at linear ``target``, about x^(1/2.2), level below ``DARK``."""
    return (1.0 / 2.2) * target.clamp(min=DARK) ** (1.0 / 2.2 - 1.0)


def display_error(image: Tensor, other: Tensor, target: Tensor, bright: Tensor) -> Tensor:
    """Mean squared error of ``image (N, 3)`` in the display's range, as a value whose gradient has no bias.

    image, other: two independent estimates of the same linear radiance.  d (I - T)^2 = 2 (I - T) dI: one estimate
    tells the difference, the other the slope, so the noise does not multiply with itself as in a square.  The display's
    curve is replaced by its tangent at the photograph, because a curve of a noisy value has another mean than the
    curve of the mean.  Beyond ``ROBUST`` the error grows linearly.  bright: ``(N, 3)`` bool, photographs at the upper
    end of their range, where only what is too dark is an error.
    """
    slope = display_slope(target)
    miss = ((other - target) * slope).detach()
    miss = torch.where(bright, miss.clamp(max=0.0), miss)
    whole, miss = miss, miss * (ROBUST / miss.abs().clamp(min=ROBUST))
    apart = (image.detach() - target) * slope
    value = miss * torch.where(bright, apart.clamp(max=0.0), apart) + miss * (whole - miss)  # squared, then linear
    pull = 2.0 * miss * slope * image
    return (value + pull - pull.detach()).mean()


def agreement(color: Tensor, weight: Tensor) -> Tensor:
    """How much the views disagree on the colour of a point, mean over points.

    color: ``(N, V, 3)`` display values where the point projects.  weight: ``(N, V)``, 0 where it is not seen.  A point
    on the true surface has one colour in all views that see it, but for highlights; a point beside it has another in
    each.  Neither light nor material is needed, so this term works before they are fitted.  Points that fewer than two
    views see do not count.
    """
    total = weight.sum(1)
    seen = (weight > 0.0).sum(1) >= 2
    share = weight / total.clamp(min=1e-6)[:, None]
    mean = (share[..., None] * color).sum(1, keepdim=True)
    square = (color - mean).square().sum(-1)
    apart = SAME * SAME * (1.0 - torch.exp(-square / (2.0 * SAME * SAME)))  # bounded: an outlier pulls no surface
    return ((share * apart).sum(1) * seen).sum() / seen.sum().clamp(min=1) / (SAME * SAME)


def outline(cover: Tensor, mask: Tensor) -> Tensor:
    """Mean absolute difference of antialiased coverage and mask: what the silhouettes miss and what is too much."""
    return (cover - mask).abs().mean()


def curvature(level: Tensor, cell: float, share: Tensor) -> Tensor:
    """Squared Laplacian of the level, in cells, summed with the weights ``share``: bumps that no photograph asks for.

    level, share: ``(X, Y, Z)``.  Silhouettes and colours leave the surface free between what they see; a plain grid
    answers with noise.
    """
    return squared_laplacian(level, share) / (cell * cell)


def slopes(values: Tensor) -> Tensor:
    """Mean absolute difference of neighbours of a map ``(H, W, C)`` that is periodic along W: edges may stay, noise
    goes."""
    return values.diff(dim=0).abs().mean() + (values - values.roll(1, 1)).abs().mean()


def near_start(grids: Sequence[Tensor]) -> Tensor:
    """Sum over grids of the mean squared change: parameters without data stay at the start."""
    return torch.stack([grid.square().mean() for grid in grids]).sum()


def near_paint(change: Tensor, weights: Weights, views: int) -> Tensor:
    """A bounded distance of the paint from the start: ``change (N, 3)`` of the logits of base colour at points, mean.

    With few views the normals are far off and the light is hardly told.  What these two leave unexplained is shading,
    and it would be painted on: a small change of most points.  Where the start has the wrong paint the change is large;
    beyond ``REPAINT`` the gradient fades.  The fourth power of the number of views makes the weight 0.25 with 3 of
    them, where five meshes lose at most 0.2 dB of base colour, and 5e-4 with 14.
    """
    square = change.square().mean(1)
    return weights.paint / views**4 * (square / (1.0 + square / (REPAINT * REPAINT))).mean()


def palette(color: Tensor, tint: Tensor) -> Tensor:
    """How many base colours an object has: mean over random pairs of points of a bounded distance of their colours.

    color: ``(N, 3)`` logarithms of base colour at points in random order, each paired with the next.  tint: ``(N, 3)``
    photographed colour, any brightness; pairs of another tint count less.  Shading makes shades of one colour, which
    this draws together so that the light has to explain them; pairs that differ by much more than ``PALETTE`` have
    almost no gradient (the global sparsity of reflectances of Barron and Malik 2015, Shape, Illumination, and
    Reflectance from Shading, section 4.1.2, on pairs).
    """
    logs = tint.clamp(min=DARK).log()
    logs = logs - logs.mean(1, keepdim=True)
    alike = torch.exp(-(logs - logs.roll(1, 0)).square().sum(1) / (2.0 * TINT * TINT))
    square = (color - color.roll(1, 0)).square().mean(1)
    return (alike * square / (square + PALETTE * PALETTE)).mean()


def hue_drift(color: Tensor, start: Tensor) -> Tensor:
    """How far the object's mean hue has moved, squared.

    color, start: ``(N, 3)`` logarithms of base colour at the same points.  One factor a channel is free between paint
    and light: photographs do not tell a red object under white light from a white one under red light, and the other
    terms pick one.  The start has read many objects and knows better.  The brightness is left free: a start is often
    too dark or too bright as a whole.
    """
    drift = (color - start).mean(0)
    return (drift - drift.mean()).square().mean()


def priors(unknowns: Unknowns, weights: Weights, views: int) -> Tensor:
    """What holds material, light and exposures to the start: less, the more photographs there are."""
    base, finish = ([grid[..., part] for grid in unknowns.material] for part in (slice(0, 3), slice(3, 5)))
    loss = weights.base_coarse / views * near_start(base) + weights.finish / views * near_start(finish)
    loss = loss + weights.light * near_start(unknowns.light)
    loss = loss + weights.light_slope * slopes(light_field(unknowns.light, LIGHT_ROWS))
    return loss + weights.exposure * unknowns.exposure.square().mean()


def shared_pattern(change: Tensor, shading: Tensor) -> Tensor:
    """Squared correlation, over points, of the change of log base colour ``(N,)`` and log shading ``(N,)``.

    Paint has no reason to follow the light.  Where a change of the paint repeats the pattern of the shading, or its
    negative, the light's error is being written into the paint (after Hasselgren, Hofmann and Munkberg 2022, Shape,
    Light, and Material Decomposition, section 3: demodulation).
    """
    a, b = change - change.mean(), (shading - shading.mean()).detach()
    return (a * b).mean().square() / (b.square().mean() + 1e-4)
