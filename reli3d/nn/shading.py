"""What a surface point is told of the light on it, so that shade can be told from paint.

Two estimates: the irradiance of the environment that the network predicts, and how the brightness of the photographs
varies with the normal.  The second needs no network: over many points the paint averages out and the light remains
(Ramamoorthi and Hanrahan 2001: a diffuse surface shows nine spherical harmonics of its light).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from reli3d.render.environment import Environment

BLACK = 0.01  # added to a radiance before its logarithm
RIDGE = 0.02  # of the fit: holds harmonics that the visible normals do not determine near zero
DARKEST = 0.05  # of the mean brightness: the fit may ring below zero where no point was seen


@dataclass(frozen=True)
class Shading:
    irradiance: Environment  # of the predicted light, over the normal
    observed: Tensor  # (9, 3) harmonics of the photographs' linear brightness over the normal, its mean 1

    def features(self, normal: Tensor) -> Tensor:
        """Normal, logarithm of the irradiance over pi, logarithm of the observed brightness, ``(N, 9)``.

        normal: ``(N, 3)`` unit, world.  No gradient.
        """
        predicted = torch.log(self.irradiance.lookup(normal.contiguous()) / torch.pi + BLACK)
        observed = torch.log((harmonics(normal) @ self.observed).clamp(min=DARKEST))
        return torch.cat([normal, predicted, observed], -1)


def harmonics(normal: Tensor) -> Tensor:
    """The polynomials ``(N, 9)`` that span spherical harmonics up to order two; the first is 1."""
    x, y, z = normal.unbind(-1)
    return torch.stack([torch.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], -1)


def brightness_over_normal(color: Tensor, seen: Tensor, normal: Tensor) -> Tensor:
    """Harmonics ``(9, 3)`` fitted by ridge least squares to linear colours ``(N, 3)`` at unit ``normal (N, 3)``.

    seen: ``(N,)`` weight of each point.  Divided by the weighted mean colour.  Without a seen point, or black: 1.
    """
    weight = (seen + 1e-6)[:, None]
    total, mean = weight.sum(), (weight * color).sum(0) / weight.sum()
    basis = harmonics(normal)
    ridge = torch.full((9,), RIDGE, device=color.device)
    ridge[0] = 0.0
    gram = (basis * weight).T @ basis / total + torch.diag(ridge)
    fit = torch.linalg.solve(gram, (basis * weight).T @ (color / mean.clamp(min=1e-3)) / total)
    fit[0] += (mean < 1e-3).float()
    return fit
