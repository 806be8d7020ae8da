"""Refinement of an asset by inverse rendering: fits surface, material and lighting to posed images."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import asdict, dataclass, field, replace

import torch
from torch import Tensor

from reli3d._bridge import check, full_precision, load_modules, present
from reli3d.fit import losses
from reli3d.fit.background import Background
from reli3d.fit.bounce import gathered
from reli3d.fit.budget import Budget, Part
from reli3d.fit.choice import UNCHANGED, Fitted, Parts, chosen, mean_psnr, view_errors
from reli3d.fit.input_images import InputImages, PosedImages
from reli3d.fit.light_frame import light_follows_camera
from reli3d.fit.light_hue import CHROMATICITY_WEIGHT, with_neutral_light
from reli3d.fit.maps import FixedSurface, fit_maps
from reli3d.fit.material_start import best_material_start
from reli3d.fit.shape import ShapeData, empty, finished, fit_shape, start_grid
from reli3d.fit.transfer import transfer_textures
from reli3d.fit.unknowns import START_GRID, Start, Unknowns, corrected, filled_grid
from reli3d.geometry.mesh import Mesh, watertight
from reli3d.kernels import cache, flexicubes_adjoint, shade_adjoint  # noqa: F401 # they are compiled before the fit
from reli3d.render.asset import Asset

RESOLUTION = 128  # cells along the longest side
LIGHT_UNTIL, SHAPE_UNTIL = 0.12, 0.5  # fractions of the budget: first the lighting, then the surface, then all maps
MIN_VIEWS_FOR_TRIALS = 12  # with 8, roughness and metallic improve, but relighting falls by 0.5 dB (six objects)
MIN_ATLAS_TEXELS = 256  # along a side of the new surface's textures: smaller ones have no room for its charts
MAX_DETAIL_TEXELS = 512  # along a side of the base color's detail map
UV_TOLERANCE = 1e-3  # beyond [0, 1]; within a texel


@dataclass(frozen=True)
class RefineOptions:
    """Options of :func:`refine`.

    resolution: of :func:`~reli3d.fit.shape.start_grid`.  cameras: optimize the poses as well.  light: of
    :meth:`InputImages.of`; unless ``object``, the result has the lighting of view 0.  light_chromaticity: weight of
    :func:`~reli3d.fit.light_hue.with_neutral_light`; 1 keeps the lighting of a start whose lighting is known.
    surroundings: the uncropped images of all views, whose background, assumed far away, initializes and constrains the
    lighting (:class:`~reli3d.fit.background.Background`); not with ``light="camera"``.
    """

    resolution: int = RESOLUTION
    weights: losses.Weights = losses.Weights()  # it is frozen
    cameras: bool = False
    light: str | Sequence[Hashable] = "object"
    light_chromaticity: float = CHROMATICITY_WEIGHT
    surroundings: PosedImages | None = None
    seed: int = 0


@dataclass(frozen=True)
class Refinement:
    """Result of :func:`refine`.

    asset: the refined asset, or the start if no blend of fit and start is at least as good.  parts: the blend weights.
    before, after: mean PSNR [dB] over the fitted views and over the held-out views (NaN if there are none), of
    renderings on white with direct light and one-bounce interreflection (:func:`~reli3d.fit.bounce.gathered`).  held:
    indices of the held-out views.  c2w: ``(V, 4, 4)``, the corrected cameras.  notes: one line each.  curve: loss
    curve, as in :class:`~reli3d.fit.budget.Budget`.  steps: number of steps per stage.
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
        """False if ``asset`` is the start."""
        return self.parts != UNCHANGED

    def record(self) -> dict:
        """The result without the asset and the cameras, in plain values for a JSON file."""
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


def held_out(groups: Sequence[int]) -> tuple[int, ...]:
    """Indices of the held-out views: none of fewer than 3 views, one of fewer than 12, otherwise two.

    groups: index of the lighting per view; one view of each lighting is not held out.
    """
    count, held = len(groups), list[int]()
    for view in () if count < 3 else (count // 2,) if count < 12 else (count // 3, 2 * count // 3):
        fitted = Counter(group for v, group in enumerate(groups) if v not in held)
        free = [v for v, group in enumerate(groups) if v not in held and fitted[group] > 1]
        held += [min(free, key=lambda v: abs(v - view))] if free else []
    return tuple(held)


@torch.inference_mode(False)
@torch.enable_grad()
@full_precision
def refine(
    asset: Asset,
    views: PosedImages,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    options: RefineOptions = RefineOptions(),  # noqa: B008 # it is frozen
    bar: bool = False,
    interrupt: Callable[[], bool] | None = None,
) -> Refinement:
    """Fits surface, material and lighting of ``asset`` to posed images by inverse rendering.

    views: images, masks and cameras in the frame of ``asset``.  seconds, steps: the budget, exactly one;
    with ``steps`` the result is deterministic on one CPU.  bar: show progress on stderr.  interrupt: called before
    every step; True ends the fit with the best result so far.

    The colors of :func:`held_out` views are not fitted.  :func:`~reli3d.fit.choice.chosen` selects what is kept.
    Nothing has gradients.  Raises TypeError or ValueError for mismatched shapes or devices, an invalid ``light`` or
    budget, or an asset without environment, textures, normals, UV or faces.
    """
    images, background = InputImages.of(views, options.light), None
    _check_asset(asset, images)
    if options.surroundings is not None:
        check("surroundings.images", options.surroundings.images, like=images.color)
        background = Background.of(InputImages.of(options.surroundings, options.light))
    device = images.color.device
    kernels = cache.imported(device.type)
    if not cache.compiled(kernels, device.type):  # it takes up to half a minute, which is not part of the budget
        load_modules(kernels, device)
    budget = Budget(seconds, steps, bar, interrupt)
    held = held_out(images.light_group)
    used = [v for v in range(len(images)) if v not in held]
    low, high = asset.mesh.vertices.detach().aminmax(dim=0)
    shift, scale = (low + high) / 2, 2.0 / float((high - low).max())
    first, near = _moved(asset.detach(), shift, scale), images.moved(shift, scale)
    if _tiled(first.mesh):
        first = transfer_textures(first.mesh, first, _atlas_size(first))
    elif first.mesh.tangents is None:
        first = replace(first, mesh=first.mesh.with_tangents())
    received = gathered(first.mesh, near.select(used), seed=options.seed)
    before = view_errors(first, received, near)
    first = with_neutral_light(first, options.light_chromaticity)
    notes: list[str] = []
    if (rotations := near.light_rotations) is not None:
        moves = "turns about +Y" if images.light_frame == "turntable" else "moves"
        notes.append(f"the lighting {moves} with the camera; the environment is that of view 0")
    elif len(set(images.light_group)) > 1:
        notes.append(f"{len(set(images.light_group))} lightings; the environment is that of view 0")
    elif light_follows_camera(first.mesh, near):
        advice = "if the lighting moves with it, set light to camera (flash) or turntable"
        notes.append(f"brightness varies with the camera; {advice}")
    with torch.random.fork_rng(devices=[]):
        rotated = None if rotations is None else rotations[used]
        start = Start.of(first, rotations=rotated)
        if background is not None:
            first = background.scaled(first, start)
            start = background.over(Start.of(first, rotations=rotated))
        data = FixedSurface(start, first, received, near, used)
        fitted = _fitted(data, options, budget, notes)
        kept, parts, after = chosen(fitted, used, list(held), before)
    if budget.bar is not None:
        budget.bar.close()
    if budget.interrupted:
        notes.append("interrupted, the best result so far is kept")
    lines = tuple(f"refinement: {note}" for note in (*notes, parts))
    back, c2w = (-scale * shift, 1.0 / scale), views.c2w
    if parts == UNCHANGED:
        kept, after = asset, before
    else:
        kept, c2w = _moved(kept, *back), fitted.images.moved(*back).camera.c2w
    was, now = ((mean_psnr(e[used]), mean_psnr(e[list(held)])) for e in (before, after))
    return Refinement(kept, parts, was, now, held, c2w, lines, budget.curve, budget.counts)


def _fitted(data: FixedSurface, options: RefineOptions, budget: Budget, notes: list[str]) -> Fitted:
    first, images, used, seed = data.asset, data.images, data.used, options.seed
    start, weights, texels = data.start, options.weights, _atlas_size(first)
    closed = watertight(first.mesh)
    sdf = first.mesh.vertices.new_ones(2, 2, 2)  # unused placeholder: an open surface has no signed distance
    if closed:
        grid, sdf, bound = start_grid(first.mesh, images, options.resolution)
    unknowns = Unknowns.zero(sdf, len(images), min(MAX_DETAIL_TEXELS, texels), max(images.light_group) + 1)
    fit_maps(unknowns, data, weights, budget, Part("light", LIGHT_UNTIL), seed=seed, detail=False)
    if closed:
        around = filled_grid(first.mesh.vertices, data.received, START_GRID)
        shape = ShapeData.of(start, sdf, bound, grid, around, images, used)
        fit_shape(unknowns, shape, weights, budget, SHAPE_UNTIL, seed=seed, cameras=options.cameras)
        del shape  # 170 MB of 60 images
        if empty(unknowns.sdf, bound):
            notes.append("the masks do not overlap in space, so only maps and lighting are fitted; run reli3d check")
        elif budget.counts["shape"]:
            surface = transfer_textures(finished(unknowns.sdf, bound, grid), first, texels)
            images = replace(images, camera=corrected(images.camera, unknowns.pose))
            received = gathered(surface.mesh, images.select(used), seed=seed)
            data = FixedSurface(start, surface, received, images, used)
    else:
        notes.append("the surface is not closed, so only maps and lighting are fitted")
    surface, held = data.asset, [v for v in range(len(images)) if v not in used]
    # Under lighting that moves with the camera, a metal may fit a dielectric's highlights (relighting -4 dB).
    if len(images) >= MIN_VIEWS_FOR_TRIALS and images.light_frame != "camera":
        unknowns, data = best_material_start(unknowns, data, held, weights, budget, seed=seed)
        if data.asset is not surface:
            kind = "metal" if float(data.asset.textures.metallic.mean()) > 0.5 else "dielectric"
            notes.append(f"roughness and metallic are fitted from those of a glossy {kind}")
    fit_maps(unknowns, data, weights, budget, Part("maps", 1.0), seed=seed)
    return Fitted(first, surface, data.received, start, unknowns, images, data.asset)


def _tiled(mesh: Mesh) -> bool:
    """Whether UV leave [0, 1], so that texels may be shared by several places of the surface."""
    low, high = present("mesh.uv", mesh.uv).detach().aminmax()
    return float(low) < -UV_TOLERANCE or float(high) > 1.0 + UV_TOLERANCE


def _atlas_size(asset: Asset) -> int:
    return max(MIN_ATLAS_TEXELS, asset.textures.size)


def _check_asset(asset: Asset, images: InputImages) -> None:
    if asset.environment is None:
        raise ValueError("asset.environment: expected an environment to start from, got None")
    if asset.textures is None:
        raise ValueError("asset.textures: expected textures to start from, got None")
    if asset.mesh.uv is None or asset.mesh.normals is None or not len(asset.mesh.faces):
        raise ValueError("asset.mesh: expected faces with normals and uv, got none; see reli3d.unwrap")
    if asset.mesh.vertices.device != images.color.device:
        raise ValueError(f"views: expected device {asset.mesh.vertices.device}, got {images.color.device}")


def _moved(asset: Asset, shift: Tensor, scale: float) -> Asset:
    """``asset`` in the frame ``scale * (x - shift)``."""
    return replace(asset, mesh=replace(asset.mesh, vertices=scale * (asset.mesh.vertices - shift)))
