"""What a step of training asks of a :class:`~reli3d.nn.local.LocalReconstructor` about one object."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from reli3d.nn.local import LocalField, LocalReconstructor, PixelMaps
from reli3d.nn.value_bins import bin_loss
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.train.batches import Pictures, Sample
from reli3d.train.pixels import Group, predicted

WEIGHTS = {
    "occupancy": 1.0,
    "surface": 0.02,
    "gradient": 0.6,
    "base_color": 2.0,
    "pattern": 0.24,
    "roughness": 2.0,
    "metallic": 2.0,
    "normal": 1.0,
    "pixel_color": 1.5,
    "pixel_pattern": 0.24,
    "pixel_roughness": 2.0,
    "pixel_metallic": 2.0,
    "pixel_normal": 1.0,
    "pixel_depth": 0.3,
    "light": 0.4,
    "light_level": 0.1,
    "irradiance": 0.4,
}
ASTRAY = 0.02, 0.3  # greatest deviation of position [model's cube] and normal [radian] of an extracted surface
GRADIENT_POINTS, GRADIENT_STEP = 384, 0.012  # surface points whose level's slope is asked, over about a grid cell
PLAIN = 0.002  # mean square error of a pattern (27 dB) that is as good as none
DEPTH_UNIT = 0.1  # of the object's longest side
NORMALS = 192  # directions at which the irradiance is compared


PIXEL_TERMS = tuple(name for name in WEIGHTS if name.startswith("pixel"))


def encode_sample(model: LocalReconstructor, sample: Sample) -> LocalField:
    return model.encode(*_views_of(sample))


def _views_of(sample: Sample) -> tuple[Tensor, ...]:
    """Arguments of :meth:`~reli3d.nn.local.LocalReconstructor.encode`."""
    detail = torch.cat([sample.images, sample.silhouette[..., None]], -1).contiguous()
    return sample.images, sample.masks, sample.c2w, sample.intrinsics, detail, sample.intrinsics


def pixel_losses(model: LocalReconstructor, group: Group) -> dict[str, Tensor]:
    """The terms PIXEL_TERMS alone; gradients reach the predictions of the 2D U-Net."""
    pixels, color = predicted(model, group)
    return _pixels(pixels, color, group.views, group.counts)


def losses(model: LocalReconstructor, sample: Sample) -> dict[str, Tensor]:
    """Unweighted terms, each a scalar; gradients reach every parameter."""
    field = encode_sample(model, sample)
    position, normal, bumped = (t.contiguous() for t in sample.surface.unbind(1))
    normal, bumped = functional.normalize(normal, dim=-1), functional.normalize(bumped, dim=-1)
    field = field.with_shading(position, normal, sample.visible)
    return {
        **_shape(field, sample, position, normal),
        **_paint(field, sample, position, normal, bumped),
        **_pixels(field.pixels, field.color, sample, (len(sample.images),)),
        **_light(field, sample),
    }


def _shape(field: LocalField, sample: Sample, position: Tensor, normal: Tensor) -> dict[str, Tensor]:
    """Occupancy as a soft step; level zero and its slope along the normal at surface points.

    The slope is asked by differences over a tetrahedron: no second derivative of the network is needed.  It is asked
    around points a little off the surface, as the surface that is drawn errs.
    """
    softness = field.model.preset.softness
    level = field.sdf(sample.points)
    target = (-sample.distance / softness).sigmoid()
    corners = GRADIENT_STEP * position.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    few = position[:GRADIENT_POINTS]
    near, _ = astray(few, normal[:GRADIENT_POINTS])
    around = field.free_sdf((near[:, None] + corners).reshape(-1, 3)).reshape(-1, 4)
    slope = (around[..., None] * corners).sum(1)
    on_surface = field.free_sdf(few)
    return {
        "occupancy": functional.binary_cross_entropy_with_logits(-level, target),
        "surface": functional.smooth_l1_loss(on_surface, torch.zeros_like(on_surface)),
        "gradient": (1 - functional.cosine_similarity(slope, normal[:GRADIENT_POINTS], dim=-1, eps=1e-6)).mean(),
    }


def _paint(field: LocalField, sample: Sample, position: Tensor, normal: Tensor, bumped: Tensor) -> dict[str, Tensor]:
    """Material at surface points, asked a little off the surface and with a tilted normal, as extraction errs."""
    got = field.material(*astray(position, normal), sample.visible)
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


def astray(position: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Points ``(N, 3)`` moved along their normals, and the normals tilted, as far as an extracted surface errs.

    How far they are apart is drawn for all points together, for it differs from object to object.
    """
    share = torch.rand((), device=position.device)
    distance = ASTRAY[0] * share * torch.randn_like(position[:, :1])
    tilt = ASTRAY[1] * share * torch.randn_like(normal) / 2**0.5  # two of its three components turn the normal
    return position + distance * normal, functional.normalize(normal + tilt, dim=-1)


def excess_entropy(value: Tensor, target: Tensor) -> Tensor:
    """Cross-entropy of values in [0, 1] over its least value: 0 where they are equal.

    The mean square has hardly a slope where a sigmoid is near 0 or 1: black colors would stay black, and a metallic
    of 0.1 everywhere would stay so.
    """
    least = functional.binary_cross_entropy(target, target)
    return functional.binary_cross_entropy(value, target) - least


def pattern_loss(color: Tensor, target: Tensor) -> Tensor:
    """Logarithm of the mean square difference of base colors ``(N, 3)``, sRGB, after each channel's best factor in
    linear light; PLAIN is added, and 0 is no difference.

    How bright an albedo is no image tells: a longer exposure looks the same.  How it varies over the surface, they do.
    The factor has its gradient, else the colors would drift: the mean square is that of encoded colors.  By the
    logarithm a stain on a plain object counts as much as a lost pattern.
    """
    p, t = srgb_to_linear(color), srgb_to_linear(target)
    factor = (p * t).sum(0) / p.square().sum(0).clamp(min=1e-4)
    return torch.log1p(functional.mse_loss(linear_to_srgb((p * factor).clamp(0.0, 1.0)), target) / PLAIN)


def _pixels(pixels: PixelMaps, shown: Tensor, views: Pictures, counts: tuple[int, ...]) -> dict[str, Tensor]:
    """The pyramid's predictions against the maps of the views, at pixels that show the surface alone.

    shown: ``(V, P, P, 3)`` sRGB, the colors of these pixels.  counts: views of each object, side by side.
    """
    valid = views.view_valid
    want = views.view_material[valid]
    color = pixels.base_logit(shown)[valid].sigmoid()
    of_objects = [int(part.sum()) for part in valid.split(list(counts))]  # none of a thin one in a small picture
    pairs = zip(color.split(of_objects), want[:, :3].split(of_objects), strict=True)
    patterns = [pattern_loss(c, w) if len(w) else w.sum() for c, w in pairs]
    share = color.new_tensor([count if n else 0 for count, n in zip(counts, of_objects, strict=True)])
    found = {
        "pixel_color": excess_entropy(color, want[:, :3]),
        "pixel_pattern": (torch.stack(patterns) * share).sum() / share.sum(),
        "pixel_normal": (1 - (pixels.normal[valid] * views.view_normal[valid]).sum(-1)).mean(),
        "pixel_depth": functional.smooth_l1_loss(
            pixels.depth[valid][:, 0] / DEPTH_UNIT, views.view_depth[valid] / DEPTH_UNIT, beta=0.2
        ),
    }
    return found | _finish(pixels, views)


def _finish(pixels: PixelMaps, views: Pictures) -> dict[str, Tensor]:
    """Roughness and metallic of the pixels, by cross-entropy over bins where the network has them; nothing where no
    view has a known finish.
    """
    valid = views.view_valid & views.finish_known[:, None, None]
    if not bool(valid.any()):
        return {}
    want, found = views.view_material[valid][:, 3:], {}
    for k, name in enumerate(("roughness", "metallic")):
        if pixels.bins.shape[-1] > 1:
            loss = bin_loss(pixels.bins[..., k, :][valid], want[:, k])
        else:
            loss = excess_entropy(getattr(pixels, name)[valid][:, 0].sigmoid(), want[:, k])
        found[f"pixel_{name}"] = loss
    return found


def _light(field: LocalField, sample: Sample) -> dict[str, Tensor]:
    """Log radiance over the sphere, and log irradiance at random normals, which lamps decide.

    Both after each channel's best factor, for a darker paint under a brighter light gives the same photographs; the
    logarithm of that factor is a term of its own.
    """
    log = field.log_light
    count = len(sample.light)
    rows = int((count // 2) ** 0.5)
    angle = torch.sin((torch.arange(count) // (2 * rows) + 0.5) * torch.pi / rows).to(log)
    got = Environment(log.permute(1, 2, 0).contiguous()).lookup(sample.light_directions)
    error = torch.logaddexp(got, got.new_tensor(-4.6)) - (sample.light + 0.01).log()
    angle = angle / angle.sum()
    level = (error * angle[:, None]).sum(0)
    normals = functional.normalize(torch.randn(NORMALS, 3, device=log.device), dim=-1)
    cosine = (normals @ sample.light_directions.T).clamp(min=0) * angle
    cosine = cosine / cosine.sum(-1, keepdim=True)
    irradiance, want = cosine @ got.exp(), cosine @ sample.light
    under = (irradiance + 0.01).log() - (want + 0.01).log()
    return {
        "light": ((error - level).abs().mean(-1) * angle).sum(),
        "light_level": level.abs().mean(),
        "irradiance": (under - under.mean(0)).abs().mean(),
    }
