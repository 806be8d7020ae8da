"""The small network: convolutions over each view, over space and over the sphere of directions.

A 2D U-Net predicts base color, normal and depth of every pixel (``pyramid``); depths are refined by comparing the views
(``cost_volume``); a 3D U-Net pools the views over the volume of the object (``volume``); a U-Net on lat-long maps
completes the environment (``light_map``).  Small MLPs evaluate points from all.  Positions are relative to the views.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d._bridge import mapped
from reli3d.geometry.camera import Camera, image_plane
from reli3d.geometry.hull import hull_distance, hull_grid
from reli3d.geometry.projection import gather_views
from reli3d.kernels.view_features import CONFIDENT_WEIGHT
from reli3d.nn.blocks import in_rows, linear_of
from reli3d.nn.cost_volume import CostVolume
from reli3d.nn.heads import ROUGHNESS_MIN, color_logit, mlp
from reli3d.nn.light_features import Shading, brightness_at, brightness_over_normal, palette_of, unshaded
from reli3d.nn.light_map import LightMap
from reli3d.nn.presets import OFFSET_VIEWS, LocalPreset
from reli3d.nn.pyramid import MIN_COVERAGE, ImagePyramid, depth_of_origin, pixel_hull_depths, pixel_positions
from reli3d.nn.view_features import AHEAD, ViewFeatures, ViewMaps, ahead_of_surface
from reli3d.nn.view_lookup import fuse_views, summarize_views
from reli3d.nn.volume import HULL_SCALE, FeatureVolume
from reli3d.render.color import srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.points import SurfacePoints

LIGHT_ROWS = 16  # rows of the map whose irradiance the material heads read
TOKEN_EXTRA = 4  # depth and world normal, appended to the pyramid's features
QUARTER = 4  # pixels of a view per side of a pixel whose ray is intersected with the hull
FUSED_WIDTH = 10  # width of Fused.numbers
VIEW_WEIGHT = 7  # of its columns: greatest blend weight of a view, 0 to 1: about 0 where none shows the point
HEAD_OUTPUTS = 13  # width of LocalField.heads
NORMAL_RIGHT = -5  # of the pyramid's predictions: changes its sign under a left-right flip of the image
METALLIC_LOGIT = -2.0  # where the prediction is zero
MIN_INTERPOLATION_WEIGHT = 0.25  # sum of the bilinear weights of covered pixels below which a correction fades out
VIEW_WEIGHT_POWER = 2.0  # exponent of the blend weights: favors frontal views, with smooth seams


@dataclass(frozen=True)
class PixelMaps:
    """Predictions of the pyramid per pixel, at half the views' resolution; depth is corrected by the cost volume."""

    gain: Tensor  # (V, P, P, 1) of the mean logit of the observed color: 0 where a highlight hides the base color
    shift: Tensor  # (V, P, P, 3) of the color logits
    confidence: Tensor  # (V, P, P, 1) logarithm of a blend weight
    roughness: Tensor  # (V, P, P, 1) logit
    metallic: Tensor  # (V, P, P, 1) logit
    chroma: Tensor  # (V, P, P, 1) gain of the color logits minus their mean
    normal: Tensor  # (V, P, P, 3) world, unit
    depth: Tensor  # (V, P, P, 1) along the camera axis, relative to the world origin's
    spread: Tensor  # (V, P, P, 1) standard deviation of depth, 0 before the cost volume

    def of_views(self, count: int) -> PixelMaps:
        """The maps of the first ``count`` views."""
        return mapped(self, lambda values: values[:count])

    @staticmethod
    def of(raw: Tensor, span: Tensor, camera: Camera, mean: Tensor) -> PixelMaps:
        """Decodes the pyramid's output ``raw (V, P, P, 12)`` at the pixels of ``camera``.

        span: ``(V, Q, Q, 2)``, depths at which each ray enters and leaves the hull.  mean: :func:`mean_logit` of the
        object, from which the gain applies: exposure makes the absolute brightness ambiguous, but not the contrast.
        """
        gain, shift, confidence, rough, metal, normal, depth, chroma = raw.split([1, 3, 1, 1, 1, 3, 1, 1], -1)
        x, y = image_plane(camera)
        toward = -functional.normalize(torch.stack([x, y, -torch.ones_like(x)], -1), dim=-1)  # towards the camera
        normal = functional.normalize(0.3 * toward + normal, dim=-1)
        world = torch.einsum("vij,vxyj->vxyi", camera.c2w[:, :3, :3], normal)
        size = camera.height, camera.width
        span = functional.interpolate(span.permute(0, 3, 1, 2), size=size, mode="nearest").permute(0, 2, 3, 1)
        depth = torch.lerp(span[..., :1], span[..., 1:], (depth - 1.0).sigmoid())  # inside the hull
        gain, chroma = (gain + 2.0).sigmoid(), 2.0 * chroma.sigmoid()
        color = gain, shift - gain * mean, confidence
        return PixelMaps(*color, rough, metal + METALLIC_LOGIT, chroma, world, depth, torch.zeros_like(depth))

    def stacked(self) -> Tensor:
        """All maps but depth and its spread, ``(V, P, P, 11)``."""
        material = [self.gain, self.shift, self.confidence, self.roughness, self.metallic, self.chroma]
        return torch.cat([*material, self.normal], -1)

    @cached_property
    def packed(self) -> Tensor:
        """:meth:`stacked` in the layout of :func:`~reli3d.nn.view_lookup.fuse_views`, without gradient."""
        parts = self.stacked().detach().split([4, 4, 3], -1)
        return torch.stack([functional.pad(part, (0, 4 - part.shape[-1])) for part in parts])

    def shape_at(self, side: int) -> Tensor:
        """Means of depth and normal, ``(V, side, side, 4)``."""
        shape = torch.cat([self.depth, self.normal], -1).permute(0, 3, 1, 2)
        return functional.avg_pool2d(shape, shape.shape[-1] // side).permute(0, 2, 3, 1)

    def base_logit(self, color: Tensor) -> Tensor:
        """Base color logit ``(V, P, P, 3)`` of pixels with the observed ``color (V, P, P, 3)``, sRGB."""
        return base_color_logit(color, self.gain, self.chroma, self.shift)


def base_color_logit(color: Tensor, gain: Tensor, chroma: Tensor, shift: Tensor) -> Tensor:
    """Base color logit ``(..., 3)`` for the observed ``color (..., 3)``, sRGB; other arguments as in PixelMaps."""
    logit = color_logit(color)
    mean = logit.mean(-1, keepdim=True)
    return gain * mean + chroma * (logit - mean) + shift


def mean_logit(color: Tensor, mask: Tensor) -> Tensor:
    """Mean color logit ``()`` of ``color (V, P, P, 3)``, sRGB, weighted by the coverage ``mask (V, P, P, 1)``."""
    return (color_logit(color).mean(-1, keepdim=True) * mask).sum() / mask.sum().clamp(min=1.0)


@dataclass(frozen=True)
class Fused:
    """The views' predictions at N surface points, blended by visibility, viewing angle and confidence."""

    logit: Tensor  # (N, 3) of the base color
    numbers: Tensor  # (N, FUSED_WIDTH), see :func:`~reli3d.nn.view_lookup.fuse_views`
    normal: Tensor  # (N, 3) unit


class LocalReconstructor(nn.Module):
    """The network of a :class:`~reli3d.nn.presets.LocalPreset`, one object at a time."""

    def __init__(self, preset: LocalPreset):
        super().__init__()
        self.preset = preset
        self.pyramid = ImagePyramid(preset.pyramid)
        self.cost_volume = CostVolume(preset.pyramid.features) if preset.cost_volume else None
        tokens = preset.pyramid.features + TOKEN_EXTRA
        self.volume = FeatureVolume(preset.volume, tokens)
        self.light = LightMap(preset.light)
        self.view_features = ViewFeatures(tokens, width=preset.view_width)
        inside = preset.volume.features + preset.view_width + 2 + AHEAD
        self.level = mlp(inside, preset.head_width, 1, 2)
        surface = inside + FUSED_WIDTH + 3 + Shading.WIDTH
        self.color = mlp(surface, preset.head_width, 7, 2)  # prediction, correction, weight of the prediction
        self.surface = mlp(surface, preset.head_width, 6, 2)  # roughness, metallic, normal offset, weight of the views'
        if self.device.type != "meta":  # on meta tensors torch.nn.init imports torch's compiler
            for head in (self.color, self.surface):
                nn.init.normal_(linear_of(head, -1).weight, std=0.01)
                nn.init.zeros_(linear_of(head, -1).bias)

    @property
    def device(self) -> torch.device:
        return linear_of(self.level, 0).weight.device

    @property
    def dtype(self) -> torch.dtype:
        """Compute dtype of the large convolutions."""
        return torch.bfloat16 if self.pyramid.in_bfloat16 else torch.float32

    def to_compute(self, dtype: torch.dtype) -> LocalReconstructor:
        """Sets the compute dtype of the U-Nets' convolutions, float32 or bfloat16, else ValueError."""
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
        inference: bool = False,
    ) -> LocalField:
        """Encodes the posed views of one object, in the model's frame.

        images: ``(V, S, S, 3)`` sRGB in [0, 1], not premultiplied by the mask.  masks: ``(V, S, S)``.  c2w: ``(V, 4,
        4)`` OpenGL.  intrinsics: ``(V, 4)`` in pixels of ``images``.  detail: ``(V, D, D, 4)``, sRGB and signed
        silhouette distance in pixels, from which colors are read.  detail_intrinsics: ``(V, 4)`` in its pixels.
        mirrored: number of views at the end that are the first views, flipped left to right, with mirrored cameras, for
        shape and material alone.  inference: without gradient, by fused kernels, equal to float32 rounding.  Gradients
        reach every parameter, those of the cost volume from two input views.  Raises ValueError if more than half are
        mirrored.
        """
        with torch.set_grad_enabled(torch.is_grad_enabled() and not inference):
            views = images, masks, c2w, intrinsics, detail, detail_intrinsics
            features, pixels, camera = self.read_pixels(*views, mirrored=mirrored)
            color, mask = pixel_colors(images, masks, camera)
            tokens = torch.cat([features, pixels.shape_at(features.shape[1])], -1).contiguous()
            maps = ViewMaps(tokens, detail, Camera(c2w, detail_intrinsics, *detail.shape[2:0:-1]), mirrored)
            surface = torch.cat([pixels.depth * mask, pixels.spread * mask, mask], -1)
            volume = self.volume(maps, surface, self.widening)
            lit = mask[..., 0].clone()
            lit[maps.input_count :] = 0.0
            log_light = self._light(pixels, color, lit, camera)
            return LocalField(maps, self, pixels, color, surface, volume, log_light, inference=inference)

    @property
    def widening(self) -> Tensor | float:
        """Effect of uncertain depths, see :func:`~reli3d.nn.view_features.ahead_of_surface`."""
        return 0.0 if self.cost_volume is None else self.cost_volume.widening

    def read_pixels(self, *views: Tensor, mirrored: int = 0) -> tuple[Tensor, PixelMaps, Camera]:
        """Features and predictions of the ``views`` of :meth:`encode`, and the cameras of the predictions."""
        images, masks, c2w, intrinsics, detail, detail_intrinsics = views
        if not 0 <= 2 * mirrored <= len(images):
            raise ValueError(f"mirrored: expected at most half of the {len(images)} views, got {mirrored}")
        taken = len(images) - mirrored
        camera = Camera(c2w, intrinsics, *images.shape[2:0:-1])
        read = camera[:taken]
        quarter = functional.avg_pool2d(masks[:taken, None], QUARTER)[:, 0]
        outlined = Camera(c2w, detail_intrinsics, *detail.shape[2:0:-1])
        span = pixel_hull_depths(detail[..., 3], outlined, quarter, read.resized(*quarter.shape[:0:-1]))
        features, raw = self.pyramid(images[:taken], masks[:taken], pixel_positions(read), span)
        coarse = camera.resized(*raw.shape[2:0:-1])
        mean = mean_logit(*pixel_colors(images[:taken], masks[:taken], coarse[:taken]))
        if mirrored:
            nearer = depth_of_origin(c2w[:mirrored]) - depth_of_origin(c2w[taken:])
            turned = raw[:mirrored].flip(2)
            turned[..., NORMAL_RIGHT] *= -1.0
            span = torch.cat([span, span[:mirrored].flip(2) + nearer[:, None, None, None]])
            features, raw = torch.cat([features, features[:mirrored].flip(2)]), torch.cat([raw, turned])
        pixels = PixelMaps.of(raw, span, coarse, mean)
        if self.cost_volume is not None and taken > 1:
            depth, spread = _refined_depth(
                self.cost_volume, pixels.of_views(taken), features[:taken], images, masks, span[:taken], read
            )
            if mirrored:
                depth = torch.cat([depth, depth[:mirrored].flip(2) + nearer[:, None, None, None]])
                spread = torch.cat([spread, spread[:mirrored].flip(2)])
            pixels = replace(pixels, depth=depth, spread=spread)
        return features, pixels, coarse

    def _light(self, pixels: PixelMaps, color: Tensor, mask: Tensor, camera: Camera) -> Tensor:
        v, y, x = (mask > 0.9).nonzero(as_tuple=True)
        right, up = (t[v, y, x] for t in image_plane(camera))
        local = torch.stack([right, up, -torch.ones_like(right)], -1)
        wo = -functional.normalize((camera.c2w[v, :3, :3] @ local[..., None])[..., 0], dim=-1)
        observed = color[v, y, x]
        logit = base_color_logit(observed, pixels.gain[v, y, x], pixels.chroma[v, y, x], pixels.shift[v, y, x])
        albedo = srgb_to_linear(logit.sigmoid())
        gloss = 1.0 - pixels.roughness[v, y, x, 0].sigmoid()
        return self.light(srgb_to_linear(observed), albedo, gloss, pixels.normal[v, y, x], wo)


def _refined_depth(
    volume: CostVolume, pixels: PixelMaps, features: Tensor, images: Tensor, masks: Tensor, span: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Depth of ``pixels`` plus the correction by ``volume``, and its deviation, ``(V, P, P, 1)``, upsampled."""
    count = len(features)
    quarter = camera.resized(features.shape[2], features.shape[1])
    color, coverage = pixel_colors(images[:count], masks[:count], quarter)
    shape = pixels.shape_at(features.shape[2])
    depth, normal = shape[..., 0], functional.normalize(shape[..., 1:], dim=-1)
    found, spread = volume(features, color, depth, normal, span, quarter, coverage[..., 0])
    change = torch.stack([found - depth, spread, (coverage[..., 0] > MIN_COVERAGE).to(depth)], 1)
    change = functional.interpolate(change, size=pixels.depth.shape[1:3], mode="bilinear", align_corners=False)
    offset, spread = (change[:, :2] / change[:, 2:].clamp(min=MIN_INTERPOLATION_WEIGHT))[..., None].unbind(1)
    return pixels.depth + offset, spread


def pixel_colors(images: Tensor, masks: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Colors ``(V, P, P, 3)`` and coverage ``(V, P, P, 1)`` of the views, downsampled to the size of ``camera``."""
    shown = torch.cat([images, masks[..., None]], -1).permute(0, 3, 1, 2)
    shown = functional.avg_pool2d(shown, images.shape[1] // camera.height)
    color, mask = shown.permute(0, 2, 3, 1).split([3, 1], -1)
    return color, mask


@dataclass(frozen=True)
class LocalField:
    """Output of a :class:`LocalReconstructor` for one object, in the model's frame."""

    maps: ViewMaps
    model: LocalReconstructor
    pixels: PixelMaps
    color: Tensor  # (V, P, P, 3) sRGB, observed
    surface: Tensor  # (V, P, P, 3) predicted depth and its standard deviation, times coverage, and coverage
    volume: Tensor  # (N, N, N, F)
    log_light: Tensor  # (3, H, 2H)
    shading: Shading | None = None
    inference: bool = False  # points are evaluated without gradient, see LocalReconstructor.encode

    def bound(self, points: Tensor) -> Tensor:
        """Signed distance ``(N,)`` to the visual hull over ``softness``: a lower bound of :meth:`sdf`; no gradient."""
        return -hull_distance(points, self.maps.silhouette, self.maps.camera) / self.model.preset.softness

    def grid_bound(self, axis: Tensor, far: float) -> Tensor:
        """:meth:`bound` at the points ``(axis[i], axis[j], axis[k])``, ``(n, n, n)``; above ``far`` any such value."""
        softness = self.model.preset.softness
        return -hull_grid(axis, self.maps.silhouette, self.maps.camera, far=far * softness) / softness

    def _rows(self, evaluate: Callable[..., dict[str, Tensor]], *inputs: Tensor) -> dict[str, Tensor]:
        return in_rows(evaluate, *inputs) if self.inference else evaluate(*inputs)

    def free_sdf(self, points: Tensor) -> Tensor:
        """Predicted field values ``(N,)``, not clamped to the visual hull.  Gradients reach the network."""
        return self.sdf_within(points, self.bound(points))

    def sdf_within(self, points: Tensor, bound: Tensor) -> Tensor:
        """:meth:`free_sdf` of points whose :meth:`bound` ``(N,)`` is known."""
        return self._rows(lambda *at: {"sdf": self._sdf_within(*at)}, points, bound)["sdf"]

    def _sdf_within(self, points: Tensor, bound: Tensor) -> Tensor:
        return self.model.level(self._features(points, bound))[:, 0] - self._offset()

    def _offset(self) -> float:
        """Outward offset of the surface, in units of ``softness``."""
        many, one = self.model.preset.offset_many_views, self.model.preset.offset_one_view
        return many + (one - many) / min(len(self.maps.images), OFFSET_VIEWS)

    def sdf(self, points: Tensor) -> Tensor:
        """Field values ``(N,)``: negative inside, zero on the surface, in units of ``softness``."""
        bound = self.bound(points)
        return torch.maximum(self.sdf_within(points, bound), bound)

    def _features(
        self, points: Tensor, bound: Tensor, visible: Tensor | None = None, normal: Tensor | None = None
    ) -> Tensor:
        model, maps = self.model, self.maps.inputs  # mirror images already contribute through the volume
        hull = -bound * model.preset.softness
        views = model.view_features.fused if self.inference else model.view_features
        of_views = views(maps, points, None if visible is None else visible[:, : maps.input_count], normal)
        of_space = model.volume.sample(self.volume, points)
        rest = [(hull / HULL_SCALE).clamp(-2, 2), torch.full_like(hull, 1.0 / len(self.maps.images))]
        ahead = ahead_of_surface(self.surface[: maps.input_count], maps, points, model.widening)
        return torch.cat([of_space, of_views, torch.stack(rest, -1), ahead], -1)

    def fused(self, position: Tensor, normal: Tensor, visible: Tensor) -> Fused:
        """Blended predictions at surface points: ``position``, ``normal`` ``(N, 3)``, ``visible (N, V)``."""
        maps = self.maps
        if self.inference:  # one kernel, equal to float32 rounding
            return Fused(*fuse_views(maps.images, self.pixels.packed, maps.camera, position, visible, normal))
        got, _ = gather_views(self.pixels.stacked(), position, maps.camera)
        shown, view_weight, summary = summarize_views(maps.images, maps.camera, position, visible, normal)
        gain, shift, confidence, rough, metal, chroma, fused = got.split([1, 3, 1, 1, 1, 1, 3], -1)
        hidden = (visible <= 0.0) & (summary[:, 5:6] >= CONFIDENT_WEIGHT)  # occluded, and another view is confident
        log_weight = VIEW_WEIGHT_POWER * view_weight.log() + confidence[..., 0]
        weight = log_weight.masked_fill(hidden, -math.inf).softmax(-1)[..., None]
        each = base_color_logit(shown[..., :3], gain, chroma, shift)
        logit = (each * weight).sum(1)
        spread = ((each - logit[:, None]).square() * weight).sum((1, 2), keepdim=True)[..., 0].clamp(min=1e-6).sqrt()
        fused = functional.normalize((fused * weight).sum(1) + 1e-3 * normal, dim=-1)
        facing = (fused * normal).sum(-1, keepdim=True)
        mean = [(rough * weight).sum(1), (metal * weight).sum(1), (gain * weight).sum(1)]
        numbers = torch.cat([*mean, fused - normal, facing, summary[:, 5:6], (confidence * weight).sum(1), spread], -1)
        return Fused(logit, numbers, fused)

    def with_shading(self, position: Tensor, normal: Tensor, visible: Tensor) -> LocalField:
        """The field with :class:`Shading` estimated from some thousand points spread over the surface; no gradient."""
        with torch.no_grad():
            maps, inputs = self.maps, self.maps.input_count
            visible = torch.cat([visible[:, :inputs], torch.zeros_like(visible[:, inputs:])], 1)
            color = fuse_views(maps.images, self.pixels.packed, maps.camera, position, visible, normal)[0].sigmoid()
            _, _, summary = summarize_views(maps.images, maps.camera, position, visible, normal)
            shown, visible_in_any = summary[:, :3], visible.amax(1)
            observed = brightness_over_normal(srgb_to_linear(shown), visible_in_any, normal)
            unlit = unshaded(shown, brightness_at(normal, observed))
            irradiance = Environment(self.radiance_map(LIGHT_ROWS).detach().contiguous()).irradiance()
            return replace(self, shading=Shading(irradiance, observed, palette_of(color, unlit, visible_in_any)))

    def material(self, position: Tensor, normal: Tensor, visible: Tensor) -> SurfacePoints:
        """Surface points with material.  normal: geometric, unit.  visible: ``(N, V)``, 1 where a view sees it."""

        def evaluate(position: Tensor, normal: Tensor, visible: Tensor) -> dict[str, Tensor]:
            fused = self.fused(position, normal, visible)
            return _material(fused, self._heads(fused, position, normal, visible), normal)

        return SurfacePoints(position, normal, **self._rows(evaluate, position, normal, visible))

    def heads(self, position: Tensor, normal: Tensor, visible: Tensor) -> Tensor:
        """Raw outputs ``(N, HEAD_OUTPUTS)`` for :meth:`material_from_heads`: smooth, so that vertices suffice."""
        evaluate = lambda p, n, v: {"heads": self._heads(self.fused(p, n, v), p, n, v)}
        return self._rows(evaluate, position, normal, visible)["heads"]

    def material_from_heads(self, heads: Tensor, position: Tensor, normal: Tensor, visible: Tensor) -> SurfacePoints:
        """:meth:`material` at surface points with given, possibly interpolated ``heads (N, HEAD_OUTPUTS)``."""
        evaluate = lambda h, p, n, v: _material(self.fused(p, n, v), h, n)
        return SurfacePoints(position, normal, **self._rows(evaluate, heads, position, normal, visible))

    def _heads(self, fused: Fused, position: Tensor, normal: Tensor, visible: Tensor) -> Tensor:
        if self.shading is None:
            raise ValueError("field: expected the result of with_shading, got a field without shading")
        parts = [
            self._features(position, self.bound(position), visible, normal),
            fused.numbers,
            fused.logit,
            self.shading.features(normal, fused.logit.detach().sigmoid()),
        ]
        features = torch.cat(parts, -1)
        return torch.cat([self.model.color(features), self.model.surface(features)], -1)

    def radiance_map(self, height: int | None = None) -> Tensor:
        """Linear radiance ``(H, 2H, 3)``, upper edge +Y, center +X; height: at most the preset's, its default."""
        log = self.log_light
        if height is not None and height < log.shape[1]:
            return functional.adaptive_avg_pool2d(log.exp()[None], (height, 2 * height))[0].permute(1, 2, 0)
        return log.exp().permute(1, 2, 0)


def _material(fused: Fused, heads: Tensor, normal: Tensor) -> dict[str, Tensor]:
    predicted, correction, weight, rough, metal, offset, of_views = heads.split([3, 3, 1, 1, 1, 3, 1], -1)
    weight = (weight - 3.0).sigmoid()
    base = (1.0 - weight) * fused.logit + weight * predicted + correction
    shaded = functional.normalize(normal + of_views.sigmoid() * (fused.normal - normal) + offset, dim=-1)
    rough, metal = (v[:, 0] for v in (rough + fused.numbers[:, :1], metal + fused.numbers[:, 1:2]))
    return {
        "base_color": srgb_to_linear(base.sigmoid()),
        "metallic": metal.sigmoid(),
        "normal": shaded,
        "roughness": ROUGHNESS_MIN + (1 - ROUGHNESS_MIN) * rough.sigmoid(),
    }
