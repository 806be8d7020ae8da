"""Pipeline from posed images to a relightable asset.

One function per stage; :func:`reconstruct` runs all stages, and :func:`reconstruct_folder` reads an object folder and
writes the result.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn import functional

from reli3d._bridge import expect, full_precision, present
from reli3d.errors import InputError
from reli3d.geometry.bake import bake
from reli3d.geometry.cover import FIELD_MAX, cover_silhouettes
from reli3d.geometry.mesh import Mesh, largest_components, weld, without_degenerate_faces
from reli3d.geometry.normals import displace_to_normals
from reli3d.geometry.rays import RayScene
from reli3d.geometry.smooth import taubin_smooth
from reli3d.geometry.sparse_sdf import sparse_sdf
from reli3d.geometry.surface import extract_surface
from reli3d.geometry.tangents import encode_normals
from reli3d.geometry.uv import source_vertices, unwrap, unwrap_xatlas
from reli3d.nn.blocks import in_rows, submit
from reli3d.nn.field import CHUNK, TriplaneField
from reli3d.nn.local import HEAD_OUTPUTS, VIEW_WEIGHT, LocalField, LocalReconstructor
from reli3d.nn.presets import CALIBRATED_VIEWS, LocalPreset, Preset
from reli3d.nn.view_features import ViewMaps
from reli3d.nn.weights import Network, load_model
from reli3d.prepare import Prepared, completed, prepare, published_input
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.environment import Environment
from reli3d.render.exposure import estimate_base_color_and_light
from reli3d.render.latlong import lat_long_directions
from reli3d.views.check import up_axis, verdict
from reli3d.views.folder import load_views
from reli3d.views.normalize import FAR_DISTANCES, normalize
from reli3d.views.published_views import (
    BACKGROUNDS,
    background_shown,
    has_background,
    hero_first,
    placement_notes,
)
from reli3d.views.similarity import Similarity, output_frame
from reli3d.views.views import ViewBatch, Views, crop_side, whole_views

if TYPE_CHECKING:
    from reli3d.fit.fine_detail import Crop
    from reli3d.fit.refine import Refinement

REFINED = 384  # pixels per side of the views that a refinement compares with
SURROUNDINGS = 256  # pixels per side of the uncropped images whose background a refinement reads
MAX_CROP_PIXELS = 3 << 23  # of all photographs whose detail is added: 100 MB during the fit
LEAST_REFINED = 3  # views with the complete object from which a refinement leaves out the others
INSIDE = 2.0  # pixels from the silhouette within which colors may be mixed with the background
MIN_PART_FRACTION = 0.01  # of the faces; smaller components are removed
TEXELS = 1 << 19  # evaluated at once on a CPU: 100 bytes each
SHADING_POINTS = 4096  # vertices from which the lighting on the object is estimated
OUTSIDE_FIELD = 1.0  # field value of grid points outside the visual hull
NORMAL_LENGTH = 0.03  # model units: up to four views, predicted normals determine the shape of smaller features
NORMAL_WEIGHT, MAX_NORMAL_WEIGHT = 8.0, 3.0  # of predicted normals; divided by the number of views
MARGIN_CELLS = 2.5  # cells around the silhouettes' hull in which the field is still evaluated

Field = LocalField | TriplaneField  # network output for one object


class NoSurface(InputError):
    """The field of an object has one sign in the whole box, so there is no surface."""


def encode(model: Network, prepared: Prepared, *, background: bool = False) -> Field:
    """Runs the network on the views of one object.

    background: whether the illumination branch of a :class:`~reli3d.nn.model.Reconstructor` reads the background.
    """
    batch = prepared.batch
    views = batch.images, batch.masks, batch.c2w, batch.intrinsics
    if isinstance(model, LocalReconstructor):
        detail = prepared.images, prepared.camera.intrinsics
        return model.encode(*views, *detail, mirrored=prepared.mirrored, inference=True)
    shown = torch.tensor([background], device=batch.images.device, dtype=torch.bool)
    code = model.encode(*(v[None] for v in views), background_visible=shown)
    maps = ViewMaps(code.view_tokens[0].float(), prepared.images, prepared.camera)
    return TriplaneField(maps, model, code)


def extract(field: Field, resolution: int) -> Mesh:
    """Closed surface of the field on a grid of ``resolution`` cubes per side, in the model frame.

    Components below MIN_PART_FRACTION of the faces are removed.  Raises NoSurface, an InputError, if there is none.
    """
    if isinstance(field, LocalField):
        mesh = largest_components(without_degenerate_faces(_bounded_surface(field, resolution)), MIN_PART_FRACTION)
        mesh = taubin_smooth(mesh, iterations=field.model.preset.smoothing)  # predictions are noisy between cells
        return _with_predicted_normals(field, mesh.with_normals())
    mesh = without_degenerate_faces(_free_surface(field, resolution))
    return largest_components(mesh, MIN_PART_FRACTION).with_normals()


def _with_predicted_normals(field: LocalField, mesh: Mesh) -> Mesh:
    """``mesh`` displaced, inside the visual hull, towards the normals that the 2D U-Net predicts in the views.

    The target is a weighted mean of both normals: with few views their errors are similar and partly independent.
    """
    position, normal = mesh.vertices, present("mesh.normals", mesh.normals)
    fused = field.fused(position, normal, field.maps.visibility(RayScene(position, mesh.faces), position, normal))
    weight = min(MAX_NORMAL_WEIGHT, NORMAL_WEIGHT / field.maps.input_count) * fused.numbers[:, VIEW_WEIGHT, None]
    target = functional.normalize(normal + weight * fused.normal, dim=-1)
    inside = -field.bound(position) * field.model.preset.softness
    length = NORMAL_LENGTH * min(1.0, CALIBRATED_VIEWS / field.maps.input_count)
    return displace_to_normals(mesh, target, length=length, limit=inside.clamp(min=0.0))


def _free_surface(field: TriplaneField, resolution: int) -> Mesh:
    radius = field.model.preset.radius
    axis = torch.linspace(-radius, radius, resolution + 1, device=field.maps.images.device, dtype=torch.float32)
    sdf = field.grid_sdf(axis)
    _check_signs(sdf)
    points = torch.cartesian_prod(axis, axis, axis)
    return extract_surface(sdf, radius=radius, weights=field.cube_weights(points, sdf))


def _bounded_surface(field: LocalField, resolution: int) -> Mesh:
    """Surface inside the visual hull, on a grid that covers the hull's bounding box."""
    preset, maps = field.model.preset, field.maps
    radius = preset.radius
    radius = min(radius, _hull_reach(field, resolution) + 2 * MARGIN_CELLS * radius / resolution)
    axis = torch.linspace(-radius, radius, resolution + 1, device=maps.images.device, dtype=torch.float32)
    cell = 2 * radius / resolution / preset.softness
    bound = field.grid_bound(axis, FIELD_MAX + 4 * cell)  # values above FIELD_MAX do not affect the result
    near = bound < MARGIN_CELLS * cell

    def evaluate(index: Tensor) -> Tensor:
        parts = []
        for k in index.split(CHUNK):
            points = torch.stack([axis[i] for i in torch.unravel_index(k, bound.shape)], 1)
            parts.append(torch.maximum(field.sdf_within(points, bound.view(-1)[k]), bound.view(-1)[k]))
        return torch.cat(parts)

    sdf = torch.maximum(sparse_sdf(bound.clamp(min=OUTSIDE_FIELD), near, evaluate), bound)
    sdf = cover_silhouettes(sdf, bound, maps.silhouette, maps.camera, radius=radius)
    _check_signs(sdf)
    return extract_surface(sdf, radius=radius)


def _check_signs(sdf: Tensor) -> None:
    low, high = (float(v) for v in torch.aminmax(sdf))
    if low >= 0.0 or high < 0.0:
        raise NoSurface("sdf", f"expected values on both sides of 0, got [{low:.4g}, {high:.4g}]: no surface")


def _hull_reach(field: LocalField, resolution: int) -> float:
    """Largest coordinate of the points of the model's grid that lie inside all silhouettes."""
    radius = field.model.preset.radius
    axis = torch.linspace(-radius, radius, resolution + 1, device=field.maps.images.device, dtype=torch.float32)
    inside = field.grid_bound(axis, 0.0) < 0
    reach = axis.abs()[inside.nonzero()]
    if len(reach) == 0:
        raise InputError("masks", "expected masks that overlap in space, got none inside all of them; run reli3d check")
    return float(reach.max())


def texture(
    field: Field, mesh: Mesh, size: int, scene: RayScene | None, *, uv: str = "project"
) -> tuple[Mesh, TextureSet]:
    """``mesh`` with UV, normals and tangents, and its textures of ``size`` texels per side; the faces keep their order.

    scene: rays against ``mesh``, for networks that use the visibility of points in the views; otherwise None.  uv:
    ``project`` or ``xatlas``.
    """
    maps = field.maps

    def at_vertices(field: LocalField, mesh: Mesh) -> tuple[LocalField, Tensor]:
        """The field with its lighting; head outputs and visibility at the vertices, which are as dense as the grid."""
        every = slice(None, None, max(1, len(mesh.vertices) // SHADING_POINTS))
        position, normal = mesh.vertices, present("mesh.normals", mesh.normals)
        visible = maps.visibility(present("scene", scene), position, normal)
        field = field.with_shading(*(v[every].contiguous() for v in (position, normal, visible)))
        return field, torch.cat([field.heads(position, normal, visible), visible], 1)

    pending = submit(partial(at_vertices, field, mesh), mesh.vertices.device) if isinstance(field, LocalField) else None
    whole = mesh
    try:
        mesh = unwrap(mesh, texture_size=size) if uv == "project" else unwrap_xatlas(mesh, texture_size=size)
        mesh = mesh.with_tangents()
    finally:
        local, known = pending() if pending else (None, None)
    if known is not None:
        known = known.index_select(0, source_vertices(whole, mesh))

    def surface(position: Tensor, normal: Tensor, tangent: Tensor, *values: Tensor) -> dict[str, Tensor]:
        if isinstance(field, TriplaneField):
            got = field.material(position, normal)
        else:
            heads, corners = values[0].split([HEAD_OUTPUTS, len(maps.images)], 1)
            visible = maps.visibility_within(present("scene", scene), position, normal, corners)
            got = present("local", local).material_from_heads(heads, position, normal, visible)
        found = {"base_color": got.base_color, "roughness": got.roughness[:, None], "metallic": got.metallic[:, None]}
        return {**found, "normal": encode_normals(got.normal, normal, tangent)}

    chunk = CHUNK if mesh.vertices.is_cuda else TEXELS
    baked = bake(mesh, size, partial(in_rows, surface), chunk=chunk, tangents=True, values=known)
    return mesh, TextureSet(**{k: v.clamp_(0, 1) for k, v in baked.items()})


@full_precision
def transform_asset(asset: Asset, similarity: Similarity) -> Asset:
    """``asset`` transformed by ``similarity``: positions, normals, tangents and environment."""
    mesh, rotation = asset.mesh, similarity.rotation.to(asset.mesh.vertices)
    normals, tangents = present("mesh.normals", mesh.normals), present("mesh.tangents", mesh.tangents)
    tangents = torch.cat([tangents[:, :3] @ rotation.T, tangents[:, 3:]], -1)
    moved = replace(mesh, vertices=similarity.apply(mesh.vertices), normals=normals @ rotation.T, tangents=tangents)
    environment = asset.environment
    identity = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    if environment is not None and not torch.equal(rotation, identity):
        rows = environment.radiance.shape[0]
        environment = Environment(environment.lookup((lat_long_directions(rows).to(rotation) @ rotation).contiguous()))
    return replace(asset, mesh=moved, environment=environment)


def _check_place(near: Mesh, mesh: Mesh) -> None:
    """Raises InputError if vertices of ``near`` coincide in ``mesh``, its transform: float32 is coarse far from the
    origin.
    """
    low, high = mesh.vertices.aminmax(dim=0)
    far, size = float(torch.maximum(-low, high).max()), float((high - low).max())
    if far > FAR_DISTANCES * size and len(weld(mesh.vertices)[0]) < len(weld(near.vertices)[0]):
        raise InputError(
            "views",
            f"expected an object near the origin, got one of size {size:.3g} at {far:.3g}; "
            "subtract its position from those of the cameras",
        )


class Stopwatch:
    """Seconds of each stage in the order of execution, and notes; synchronizes the device before reading the clock."""

    def __init__(self, device: torch.device, report=None):
        self.seconds: dict[str, float] = {}
        self.notes: list[str] = []
        self._device, self._report = device, report

    @contextmanager
    def stage(self, name: str):
        if self._report:
            self._report(name)
        began = time.perf_counter()
        yield
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began


@dataclass(frozen=True)
class ReconstructOptions:
    """Options of :func:`reconstruct`.

    texture_size: texels per side, 256 to 4096.  resolution: cubes per side of the FlexiCubes grid, 16 to 256; None:
    the preset's.  normalization: a mode of :func:`~reli3d.views.normalize.normalize` or the
    :class:`~reli3d.views.similarity.Similarity` to the model frame; None: ``auto``, for the published network
    ``none``.  up: axis of the world that becomes +Y, such as ``-y``.  uv: ``project`` or ``xatlas``.  hero: index of
    the reference view.  background: what the lighting estimate reads, ``masked`` (the object), ``visible`` (published
    network only), or ``auto`` (``visible`` if all views have a background and the weights read it).  symmetry: ``auto``
    completes objects with a mirror plane (bundled network only), or ``off``.  Raises InputError for an invalid value.

    >>> options = reli3d.ReconstructOptions(texture_size=512, symmetry="off")
    >>> asset = reli3d.reconstruct(reli3d.load_views("photos/shoe"), options=options)
    """

    texture_size: int = 1024
    resolution: int | None = None
    normalization: str | Similarity | None = None
    up: str = "y"
    uv: str = "project"
    hero: int = 0
    background: str = "masked"
    symmetry: str = "auto"

    def __post_init__(self):
        output_frame(self.up)
        words = {"symmetry": ("auto", "off"), "uv": ("project", "xatlas"), "background": BACKGROUNDS}
        if not isinstance(self.normalization, Similarity | None):
            words["normalization"] = ("auto", "hull", "none")
        for name, allowed in words.items():
            if getattr(self, name) not in allowed:
                raise InputError(name, f"expected {', '.join(allowed)}, got {getattr(self, name)}")
        if not 256 <= self.texture_size <= 4096:
            raise InputError("texture_size", f"expected 256 to 4096 texels, got {self.texture_size}")
        if self.resolution is not None and not 16 <= self.resolution <= 256:
            raise InputError("resolution", f"expected 16 to 256 cubes, got {self.resolution}")


DEFAULT = ReconstructOptions()


@dataclass(frozen=True)
class Placed:
    """Views in network input order, and the transforms to the model frame and to the asset frame."""

    views: Views
    model_from_input: Similarity
    output_from_input: Similarity


@full_precision
def place(views: Views, preset: Preset | LocalPreset, options: ReconstructOptions = DEFAULT) -> Placed:
    """The views with the reference view first, and the transforms to the model frame and to the asset frame.

    If poses are used as stored by default and the object does not fit the model's cube, the views get a note.
    """
    normalization = options.normalization or ("none" if published_input(preset) else "auto")
    if options.normalization is None and normalization == "none":
        views = replace(views, notes=(*views.notes, *placement_notes(views)))
    views = hero_first(views, options.hero)
    if options.hero and isinstance(preset, Preset):
        views = replace(views, notes=(*views.notes, f"reference view: {views.names[0]}"))
    to_model = normalization if isinstance(normalization, Similarity) else normalize(views, normalization)
    return Placed(views, to_model, output_frame(options.up))


def _reads_background(model: Network) -> bool:
    return isinstance(model.preset, Preset) and model.preset.reads_background


@torch.no_grad()
@full_precision
def reconstruct(views: Views, *, weights: str | Network = "small", device: str = "cpu",
                options: ReconstructOptions = DEFAULT, watch: Stopwatch | None = None) -> Asset:  # fmt: skip
    """Reconstructs a relightable asset from posed images of one object.

    views: 1 to 16, see :func:`reli3d.load_views`.  weights: ``small`` (bundled), ``official`` (published, after
    ``reli3d download``), the path of a safetensors file, or a network.  device: ``cpu`` or ``cuda``, ignored for a
    network; the asset is on the network's device.  watch: receives the seconds of each stage.

    The asset is in the world frame and units of the cameras, rotated so that ``options.up`` is +Y.  Deterministic.  No
    gradient; :func:`refine` optimizes the result.  Raises TypeError unless ``views`` are Views; InputError for an
    empty visual hull or unreadable weights; NoSurface, an InputError, if the network predicts no surface.  Source: the
    ReLi3D paper, ICLR 2026.

    >>> asset = reli3d.reconstruct(reli3d.load_views("photos/shoe", views=4))
    >>> reli3d.write_glb("shoe.glb", asset)
    """
    expect("views", views, Views)
    model = weights if isinstance(weights, Network) else load_model(weights, device)
    watch = watch or Stopwatch(model.device)
    with watch.stage("normalize"):
        placed = place(views, model.preset, options)
    return reconstruct_placed(placed, model, options, watch)


@torch.no_grad()
@full_precision
def reconstruct_placed(placed: Placed, model: Network, options: ReconstructOptions, watch: Stopwatch) -> Asset:
    """:func:`reconstruct` after its first stage, :func:`place`."""
    shown = background_shown(placed.views, options.background, readable=_reads_background(model))
    with watch.stage("prepare"):
        prepared = prepare(model, placed.views, placed.model_from_input)
    if options.symmetry == "auto" and isinstance(model, LocalReconstructor):
        with watch.stage("symmetry"):
            prepared = completed(prepared)
        if prepared.mirrored:
            watch.notes.append(
                "symmetry: the silhouettes have a mirror plane; mirrored views complete unobserved surfaces"
            )
    with watch.stage("network"):
        field = encode(model, prepared, background=shown)
    with watch.stage("surface"):
        mesh = extract(field, options.resolution or model.preset.resolution)
    with watch.stage("textures"):
        scene = RayScene(mesh.vertices, mesh.faces) if isinstance(field, LocalField) else None
        mesh, textures = texture(field, mesh, options.texture_size, scene, uv=options.uv)
    with watch.stage("light"):
        asset = Asset(mesh, textures, Environment(field.radiance_map().contiguous()))
        if scene is not None:  # images determine only the product of albedo and lighting
            maps = field.maps.inputs
            inside = maps.images[..., 3] > INSIDE
            asset = estimate_base_color_and_light(asset, maps.images[..., :3], inside, maps.camera, scene)
    with watch.stage("frame"):
        near, output_from_model = asset.mesh, placed.output_from_input.compose(placed.model_from_input.inverse())
        asset = transform_asset(asset, output_from_model)
        _check_place(near, asset.mesh)
    return asset


@full_precision
def refine(asset: Asset, views: Views, *, seconds: float | None = None, steps: int | None = None,
           background: str = "masked", **options) -> Asset:  # fmt: skip
    """Refines mesh, maps and lighting of ``asset`` by inverse rendering of ``views``.

    Keeps the first blend of start and fit whose errors (:func:`~reli3d.fit.choice.chosen`) do not exceed the start's;
    if none, ``asset``.  Then :mod:`reli3d.fit.fine_detail` follows.

    views: in the frame of ``asset``; those that cut the object off are left out while three others remain.  seconds,
    steps: exactly one; with ``steps`` the result is reproducible.  background: ``visible`` uses the far background of
    ``views``, loaded with ``whole=True``, as lighting; or ``masked``.  options: see
    :class:`reli3d.fit.refine.RefineOptions`.  The result has no gradients.  Raises TypeError for a wrong type,
    ValueError for both or no budget, InputError if no view has the ``visible`` background.

    >>> views = reli3d.load_views("photos/shoe", every=True)
    >>> asset = reli3d.refine(reli3d.reconstruct(views.taken()), views, seconds=60)
    """
    from reli3d.fit import refine as fit  # imported where it is used: it loads kernels of its own
    from reli3d.fit.budget import Budget

    expect("asset", asset, Asset)
    expect("views", views, Views)
    Budget(seconds, steps)  # raises ValueError
    if background not in ("masked", "visible"):
        raise InputError("background", f"expected masked or visible, got {background}")
    options = {"light": views.lighting, **options}
    views, options["light"] = _complete_views(views, options["light"])
    views = views.to(asset.mesh.vertices.device)
    if background == "visible":
        options["surroundings"] = _surroundings(views, options["light"])
    batch = views.resampled(REFINED, linear=True)
    result = fit.refine(asset, batch, seconds=seconds, steps=steps, options=fit.RefineOptions(**options))
    return _with_detail(result, _detail_crops(views, present("asset.textures", asset.textures).size))[0]


def _surroundings(views: Views, light: str | Sequence) -> ViewBatch:
    """The uncropped views for ``RefineOptions.surroundings``; those without a background are masked completely.

    Raises InputError if none has one, or for lighting that moves with the camera.
    """
    fix = "use background masked or auto"
    if light == "camera":
        raise InputError("background", f"expected lighting that does not move with the camera for visible; {fix}")
    batch = views.resampled(SURROUNDINGS, crop=False, linear=True)
    usable = [has_background(*of_view) for of_view in zip(views.images, views.masks, strict=True)]
    if not any(usable):
        raise InputError("background", f"expected content outside the masks for visible, got one color or none; {fix}")
    batch.masks[[not has for has in usable]] = 1.0
    return batch


def _detail_crops(views: Views, texels: int) -> list[Crop]:
    """The views cropped as by ``Views.resampled``, at their own resolution but at most ``texels`` pixels per side."""
    from reli3d.fit.fine_detail import Crop

    crops, largest = [], min(texels, math.isqrt(MAX_CROP_PIXELS // len(views)))
    for k, mask in enumerate(views.masks):
        one = views.select([k]).resampled(min(crop_side(mask), largest), linear=True)
        color, cover = ((255.0 * values[0] + 0.5).to(torch.uint8) for values in (one.images, one.masks))
        crops.append(Crop(color, cover, one.intrinsics[0]))
    return crops


def _with_detail(result: Refinement, crops: Sequence[Crop]) -> tuple[Asset, dict[str, Any], list[str]]:
    """The refined asset with the detail of the photographs, its record and notes."""
    from reli3d.fit.fine_detail import with_fine_detail

    if not result.changed:
        return result.asset, {}, []
    asset, (before, after) = with_fine_detail(result.asset, crops, result.c2w, REFINED, result.held)
    added = asset is not result.asset
    record = {"detail": {"added": added, "error_before": round(before, 4), "error_after": round(after, 4)}}
    note = (
        f"refinement: detail of the photographs in the base color, error in held-out views {before:.3f} to {after:.3f}"
    )
    return asset, record, [note] if added else []


def _complete_views(views: Views, light: str | Sequence) -> tuple[Views, str | Sequence]:
    """The views that show the whole object while LEAST_REFINED do, else all, and their entries of ``light``."""
    chosen = whole_views(views.masks, LEAST_REFINED)
    if not isinstance(light, str) and len(light) == len(views):
        light = [light[i] for i in chosen]
    return views.select(chosen), light


class Progress:
    """Progress callbacks of :func:`reconstruct_folder`, without effect; commands override them."""

    def __call__(self, stage: str) -> None:
        """Called at the start of each stage."""

    def report(self, notes: Iterable[str]) -> None:
        """Called with notes on the object, one line each."""


@dataclass(frozen=True)
class FolderOptions:
    """Which images of a folder :func:`reconstruct_folder` reads, and whether it refines the result.

    views, masks, remove_background: as in :func:`~reli3d.views.folder.load_views`.  budget: ``seconds`` or ``steps`` of
    a refinement on all images that show the whole object; empty: none.  cameras: also optimize the cameras.
    interrupt: as in :func:`reli3d.fit.refine.refine`.  light: as in ``InputImages.of``, or ``per-group`` (one
    lighting per sub-folder of images); None: read from the folder.
    """

    views: int | None = None
    masks: Path | None = None
    remove_background: bool = False
    budget: Mapping[str, float | int] | None = None
    cameras: bool = False
    interrupt: Callable[[], bool] | None = None
    light: str | None = None

    def read(self, folder: Path, *, whole: bool) -> Views:
        """The views of ``folder``; whole: see :func:`~reli3d.views.folder.load_views`."""
        return load_views(
            folder,
            views=self.views,
            masks=self.masks,
            remove_background=self.remove_background,
            every=bool(self.budget) and self.views is None,
            whole=whole,
        )

    def lighting(self, views: Views) -> str | list[str]:
        """Argument ``light`` of a refinement.  Raises InputError for ``per-group`` without two sub-folders."""
        if self.light != "per-group":
            return self.light or views.lighting
        groups = [name.rpartition("/")[0] for name in views.names]
        if len(set(groups)) < 2:
            raise InputError("--light", "per-group: expected images in at least two sub-folders, got one folder")
        return groups


def reconstruct_folder(
    folder: Path,
    name: str,
    replacing: Callable,
    model: Network,
    weights: Mapping[str, Any],
    *,
    reading: FolderOptions,
    options: ReconstructOptions,
    progress: Progress,
) -> None:
    """Reconstructs the object of ``folder``, refines it if ``reading`` has a budget, and writes the result.

    name: title of the viewer page.  replacing: from :func:`reli3d.output.folder.claimed`.  weights: record of the
    weights for ``run_info.json``.  Raises InputError, with the likely cause if the cameras are implausible, and
    OSError; an earlier result is then kept.
    """
    from reli3d.output import results
    from reli3d.output.preview import comparison, preview

    watch = Stopwatch(model.device, progress)
    with watch.stage("reading"):
        visible = bool(reading.budget) and options.background == "visible"
        whole = (
            published_input(model.preset) or visible or (_reads_background(model) and options.background != "masked")
        )
        photographs = reading.read(folder, whole=whole)
        views, batch, around = photographs.taken(), None, None
        if reading.budget:
            complete, light = _complete_views(photographs, reading.lighting(photographs))
            if left_out := len(photographs) - len(complete):
                note = f"refinement: {left_out} images that cut the object off are left out"
                views = replace(views, notes=(*views.notes, note))
            batch, names = complete.resampled(REFINED, linear=True), complete.names
            if visible:
                around = _surroundings(complete, light)
            crops = _detail_crops(complete, options.texture_size)
            del complete
        del photographs  # 1 GB of 60 images of 1 MP
    if options.up == "y" and (axis := up_axis(views.c2w)) not in (None, "y"):
        views = replace(views, notes=(*views.notes, f"the cameras suggest {axis} as the up axis: try --up {axis}"))
    progress.report(views.notes)
    with _diagnosed(views):
        with watch.stage("normalize"):
            placed = place(views, model.preset, options)
        progress.report(placed.views.notes[len(views.notes) :])
        views = placed.views
        ignored = around is not None and not _reads_background(model)
        of_network = replace(options, background="masked") if ignored else options
        asset = reconstruct_placed(placed, model, of_network, watch)
    progress.report(watch.notes)
    output = placed.output_from_input
    shown, compared, first, record = views.transformed(output), None, None, {}
    if batch is not None:
        with watch.stage("refine"):
            from reli3d.fit import refine as fit

            batch = replace(batch, c2w=output.of_cameras(batch.c2w)).to(model.device)
            if around is not None:
                around = replace(around, c2w=output.of_cameras(around.c2w)).to(model.device)
            chosen = fit.RefineOptions(light=light, cameras=reading.cameras, surroundings=around)
            budget: dict[str, Any] = dict(reading.budget or {})
            result = fit.refine(asset, batch, options=chosen, bar=True, interrupt=reading.interrupt, **budget)
        progress.report(result.notes)
        with watch.stage("detail"):
            refined, detail, notes = _with_detail(result, [crop.to(model.device) for crop in crops])
        progress.report(notes)
        compared = comparison(asset, refined, shown.to(model.device))
        first, asset = asset if result.changed else None, refined
        fitted = {"views": len(batch), "view_names": list(names), **budget}
        record = {"refinement": fitted | result.record() | detail}
    with watch.stage("preview"):
        scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
        frames, moved = results.frame_record(placed.model_from_input, output, views.origin, options.up)
        frames["weights"] = dict(weights)
        if batch is not None and reading.cameras:
            record["refinement"]["cameras"] = results.camera_record(names, result.c2w, moved)
        on_device = shown.to(model.device)
        sheet = preview(asset, on_device, scene)  # the longest tasks first, to balance the threads
        measured = results.measure(asset.mesh, scene, on_device)
        glb, page = results.encode(asset, shown, frames, name=name, before=first, translation=moved, scene=scene)
        drawn, measures = sheet(), measured()
    info = {
        "object": name,
        "folder": os.path.realpath(folder),
        "views": list(views.names),
        "views_in_folder": views.in_folder,
        "notes": [*views.notes, *watch.notes],
        **frames,
        "preset": model.preset.name,
        "precision": str(model.dtype).removeprefix("torch."),
        "texture_size": options.texture_size,
        "resolution": options.resolution or model.preset.resolution,
        "background": options.background,
        "symmetry": options.symmetry,
        "device": model.device.type,
        **measures,
        **record,
        "seconds": {stage: round(value, 4) for stage, value in watch.seconds.items()},
        "peak_memory_mib": results.peak_memory_mib(),
        "versions": results.versions(),
    }
    progress("writing")
    results.write_results(replacing, asset, glb, page, drawn, info, comparison=compared)


@contextmanager
def _diagnosed(views: Views) -> Iterator[None]:
    """Appends the verdict of :mod:`reli3d.views.check` to an InputError of the block if the cameras are implausible."""
    try:
        yield
    except InputError as error:
        found = verdict(views)
        if not found.startswith("suspect"):
            raise
        raise InputError(error.where, f"{error.problem}; {found}") from None
