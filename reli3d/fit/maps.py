"""Fits lighting and material on a fixed surface: primary rays are traced once, random pixels shaded at every step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from reli3d._bridge import present
from reli3d.fit import losses
from reli3d.fit.bounce import reflected
from reli3d.fit.budget import Budget, Part
from reli3d.fit.input_images import InputImages
from reli3d.fit.lighting import Lights, radiance
from reli3d.fit.unknowns import Start, Unknowns, bent, material_change, material_logits, material_of
from reli3d.geometry.hits import interpolate
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.gbuffer import primary_hits, sample_texture, surface_points
from reli3d.render.points import SurfacePoints

PIXELS_PER_STEP = 6144
SHADING_SAMPLES = ((6, 6, 2), (12, 12, 4))  # of light, BSDF and cosine, in the first and the second half of a stage
MAX_PIXELS = 400_000  # of all images: 51 MB; of more, a random subset
LEARNING_RATES = {"material": 0.04, "detail": 0.03, "bend": 0.02, "light": 0.04, "exposure": 0.01}
GRID_INTERVAL = 0.1  # of a stage's progress, after which the next finer map or grid is optimized as well
DETAIL_FROM = 0.35  # progress from which the texture detail is optimized
MATERIAL_UNTIL = 0.7  # progress at which the material is frozen, and the bend is reset and fitted with a stronger prior


@dataclass(frozen=True)
class FixedSurface:
    """Constants of a fit of maps and lighting.

    asset: the surface with the start's maps.  received: ``(vertices, 3)``, from :func:`~reli3d.fit.bounce.gathered`.
    used: indices of the views whose colors are used.
    """

    start: Start
    asset: Asset
    received: Tensor
    images: InputImages
    used: list[int]


@dataclass(frozen=True)
class Pixels:
    """Pixels inside the masks and the surface points visible there; N rows."""

    view: Tensor
    face: Tensor
    bary: Tensor
    position: Tensor
    normal: Tensor
    ng: Tensor
    wo: Tensor
    uv: Tensor
    logits: Tensor  # of the start's material
    target: Tensor  # (N, 3) linear
    received: Tensor  # (N, 3) of :func:`~reli3d.fit.bounce.gathered`
    order: Tensor  # random permutation; consecutive entries are a uniform sample

    @torch.no_grad()
    def with_maps(self, asset: Asset) -> Pixels:
        """The pixels with the material of ``asset``, which has the same surface."""
        return replace(self, logits=material_logits(surface_points(asset.mesh, asset.textures, self.face, self.bary)))


@torch.no_grad()
def traced(data: FixedSurface, scene: RayScene, seed: int) -> Pixels:
    """The pixels of the used views that are at least one pixel inside the masks and whose rays hit the surface.

    Of more than ``MAX_PIXELS``, a uniform random sample.  scene: rays against the surface.  seed: random seed of the
    sample and the order.
    """
    asset, images = data.asset, data.images
    inside, mesh = images.inside(), asset.mesh
    columns: tuple[list[Tensor], ...] = ([], [], [], [], [])
    for view in data.used:
        hits, _, directions = primary_hits(scene, images.camera[view])
        both = inside[view] & (hits.face >= 0)
        face = hits.face[both]
        of_view = torch.full_like(face, view, dtype=torch.long)
        values = (of_view, face, hits.bary[both], -directions[both], images.color[view][both])
        for column, value in zip(columns, values, strict=True):
            column.append(value)
    rng = torch.Generator().manual_seed(seed)
    order = torch.randperm(sum(map(len, columns[0])), generator=rng, dtype=torch.int64, device="cpu")
    order = order.to(inside.device)
    rows = order[:MAX_PIXELS] if len(order) > MAX_PIXELS else slice(None)
    joined = []
    for column in columns:
        joined.append(torch.cat(column)[rows])
        column.clear()  # less memory
    if len(order) > MAX_PIXELS:
        order = torch.arange(MAX_PIXELS, device=order.device, dtype=torch.int64)
    which, face, bary, wo, target = joined
    at = surface_points(mesh, asset.textures, face, bary)
    uv = interpolate(present("mesh.uv", mesh.uv), mesh.faces, face, bary)
    received = interpolate(data.received, mesh.faces, face, bary)
    logits = material_logits(at)
    return Pixels(which, face, bary, at.position, at.normal, at.ng, wo, uv, logits, target, received, order)


def maps_loss(
    unknowns: Unknowns,
    data: FixedSurface,
    pixels: Pixels,
    rows: Tensor,
    weights: losses.Weights,
    *,
    direct: Callable[..., Tensor],
    seed: int,
    independent: bool = True,
) -> Tensor:
    """Loss of one step over ``rows`` of the pixels; gradients reach material, detail, bend, light and exposure.

    direct: :func:`~reli3d.fit.lighting.radiance` with its samples and scene.  seed: of the light samples.  independent:
    as in :func:`~reli3d.fit.losses.estimated_error`.
    """
    position, view, target = pixels.position[rows], pixels.view[rows], pixels.target[rows]
    detail = sample_texture(unknowns.detail, pixels.uv[rows])
    change = material_change(unknowns, position)
    change = torch.cat([change[:, :3] + detail, change[:, 3:]], 1)
    normal, turned = bent(unknowns, position, pixels.normal[rows])
    points = SurfacePoints(position, pixels.ng[rows], normal, *material_of(pixels.logits[rows] + change))
    lights, exposure = Lights.of(unknowns, data.start, data.images), unknowns.exposure.exp()[view, None]
    bounced = reflected(points, pixels.received[rows])

    def lit(seed: int) -> Tensor:
        return (bounced + lights.evaluate(points, pixels.wo[rows], view, partial(direct, seed=seed))) * exposure

    loss = weights.image * losses.estimated_error(lit, target, seed, independent)
    color = points.base_color.clamp(min=losses.MIN_LINEAR).log()
    loss = loss + weights.palette * losses.palette(color, target)
    loss = loss + losses.priors(unknowns, weights, len(data.used))
    loss = loss + weights.background * losses.near_background(unknowns, data.start)
    loss = loss + losses.near_base_color(change[:, :3], weights, len(data.used))
    return loss + weights.bend * turned.square().sum(1).mean()


def fading(progress: float, settled: bool) -> float:
    """Learning-rate factor, which falls linearly from 1 to 0.1.

    The decay begins at progress 0.6 or, once the material is frozen (``settled``), at ``MATERIAL_UNTIL``.
    """
    since = (progress - MATERIAL_UNTIL) / (1.0 - MATERIAL_UNTIL) if settled else (progress - 0.6) / 0.4
    return 1.0 - 0.9 * min(max(since, 0.0), 1.0)


def fit_maps(
    unknowns: Unknowns,
    data: FixedSurface,
    weights: losses.Weights,
    budget: Budget,
    part: Part,
    *,
    seed: int,
    detail: bool = True,
    pixels: Pixels | None = None,
) -> None:
    """Fits lighting, exposures and material on a fixed surface, coarse to fine.

    detail: fit the texture detail and the bend of the normals as well.  pixels: None: those of :func:`traced`.

    Errors of normals, shadows and interreflection would be baked into the base color.  While the material is fitted, a
    weakly regularized bend of the shading normals absorbs these errors.  Then the material is frozen, and the bend is
    reset and fitted again with a stronger prior; only this second bend is kept.
    """
    scene = RayScene(data.asset.mesh.vertices, data.asset.mesh.faces)
    pixels = traced(data, scene, seed) if pixels is None else pixels
    count = len(pixels.order)
    if count == 0:
        budget.counts[part.name] = 0
        return
    names = ("light", "exposure", "material", *(("detail", "bend") if detail else ()))
    groups = []
    for which in names:
        for k, value in enumerate(unknowns.groups()[which]):
            opens = DETAIL_FROM if which == "detail" else GRID_INTERVAL * k
            groups.append({"params": [value], "lr": 0.0, "full": LEARNING_RATES[which], "opens": opens})
            value.requires_grad_(True)
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
    first, settled = 0, False
    free, kept = weights.free_bend * len(data.used), weights.bend / len(data.used) ** 2
    for step, progress in budget.take(part):
        if detail and progress >= MATERIAL_UNTIL and not settled:
            settled = True
            for value in (*unknowns.material, unknowns.detail):
                value.requires_grad_(False)
            unknowns.reset_bend()
        fade = fading(progress, settled)
        for group in optimizer.param_groups:
            group["lr"] = group["full"] * fade if progress >= group["opens"] else 0.0
        end = first + min(PIXELS_PER_STEP, count)
        rows = pixels.order[torch.arange(first, end, device=pixels.order.device, dtype=torch.int64) % count]
        first = (first + PIXELS_PER_STEP) % count
        direct = partial(radiance, samples=SHADING_SAMPLES[progress >= 0.5], scene=scene)
        own = replace(weights, bend=kept if settled else free)
        loss = maps_loss(unknowns, data, pixels, rows, own, direct=direct, seed=seed * 1_000_003 + step)
        optimizer.zero_grad()  # to None: Adam skips frozen tensors
        loss.backward()
        optimizer.step()
        budget.record(part.name, step, float(loss.detach()))
    for group in optimizer.param_groups:
        group["params"][0].requires_grad_(False)
    if not settled and budget.counts[part.name]:  # interrupted
        unknowns.reset_bend()
