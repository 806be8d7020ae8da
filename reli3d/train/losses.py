"""What a step of training asks of the network: the field at points, the material at the surface, the light, and
images.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from reli3d.nn.field import LIGHT_ROWS, bound_level, object_shading, surface_level, surface_material
from reli3d.nn.light_features import Shading
from reli3d.nn.model import Code, Reconstructor
from reli3d.nn.view_features import ViewMaps
from reli3d.render.bump import radial_bump
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from reli3d.synthetic.samples import PAINT
from reli3d.train.batches import Batch

IMAGE_SAMPLES = (12, 8, 2)  # light, GGX and cosine samples a pixel of the image loss
LIGHT_DIRECTIONS = 384  # of the 2048 of a sample's map: enough for one step's mean, a fifth of the decoder's time
ASTRAY = 0.04, 0.4  # greatest deviation of position [model's cube] and normal [radian] of an extracted surface


def losses(model: Reconstructor, batch: Batch) -> dict[str, Tensor]:
    """Unweighted terms, each a scalar mean over the batch; gradients reach every parameter that took part."""
    code = model.encode(batch.images, batch.masks, batch.c2w, batch.intrinsics)
    lights = model.decode_environment(code, LIGHT_ROWS)
    fields = []
    for b in range(len(batch.images)):
        own = code.of(b)
        maps = maps_of(own, batch.images[b], batch.silhouette[b], batch.c2w[b], batch.intrinsics[b])
        shading = sample_shading(model, lights[b], maps, batch, b)
        fields.append(field_losses(model, own, maps, batch, b, shading))
        fields[-1]["image"] = _image_loss(model, own, maps, batch, b, lights[b], shading)
    terms = {k: torch.stack([f[k] for f in fields]).mean() for k in fields[0]}
    terms["light"] = light_loss(model, code, batch)
    return terms


def maps_of(code: Code, images: Tensor, silhouette: Tensor, c2w: Tensor, intrinsics: Tensor) -> ViewMaps:
    return ViewMaps(code.view_tokens[0], torch.cat([images, silhouette[..., None]], -1).contiguous(), c2w, intrinsics)


def sample_shading(model: Reconstructor, light: Tensor, maps: ViewMaps, batch: Batch, b: int) -> Shading | None:
    """What is known of the light on object ``b`` of the batch, from its surface points."""
    position, normal, _ = batch.surface[b].unbind(1)
    return object_shading(model, light, maps, position.contiguous(), functional.normalize(normal, dim=-1),
                          batch.visible[b])  # fmt: skip


def field_losses(model: Reconstructor, code: Code, maps: ViewMaps, batch: Batch, b: int,
                 shading: Shading | None) -> dict[str, Tensor]:  # fmt: skip
    """The terms of object ``b`` that ask for no image: occupancy at its points, material at its surface."""
    level = surface_level(model, code, maps, batch.points[b])
    if model.preset.silhouette_bound:
        level = torch.maximum(level, bound_level(model, maps, batch.points[b]))
    target = (-batch.distance[b] / model.preset.softness).sigmoid()
    out = {"occupancy": functional.binary_cross_entropy_with_logits(-level, target)}

    position, normal, bumped = batch.surface[b].unbind(1)
    normal = functional.normalize(normal, dim=-1)
    got = surface_material(model, code, maps, *astray(position, normal), batch.visible[b], shading)
    out["base_color"] = functional.mse_loss(got["base_color"], batch.material[b, :, :3])
    out["pattern"] = pattern_loss(got["base_color"], batch.material[b, :, :3])
    out["roughness"] = functional.mse_loss(got["roughness"][:, 0], batch.material[b, :, 3])
    out["metallic"] = functional.mse_loss(got["metallic"][:, 0], batch.material[b, :, 4])
    world = radial_bump(position, normal, got["normal"])
    out["normal"] = (1 - functional.cosine_similarity(world, bumped, dim=-1)).mean()
    return out


def astray(position: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Points ``(N, 3)`` moved along their normals, and the normals tilted, as far as an extracted surface errs.

    The material is asked for where the extracted surface lies, not where the object's does; how far they are apart is
    drawn for all points together, for it differs from object to object.
    """
    share = torch.rand((), device=position.device)
    distance = ASTRAY[0] * share * torch.randn_like(position[:, :1])
    tilt = ASTRAY[1] * share * torch.randn_like(normal) / 2**0.5  # two of its three components turn the normal
    return position + distance * normal, functional.normalize(normal + tilt, dim=-1)


def pattern_loss(color: Tensor, target: Tensor) -> Tensor:
    """Mean square difference of base colours ``(N, 3)``, sRGB, after each channel's best factor in linear light.

    How bright an albedo is no image tells: a longer exposure looks the same.  How it varies over the surface, they do.
    """
    p, t = srgb_to_linear(color), srgb_to_linear(target)
    factor = (p * t).sum(0) / p.square().sum(0).clamp(min=1e-4)
    return functional.mse_loss(linear_to_srgb((p * factor.detach()).clamp(0.0, 1.0)), target)


def _image_loss(model: Reconstructor, code: Code, maps: ViewMaps, batch: Batch, b: int, light: Tensor,
                known: Shading | None) -> Tensor:  # fmt: skip
    """Difference of log(1 + radiance) of pixels of a view, mostly one that was not input, shaded with what is
    predicted.

    Shadows and what other surfaces reflect are missing from the prediction: the term teaches which material and light
    explain a colour together, and weighs little.  Gradients reach material, bump normal and light.
    """
    position, _, wo = batch.pixels[b].unbind(1)
    wo = functional.normalize(wo, dim=-1)
    near = torch.cdist(position, batch.surface[b, :, 0]).argmin(1)  # the sample knows who sees its surface points
    normal = functional.normalize(batch.surface[b, near, 1], dim=-1)
    normal = torch.where(
        (normal * wo).sum(-1, keepdim=True) > 0, normal, wo
    )  # the nearest point may lie round a corner
    got = surface_material(model, code, maps, position, normal, batch.visible[b, near], known)
    shading = radial_bump(position, normal, got["normal"])
    points = SurfacePoints(position, normal, shading, srgb_to_linear(got["base_color"]), got["roughness"][:, 0],
                           got["metallic"][:, 0])  # fmt: skip
    radiance = shade(points, wo, Environment(light), options=ShadeOptions(IMAGE_SAMPLES, b, paint=PAINT))
    return (torch.log1p(radiance) - torch.log1p(batch.pixel_radiance[b])).abs().mean()


def light_loss(model: Reconstructor, code: Code, batch: Batch) -> Tensor:
    """Absolute difference of log radiance over directions, weighted by solid angle; 0.01 keeps black from mattering."""
    count = batch.light.shape[1]
    pick = torch.randperm(count)[:LIGHT_DIRECTIONS]
    directions, target = batch.light_directions[:, pick], batch.light[:, pick]
    rows = int((count // 2) ** 0.5)
    weight = torch.sin((pick // (2 * rows) + 0.5) * torch.pi / rows)
    radiance = model.radiance(code, directions)
    error = (torch.log(radiance + 0.01) - torch.log(target + 0.01)).abs().mean(-1)
    return (error * weight).sum() / (weight.sum() * len(error))
