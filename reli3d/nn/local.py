"""The small network: convolutions over each view, over space and over the sphere of directions.

Every view goes through a 2D U-Net that predicts paint, normal and depth where it looks (``pyramid``); a volume pools
what all views say of the object's space (``volume``); a map of directions gathers what the surface shows of the light
(``light_map``).  A point is then asked of all of them by small MLPs.  All parts know where a point is only relative to
the views and to the object, so what is learned in one place holds everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.geometry.projection import fuse_views, gather_views, summarize_views
from reli3d.nn.blocks import in_rows
from reli3d.nn.field import LIGHT_ROWS, PointMaterial, bound_level
from reli3d.nn.heads import ROUGHNESS_MIN, color_logit, mlp
from reli3d.nn.light_features import Shading, brightness_at, brightness_over_normal, palette_of, unshaded
from reli3d.nn.light_map import LightMap
from reli3d.nn.presets import SHADING_FEATURES, LocalPreset
from reli3d.nn.pyramid import ImagePyramid, place_of_pixels
from reli3d.nn.view_features import ViewFeatures, ViewMaps
from reli3d.nn.volume import HULL_SCALE, FeatureVolume
from reli3d.render.color import srgb_to_linear
from reli3d.render.environment import Environment

TOKEN_EXTRA = 4  # depth and world normal, beside the pyramid's features
FUSED = 10  # numbers of Fused beside the colour
SHARPNESS = 2.0  # power of a view's share: the view that looks straightest speaks, with smooth seams


@dataclass(frozen=True)
class PixelMaps:
    """What the pyramid predicts of every pixel, at half the views' resolution."""

    gain: Tensor  # (V, P, P, 1) of the logit of the colour seen: 0 where a highlight hides the paint
    shift: Tensor  # (V, P, P, 3) of that logit
    confidence: Tensor  # (V, P, P, 1) logarithm of a weight among the views
    roughness: Tensor  # (V, P, P, 1) logit
    metallic: Tensor  # (V, P, P, 1) logit
    normal: Tensor  # (V, P, P, 3) world, unit
    depth: Tensor  # (V, P, P, 1) along the camera's axis, from the world's origin

    @staticmethod
    def of(raw: Tensor, c2w: Tensor, intrinsics: Tensor, size: int) -> PixelMaps:
        """From the pyramid's 12 numbers ``(V, P, P, 12)``; ``intrinsics`` in pixels of the views, ``size`` wide."""
        gain, shift, confidence, rough, metal, normal, depth = raw.split([1, 3, 1, 1, 1, 3, 2], -1)
        side = raw.shape[1]
        pixel = (torch.arange(side, device=raw.device) + 0.5) * (size / side)
        fx, fy, cx, cy = (k[:, None, None] for k in intrinsics.unbind(-1))
        x, y = ((pixel - cx) / fx).expand(-1, side, side), ((cy - pixel[:, None]) / fy).expand(-1, side, side)
        toward = -functional.normalize(torch.stack([x, y, -torch.ones_like(x)], -1), dim=-1)  # to the camera
        normal = functional.normalize(0.3 * toward + normal, dim=-1)
        world = torch.einsum("vij,vxyj->vxyi", c2w[:, :3, :3], normal)
        return PixelMaps((gain + 2.0).sigmoid(), shift, confidence, rough, metal - 2.0, world, depth[..., :1] - 0.2)

    def stacked(self) -> Tensor:
        """``(V, P, P, 10)``, all but the depth."""
        return torch.cat([self.gain, self.shift, self.confidence, self.roughness, self.metallic, self.normal], -1)

    @cached_property
    def packed(self) -> Tensor:
        """The same as :func:`~reli3d.geometry.projection.fuse_views` reads it, without gradient."""
        parts = self.stacked().detach().split([4, 3, 3], -1)
        return torch.stack([functional.pad(part, (0, 4 - part.shape[-1])) for part in parts])

    def base_logit(self, color: Tensor) -> Tensor:
        """Logit of the base colour of pixels of ``color (V, P, P, 3)`` sRGB."""
        return self.gain * color_logit(color) + self.shift


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
        inside = preset.volume.features + preset.view_width + 2
        self.level = mlp(inside, preset.head_width, 1, 2)
        surface = inside + FUSED + 3 + SHADING_FEATURES
        self.color = mlp(surface, preset.head_width, 7, 2)  # own guess, correction, share of the own guess
        self.surface = mlp(surface, preset.head_width, 6, 2)  # roughness, metallic, bend of the normal, its share
        if self.device.type != "meta":  # there are no values there, and torch would import its compiler to say so
            for head in (self.color, self.surface):
                nn.init.normal_(head[-1].weight, std=0.01)
                nn.init.zeros_(head[-1].bias)

    @property
    def device(self) -> torch.device:
        return self.level[0].weight.device

    @property
    def dtype(self) -> torch.dtype:
        """In which it computes: float32."""
        return self.level[0].weight.dtype

    def encode(self, images: Tensor, masks: Tensor, c2w: Tensor, intrinsics: Tensor, detail: Tensor,
               detail_intrinsics: Tensor) -> LocalField:  # fmt: skip
        """Read the posed views of one object, in the model's frame.

        images: ``(V, S, S, 3)`` sRGB in [0, 1], straight.  masks: ``(V, S, S)``.  c2w: ``(V, 4, 4)`` OpenGL.
        intrinsics: ``(V, 4)`` pixels of ``images``.  detail: ``(V, D, D, 4)`` sRGB and signed distance to the
        silhouette in pixels, from which colours are read; its intrinsics.  Gradients reach every parameter.
        """
        size = images.shape[1]
        features, raw = self.pyramid(images, masks, place_of_pixels(c2w, intrinsics, size))
        pixels = PixelMaps.of(raw, c2w, intrinsics, size)
        shape = torch.cat([pixels.depth, pixels.normal], -1).permute(0, 3, 1, 2)
        shape = functional.avg_pool2d(shape, raw.shape[1] // features.shape[1]).permute(0, 2, 3, 1)
        tokens = torch.cat([features, shape], -1).contiguous()
        maps = ViewMaps(tokens, detail, c2w, detail_intrinsics)
        volume = self.volume(maps)
        shown = torch.cat([images, masks[..., None]], -1).permute(0, 3, 1, 2)
        shown = functional.avg_pool2d(shown, size // raw.shape[1])
        color, mask = shown.permute(0, 2, 3, 1).split([3, 1], -1)
        log_light = self._light(pixels, color, mask[..., 0], c2w, intrinsics / (size / raw.shape[1]))
        return LocalField(self, maps, pixels, color, volume, log_light)

    def _light(self, pixels: PixelMaps, color: Tensor, mask: Tensor, c2w: Tensor, intrinsics: Tensor) -> Tensor:
        v, y, x = (mask > 0.9).nonzero(as_tuple=True)
        fx, fy, cx, cy = intrinsics[v].unbind(-1)
        local = torch.stack([(x + 0.5 - cx) / fx, (cy - y - 0.5) / fy, -torch.ones_like(fx)], -1)
        wo = -functional.normalize((c2w[v, :3, :3] @ local[..., None])[..., 0], dim=-1)
        seen = color[v, y, x]
        albedo = srgb_to_linear((pixels.gain[v, y, x] * color_logit(seen) + pixels.shift[v, y, x]).sigmoid())
        gloss = 1.0 - pixels.roughness[v, y, x, 0].sigmoid()
        return self.light(srgb_to_linear(seen), albedo, gloss, pixels.normal[v, y, x], wo)


@dataclass(frozen=True)
class LocalField:
    """One object: level at points of its volume, material at points of its surface, light around it."""

    model: LocalReconstructor
    maps: ViewMaps
    pixels: PixelMaps
    color: Tensor  # (V, P, P, 3) sRGB, what the pixels of ``pixels`` show
    volume: Tensor  # (N, N, N, F)
    log_light: Tensor  # (3, H, 2H)
    shading: Shading | None = None

    bounded = True  # the silhouettes bound the surface
    reads_views = True  # the material asks which view sees a point

    def bound(self, points: Tensor) -> Tensor:
        """Level ``(N,)`` of the silhouettes' hull: no point is further inside than this; no gradient."""
        return bound_level(self.maps, points, self.model.preset.softness)

    def grid_level(self, axis: Tensor) -> None:
        """None: features of points belong to no plane, see :meth:`reli3d.nn.field.Field.grid_level`."""

    def cube_weights(self, points: Tensor, level: Tensor) -> dict[str, Tensor]:
        """Empty: this network gives cubes no weights, see :meth:`reli3d.nn.field.Field.cube_weights`."""
        return {}

    def free_level(self, points: Tensor) -> Tensor:
        """Level ``(N,)`` that the network gives ``points (N, 3)``, negative inside, without the hull's bound."""

        def ask(points: Tensor) -> dict[str, Tensor]:
            return {"level": self.model.level(self._features(points))[:, 0]}

        return in_rows(ask, points)["level"] - self._offset()

    def _offset(self) -> float:
        """Moves the surface outward."""
        many, one = self.model.preset.offset_many_views, self.model.preset.offset_one_view
        return many + (one - many) / len(self.maps.c2w)

    def level(self, points: Tensor) -> Tensor:
        """Level ``(N,)``: negative inside, zero on the surface, in units of ``softness``."""
        return torch.maximum(self.free_level(points), self.bound(points))

    def _features(self, points: Tensor, visible: Tensor | None = None, normal: Tensor | None = None) -> Tensor:
        model = self.model
        hull = -self.bound(points) * model.preset.softness
        of_views, _ = model.view_features(self.maps, points, visible, normal)
        of_space = model.volume.sample(self.volume, points)
        rest = [(hull / HULL_SCALE).clamp(-2, 2), torch.full_like(hull, 1.0 / len(self.maps.c2w))]
        return torch.cat([of_space, of_views, torch.stack(rest, -1)], -1)

    def fused(self, position: Tensor, normal: Tensor, visible: Tensor) -> Fused:
        """The views' predictions at surface points: ``position``, ``normal`` ``(N, 3)``, ``visible (N, V)``."""
        maps = self.maps
        if not torch.is_grad_enabled():
            return Fused(*fuse_views(maps.images, self.pixels.packed, maps.c2w, maps.intrinsics, position, visible,
                                     normal))  # fmt: skip
        pixels = self.pixels.stacked()
        scale = pixels.shape[1] / maps.images.shape[1]
        got, _ = gather_views(pixels, position, maps.c2w, maps.intrinsics * scale)
        own, share, summary = summarize_views(maps.images, maps.c2w, maps.intrinsics, position, visible, normal)
        gain, shift, confidence, rough, metal, bent = got.split([1, 3, 1, 1, 1, 3], -1)
        weight = (SHARPNESS * share.log() + confidence[..., 0]).softmax(-1)[..., None]
        each = gain * color_logit(own[..., :3]) + shift
        logit = (each * weight).sum(1)
        spread = ((each - logit[:, None]).square() * weight).sum((1, 2), keepdim=True)[..., 0].clamp(min=1e-6).sqrt()
        bent = functional.normalize((bent * weight).sum(1) + 1e-3 * normal, dim=-1)
        facing = (bent * normal).sum(-1, keepdim=True)
        mean = [(rough * weight).sum(1), (metal * weight).sum(1), (gain * weight).sum(1)]
        numbers = torch.cat([*mean, bent - normal, facing, summary[:, 5:6], (confidence * weight).sum(1), spread], -1)
        return Fused(logit, numbers, bent)

    def with_shading(self, position: Tensor, normal: Tensor, visible: Tensor) -> LocalField:
        """The field that knows the light on its surface, from some thousand points all over it; no gradient."""
        with torch.no_grad():
            color = self.fused(position, normal, visible).logit.sigmoid()
            _, _, summary = summarize_views(self.maps.images, self.maps.c2w, self.maps.intrinsics, position, visible,
                                            normal)  # fmt: skip
            shown, seen = summary[:, :3], visible.amax(1)
            observed = brightness_over_normal(srgb_to_linear(shown), seen, normal)
            plain = unshaded(shown, brightness_at(normal, observed))
            irradiance = Environment(self.radiance_map(LIGHT_ROWS).detach().contiguous()).irradiance()
            return replace(self, shading=Shading(irradiance, observed, palette_of(color, plain, seen)))

    def material(self, position: Tensor, normal: Tensor, visible: Tensor) -> PointMaterial:
        """Material at surface points: ``position``, ``normal`` ``(N, 3)`` unit, ``visible (N, V)``; after
        :meth:`with_shading`.
        """

        def ask(position: Tensor, normal: Tensor, visible: Tensor) -> dict[str, Tensor]:
            fused = self.fused(position, normal, visible)
            features = torch.cat([
                self._features(position, visible, normal), fused.numbers, fused.logit,
                self.shading.features(normal, fused.logit.detach().sigmoid()),
            ], -1)  # fmt: skip
            own, correction, share = self.model.color(features).split([3, 3, 1], -1)
            share = (share - 3.0).sigmoid()
            base = (1.0 - share) * fused.logit + share * own + correction
            rough, metal, bend, turn = self.model.surface(features).split([1, 1, 3, 1], -1)
            shaded = functional.normalize(normal + turn.sigmoid() * (fused.normal - normal) + bend, dim=-1)
            rough, metal = (v[:, 0] for v in (rough + fused.numbers[:, :1], metal + fused.numbers[:, 1:2]))
            return {"base_color": base.sigmoid(), "metallic": metal.sigmoid(), "normal": shaded,
                    "roughness": ROUGHNESS_MIN + (1 - ROUGHNESS_MIN) * rough.sigmoid()}  # fmt: skip

        return PointMaterial(**in_rows(ask, position, normal, visible))

    def radiance_map(self, height: int | None = None) -> Tensor:
        """Linear radiance ``(H, 2H, 3)``, row 0 is +Y, the centre column -Z; default height the network's."""
        log = self.log_light
        if height is not None and height < log.shape[1]:
            return functional.adaptive_avg_pool2d(log.exp()[None], (height, 2 * height))[0].permute(1, 2, 0)
        return log.exp().permute(1, 2, 0)
