"""The small network: convolutions over each view, over space and over the sphere of directions.

Every view goes through a 2D U-Net that predicts paint, normal and depth where it looks (``pyramid``); a volume pools
what all views say of the object's space (``volume``); a map of directions gathers what the surface shows of the light
(``light_map``).  Small MLPs then evaluate a point from all of them.  All parts see where a point is only relative to
the views and to the object, so what is learned in one place holds everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.geometry.camera import Camera, image_plane
from reli3d.geometry.projection import gather_views
from reli3d.kernels.view_features import CONFIDENT_WEIGHT
from reli3d.nn.blocks import in_rows, linear_of
from reli3d.nn.field import Field, PointMaterial, bound_sdf, grid_bound_sdf
from reli3d.nn.heads import ROUGHNESS_MIN, color_logit, mlp
from reli3d.nn.light_features import Shading, brightness_at, brightness_over_normal, palette_of, unshaded
from reli3d.nn.light_map import LightMap
from reli3d.nn.presets import LocalPreset
from reli3d.nn.pyramid import PREDICTED, ImagePyramid, depth_of_origin, place_of_pixels, span_of_pixels
from reli3d.nn.view_features import AHEAD, ViewFeatures, ViewMaps, ahead_of_surface
from reli3d.nn.view_lookup import fuse_views, summarize_views
from reli3d.nn.volume import HULL_SCALE, FeatureVolume
from reli3d.render.color import srgb_to_linear
from reli3d.render.environment import Environment

LIGHT_ROWS = 16  # of the map whose irradiance the material heads read
TOKEN_EXTRA = 4  # depth and world normal, beside the pyramid's features
QUARTER = 4  # pixels of a view along a pixel whose ray is intersected with the hull
FUSED = 10  # numbers of Fused beside the colour
HEADS = 13  # numbers of LocalField.heads
# of what the pyramid predicts in the mirror image of a photograph
SIGN_OF_MIRRORED = torch.ones(PREDICTED, dtype=torch.float32, device="cpu")
SIGN_OF_MIRRORED[7] = -1.0  # the normal's component to the right, see PixelMaps.of
SHARPNESS = 2.0  # power of a view's share: the view that looks straightest speaks, with smooth seams


@dataclass(frozen=True)
class PixelMaps:
    """What the pyramid predicts of every pixel, at half the views' resolution."""

    gain: Tensor  # (V, P, P, 1) of the mean logit of the colour seen: 0 where a highlight hides the paint
    shift: Tensor  # (V, P, P, 3) of the colour's logit
    confidence: Tensor  # (V, P, P, 1) logarithm of a weight among the views
    roughness: Tensor  # (V, P, P, 1) logit
    metallic: Tensor  # (V, P, P, 1) logit
    chroma: Tensor  # (V, P, P, 1) gain of what the logits of the three channels differ from their mean
    normal: Tensor  # (V, P, P, 3) world, unit
    depth: Tensor  # (V, P, P, 1) along the camera's axis, from the world's origin

    @staticmethod
    def of(raw: Tensor, span: Tensor, camera: Camera, mean: Tensor) -> PixelMaps:
        """Decodes the pyramid's output ``raw (V, P, P, 12)`` at the pixels of ``camera``.

        span: ``(V, Q, Q, 2)``, depths at which each ray enters and leaves the hull.  mean: :func:`mean_logit` of the
        object, broadcast over the pixels.  The gain applies to the difference from ``mean``, because exposure makes the
        absolute brightness of an object ambiguous, but not its hue and contrast.
        """
        gain, shift, confidence, rough, metal, normal, depth, chroma = raw.split([1, 3, 1, 1, 1, 3, 1, 1], -1)
        x, y = image_plane(camera)
        toward = -functional.normalize(torch.stack([x, y, -torch.ones_like(x)], -1), dim=-1)  # to the camera
        normal = functional.normalize(0.3 * toward + normal, dim=-1)
        world = torch.einsum("vij,vxyj->vxyi", camera.c2w[:, :3, :3], normal)
        size = camera.height, camera.width
        span = functional.interpolate(span.permute(0, 3, 1, 2), size=size, mode="nearest").permute(0, 2, 3, 1)
        depth = torch.lerp(span[..., :1], span[..., 1:], (depth - 1.0).sigmoid())  # the surface lies within
        gain, chroma = (gain + 2.0).sigmoid(), 2.0 * chroma.sigmoid()
        return PixelMaps(gain, shift - gain * mean, confidence, rough, metal - 2.0, chroma, world, depth)

    def stacked(self) -> Tensor:
        """``(V, P, P, 11)``, all but the depth."""
        paint = [self.gain, self.shift, self.confidence, self.roughness, self.metallic, self.chroma]
        return torch.cat([*paint, self.normal], -1)

    @cached_property
    def packed(self) -> Tensor:
        """The same as :func:`~reli3d.nn.view_lookup.fuse_views` reads it, without gradient."""
        parts = self.stacked().detach().split([4, 4, 3], -1)
        return torch.stack([functional.pad(part, (0, 4 - part.shape[-1])) for part in parts])

    def base_logit(self, color: Tensor) -> Tensor:
        """Logit of the base colour of pixels of ``color (V, P, P, 3)`` sRGB."""
        return paint_logit(color, self.gain, self.chroma, self.shift)


def paint_logit(color: Tensor, gain: Tensor, chroma: Tensor, shift: Tensor) -> Tensor:
    """Logit ``(..., 3)`` of the base colour where ``color (..., 3)`` sRGB is seen; the rest as in PixelMaps."""
    logit = color_logit(color)
    mean = logit.mean(-1, keepdim=True)
    return gain * mean + chroma * (logit - mean) + shift


def mean_logit(color: Tensor, mask: Tensor) -> Tensor:
    """Mean logit ``()`` of the object's colours ``(V, P, P, 3)`` sRGB, weighted by its coverage ``(V, P, P, 1)``."""
    return (color_logit(color).mean(-1, keepdim=True) * mask).sum() / mask.sum().clamp(min=1.0)


@dataclass(frozen=True)
class Fused:
    """The views' predictions at N surface points, the one that sees best loudest."""

    logit: Tensor  # (N, 3) of the base colour
    numbers: Tensor  # (N, FUSED): roughness, metallic, normal, its cosine to the surface's, seen, agreement
    normal: Tensor  # (N, 3) unit


class LocalReconstructor(nn.Module):
    """The network of a :class:`~reli3d.nn.presets.LocalPreset`, one object at a time."""

    def __init__(self, preset: LocalPreset):
        super().__init__()
        self.preset = preset
        self.pyramid = ImagePyramid(preset.pyramid)
        tokens = preset.pyramid.features + TOKEN_EXTRA
        self.volume = FeatureVolume(preset.volume, tokens)
        self.light = LightMap(preset.light)
        self.view_features = ViewFeatures(tokens, width=preset.view_width)
        inside = preset.volume.features + preset.view_width + 2 + AHEAD
        self.level = mlp(inside, preset.head_width, 1, 2)
        surface = inside + FUSED + 3 + Shading.WIDTH
        self.color = mlp(surface, preset.head_width, 7, 2)  # own guess, correction, share of the own guess
        self.surface = mlp(surface, preset.head_width, 6, 2)  # roughness, metallic, bend of the normal, its share
        if self.device.type != "meta":  # there are no values there, and torch would import its compiler to say so
            for head in (self.color, self.surface):
                nn.init.normal_(linear_of(head, -1).weight, std=0.01)
                nn.init.zeros_(linear_of(head, -1).bias)

    @property
    def device(self) -> torch.device:
        return linear_of(self.level, 0).weight.device

    @property
    def dtype(self) -> torch.dtype:
        """In which its large convolutions compute."""
        return torch.bfloat16 if self.pyramid.in_bfloat16 else torch.float32

    def to_compute(self, dtype: torch.dtype) -> LocalReconstructor:
        """Have the convolutions over pictures and space compute in float32 or bfloat16; parameters and results stay
        float32.  Raises ValueError for another dtype.
        """
        if dtype not in (torch.float32, torch.bfloat16):
            raise ValueError(f"dtype: expected float32 or bfloat16, got {dtype}")
        self.pyramid.in_bfloat16 = self.volume.in_bfloat16 = dtype == torch.bfloat16
        return self

    def encode(
        self,
        images: Tensor,
        masks: Tensor,
        c2w: Tensor,
        intrinsics: Tensor,
        detail: Tensor,
        detail_intrinsics: Tensor,
        *,
        mirrored: int = 0,
    ) -> LocalField:
        """Read the posed views of one object, in the model's frame.

        images: ``(V, S, S, 3)`` sRGB in [0, 1], straight.  masks: ``(V, S, S)``.  c2w: ``(V, 4, 4)`` OpenGL.
        intrinsics: ``(V, 4)`` pixels of ``images``.  detail: ``(V, D, D, 4)`` sRGB and signed distance to the
        silhouette in pixels, from which colours are read; its intrinsics.  mirrored: how many of the last views are
        the first ones in order, flipped left to right, seen by mirrored cameras: they tell the shape and the paint,
        not the light.  Gradients reach every parameter.  Raises ValueError where they are more than half.
        """
        views = images, masks, c2w, intrinsics, detail, detail_intrinsics
        return self._encoded(views, mirrored, inference=False)

    @torch.no_grad()
    def encode_for_inference(
        self,
        images: Tensor,
        masks: Tensor,
        c2w: Tensor,
        intrinsics: Tensor,
        detail: Tensor,
        detail_intrinsics: Tensor,
        *,
        mirrored: int = 0,
    ) -> LocalField:
        """:meth:`encode` by fused kernels; its field evaluates points by them too, in blocks that stay in the cache.

        The values are those of :meth:`encode` to float32 rounding.  No gradient passes.
        """
        views = images, masks, c2w, intrinsics, detail, detail_intrinsics
        return self._encoded(views, mirrored, inference=True)

    def _encoded(self, views: tuple[Tensor, ...], mirrored: int, *, inference: bool) -> LocalField:
        images, masks, c2w, intrinsics, detail, detail_intrinsics = views
        features, pixels, camera = self.read_pixels(images, masks, c2w, intrinsics, detail, detail_intrinsics, mirrored)
        color, mask = shown_pixels(images, masks, camera)
        shape = torch.cat([pixels.depth, pixels.normal], -1).permute(0, 3, 1, 2)
        shape = functional.avg_pool2d(shape, camera.height // features.shape[1]).permute(0, 2, 3, 1)
        tokens = torch.cat([features, shape], -1).contiguous()
        maps = ViewMaps(tokens, detail, Camera(c2w, detail_intrinsics, *detail.shape[2:0:-1]), mirrored)
        surface = torch.cat([pixels.depth * mask, mask], -1)
        volume = (self.volume.fused if inference else self.volume)(maps, surface)
        lit = mask[..., 0].clone()
        lit[maps.taken :] = 0.0
        log_light = self._light(pixels, color, lit, camera)
        return LocalField(maps, self, pixels, color, surface, volume, log_light, inference=inference)

    def read_pixels(
        self,
        images: Tensor,
        masks: Tensor,
        c2w: Tensor,
        intrinsics: Tensor,
        detail: Tensor,
        detail_intrinsics: Tensor,
        mirrored: int = 0,
    ) -> tuple[Tensor, PixelMaps, Camera]:
        """The first part of :meth:`encode`, each view by itself: features of a quarter of the resolution, predictions
        of half of it, and the cameras of these.  Mirror images are not read: their maps are those of the photographs,
        flipped.
        """
        if not 0 <= 2 * mirrored <= len(images):
            raise ValueError(f"mirrored: expected at most half of the {len(images)} views, got {mirrored}")
        taken = len(images) - mirrored
        camera = Camera(c2w, intrinsics, *images.shape[2:0:-1])
        read = camera[:taken]
        quarter = functional.avg_pool2d(masks[:taken, None], QUARTER)[:, 0]
        outlined = Camera(c2w, detail_intrinsics, *detail.shape[2:0:-1])
        span = span_of_pixels(detail[..., 3], outlined, quarter, read.resized(*quarter.shape[:0:-1]))
        features, raw = self.pyramid(images[:taken], masks[:taken], place_of_pixels(read), span)
        coarse = camera.resized(*raw.shape[2:0:-1])
        mean = mean_logit(*shown_pixels(images[:taken], masks[:taken], coarse[:taken]))
        if mirrored:
            nearer = depth_of_origin(c2w[:mirrored]) - depth_of_origin(c2w[taken:])
            turned = raw[:mirrored].flip(2) * SIGN_OF_MIRRORED.to(raw)
            span = torch.cat([span, span[:mirrored].flip(2) + nearer[:, None, None, None]])
            features, raw = torch.cat([features, features[:mirrored].flip(2)]), torch.cat([raw, turned])
        return features, PixelMaps.of(raw, span, coarse, mean), coarse

    def _light(self, pixels: PixelMaps, color: Tensor, mask: Tensor, camera: Camera) -> Tensor:
        v, y, x = (mask > 0.9).nonzero(as_tuple=True)
        right, up = (t[v, y, x] for t in image_plane(camera))
        local = torch.stack([right, up, -torch.ones_like(right)], -1)
        wo = -functional.normalize((camera.c2w[v, :3, :3] @ local[..., None])[..., 0], dim=-1)
        seen = color[v, y, x]
        logit = paint_logit(seen, pixels.gain[v, y, x], pixels.chroma[v, y, x], pixels.shift[v, y, x])
        albedo = srgb_to_linear(logit.sigmoid())
        gloss = 1.0 - pixels.roughness[v, y, x, 0].sigmoid()
        return self.light(srgb_to_linear(seen), albedo, gloss, pixels.normal[v, y, x], wo)


def shown_pixels(images: Tensor, masks: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Colours ``(V, P, P, 3)`` and coverage ``(V, P, P, 1)`` of views at the resolution of ``camera``."""
    shown = torch.cat([images, masks[..., None]], -1).permute(0, 3, 1, 2)
    shown = functional.avg_pool2d(shown, images.shape[1] // camera.height)
    color, mask = shown.permute(0, 2, 3, 1).split([3, 1], -1)
    return color, mask


@dataclass(frozen=True)
class LocalField(Field):
    """Output of a :class:`LocalReconstructor` for one object."""

    model: LocalReconstructor
    pixels: PixelMaps
    color: Tensor  # (V, P, P, 3) sRGB, what the pixels of ``pixels`` show
    surface: Tensor  # (V, P, P, 2) depth of ``pixels`` times coverage, and coverage
    volume: Tensor  # (N, N, N, F)
    log_light: Tensor  # (3, H, 2H)
    shading: Shading | None = None
    inference: bool = False  # from encode_for_inference: points are evaluated without gradient

    reads_views: ClassVar[bool] = True

    def bound(self, points: Tensor, far: float = math.inf) -> Tensor:
        """Signed distance ``(N,)`` to the visual hull in units of ``softness``, a lower bound of :meth:`sdf`.

        Where it exceeds ``far``, the result is any value above ``far``.  No gradient.
        """
        return bound_sdf(self.maps, points, self.model.preset.softness, far)

    def grid_bound(self, axis: Tensor, far: float = math.inf) -> Tensor:
        """:meth:`bound` at the points ``(axis[i], axis[j], axis[k])``, ``(n, n, n)``; axis: ``(n,)`` ascending."""
        return grid_bound_sdf(self.maps, axis, self.model.preset.softness, far)

    def _rows(self, evaluate: Callable[..., dict[str, Tensor]], *inputs: Tensor) -> dict[str, Tensor]:
        return in_rows(evaluate, *inputs) if self.inference else evaluate(*inputs)

    def free_sdf(self, points: Tensor) -> Tensor:
        return self.sdf_within(points, self.bound(points))

    def sdf_within(self, points: Tensor, bound: Tensor) -> Tensor:
        """:meth:`free_sdf` of points whose :meth:`bound` ``(N,)`` is known."""
        return self._rows(lambda *at: {"sdf": self._sdf_within(*at)}, points, bound)["sdf"]

    def _sdf_within(self, points: Tensor, bound: Tensor) -> Tensor:
        return self.model.level(self._features(points, bound))[:, 0] - self._offset()

    def _offset(self) -> float:
        """Moves the surface outward."""
        many, one = self.model.preset.offset_many_views, self.model.preset.offset_one_view
        return many + (one - many) / len(self.maps.images)

    def sdf(self, points: Tensor) -> Tensor:
        """Field values ``(N,)``: negative inside, zero on the surface, in units of ``softness``."""
        bound = self.bound(points)
        return torch.maximum(self.sdf_within(points, bound), bound)

    def _features(
        self, points: Tensor, bound: Tensor, visible: Tensor | None = None, normal: Tensor | None = None
    ) -> Tensor:
        model, maps = self.model, self.maps.photographs  # the volume knows the mirror images: twice the time, no gain
        hull = -bound * model.preset.softness
        views = model.view_features.fused if self.inference else model.view_features
        of_views, _ = views(maps, points, None if visible is None else visible[:, : maps.taken], normal)
        of_space = model.volume.sample(self.volume, points)
        rest = [(hull / HULL_SCALE).clamp(-2, 2), torch.full_like(hull, 1.0 / len(self.maps.images))]
        ahead = ahead_of_surface(self.surface[: maps.taken], maps, points)
        return torch.cat([of_space, of_views, torch.stack(rest, -1), ahead], -1)

    def fused(self, position: Tensor, normal: Tensor, visible: Tensor) -> Fused:
        """The views' predictions at surface points: ``position``, ``normal`` ``(N, 3)``, ``visible (N, V)``."""
        if self.inference:
            return self._fused_by_kernel(position, normal, visible)
        maps = self.maps
        pixels = self.pixels.stacked()
        got, _ = gather_views(pixels, position, maps.camera)
        shown, share, summary = summarize_views(maps.images, maps.camera, position, visible, normal)
        gain, shift, confidence, rough, metal, chroma, bent = got.split([1, 3, 1, 1, 1, 1, 3], -1)
        hidden = (visible <= 0.0) & (summary[:, 5:6] >= CONFIDENT_WEIGHT)  # and a view that sees the point is sure
        weight = (SHARPNESS * share.log() + confidence[..., 0]).masked_fill(hidden, -math.inf).softmax(-1)[..., None]
        each = paint_logit(shown[..., :3], gain, chroma, shift)
        logit = (each * weight).sum(1)
        spread = ((each - logit[:, None]).square() * weight).sum((1, 2), keepdim=True)[..., 0].clamp(min=1e-6).sqrt()
        bent = functional.normalize((bent * weight).sum(1) + 1e-3 * normal, dim=-1)
        facing = (bent * normal).sum(-1, keepdim=True)
        mean = [(rough * weight).sum(1), (metal * weight).sum(1), (gain * weight).sum(1)]
        numbers = torch.cat([*mean, bent - normal, facing, summary[:, 5:6], (confidence * weight).sum(1), spread], -1)
        return Fused(logit, numbers, bent)

    def _fused_by_kernel(self, position: Tensor, normal: Tensor, visible: Tensor) -> Fused:
        """:meth:`fused` to float32 rounding, without gradient."""
        maps = self.maps
        return Fused(*fuse_views(maps.images, self.pixels.packed, maps.camera, position, visible, normal))

    def with_shading(self, position: Tensor, normal: Tensor, visible: Tensor) -> LocalField:
        """The field with the light on its surface, from some thousand points all over it; no gradient."""
        with torch.no_grad():
            visible = torch.cat([visible[:, : self.maps.taken], torch.zeros_like(visible[:, self.maps.taken :])], 1)
            color = self._fused_by_kernel(position, normal, visible).logit.sigmoid()
            _, _, summary = summarize_views(self.maps.images, self.maps.camera, position, visible, normal)
            shown, seen = summary[:, :3], visible.amax(1)
            observed = brightness_over_normal(srgb_to_linear(shown), seen, normal)
            plain = unshaded(shown, brightness_at(normal, observed))
            irradiance = Environment(self.radiance_map(LIGHT_ROWS).detach().contiguous()).irradiance()
            return replace(self, shading=Shading(irradiance, observed, palette_of(color, plain, seen)))

    def material(self, position: Tensor, normal: Tensor, visible: Tensor) -> PointMaterial:
        def ask(position: Tensor, normal: Tensor, visible: Tensor) -> dict[str, Tensor]:
            fused = self.fused(position, normal, visible)
            return _painted(fused, self._heads(fused, position, normal, visible), normal)

        return PointMaterial(**self._rows(ask, position, normal, visible))

    def heads(self, position: Tensor, normal: Tensor, visible: Tensor) -> Tensor:
        """What the heads say of surface points, ``(N, HEADS)``, for :meth:`painted`; arguments of :meth:`material`.

        It changes from cell to cell of the volume, not from texel to texel: values between points may be interpolated.
        """

        def ask(position: Tensor, normal: Tensor, visible: Tensor) -> dict[str, Tensor]:
            return {"heads": self._heads(self.fused(position, normal, visible), position, normal, visible)}

        return self._rows(ask, position, normal, visible)["heads"]

    def painted(self, heads: Tensor, position: Tensor, normal: Tensor, visible: Tensor) -> PointMaterial:
        """Material at surface points where ``heads (N, HEADS)`` are known: what the views show is looked up again."""

        def ask(heads: Tensor, position: Tensor, normal: Tensor, visible: Tensor) -> dict[str, Tensor]:
            return _painted(self.fused(position, normal, visible), heads, normal)

        return PointMaterial(**self._rows(ask, heads, position, normal, visible))

    def _heads(self, fused: Fused, position: Tensor, normal: Tensor, visible: Tensor) -> Tensor:
        if self.shading is None:
            raise ValueError("field: expected one with_shading, got one that does not know the light on its surface")
        parts = [
            self._features(position, self.bound(position), visible, normal),
            fused.numbers,
            fused.logit,
            self.shading.features(normal, fused.logit.detach().sigmoid()),
        ]
        features = torch.cat(parts, -1)
        return torch.cat([self.model.color(features), self.model.surface(features)], -1)

    def radiance_map(self, height: int | None = None) -> Tensor:
        log = self.log_light
        if height is not None and height < log.shape[1]:
            return functional.adaptive_avg_pool2d(log.exp()[None], (height, 2 * height))[0].permute(1, 2, 0)
        return log.exp().permute(1, 2, 0)


def _painted(fused: Fused, heads: Tensor, normal: Tensor) -> dict[str, Tensor]:
    guess, correction, share, rough, metal, bend, turn = heads.split([3, 3, 1, 1, 1, 3, 1], -1)
    share = (share - 3.0).sigmoid()
    base = (1.0 - share) * fused.logit + share * guess + correction
    shaded = functional.normalize(normal + turn.sigmoid() * (fused.normal - normal) + bend, dim=-1)
    rough, metal = (v[:, 0] for v in (rough + fused.numbers[:, :1], metal + fused.numbers[:, 1:2]))
    return {
        "base_color": srgb_to_linear(base.sigmoid()),
        "metallic": metal.sigmoid(),
        "normal": shaded,
        "roughness": ROUGHNESS_MIN + (1 - ROUGHNESS_MIN) * rough.sigmoid(),
    }
