"""Pixel-aligned features of points from the input views, which keep the detail of the images in a small network.

Patch tokens, color, silhouette distance and depth where a point projects pass through a small MLP per view and are
pooled over the views: order-invariant, for any number of views (Yu et al. 2021, pixelNeRF; Wang et al. 2021, IBRNet).
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
from reli3d.nn.pyramid import depth_of_origin
from reli3d.nn.view_lookup import NUMBERS, pool_views, summarize_views

INTERPOLATION_ERROR = 1e-4  # bound on the float32 error of interpolated zeros and ones


@dataclass(frozen=True)
class ViewMaps:
    """Posed maps of one object: ``tokens (V, P, P, C)``, and ``images (V, S, S, 4)`` of sRGB and signed silhouette
    distance in pixels.  The last ``mirrored`` views are mirror images of the first ones, in order.
    """

    tokens: Tensor
    images: Tensor
    camera: Camera  # of ``images``
    mirrored: int = 0

    @property
    def input_count(self) -> int:
        """Number of input views, without mirror images."""
        return len(self.images) - self.mirrored

    @cached_property
    def inputs(self) -> ViewMaps:
        """The input views alone, without mirror images."""
        if not self.mirrored:
            return self
        count = self.input_count
        return ViewMaps(self.tokens[:count], self.images[:count], self.camera[:count])

    def visibility(self, scene: RayScene, position: Tensor, normal: Tensor) -> Tensor:
        """``(N, V)`` float32, 1 where a surface point is visible; in mirror images only if it is in no input view.

        position, normal: ``(N, 3)``, the normal unit.  scene: of the surface.  No gradient.
        """
        visible = visible_from(scene, position, normal, self.inputs.camera).float()
        if self.mirrored:
            visible = torch.cat([visible, self._mirrored(scene, position, normal, visible)], 1)
        return visible

    def _mirrored(self, scene: RayScene, position: Tensor, normal: Tensor, visible: Tensor) -> Tensor:
        """``(N, mirrored)`` float32, 1 where a mirror image shows a point and none of the input views does."""
        rest = (~visible.any(1)).nonzero()[:, 0]
        found = position.new_zeros(len(position), self.mirrored)
        found[rest] = visible_from(scene, position[rest], normal[rest], self.camera[self.input_count :]).float()
        return found

    def visibility_within(self, scene: RayScene, position: Tensor, normal: Tensor, corners: Tensor) -> Tensor:
        """:meth:`visibility` of points in faces, tracing rays only to views in which the corners of the face disagree.

        corners: ``(N, V)`` :meth:`visibility` of the corners, interpolated at the points.  In such faces, points
        visible in no input view have rays to all mirror images.
        """
        visible = corners.round()
        unsure = (corners - visible).abs() > INTERPOLATION_ERROR
        mixed = unsure.any(1).nonzero()[:, 0]
        position, normal, unsure, part = position[mixed], normal[mixed], unsure[mixed], visible[mixed]
        active, known = unsure[:, : self.input_count], part[:, : self.input_count]
        known[active] = visible_from(scene, position, normal, self.inputs.camera, active)[active].float()
        if self.mirrored:
            part[:, self.input_count :] = self._mirrored(scene, position, normal, known)
        visible[mixed] = part
        return visible

    @cached_property
    def silhouette(self) -> Tensor:
        """Signed silhouette distances ``(V, S, S)``, contiguous."""
        return self.images[..., 3].contiguous()


AHEAD = 4  # width of ahead_of_surface
NEAR_DISTANCE, FAR_DISTANCE = 0.05, 0.2  # scales of its distances, world units


def ahead_of_surface(surface: Tensor, maps: ViewMaps, points: Tensor, widening: Tensor | float = 0.0) -> Tensor:
    """Signed distances of ``points (N, 3)`` in front of the surfaces predicted in the views, ``(N, AHEAD)``.

    surface: ``(V, P, P, 3)``, pixel depth relative to the world origin's along the camera axis, its standard deviation
    ``s``, both times coverage, and coverage.  Over the views that cover the point: maximum and mean of tanh(distance /
    near), mean of tanh(distance / far), and the fraction of such views; near and far are the roots of
    ``NEAR_DISTANCE**2 + widening * s**2`` and ``FAR_DISTANCE**2 + widening * s**2``.  Far behind a surface a view has
    no information.  Gradients reach ``surface`` and ``widening``.
    """
    got, pixel = gather_views(surface, points, maps.camera)
    covered = got[..., 2].clamp(min=0.1)
    ahead = got[..., 0] / covered - (pixel[..., 2] - depth_of_origin(maps.camera.c2w))
    shown = (got[..., 2] > 0.5).to(ahead)
    wider = widening * (got[..., 1] / covered).square()
    scales = [(scale**2 + wider).clamp(min=scale**2 / 4).sqrt() for scale in (NEAR_DISTANCE, FAR_DISTANCE)]
    near, far = ((ahead / scale).tanh() * shown for scale in scales)
    fraction = shown.mean(1)
    few = fraction.clamp(min=0.5 / len(surface))
    greatest = (near - 2.0 * (1.0 - shown)).amax(1).clamp(min=-1.0)
    return torch.stack([greatest, near.mean(1) / few, far.mean(1) / few, fraction], -1)


class ViewFeatures(nn.Module):
    """Features ``(N, width)`` of points, pooled over the views."""

    def __init__(self, token_width: int, channels: int = 16, hidden: int = 48, width: int = 48):
        super().__init__()
        self.tokens = nn.Linear(token_width, channels)
        self.per_view = nn.Sequential(
            nn.Linear(channels + NUMBERS, hidden), nn.SiLU(), nn.Linear(hidden, width - NUMBERS)
        )
        self.width = width

    def forward(
        self, maps: ViewMaps, points: Tensor, visible: Tensor | None = None, normal: Tensor | None = None
    ) -> Tensor:
        """Features of ``points (N, 3)`` [model frame].

        visible: ``(N, V)``, 1 where a view shows a surface point; None in free space.  normal: unit, with it.
        """
        first, activation, last = linear_of(self.per_view, 0), self.per_view[1], self.per_view[2]
        channels = self.tokens.out_features
        gathered, _ = gather_views(self.tokens(maps.tokens), points, maps.camera)
        numbers, weight, summary = summarize_views(maps.images, maps.camera, points, visible, normal)
        hidden = linear(gathered, first.weight[:, :channels]) + linear(numbers, first.weight[:, channels:], first.bias)
        pooled = (weight[:, None] @ activation(hidden))[:, 0]
        return torch.cat([last(pooled), summary], -1)  # the last layer is linear: pool first

    @torch.no_grad()
    def fused(
        self, maps: ViewMaps, points: Tensor, visible: Tensor | None = None, normal: Tensor | None = None
    ) -> Tensor:
        """:meth:`forward` by :func:`~reli3d.nn.view_lookup.pool_views`, equal to float32 rounding; no gradient."""
        first, channels = linear_of(self.per_view, 0), self.tokens.out_features
        # bilinear weights sum to 1, so the layer and its bias commute with the lookup
        tokens = linear(self.tokens(maps.tokens), first.weight[:, :channels], first.bias)
        mix = first.weight[:, channels:].T
        pooled, summary = pool_views(maps.images, tokens, mix, maps.camera, points, visible, normal)
        return torch.cat([linear_of(self.per_view, 2)(pooled), summary], -1)
