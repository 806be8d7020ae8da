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

from reli3d.geometry.projection import gather_views

HIDDEN_WEIGHT = 0.02  # share of a view that does not see the point: enough to say something where no view does
EDGE = 0.01  # of the image: colours closer than this to the silhouette mix with the background
OUTSIDE = 0.15  # silhouette distances beyond this share of the image say no more


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
        self.per_view = nn.Sequential(nn.Linear(channels + 9, hidden), nn.SiLU(), nn.Linear(hidden, width - 9))
        self.width = width

    def forward(self, maps: ViewMaps, points: Tensor, visible: Tensor | None = None, normal: Tensor | None = None):
        """Features of ``points (N, 3)`` [model frame].

        visible: ``(N, V)``, 1 where the view sees the surface point, 0 where it is hidden; without it the points are
        in free space. normal: ``(N, 3)`` unit, outward, beside ``visible``.  Gradients reach the tokens.
        """
        size, grid = maps.images.shape[1], maps.tokens.shape[1]
        tokens, _ = gather_views(self.tokens(maps.tokens), points, maps.c2w, maps.intrinsics * (grid / size))
        image, pixel = gather_views(maps.images, points, maps.c2w, maps.intrinsics)
        rgb, silhouette = image[..., :3], image[..., 3:]
        centre = (maps.c2w[:, :3, 3] * maps.c2w[:, :3, 2]).sum(-1)  # depth of the origin in each view
        depth = (pixel[..., 2] - centre)[..., None]
        inside = ((pixel[..., :2] > 0) & (pixel[..., :2] < size)).all(-1, keepdim=True) & (pixel[..., 2:] > 0)
        inside = inside.to(rgb.dtype)
        to_camera = torch.nn.functional.normalize(maps.c2w[:, :3, 3] - points[:, None], dim=-1)
        if visible is None:
            seen, facing = torch.zeros_like(depth), torch.ones_like(depth)
            share = inside
        else:
            seen = visible[..., None].to(rgb.dtype) * 2 - 1
            facing = (to_camera * normal[:, None]).sum(-1, keepdim=True).clamp(min=0)
            share = inside * (HIDDEN_WEIGHT + visible[..., None] * facing.square())
        edge = silhouette / (EDGE * size)
        share = share * edge.clamp(0.05, 1) + 1e-4
        distance = (silhouette / size).clamp(-OUTSIDE, OUTSIDE) / OUTSIDE
        own = torch.cat([tokens, rgb, distance, depth, inside, seen, facing, edge.clamp(-1, 1)], -1)
        weight = share / share.sum(1, keepdim=True)
        first, activation, last = self.per_view
        pooled = last((activation(first(own)) * weight).sum(1))  # pooled before the last layer: it is linear
        color = (rgb * weight).sum(1)
        spread = ((rgb - color[:, None]).square() * weight).sum(1).mean(-1, keepdim=True).sqrt()
        summary = torch.cat([color, spread, distance.amin(1), share.amax(1), points], -1)
        return torch.cat([pooled, summary], -1), color
