"""Lighting features at surface points, which let the material heads separate shading from base color.

Two estimates: the irradiance of the predicted environment, and a least-squares fit of the observed brightness to nine
spherical harmonics of the normal (Ramamoorthi and Hanrahan 2001), in which the base color averages out.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from reli3d.nn.heads import color_logit
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment

LOG_OFFSET = 0.01  # added to a radiance before its logarithm
RIDGE_WEIGHT = 0.02  # of the fit: keeps harmonics that the visible normals do not constrain near zero
MIN_BRIGHTNESS = 0.05  # of the mean brightness: the fit may ring below zero at unobserved normals


@dataclass(frozen=True)
class Shading:
    irradiance: Environment  # of the predicted lighting, indexed by the normal
    observed: Tensor  # (9, 3) harmonics of the observed linear brightness over the normal, of mean 1
    palette: Tensor  # (12,) see :func:`palette_of`

    WIDTH: ClassVar[int] = 24  # of :meth:`features`

    def features(self, normal: Tensor, color: Tensor) -> Tensor:
        """Features ``(N, 24)`` at unit ``normal (N, 3)``, observed as ``color (N, 3)``, sRGB; no gradient."""
        predicted = torch.log(self.irradiance.lookup(normal.contiguous()) / torch.pi + LOG_OFFSET)
        brightness = brightness_at(normal, self.observed)
        unlit = color_logit(unshaded(color, brightness))
        return torch.cat([normal, predicted, brightness.log(), unlit, self.palette.expand(len(normal), -1)], -1)


def unshaded(color: Tensor, brightness: Tensor) -> Tensor:
    """Color ``(N, 3)``, sRGB, divided in linear space by ``brightness (N, 3)``."""
    return linear_to_srgb((srgb_to_linear(color) / brightness).clamp(0.0, 1.0))


def palette_of(color: Tensor, unlit: Tensor, visible: Tensor) -> Tensor:
    """Mean and standard deviation ``(12,)`` of the logits of the observed ``color`` and of :func:`unshaded` colors.

    color, unlit: ``(N, 3)``, sRGB.  visible: ``(N,)``, weight of each point.
    """
    weight = ((visible + 1e-6) / (visible + 1e-6).sum())[:, None]
    values = torch.cat([color_logit(color), color_logit(unlit)], -1)
    mean = (values * weight).sum(0)
    return torch.cat([mean, ((values - mean).square() * weight).sum(0).sqrt()])


def harmonics(normal: Tensor) -> Tensor:
    """Polynomials ``(N, 9)`` that span the spherical harmonics of degrees 0 to 2; the first is 1."""
    x, y, z = normal.unbind(-1)
    return torch.stack([torch.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], -1)


def brightness_at(normal: Tensor, observed: Tensor) -> Tensor:
    """Value ``(N, 3)`` of the fit ``observed (9, 3)`` at unit ``normal (N, 3)``, at least MIN_BRIGHTNESS."""
    return (harmonics(normal) @ observed).clamp(min=MIN_BRIGHTNESS)


def brightness_over_normal(color: Tensor, visible: Tensor, normal: Tensor) -> Tensor:
    """Ridge regression of linear ``color (N, 3)`` on the :func:`harmonics` of unit ``normal (N, 3)``, ``(9, 3)``.

    visible: ``(N,)``, weights.  Relative to the weighted mean color; the constant 1 where that is black.
    """
    weight = (visible + 1e-6)[:, None]
    total, mean = weight.sum(), (weight * color).sum(0) / weight.sum()
    basis = harmonics(normal)
    ridge = basis.new_tensor([0.0, *[RIDGE_WEIGHT] * 8])
    gram = (basis * weight).T @ basis / total + torch.diag(ridge)
    fit = torch.linalg.solve(gram, (basis * weight).T @ (color / mean.clamp(min=1e-3)) / total)
    fit[0] += (mean < 1e-3).float()
    return fit
