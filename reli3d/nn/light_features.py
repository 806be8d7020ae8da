"""Features of the light at surface points, by which shading is separated from paint.

Two estimates: the irradiance of the environment that the network predicts, and how the brightness of the photographs
varies with the normal.  The second needs no network: over many points the paint averages out and the light remains
(Ramamoorthi and Hanrahan 2001: a diffuse surface shows nine spherical harmonics of its light).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from reli3d.nn.heads import color_logit
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment

BLACK = 0.01  # added to a radiance before its logarithm
RIDGE = 0.02  # of the fit: holds harmonics that the visible normals do not determine near zero
DARKEST = 0.05  # of the mean brightness: the fit may ring below zero where no point was seen


@dataclass(frozen=True)
class Shading:
    irradiance: Environment  # of the predicted light, over the normal
    observed: Tensor  # (9, 3) harmonics of the photographs' linear brightness over the normal, its mean 1
    palette: Tensor  # (12,) see :func:`palette_of`

    WIDTH: ClassVar[int] = 24  # of :meth:`features`

    def features(self, normal: Tensor, color: Tensor) -> Tensor:
        """Normal, logarithms of the irradiance over pi and of the observed brightness, logit of the colour without
        shade, palette: ``(N, 24)``.

        normal: ``(N, 3)`` unit, world.  color: ``(N, 3)`` sRGB, what the views show there.  No gradient.
        """
        predicted = torch.log(self.irradiance.lookup(normal.contiguous()) / torch.pi + BLACK)
        brightness = brightness_at(normal, self.observed)
        plain = color_logit(unshaded(color, brightness))
        return torch.cat([normal, predicted, brightness.log(), plain, self.palette.expand(len(normal), -1)], -1)


def unshaded(color: Tensor, brightness: Tensor) -> Tensor:
    """sRGB colours ``(N, 3)`` divided, in linear light, by the ``brightness (N, 3)`` of the shade they lie in."""
    return linear_to_srgb((srgb_to_linear(color) / brightness).clamp(0.0, 1.0))


def palette_of(color: Tensor, plain: Tensor, seen: Tensor) -> Tensor:
    """``(12,)`` means and deviations, over the points that are ``seen (N,)``, of the logits of the colours that the
    views show and of those without shade: the look of the whole object separates its paint from a stain.
    """
    weight = ((seen + 1e-6) / (seen + 1e-6).sum())[:, None]
    values = torch.cat([color_logit(color), color_logit(plain)], -1)
    mean = (values * weight).sum(0)
    return torch.cat([mean, ((values - mean).square() * weight).sum(0).sqrt()])


def harmonics(normal: Tensor) -> Tensor:
    """The polynomials ``(N, 9)`` that span spherical harmonics up to order two; the first is 1."""
    x, y, z = normal.unbind(-1)
    return torch.stack([torch.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], -1)


def brightness_at(normal: Tensor, observed: Tensor) -> Tensor:
    """What :func:`brightness_over_normal` found, ``(9, 3)``, at unit ``normal (N, 3)``; kept from zero."""
    return (harmonics(normal) @ observed).clamp(min=DARKEST)


def brightness_over_normal(color: Tensor, seen: Tensor, normal: Tensor) -> Tensor:
    """Harmonics ``(9, 3)`` fitted by ridge least squares to linear colours ``(N, 3)`` at unit ``normal (N, 3)``.

    seen: ``(N,)`` weight of each point.  Divided by the weighted mean colour.  Without a seen point, or black: 1.
    """
    weight = (seen + 1e-6)[:, None]
    total, mean = weight.sum(), (weight * color).sum(0) / weight.sum()
    basis = harmonics(normal)
    ridge = torch.full((9,), RIDGE, device=color.device, dtype=torch.float32)
    ridge[0] = 0.0
    gram = (basis * weight).T @ basis / total + torch.diag(ridge)
    fit = torch.linalg.solve(gram, (basis * weight).T @ (color / mean.clamp(min=1e-3)) / total)
    fit[0] += (mean < 1e-3).float()
    return fit
