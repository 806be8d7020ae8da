"""What the input views say about a point: the aid that lets a small network keep the detail of the photographs.

The published network answers a point from its triplane alone.  Here the point is also looked up in every view: patch
tokens, colour, distance to the silhouette and depth go through a small network per view and are pooled over the
views, so any number of views in any order is one width of features (Yu et al. 2021, pixelNeRF, with pooling as in
Wang et al. 2021, IBRNet).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from reli3d.geometry.projection import OWN, gather_views, pool_views, summarize_views


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
        first, activation, last = self.per_view
        tokens, channels = self.tokens(maps.tokens), self.tokens.out_features
        of_tokens, of_own = first.weight[:, :channels], first.weight[:, channels:]
        if torch.is_grad_enabled():
            scale = maps.tokens.shape[1] / maps.images.shape[1]
            gathered, _ = gather_views(tokens, points, maps.c2w, maps.intrinsics * scale)
            own, weight, summary = summarize_views(maps.images, maps.c2w, maps.intrinsics, points, visible, normal)
            hidden = linear(gathered, of_tokens) + linear(own, of_own, first.bias)
            pooled = (weight[:, None] @ activation(hidden))[:, 0]
        else:  # bilinear weights sum to 1: the layer and its bias may come before the look-up
            pooled, summary = pool_views(maps.images, linear(tokens, of_tokens, first.bias), of_own.T, maps.c2w,
                                         maps.intrinsics, points, visible, normal)  # fmt: skip
        return torch.cat([last(pooled), summary], -1), summary[:, :3]  # pooled before the last layer: it is linear
