"""Light and maps of a fixed surface: primary rays are traced once, random pixels are shaded at every step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from reli3d._bridge import present
from reli3d.fit import losses
from reli3d.fit.bounce import thrown_back
from reli3d.fit.budget import Budget
from reli3d.fit.photographs import WHITE, Photographs
from reli3d.fit.shading import radiance
from reli3d.fit.unknowns import (
    Start,
    Unknowns,
    bent,
    environment,
    material_change,
    material_logits,
    material_of,
)
from reli3d.geometry.hits import interpolate
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.gbuffer import primary_hits, sample_texture, surface_points
from reli3d.render.points import SurfacePoints

BATCH = 6144  # pixels a step
SAMPLES = ((6, 6, 2), (12, 12, 4))  # of a pixel at the start and the end: coarse steps need no clean images
PIXELS = 400_000  # of all photographs that are kept: 46 MB; of more, a random part
RATES = {"material": 0.04, "detail": 0.03, "bend": 0.02, "light": 0.04, "exposure": 0.01}
OPENING = 0.1  # share of the part after which the next finer map or grid joins in
DETAIL_FROM = 0.35
PAINT_UNTIL = 0.7  # of the part that fits the paint; after it the paint stays, and the bend starts anew, held more


@dataclass(frozen=True)
class MapsStage:
    """A part of a fit on a fixed surface."""

    name: str
    until: float  # share of the budget used at its end
    paint: bool = True  # fit the textures and the bend of the normals, too


@dataclass(frozen=True)
class Pixels:
    """Pixels that show the object, and what their rays hit; N rows."""

    view: Tensor
    position: Tensor
    normal: Tensor
    ng: Tensor
    wo: Tensor
    uv: Tensor
    logits: Tensor  # of the start's material
    target: Tensor  # (N, 3) linear
    received: Tensor  # (N, 3) of :func:`~reli3d.fit.bounce.gathered`
    order: Tensor  # random, so that a run of it is a fair sample


@torch.no_grad()
def traced(
    asset: Asset, received: Tensor, scene: RayScene, photographs: Photographs, views: list[int], seed: int
) -> Pixels:
    """The pixels of ``views`` well inside the masks at which ``asset``, whose vertices receive ``received``, is hit."""
    inside, mesh, parts = photographs.inside(), asset.mesh, []
    for view in views:
        hits, _, directions = primary_hits(scene, photographs.camera[view])
        both = inside[view] & (hits.face >= 0)
        face, bary = hits.face[both], hits.bary[both]
        at = surface_points(mesh, asset.textures, face, bary)
        uv = interpolate(present("mesh.uv", mesh.uv), mesh.faces, face, bary)
        of_view = torch.full_like(face, view, dtype=torch.long)
        parts.append(
            (
                of_view,
                at.position,
                at.normal,
                at.ng,
                -directions[both],
                uv,
                material_logits(at),
                photographs.color[view][both],
                interpolate(received, mesh.faces, face, bary),
            )
        )
    columns = [torch.cat(column) for column in zip(*parts)]
    rng = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(columns[0]), generator=rng, dtype=torch.int64, device="cpu").to(columns[0].device)
    if len(order) > PIXELS:
        order = order[:PIXELS]
        columns, order = (
            [column[order] for column in columns],
            torch.arange(PIXELS, device=order.device, dtype=torch.int64),
        )
    which, position, normal, ng, wo, uv, logits, target, received = columns
    return Pixels(which, position, normal, ng, wo, uv, logits, target, received, order)


def maps_loss(
    unknowns: Unknowns,
    start: Start,
    pixels: Pixels,
    rows: Tensor,
    scene: RayScene | None,
    weights: losses.Weights,
    *,
    samples: tuple[int, int, int],
    views: int,
    seed: int,
    independent: bool = True,
) -> Tensor:
    """Loss of one step over ``rows`` of the pixels, with gradients to material, detail, bend, light and exposure."""
    position, view, target = pixels.position[rows], pixels.view[rows], pixels.target[rows]
    change = material_change(unknowns, position)
    fine = sample_texture(unknowns.detail, pixels.uv[rows])
    change = torch.cat([change[:, :3] + fine, change[:, 3:]], 1)
    normal, turned = bent(unknowns, position, pixels.normal[rows])
    points = SurfacePoints(position, pixels.ng[rows], normal, *material_of(pixels.logits[rows] + change))
    light, exposure = environment(unknowns, start), unknowns.exposure.exp()[view, None]
    bounced = thrown_back(points, pixels.received[rows])
    image = (bounced + radiance(points, pixels.wo[rows], light, samples=samples, scene=scene, seed=2 * seed)) * exposure
    other = image
    if independent:
        with torch.no_grad():
            other = radiance(points, pixels.wo[rows], light, samples=samples, scene=scene, seed=2 * seed + 1)
            other = (bounced + other) * exposure
    loss = weights.picture * losses.display_error(image, other, target, target > WHITE)
    color, was = (c.clamp(min=losses.DARK).log() for c in (points.base_color, material_of(pixels.logits[rows])[0]))
    loss = loss + weights.palette * losses.palette(color, target) + weights.hue * losses.hue_drift(color, was)
    loss = loss + losses.priors(unknowns, weights, views) + losses.near_paint(change[:, :3], weights, views)
    loss = loss + weights.bend * turned.square().sum(1).mean()
    if weights.demodulation:
        bright = other.detach().mean(1) / points.base_color.detach().mean(1).clamp(min=0.02)
        shading = bright.clamp(min=1e-3).log()
        loss = loss + weights.demodulation * losses.shared_pattern(change[:, :3].mean(1), shading)
    return loss


def fading(progress: float, settled: bool) -> float:
    """Share of the full rate: it falls from 0.6 of a part on, and once more from 1 after the paint."""
    since = (progress - PAINT_UNTIL) / (1.0 - PAINT_UNTIL) if settled else (progress - 0.6) / 0.4
    return 1.0 - 0.9 * min(max(since, 0.0), 1.0)


def fit_maps(
    unknowns: Unknowns,
    start: Start,
    asset: Asset,
    received: Tensor,
    photographs: Photographs,
    views: list[int],
    weights: losses.Weights,
    budget: Budget,
    stage: MapsStage,
    *,
    seed: int,
) -> None:
    """Fit light, exposures and materials on the surface of ``asset``, coarse parts first.

    received: ``(V, 3)``, of :func:`~reli3d.fit.bounce.gathered` at its vertices.

    Errors of normals, shadows and bounced light look like paint.  While the paint is fitted the shading normals may
    bend almost freely and take these errors.  Then the paint stays, and the bend begins again at zero, held so that it
    takes only what many pixels ask for: this one is written into the asset.
    """
    scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
    pixels = traced(asset, received, scene, photographs, views, seed)
    count = len(pixels.order)
    if count == 0:
        return
    names = ("light", "exposure", "material", *(("detail", "bend") if stage.paint else ()))
    groups, opens = [], []
    for which in names:
        for k, value in enumerate(unknowns.groups()[which]):
            groups.append({"params": [value], "lr": 0.0, "full": RATES[which]})
            opens.append(DETAIL_FROM if which == "detail" else OPENING * k)
            value.requires_grad_(True)
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
    first, settled = 0, False
    free, kept = weights.free_bend * len(views), weights.bend / len(views) ** 2
    for step, progress in budget.part(stage.name, stage.until):
        if stage.paint and progress >= PAINT_UNTIL and not settled:
            settled = True
            for value in (*unknowns.material, unknowns.detail):
                value.requires_grad_(False)
            unknowns.straighten()
        fade = fading(progress, settled)
        for group, opening in zip(optimizer.param_groups, opens, strict=True):
            group["lr"] = group["full"] * fade if progress >= opening else 0.0
        rows = pixels.order[
            torch.arange(first, first + min(BATCH, count), device=pixels.order.device, dtype=torch.int64) % count
        ]
        first = (first + BATCH) % count
        samples = SAMPLES[0] if progress < 0.5 else SAMPLES[1]
        loss = maps_loss(
            unknowns,
            start,
            pixels,
            rows,
            scene,
            replace(weights, bend=kept if settled else free),
            samples=samples,
            views=len(views),
            seed=seed * 1_000_003 + step,
        )
        optimizer.zero_grad()  # those without gradient stay as they are
        loss.backward()
        optimizer.step()
        budget.tell(stage.name, step, float(loss.detach()))
    for group in optimizer.param_groups:
        group["params"][0].requires_grad_(False)
    if not settled:  # interrupted
        unknowns.straighten()
