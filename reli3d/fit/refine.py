"""From an asset and its photographs to an asset that matches them: the order of a fit, and its safety."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace

import torch
from torch import Tensor

from reli3d._bridge import full_precision
from reli3d.fit import losses
from reli3d.fit.bounce import gathered
from reli3d.fit.budget import Budget, progress_bar
from reli3d.fit.choice import NOTHING, Fitted, Parts, chosen, decibels, picture_error
from reli3d.fit.maps import MapsStage, fit_maps
from reli3d.fit.photographs import Photographs, PosedImages
from reli3d.fit.shape import ShapeData, finished, fit_shape, start_grid
from reli3d.fit.transfer import dressed
from reli3d.fit.unknowns import START_GRID, Start, Unknowns, corrected, filled_grid
from reli3d.geometry.mesh import watertight
from reli3d.render.asset import Asset

RESOLUTION = 128  # cells along the longest side
LIGHT = MapsStage("light", until=0.12, paint=False)  # first the light, then the surface, then all maps
SHAPE_UNTIL = 0.5  # of the budget
MAPS = MapsStage("maps", until=1.0)
TEXELS = 512  # of the base colour's detail, at most


@dataclass(frozen=True)
class Refinement:
    """What :func:`refine` gives.

    asset: the refined one, or the start where no mixture of its parts is as good.  parts: what of the fit it has.
    before, after: mean PSNR [dB] on white of the photographs that were used and of those held out (NaN without any), by
    pictures with direct light and what the object throws on itself (:func:`~reli3d.fit.bounce.gathered`).
    held: their indices.  c2w: ``(V, 4, 4)``, the cameras as corrected.  notes: one line each.  curve, steps: what the
    run did.
    """

    asset: Asset
    parts: Parts
    before: tuple[float, float]
    after: tuple[float, float]
    held: tuple[int, ...]
    c2w: Tensor
    notes: tuple[str, ...]
    curve: list[dict] = field(default_factory=list)
    steps: dict[str, int] = field(default_factory=dict)

    @property
    def changed(self) -> bool:
        """False where ``asset`` is the start."""
        return self.parts != NOTHING

    def record(self) -> dict:
        """What a file may hold of it: plain values, without the asset."""
        pairs = {
            name: dict(zip(("input", "held_out"), (None if math.isnan(v) else round(v, 3) for v in values)))
            for name, values in (("psnr_before", self.before), ("psnr_after", self.after))
        }
        return {
            "kept": asdict(self.parts),
            **pairs,
            "views_held_out": list(self.held),
            "steps": self.steps,
            "notes": list(self.notes),
            "curve": self.curve,
        }


def held_out(count: int) -> tuple[int, ...]:
    """Views whose colours no fit may use: none of fewer than three, one of fewer than twelve, else two."""
    return () if count < 3 else (count // 2,) if count < 12 else (count // 3, 2 * count // 3)


@torch.enable_grad()
@full_precision
def refine(
    asset: Asset,
    views: PosedImages,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    resolution: int = RESOLUTION,
    weights: losses.Weights | None = None,
    cameras: bool = False,
    seed: int = 0,
    bar: bool = False,
    interrupt: Callable[[], bool] | None = None,
) -> Refinement:
    """``asset`` fitted to the photographs ``views``, in whose frame it lies.

    seconds or steps: one of the two; with ``steps`` the result is the same on every run of one machine.  resolution:
    cells of the surface's grid along the longest side, more where it is thin (:func:`~reli3d.fit.shape.start_grid`).
    weights: of the losses.  cameras: correct the cameras as well.  bar: progress on stderr.  interrupt:
    asked before every step; once it is true the fit ends and the best so far is taken.

    Of three views or more some are held out: their masks bound the surface, their colours are not used.  What of the
    fit is taken says :func:`~reli3d.fit.choice.chosen`.  Raises TypeError or ValueError where asset and views do not
    belong together, and on an asset without light, atlas or faces.
    """
    photographs, weights = Photographs.of(views), weights or losses.Weights()
    _check_asset(asset, photographs)
    budget = Budget(seconds, steps, interrupt=interrupt)
    if bar:
        budget.bar = progress_bar(seconds or steps or 0, "s" if seconds else "steps")
    held = held_out(len(photographs))
    used = [v for v in range(len(photographs)) if v not in held]
    low, high = asset.mesh.vertices.amin(0), asset.mesh.vertices.amax(0)
    shift, scale = (low + high) / 2, 2.0 / float((high - low).max())
    first, near = _moved(asset, shift, scale), photographs.moved(shift, scale)
    received = gathered(first.mesh, near.select(used), seed=seed)
    before = picture_error(first, received, near)
    notes: list[str] = []
    with torch.random.fork_rng(devices=[]):
        fitted = _fitted(first, received, near, used, resolution, weights, budget, notes, seed=seed, cameras=cameras)
        kept, parts, after = chosen(fitted, used, list(held), before)
    if budget.bar is not None:
        budget.bar.close()
    if budget.interrupted:
        notes.append("refinement: interrupted, the best so far is taken")
    notes.append(f"refinement: {parts}")
    was, now = ((decibels(e[used]), decibels(e[list(held)])) for e in (before, after))
    if parts == NOTHING:
        return Refinement(asset, parts, was, now, held, views.c2w, tuple(notes), budget.curve, budget.counts)
    kept, near = _moved(kept, -scale * shift, 1.0 / scale), fitted.photographs.moved(-scale * shift, 1.0 / scale)
    return Refinement(kept, parts, was, now, held, near.camera.c2w, tuple(notes), budget.curve, budget.counts)


def _fitted(
    first: Asset,
    received: Tensor,
    photographs: Photographs,
    used: list[int],
    resolution: int,
    weights: losses.Weights,
    budget: Budget,
    notes: list[str],
    *,
    seed: int,
    cameras: bool,
) -> Fitted:
    start, texels = Start.of(first), min(TEXELS, first.textures.size)
    closed = watertight(first.mesh)
    level = first.mesh.vertices.new_ones(2, 2, 2)  # stands in where the surface is open and has no level
    if closed:
        grid, level, bound = start_grid(first.mesh, photographs, resolution)
    unknowns = Unknowns.zero(level, len(photographs), texels)
    fit_maps(unknowns, start, first, received, photographs, used, weights, budget, LIGHT, seed=seed)
    surface = first
    if closed:
        around = filled_grid(first.mesh.vertices, received, START_GRID)
        data = ShapeData.of(start, level, bound, grid, around, photographs, used)
        fit_shape(unknowns, data, weights, budget, SHAPE_UNTIL, seed=seed, cameras=cameras)
        mesh = finished(unknowns.level, bound, grid)
        surface = dressed(mesh, first, first.textures.size)
        photographs = replace(photographs, camera=corrected(photographs.camera, unknowns.pose))
        received = gathered(surface.mesh, photographs.select(used), seed=seed)
    else:
        notes.append("refinement: the surface is not closed, so only its maps and light are fitted")
    fit_maps(unknowns, start, surface, received, photographs, used, weights, budget, MAPS, seed=seed)
    return Fitted(first, surface, received, start, unknowns, photographs)


def _check_asset(asset: Asset, photographs: Photographs) -> None:
    if asset.environment is None:
        raise ValueError("asset.environment: expected a light to start from, got None")
    if asset.mesh.uv is None or asset.mesh.normals is None or asset.mesh.tangents is None or not len(asset.mesh.faces):
        raise ValueError("asset.mesh: expected faces with normals, uv and tangents, got none")
    if asset.mesh.vertices.device != photographs.color.device:
        raise ValueError(f"views: expected device {asset.mesh.vertices.device}, got {photographs.color.device}")


def _moved(asset: Asset, shift: Tensor, scale: float) -> Asset:
    """``asset`` in the frame ``scale * (x - shift)``."""
    return replace(asset, mesh=replace(asset.mesh, vertices=scale * (asset.mesh.vertices - shift)))
