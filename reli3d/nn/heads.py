"""Decoder heads of the triplane: independent MLPs on point features, and the merging of FlexiCubes weights."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from reli3d.geometry.surface import CubeWeights

ROUGHNESS_MIN = 0.1  # range [0.1, 1] of the published head
NORMALIZE_EPS = 1.0e-7
COLOR_MARGIN = 0.02  # clamps colors before their logit, so that black and clipped highlights stay finite
WEIGHT_SCALE = 0.5  # of the FlexiCubes weights: greatest deviation of alpha and beta from 1
MERGED_MULTIPLIER = 0.1  # on the merging MLP's output: initial weights are near neutral
DEFORMATION_LIMIT = 1.0 - 1.0e-8  # of half a cell, so that grid vertices never coincide


HEADS = {  # outputs, hidden layers
    "density": (1, 2),
    "base_color": (3, 3),
    "normal": (3, 3),
    "deformation": (3, 2),
    "roughness": (1, 2),
    "metallic": (1, 2),
    "flexicubes": (16, 1),
}
MERGED = (12, 8, 1)  # FlexiCubes weights of a cube: of its edges, its corners, itself


def mlp(inputs: int, width: int, outputs: int, hidden: int) -> nn.Sequential:
    """Linear layers with SiLU between them, ``hidden`` of them ``width`` wide."""
    widths = [inputs, *[width] * hidden, outputs]
    layers: list[nn.Module] = []
    for a, b in zip(widths[:-1], widths[1:], strict=True):
        layers += [nn.Linear(a, b), nn.SiLU()]
    return nn.Sequential(*layers[:-1])


def activate(name: str, raw: Tensor) -> Tensor:
    """Activation of the named head.

    ``density``, ``deformation``, ``flexicubes``: identity.  ``base_color`` (sRGB-encoded), ``metallic``: [0, 1].
    ``roughness``: [0.1, 1].  ``normal``: unit, relative to +z of the surface's frame.
    """
    if name in ("base_color", "metallic"):
        return raw.sigmoid()
    if name == "roughness":
        return ROUGHNESS_MIN + (1.0 - ROUGHNESS_MIN) * raw.sigmoid()
    if name == "normal":
        normal = raw + raw.new_tensor((0.0, 0.0, 1.0))  # functional.normalize is about 10 times slower on columns
        return normal / (normal * normal).sum(-1, keepdim=True).clamp(min=NORMALIZE_EPS**2).sqrt()
    return raw


def color_logit(color: Tensor) -> Tensor:
    """Logit of colors in [0, 1], clamped by COLOR_MARGIN so that it is finite."""
    return color.clamp(COLOR_MARGIN, 1.0 - COLOR_MARGIN).logit()


class Heads(nn.ModuleDict):
    """One MLP per head, on shared features."""

    def __init__(self, features: int, width: int):
        super().__init__({name: mlp(features, width, *sizes) for name, sizes in HEADS.items()})

    def forward(self, features: Tensor, names: Sequence[str]) -> dict[str, Tensor]:
        """``{name: (..., outputs)}`` of features ``(..., features)``, see :func:`activate`.  Raises ValueError."""
        if unknown := [name for name in names if name not in self]:
            raise ValueError(f"heads: expected some of {', '.join(self)}, got {unknown[0]}")
        return {name: activate(name, self[name](features)) for name in names}


class _TruncatedExp(torch.autograd.Function):
    """exp(x) whose derivative is clamped to exp(15), so that single points deep inside do not dominate a batch."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.exp()

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return grad * x.clamp(max=15.0).exp()


truncated_exp = _TruncatedExp.apply


class WeightMerger(nn.Module):
    """MLP from the eight corner vectors of a cube to its FlexiCubes weights."""

    def __init__(self, width: int):
        super().__init__()
        self.mlp = mlp(8 * HEADS["flexicubes"][0], width, sum(MERGED), 2)

    def merged(self, corners: Tensor) -> Tensor:
        """Raw weights ``(..., 21)`` of corners ``(..., 8, 16)``; k is at x = k & 1, y = k >> 1 & 1, z = k >> 2."""
        return MERGED_MULTIPLIER * self.mlp(corners.flatten(-2))

    def forward(self, corners: Tensor) -> CubeWeights:
        """Weights of cubes from ``flexicubes (..., 8, 16)``: alpha, beta in (0.5, 1.5), gamma in (0.25, 0.75)."""
        beta, alpha, gamma = self.merged(corners).split(MERGED, dim=-1)
        return CubeWeights(
            alpha=1.0 + WEIGHT_SCALE * alpha.tanh(),
            beta=1.0 + WEIGHT_SCALE * beta.tanh(),
            gamma=(0.25 + WEIGHT_SCALE * gamma.sigmoid()).squeeze(-1),
        )


def deformation(raw: Tensor, resolution: int) -> Tensor:
    """Displacement of grid vertices from raw outputs: less than half a cell, of ``resolution`` in a unit cube."""
    return raw.tanh() * (DEFORMATION_LIMIT / (2 * resolution))
