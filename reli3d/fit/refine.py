"""From an asset and its photographs to an asset that matches them: the order of a fit, and its safety."""

from __future__ import annotations

import math
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from reli3d.fit import losses
from reli3d.fit.budget import Budget, progress_bar
from reli3d.fit.maps import MapsStage, fit_maps
from reli3d.fit.photographs import Photographs, PosedImages
from reli3d.fit.shading import radiance
from reli3d.fit.shape import Grid, ShapeData, bound_level, finished, fit_shape, start_level
from reli3d.fit.transfer import changed, dressed
from reli3d.fit.unknowns import Start, Unknowns, corrected, environment
from reli3d.geometry.mesh import watertight
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb
from reli3d.render.gbuffer import primary_hits, surface_points

RESOLUTION = 128  # cells along the longest side
LIGHT = MapsStage("light", until=0.12, detail=False)  # first the light, then the surface, then all maps
SHAPE_UNTIL = 0.5  # of the budget
MAPS = MapsStage("maps", until=1.0)
CHECK_PIXELS = 96  # of a photograph, a side, by which start and result are compared
CHECK_SAMPLES = (16, 16, 4)
TEXELS = 512  # of the base colour's detail, at most
SLACK = 0.02  # dB: the noise of a comparison


@dataclass(frozen=True)
class Refinement:
    """What :func:`refine` gives.

    asset: the refined one, or the start where that is better.  kept: which of them.  before, after: mean PSNR [dB] on
    white of the photographs that were used and of those held out (NaN without any).  held: their indices.  c2w:
    ``(V, 4, 4)``, the cameras as corrected.  notes: one line each.  curve,
    steps: what the run did.
    """

    asset: Asset
    kept: str
    before: tuple[float, float]
    after: tuple[float, float]
    held: tuple[int, ...]
    c2w: Tensor
    notes: tuple[str, ...]
    curve: list[dict] = field(default_factory=list)
    steps: dict[str, int] = field(default_factory=dict)

    def record(self) -> dict:
        """What a file may hold of it: plain values, without the asset."""
        pairs = {
            name: dict(zip(("input", "held_out"), (None if math.isnan(v) else round(v, 3) for v in values)))
            for name, values in (("psnr_before", self.before), ("psnr_after", self.after))
        }
        return {
            "kept": self.kept,
            **pairs,
            "views_held_out": list(self.held),
            "steps": self.steps,
            "notes": list(self.notes),
            "curve": self.curve,
        }


def held_out(count: int) -> tuple[int, ...]:
    """Views whose colours no fit may use: none of fewer than three, one of fewer than twelve, else two."""
    return () if count < 3 else (count // 2,) if count < 12 else (count // 3, 2 * count // 3)


@torch.no_grad()
def picture_error(asset: Asset, photographs: Photographs) -> Tensor:
    """Mean squared display error ``(V,)`` of whole pictures on white under the asset's own light, at pixel centres."""
    small = photographs.resized(min(CHECK_PIXELS, photographs.size))
    scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
    errors = []
    for view in range(len(small)):
        hits, _, directions = primary_hits(scene, small.camera[view])
        seen = hits.face >= 0
        at = surface_points(asset.mesh, asset.textures, hits.face[seen], hits.bary[seen])
        image = torch.ones_like(small.color[view])
        lit = radiance(at, -directions[seen], asset.light, samples=CHECK_SAMPLES, scene=scene, seed=view)
        image[seen] = linear_to_srgb(lit.clamp(0.0, 1.0))
        wanted = torch.lerp(
            torch.ones_like(image), linear_to_srgb(small.color[view].clamp(0, 1)), small.mask[view][..., None]
        )
        errors.append((image - wanted).square().mean())
    return torch.stack(errors)


def decibels(errors: Tensor) -> float:
    """Mean PSNR over views, NaN of none."""
    return float((-10.0 * errors.clamp(min=1e-9).log10()).mean()) if len(errors) else math.nan


@torch.enable_grad()
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
) -> Refinement:
    """``asset`` fitted to the photographs ``views``, in whose frame it lies.

    seconds or steps: one of the two; with ``steps`` the result is the same on every run of one machine.  resolution:
    cells of the surface's grid along the longest side.  weights: of the losses.  cameras: correct the cameras as well.
    bar: progress on stderr.  Ctrl-C ends the fit and the best so far is taken.

    With three views or more some are held out: their masks bound the surface, their colours are not used.  Where the
    result shows any views worse than the start does, the start is returned.  Raises TypeError or ValueError where the
    parts do not fit together, and on an asset without light, atlas or faces.
    """
    photographs, weights = Photographs.of(views), weights or losses.Weights()
    _check_asset(asset, photographs)
    budget = Budget(seconds, steps)
    if bar:
        budget.bar = progress_bar(seconds or steps or 0, "s" if seconds else "steps")
    held = held_out(len(photographs))
    used = [v for v in range(len(photographs)) if v not in held]
    low, high = asset.mesh.vertices.amin(0), asset.mesh.vertices.amax(0)
    shift, scale = (low + high) / 2, 2.0 / float((high - low).max())
    first, near = _moved(asset, shift, scale), photographs.moved(shift, scale)
    before = picture_error(first, near)
    notes: list[str] = []
    with torch.random.fork_rng(devices=[]), _interruptible(budget, notes):
        result, near = _fitted(first, near, used, resolution, weights, budget, notes, seed=seed, cameras=cameras)
    after = picture_error(result, near)
    if budget.bar is not None:
        budget.bar.close()
    was, now = ((decibels(e[used]), decibels(e[list(held)])) for e in (before, after))
    worse = [name for name, a, b in zip(("input", "held-out"), was, now) if b < a - SLACK]
    if worse:
        notes.append(f"refinement: kept the start, as the result is worse on {' and '.join(worse)} views")
    kept = asset if worse else _moved(result, -scale * shift, 1.0 / scale)
    c2w = views.c2w if worse else near.moved(-scale * shift, 1.0 / scale).camera.c2w
    name = "start" if worse else "result"
    return Refinement(kept, name, was, now, held, c2w, tuple(notes), budget.curve, budget.counts)


def _fitted(
    first: Asset,
    photographs: Photographs,
    used: list[int],
    resolution: int,
    weights: losses.Weights,
    budget: Budget,
    notes: list[str],
    *,
    seed: int,
    cameras: bool,
) -> tuple[Asset, Photographs]:
    """The fitted asset, and the photographs with their cameras corrected."""
    start, texels = Start.of(first), min(TEXELS, first.textures.size)
    closed = watertight(first.mesh)
    grid = Grid.around(first.mesh.vertices, resolution)
    level = start_level(first.mesh, grid) if closed else first.mesh.vertices.new_ones(grid.shape)
    unknowns = Unknowns.zero(level, len(photographs), texels)
    fit_maps(unknowns, start, first, photographs, used, weights, budget, LIGHT, seed=seed)
    surface = first
    if closed:
        bound = bound_level(photographs, grid)
        data = ShapeData.of(start, level, bound, grid, photographs, used)
        fit_shape(unknowns, data, weights, budget, SHAPE_UNTIL, seed=seed, cameras=cameras)
        mesh = finished(unknowns.level, bound, grid)
        surface = dressed(mesh, first, first.textures.size)
        photographs = replace(photographs, camera=corrected(photographs.camera, unknowns.pose))
    else:
        notes.append("refinement: the surface is not closed, so only its maps and light are fitted")
    fit_maps(unknowns, start, surface, photographs, used, weights, budget, MAPS, seed=seed)
    with torch.no_grad():
        return replace(changed(surface, unknowns), environment=environment(unknowns, start)), photographs


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


@contextmanager
def _interruptible(budget: Budget, notes: list[str]):
    """Ctrl-C ends the parts of a fit instead of the program."""
    import signal
    import threading

    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number, frame):
        if budget.interrupted:
            raise KeyboardInterrupt
        budget.interrupted = True
        notes.append("refinement: interrupted, the best so far is taken")

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
