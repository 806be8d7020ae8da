"""What the input views say about a point: the aid that lets a small network keep the detail of the photographs.

The published network answers a point from its triplane alone.  Here the point is also looked up in every view: patch
tokens, colour, distance to the silhouette and depth go through a small network per view and are pooled over the
views, so any number of views in any order is one width of features (Yu et al. 2021, pixelNeRF, with pooling as in
Wang et al. 2021, IBRNet).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from reli3d.geometry.camera import Camera
from reli3d.geometry.projection import gather_views
from reli3d.geometry.rays import RayScene
from reli3d.geometry.visibility import visible_from
from reli3d.nn.blocks import linear_of
from reli3d.nn.view_lookup import NUMBERS, pool_views, summarize_views

ROUNDING = 1e-4  # of interpolated 0 and 1


@dataclass(frozen=True)
class ViewMaps:
    """Posed maps of one object: ``tokens (V, P, P, C)``, ``images (V, S, S, 4)`` = sRGB and signed silhouette
    distance in pixels.  The last ``mirrored`` views are mirror images of the first ones, in order.
    """

    tokens: Tensor
    images: Tensor
    camera: Camera  # of ``images``
    mirrored: int = 0

    @property
    def taken(self) -> int:
        """Number of the views that are photographs."""
        return len(self.images) - self.mirrored

    @cached_property
    def photographs(self) -> ViewMaps:
        """The same without mirror images."""
        if not self.mirrored:
            return self
        return ViewMaps(self.tokens[: self.taken], self.images[: self.taken], self.camera[: self.taken])

    def seen(self, scene: RayScene, position: Tensor, normal: Tensor) -> Tensor:
        """``(N, V)`` float32, 1 where a view sees a surface point; mirror images only where no photograph does.

        position, normal: ``(N, 3)``, the normal unit.  scene: of the surface.  No gradient.
        """
        visible = visible_from(scene, position, normal, self.photographs.camera).float()
        if self.mirrored:
            visible = torch.cat([visible, self._mirrored(scene, position, normal, visible)], 1)
        return visible

    def _mirrored(self, scene: RayScene, position: Tensor, normal: Tensor, seen: Tensor) -> Tensor:
        """``(N, mirrored)`` float32, 1 where a mirror image sees a point that no photograph does.  seen: by those."""
        rest = (~seen.any(1)).nonzero()[:, 0]
        found = position.new_zeros(len(position), self.mirrored)
        found[rest] = visible_from(scene, position[rest], normal[rest], self.camera[self.taken :]).float()
        return found

    def seen_within(self, scene: RayScene, position: Tensor, normal: Tensor, corners: Tensor) -> Tensor:
        """:meth:`seen` of points in faces, with rays only to views that the corners of a face do not see alike.

        Of such a face a point that no photograph sees has rays to all mirror images.

        corners: ``(N, V)`` :meth:`seen` of the corners, interpolated at the points.
        """
        visible = corners.round()
        unsure = (corners - visible).abs() > ROUNDING
        mixed = unsure.any(1).nonzero()[:, 0]
        position, normal, unsure, part = position[mixed], normal[mixed], unsure[mixed], visible[mixed]
        asked, known = unsure[:, : self.taken], part[:, : self.taken]
        known[asked] = visible_from(scene, position, normal, self.photographs.camera, asked)[asked].float()
        if self.mirrored:
            part[:, self.taken :] = self._mirrored(scene, position, normal, known)
        visible[mixed] = part
        return visible

    @cached_property
    def silhouette(self) -> Tensor:
        """The signed distances alone, ``(V, S, S)`` contiguous, as look-ups of many blocks of points read them."""
        return self.images[..., 3].contiguous()


AHEAD = 4  # numbers of ahead_of_surface
NEAR_DISTANCE, FAR_DISTANCE = 0.05, 0.2  # units in which they measure a distance, in those of the world


def ahead_of_surface(surface: Tensor, maps: ViewMaps, points: Tensor) -> Tensor:
    """How far ``points (N, 3)`` lie before the surfaces that the views show, as seen from each, ``(N, AHEAD)``.

    surface: ``(V, P, P, 2)`` depth of a pixel from the world's origin along the camera's axis, times coverage, and
    coverage.  The numbers are, of the views that show the object there: the greatest and the mean distance, as
    tanh(distance / NEAR_DISTANCE), the mean of tanh(distance / FAR_DISTANCE), and the fraction of these views.  In
    front of a surface that a view shows there is nothing; far behind it a view has no information.  Gradients reach
    the surface.
    """
    got, pixel = gather_views(surface, points, maps.camera)
    covered = got[..., 1].clamp(min=0.1)
    c2w = maps.camera.c2w
    origin = (c2w[:, :3, 3] * c2w[:, :3, 2]).sum(-1)
    ahead = got[..., 0] / covered - (pixel[..., 2] - origin)
    shown = (got[..., 1] > 0.5).to(ahead)
    near, far = (ahead / NEAR_DISTANCE).tanh() * shown, (ahead / FAR_DISTANCE).tanh() * shown
    share = shown.mean(1)
    few = share.clamp(min=0.5 / len(c2w))
    greatest = (near - 2.0 * (1.0 - shown)).amax(1).clamp(min=-1.0)
    return torch.stack([greatest, near.mean(1) / few, far.mean(1) / few, share], -1)


class ViewFeatures(nn.Module):
    """Pooled features ``(N, width)`` and a colour guess ``(N, 3)`` of points from the views that see them."""

    def __init__(self, token_width: int, channels: int = 16, hidden: int = 48, width: int = 48):
        super().__init__()
        self.tokens = nn.Linear(token_width, channels)
        self.per_view = nn.Sequential(
            nn.Linear(channels + NUMBERS, hidden), nn.SiLU(), nn.Linear(hidden, width - NUMBERS)
        )
        self.width = width

    def forward(self, maps: ViewMaps, points: Tensor, visible: Tensor | None = None, normal: Tensor | None = None):
        """Features of ``points (N, 3)`` [model frame].

        visible: ``(N, V)``, 1 where the view sees the surface point, 0 where it is hidden; without it the points are
        in free space. normal: ``(N, 3)`` unit, outward, beside ``visible``.  Gradients reach the tokens.
        """
        first, activation, last = linear_of(self.per_view, 0), self.per_view[1], self.per_view[2]
        channels = self.tokens.out_features
        gathered, _ = gather_views(self.tokens(maps.tokens), points, maps.camera)
        numbers, weight, summary = summarize_views(maps.images, maps.camera, points, visible, normal)
        hidden = linear(gathered, first.weight[:, :channels]) + linear(numbers, first.weight[:, channels:], first.bias)
        pooled = (weight[:, None] @ activation(hidden))[:, 0]
        return torch.cat([last(pooled), summary], -1), summary[:, :3]  # pooled before the last layer: it is linear

    @torch.no_grad()
    def fused(self, maps: ViewMaps, points: Tensor, visible: Tensor | None = None, normal: Tensor | None = None):
        """:meth:`forward` by :func:`~reli3d.nn.view_lookup.pool_views`: to float32 rounding, without gradient."""
        first, channels = linear_of(self.per_view, 0), self.tokens.out_features
        # bilinear weights sum to 1: the layer and its bias may come before the look-up
        tokens = linear(self.tokens(maps.tokens), first.weight[:, :channels], first.bias)
        mix = first.weight[:, channels:].T
        pooled, summary = pool_views(maps.images, tokens, mix, maps.camera, points, visible, normal)
        return torch.cat([linear_of(self.per_view, 2)(pooled), summary], -1), summary[:, :3]
