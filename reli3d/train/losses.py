"""Losses of :class:`~reli3d.nn.local.LocalReconstructor` for one object."""

import torch
from torch import Tensor
from torch.nn import functional

from reli3d.nn.heads import ROUGHNESS_MIN
from reli3d.nn.local import LocalField, LocalReconstructor, PixelMaps
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.train.batches import Sample, TrainingViews
from reli3d.train.pixels import Group, predict_pixels

WEIGHTS = {
    "occupancy": 1.0, "surface": 0.02, "gradient": 0.6,
    "base_color": 2.0, "pattern": 0.24, "roughness": 2.0, "metallic": 2.0, "normal": 1.0,
    "pixel_color": 1.5, "pixel_pattern": 0.24, "pixel_roughness": 2.0, "pixel_metallic": 2.0, "pixel_normal": 1.0,
    "pixel_depth": 0.3, "light": 0.4, "light_scale": 0.1, "irradiance": 0.4,
}  # fmt: skip
MAX_PERTURBATION = 0.02, 0.3  # position [model's cube] and normal [radian] of an extracted surface deviate by so much
GRADIENT_POINTS, GRADIENT_STEP = 384, 0.012  # surface points with a gradient loss; finite-difference step, a grid cell
PATTERN_FLOOR = 0.002  # mean squared error added to that of a pattern: 27 dB
DEPTH_UNIT = 0.1  # of the object's longest side
NORMALS = 192  # directions at which the irradiance is compared
PIXEL_TERMS = tuple(name for name in WEIGHTS if name.startswith("pixel"))


def encode_sample(model: LocalReconstructor, sample: Sample) -> LocalField:
    """The sample's views and mirror images, encoded."""
    mirrored = len(sample.mirrored_c2w)
    detail = torch.cat([sample.images, sample.silhouette[..., None]], -1)
    images, masks, detail = (torch.cat([t, t[:mirrored].flip(2)]) for t in (sample.images, sample.masks, detail))
    c2w = torch.cat([sample.c2w, sample.mirrored_c2w])
    intrinsics = torch.cat([sample.intrinsics, sample.mirrored_intrinsics])
    return model.encode(images, masks, c2w, intrinsics, detail, intrinsics, mirrored=mirrored)


def pixel_losses(model: LocalReconstructor, group: Group) -> dict[str, Tensor]:
    """The terms PIXEL_TERMS only; gradients reach the pixel predictions of the 2D U-Net."""
    pixels, color = predict_pixels(model, group)
    return _pixel_terms(pixels, color, group.views, group.counts)


def losses(model: LocalReconstructor, sample: Sample) -> dict[str, Tensor]:
    """Unweighted terms, each a scalar, those of pixels if one is covered; gradients reach every parameter."""
    field, count = encode_sample(model, sample), len(sample.images)
    position, normal, bumped = (t.contiguous() for t in sample.surface.unbind(1))
    normal, bumped = functional.normalize(normal, dim=-1), functional.normalize(bumped, dim=-1)
    field = field.with_shading(position, normal, sample.visible)
    pixels = field.pixels.of_views(count), field.color[:count], sample, (count,)
    return {
        **_shape_terms(field, sample, position, normal),
        **_material_terms(field, sample, position, normal, bumped),
        **(_pixel_terms(*pixels) if bool(sample.view_valid.any()) else {}),  # means over no pixel are NaN
        **_light_terms(field, sample),
    }


def _shape_terms(field: LocalField, sample: Sample, position: Tensor, normal: Tensor) -> dict[str, Tensor]:
    """Occupancy in the volume; near surface points, value zero and direction of the gradient (a finite difference)."""
    softness = field.model.preset.softness
    sdf = field.sdf(sample.points)
    target = (-sample.distance / softness).sigmoid()
    corners = GRADIENT_STEP * position.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    few = position[:GRADIENT_POINTS]
    near, _ = perturbed(few, normal[:GRADIENT_POINTS])
    around = field.free_sdf((near[:, None] + corners).reshape(-1, 3)).reshape(-1, 4)
    gradient = (around[..., None] * corners).sum(1)
    on_surface = field.free_sdf(few)
    return {
        "occupancy": functional.binary_cross_entropy_with_logits(-sdf, target),
        "surface": functional.smooth_l1_loss(on_surface, torch.zeros_like(on_surface)),
        "gradient": (1 - functional.cosine_similarity(gradient, normal[:GRADIENT_POINTS], dim=-1, eps=1e-6)).mean(),
    }


def _material_terms(
    field: LocalField, sample: Sample, position: Tensor, normal: Tensor, bumped: Tensor
) -> dict[str, Tensor]:
    """Errors of the material at surface points, evaluated at perturbed positions and normals."""
    got = field.material(*perturbed(position, normal), sample.visible)
    base, rough, metal = sample.material[:, :3], sample.material[:, 3], sample.material[:, 4]
    color = linear_to_srgb(got.base_color)  # as samples store it
    found = {
        "base_color": excess_entropy(color, base),
        "pattern": pattern_loss(color, base),
        "normal": (1 - functional.cosine_similarity(got.normal, bumped, dim=-1)).mean(),
    }
    if bool(sample.finish_known.all()):
        found |= {"roughness": excess_entropy(got.roughness, rough), "metallic": excess_entropy(got.metallic, metal)}
    return found


def perturbed(position: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Points ``(N, 3)`` shifted along their normals, and tilted normals, by the errors of an extracted surface."""
    amplitude = torch.rand((), device=position.device)
    distance = MAX_PERTURBATION[0] * amplitude * torch.randn_like(position[:, :1])
    # two of three components tilt the normal
    tilt = MAX_PERTURBATION[1] * amplitude * torch.randn_like(normal) / 2**0.5
    return position + distance * normal, functional.normalize(normal + tilt, dim=-1)


def excess_entropy(value: Tensor, target: Tensor) -> Tensor:
    """Cross-entropy of values in [0, 1] minus its minimum, the entropy of ``target``: 0 if they are equal.

    The gradient of the mean squared error vanishes where a sigmoid is near 0 or 1; that of the cross-entropy does not.
    """
    least = functional.binary_cross_entropy(target, target)
    return functional.binary_cross_entropy(value, target) - least


def pattern_loss(color: Tensor, target: Tensor) -> Tensor:
    """Scale-invariant difference of base colors ``(N, 3)``, sRGB: ``log(1 + mse / PATTERN_FLOOR)``.

    After the best factor per channel in linear light, because exposure makes the absolute albedo ambiguous.  The
    logarithm balances objects with weak and with strong patterns.
    """
    p, t = srgb_to_linear(color), srgb_to_linear(target)
    factor = (p * t).sum(0) / p.square().sum(0).clamp(min=1e-4)
    return torch.log1p(functional.mse_loss(linear_to_srgb((p * factor).clamp(0.0, 1.0)), target) / PATTERN_FLOOR)


def _pixel_terms(pixels: PixelMaps, shown: Tensor, views: TrainingViews, counts: tuple[int, ...]) -> dict[str, Tensor]:
    """The pyramid's predictions for colors ``shown (V, P, P, 3)`` against the true maps, at pixels covered."""
    valid = views.view_valid
    target = views.view_material[valid]
    color = pixels.base_logit(shown)[valid].sigmoid()
    of_objects = [int(part.sum()) for part in valid.split(list(counts))]  # 0 for a thin object in a small image
    pairs = zip(color.split(of_objects), target[:, :3].split(of_objects), strict=True)
    patterns = [pattern_loss(c, w) if len(w) else w.sum() for c, w in pairs]
    weight = color.new_tensor([count if n else 0 for count, n in zip(counts, of_objects, strict=True)])
    depths = pixels.depth[valid][:, 0] / DEPTH_UNIT, views.view_depth[valid] / DEPTH_UNIT
    found = {
        "pixel_color": excess_entropy(color, target[:, :3]),
        "pixel_pattern": (torch.stack(patterns) * weight).sum() / weight.sum(),
        "pixel_normal": (1 - (pixels.normal[valid] * views.view_normal[valid]).sum(-1)).mean(),
        "pixel_depth": functional.smooth_l1_loss(*depths, beta=0.2),
    }
    valid = valid & views.finish_known[:, None, None]
    if bool(valid.any()):
        rough, metal = views.view_material[valid][:, 3:].unbind(1)
        rough = ((rough - ROUGHNESS_MIN) / (1.0 - ROUGHNESS_MIN)).clamp(min=0.0)  # the range of the network's values
        found["pixel_roughness"] = excess_entropy(pixels.roughness[valid][:, 0].sigmoid(), rough)
        found["pixel_metallic"] = excess_entropy(pixels.metallic[valid][:, 0].sigmoid(), metal)
    return found


def _light_terms(field: LocalField, sample: Sample) -> dict[str, Tensor]:
    """Mean absolute differences of log radiance and log irradiance, without a scale per channel, ``light_scale``."""
    log, count = field.log_light, len(sample.light)
    rows = int((count // 2) ** 0.5)
    angle = torch.sin((torch.arange(count) // (2 * rows) + 0.5) * torch.pi / rows).to(log)
    got = Environment(log.permute(1, 2, 0).contiguous()).lookup(sample.light_directions)
    error = torch.logaddexp(got, got.new_tensor(-4.6)) - (sample.light + 0.01).log()
    angle = angle / angle.sum()
    scale = (error * angle[:, None]).sum(0)
    normals = functional.normalize(torch.randn(NORMALS, 3, device=log.device), dim=-1)
    cosine = (normals @ sample.light_directions.T).clamp(min=0) * angle
    cosine = cosine / cosine.sum(-1, keepdim=True)
    irradiance, target = cosine @ got.exp(), cosine @ sample.light
    under = (irradiance + 0.01).log() - (target + 0.01).log()
    return {
        "light": ((error - scale).abs().mean(-1) * angle).sum(),
        "light_scale": scale.abs().mean(),
        "irradiance": (under - under.mean(0)).abs().mean(),
    }
