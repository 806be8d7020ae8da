"""Lat-long maps: texel directions, texels of given directions, solid angles.

A map has H rows and W columns, normally W = 2 H.  The upper edge is +Y, the horizontal center (u = 1/2, for even W the
border of columns W/2 - 1 and W/2) is +X, and +Z is right of the center.  With phi = 2 pi (u - 1/2) and theta = pi v the
direction is (cos phi sin theta, cos theta, sin phi sin theta).  Texel centers are at u = (column + 1/2) / W, v = (row +
1/2) / H.  ``reli3d.kernels.envmap`` implements the same mapping for kernels.
"""

import math

import torch
from torch import Tensor


def lat_long_directions(
    height: int, width: int | None = None, *, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Tensor:
    """Unit directions ``(height, width, 3)`` of the texel centers, computed in float64; default width: 2 ``height``."""
    width = 2 * height if width is None else width
    phi = (torch.arange(width, dtype=torch.float64, device=device) + 0.5) * (2.0 * math.pi / width) - math.pi
    theta = ((torch.arange(height, dtype=torch.float64, device=device) + 0.5) * (math.pi / height))[:, None]
    up = theta.cos().expand(height, width)
    return torch.stack([phi.cos() * theta.sin(), up, phi.sin() * theta.sin()], -1).to(dtype)


def lat_long_texels(directions: Tensor, height: int) -> tuple[Tensor, Tensor]:
    """Bilinear footprint of unit ``directions (N, 3)`` in a ``(height, 2 height)`` map; no gradients.

    Returns flat int64 indices of texels and their weights, both ``(N, 4)``; the weights of a direction sum to 1.
    Columns wrap, rows are clamped at the poles.
    """
    x, y, z = directions.detach().unbind(-1)
    row = y.clamp(-1.0, 1.0).acos() * (height / math.pi) - 0.5
    column = (torch.atan2(z, x) + math.pi) * (height / math.pi) - 0.5
    top, left = row.floor(), column.floor()
    rows = torch.stack([top, top + 1], -1).long().clamp(0, height - 1)
    columns = torch.stack([left, left + 1], -1).long() % (2 * height)
    vertical = torch.stack([1 - (row - top), row - top], -1)
    horizontal = torch.stack([1 - (column - left), column - left], -1)
    texels = rows[:, :, None] * (2 * height) + columns[:, None]
    return texels.flatten(1), (vertical[:, :, None] * horizontal[:, None]).flatten(1)


def texel_solid_angles(height: int, width: int, device: torch.device | str = "cpu") -> Tensor:
    """Solid angle [sr] of one texel in each row, ``(height,)`` float64; the sum over all texels is 4 pi."""
    edges = torch.cos(torch.linspace(0.0, math.pi, height + 1, dtype=torch.float64, device=device))
    return (edges[:-1] - edges[1:]) * (2.0 * math.pi / width)


def quarter_turn(maps: Tensor, quarters: int) -> Tensor:
    """``maps (..., H, W, C)`` with columns moved right by ``quarters`` quarters of the width.

    ``quarters = -1`` converts a map with -Z at the horizontal center, as in ReLi3D, to a map with +X there.  Raises
    ValueError unless W is a multiple of 4.
    """
    width = maps.shape[-2]
    if width % 4:
        raise ValueError(f"maps: expected a width that is a multiple of 4, got {width}")
    return maps.roll(quarters * (width // 4), -2)
