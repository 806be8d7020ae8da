"""What the input views say about a point: the aid that lets a small network keep the detail of the photographs.

The published network answers a point from its triplane alone.  Here the point is also looked up in every view: patch
tokens, colour, distance to the silhouette and depth go through a small network per view and are pooled over the
views, so any number of views in any order is one width of features (Yu et al. 2021, pixelNeRF, with pooling as in
Wang et al. 2021, IBRNet).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor, nn
from torch.nn.functional import linear

from reli3d._bridge import check, launch
from reli3d.geometry.projection import gather_views
from reli3d.kernels.view_features import view_summary_kernel

OWN = 9  # numbers that a view says of a point besides its tokens, and as many that sum up all views


@dataclass(frozen=True)
class ViewMaps:
    """Posed maps of one object: ``tokens (V, P, P, C)``, ``images (V, S, S, 4)`` = sRGB and signed silhouette
    distance in pixels.
    """

    tokens: Tensor
    images: Tensor
    c2w: Tensor
    intrinsics: Tensor  # in pixels of ``images``


class ViewFeatures(nn.Module):
    """Pooled features ``(N, width)`` and a colour guess ``(N, 3)`` of points from the views that see them."""

    def __init__(self, token_width: int, channels: int = 16, hidden: int = 48, width: int = 48):
        super().__init__()
        self.tokens = nn.Linear(token_width, channels)
        self.per_view = nn.Sequential(nn.Linear(channels + OWN, hidden), nn.SiLU(), nn.Linear(hidden, width - OWN))
        self.width = width

    def forward(self, maps: ViewMaps, points: Tensor, visible: Tensor | None = None, normal: Tensor | None = None):
        """Features of ``points (N, 3)`` [model frame].

        visible: ``(N, V)``, 1 where the view sees the surface point, 0 where it is hidden; without it the points are
        in free space. normal: ``(N, 3)`` unit, outward, beside ``visible``.  Gradients reach the tokens.
        """
        size, grid = maps.images.shape[1], maps.tokens.shape[1]
        tokens, _ = gather_views(self.tokens(maps.tokens), points, maps.c2w, maps.intrinsics * (grid / size))
        own, weight, summary = view_summary(maps, points, visible, normal)
        first, activation, last = self.per_view
        channels = tokens.shape[-1]
        hidden = linear(tokens, first.weight[:, :channels]) + linear(own, first.weight[:, channels:], first.bias)
        pooled = last((weight[:, None] @ activation(hidden))[:, 0])  # pooled before the last layer: it is linear
        return torch.cat([pooled, summary], -1), summary[:, :3]


def view_summary(
    maps: ViewMaps, points: Tensor, visible: Tensor | None, normal: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """What the images show of ``points (N, 3)``: ``(N, V, 9)`` a view, its weight ``(N, V)``, ``(N, 9)`` in sum.

    See :mod:`reli3d.kernels.view_features` for the numbers.  visible and normal as in :class:`ViewFeatures`.  No
    gradient.  Raises TypeError unless float32, ValueError on wrong shapes or mixed devices.
    """
    views, n = len(maps.images), len(points)
    check("images", maps.images, last=4), check("points", points, last=3, like=maps.images)
    if maps.images.ndim != 4 or maps.images.shape[1] != maps.images.shape[2] or maps.images.shape[1] < 2:
        raise ValueError(f"images: expected (V, S, S, 4) with S of at least 2, got {tuple(maps.images.shape)}")
    if (visible is None) != (normal is None):
        raise ValueError("visible, normal: expected both or none, got one")
    if visible is None:
        visible, normal, surface = points.new_empty(0, views), points.new_empty(0, 3), 0
    else:
        check("visible", visible, last=views, like=points), check("normal", normal, last=3, like=points)
        surface = 1
        if len(visible) != n or len(normal) != n:
            raise ValueError(f"visible, normal: expected {n} rows, got {len(visible)} and {len(normal)}")
    out = [points.new_empty(n, views, OWN), points.new_empty(n, views), points.new_empty(n, OWN)]
    inputs = (maps.images, maps.c2w, maps.intrinsics, points, normal, visible)
    images, c2w, intrinsics, points, normal, visible = (t.detach().contiguous() for t in inputs)
    launch(
        view_summary_kernel,
        n,
        [(images, wp.vec4), (c2w, wp.mat44), (intrinsics, wp.vec4), (points, wp.vec3), surface, (normal, wp.vec3),
         (visible, wp.float32), *((t, wp.float32) for t in out)],
        points.device,
    )  # fmt: skip
    return out[0], out[1], out[2]
