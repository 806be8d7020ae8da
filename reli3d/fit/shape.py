"""Fits the surface, a signed distance grid extracted at every step, to silhouettes, photo-consistency and shading."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import interpolate, max_pool3d

from reli3d.fit import losses
from reli3d.fit.bounce import reflected
from reli3d.fit.budget import Budget, Part
from reli3d.fit.facets import flattened
from reli3d.fit.fields import EvenAdam, blurred_grid
from reli3d.fit.input_images import InputImages
from reli3d.fit.lighting import Lights, radiance
from reli3d.fit.unknowns import Start, Unknowns, corrected, material_change, material_of, unit
from reli3d.fit.view_colors import MIN_COVERAGE, display_planes, view_colors, view_weights
from reli3d.geometry.distance import signed_distance
from reli3d.geometry.grid import sample_grid, squared_laplacian
from reli3d.geometry.hull import hull_distance, mask_distance
from reli3d.geometry.mesh import Mesh, largest_components, without_degenerate_faces
from reli3d.geometry.rays import RayScene
from reli3d.geometry.surface import extract_surface
from reli3d.render.color import srgb_to_linear
from reli3d.render.gbuffer import primary_hits
from reli3d.render.points import SurfacePoints
from reli3d.render.silhouette import antialias, mesh_edges

MARGIN_CELLS = 3  # around the object
BAND_CELLS = 4.0  # from the surface, within which the signed distance is exact at the start
CORE_DEPTH_CELLS = 3.0  # depth from which a point is the core of a thick part: its medial axis lies beyond the band
THIN_WEIGHT = 0.02  # of the curvature in thin parts: a sheet of three cells keeps 2/3 of its depth
MIN_THIN_FRACTION = 0.2  # of band points, from which the grid is refined: chairs, blades and sails have 0.3 to 1
MAX_REFINEMENT = 2.0  # factor of the cells along a side
MAX_GRID_POINTS = 4_500_000  # of a refined grid, about: a step takes about 2 times as long as on the usual grid
COARSE_RATIO = 4  # cells along a cell of the grid on which distances are computed first
CONSISTENCY_POINTS, SHADED_POINTS = 8192, 3072  # surface points a step, for photo-consistency and for shading
OUTLINE_VIEWS, OUTLINE_PIXELS = 2, 160  # views a step whose silhouettes are compared, and their size
SHADING_SAMPLES = (8, 8, 2)  # of light, BSDF and cosine
STEP_CELLS = (0.6, 0.08)  # largest change of the signed distance in a step, at the start and the end
# Learning rates of the poses, at the start and the end.  A rate that stays at 1e-3 moves correct cameras by 1.5 pixels
# of 512 in 76 steps; this one by 0.2.
POSE_RATES = (1e-3, 1e-4)
BLUR_CELLS = (8, 2)  # width of the filter of the gradient, at the start and the end
IMAGE_SCALES = (0.25, 1.0)  # of the images in which colors are compared, at the start and the end
MIN_PART_FRACTION = 0.01  # of the faces; smaller components are removed


@dataclass(frozen=True)
class Grid:
    """A grid of ``shape`` points with spacing ``cell``, centered at the origin."""

    shape: tuple[int, int, int]
    cell: float

    @classmethod
    def around(cls, vertices: Tensor, resolution: int) -> Grid:
        """Grid around ``vertices``, centered at the origin, with about ``resolution`` cells along the longest side."""
        reach = vertices.abs().amax(0)
        cell = 2.0 * float(reach.max()) / resolution
        return cls(tuple(2 * (math.ceil(r / cell) + MARGIN_CELLS) + 1 for r in reach.tolist()), cell)

    @property
    def radius(self) -> tuple[float, ...]:
        """Half extents of the grid."""
        return tuple(0.5 * self.cell * (n - 1) for n in self.shape)

    def points(self, device) -> Tensor:
        """``(X, Y, Z, 3)``."""
        axes = [torch.linspace(-r, r, n, device=device, dtype=torch.float32) for r, n in zip(self.radius, self.shape)]
        return torch.cartesian_prod(*axes).view(*self.shape, 3)


@torch.no_grad()
def start_sdf(mesh: Mesh, grid: Grid) -> Tensor:
    """Signed distance to a closed mesh at the points of ``grid``: exact within ``BAND_CELLS``, interpolated beyond."""
    at = grid.points(mesh.vertices.device)
    few = tuple(max(2, (n - 1) // COARSE_RATIO + 1) for n in grid.shape)
    axes = [torch.linspace(-r, r, n, device=at.device, dtype=torch.float32) for r, n in zip(grid.radius, few)]
    coarse = signed_distance(mesh.vertices, mesh.faces, torch.cartesian_prod(*axes)).reshape(few)
    sdf = interpolate(coarse[None, None], grid.shape, mode="trilinear", align_corners=True)[0, 0].contiguous()
    spacing = max(2.0 * r / (n - 1) for r, n in zip(grid.radius, few))
    # interpolation errors are below half the coarse cell's diagonal
    near = sdf.abs() < BAND_CELLS * grid.cell + spacing
    sdf[near] = signed_distance(mesh.vertices, mesh.faces, at[near])
    return sdf


@torch.no_grad()
def hull_sdf(images: InputImages, grid: Grid) -> Tensor:
    """Signed distance to the hull of all silhouettes, a lower bound on the signed distance to the surface."""
    at = grid.points(images.mask.device).reshape(-1, 3)
    inside = hull_distance(at, mask_distance(images.silhouette), images.camera)
    return -inside.reshape(grid.shape)


@torch.no_grad()
def curvature_weight(sdf: Tensor, bound: Tensor, cell: float) -> Tensor:
    """Weights ``(X, Y, Z)`` of the squared Laplacian at the points of the grid.

    1 near parts at least ``2 CORE_DEPTH_CELLS`` thick, ``THIN_WEIGHT`` near thinner parts, 0 beyond ``BAND_CELLS`` from
    the surface.  The medial axis of a thin part lies inside the band, so with full weight the term would remove the
    part.  Points deeper than ``CORE_DEPTH_CELLS`` form the core of thick parts; band points that no core reaches count
    as thin.
    """
    core = (torch.maximum(sdf, bound) < -CORE_DEPTH_CELLS * cell).to(sdf)[None, None]
    reach = round(CORE_DEPTH_CELLS + BAND_CELLS) + 1
    for axis in range(3):
        size, pad = [1, 1, 1], [0, 0, 0]
        size[axis], pad[axis] = 2 * reach + 1, reach
        core = max_pool3d(core, size, 1, pad)
    return torch.where(core[0, 0] > 0.0, 1.0, THIN_WEIGHT) * (sdf.abs() < BAND_CELLS * cell)


def start_grid(mesh: Mesh, images: InputImages, resolution: int) -> tuple[Grid, Tensor, Tensor]:
    """A grid for a closed mesh, with the signed distances to the mesh and to the masks' visual hull.

    About ``resolution`` cells along the longest side.  If much of the surface is thin, up to ``MAX_REFINEMENT`` times
    as many, within about ``MAX_GRID_POINTS``, because a sheet two cells thick loses its holes and rims.
    """
    grid = Grid.around(mesh.vertices, resolution)
    sdf, bound = start_sdf(mesh, grid), hull_sdf(images, grid)
    weight = curvature_weight(sdf, bound, grid.cell)
    finer = min(MAX_REFINEMENT, (MAX_GRID_POINTS / math.prod(grid.shape)) ** (1.0 / 3.0))
    if finer <= 1.0 or int((weight == THIN_WEIGHT).sum()) <= MIN_THIN_FRACTION * int((weight > 0.0).sum()):
        return grid, sdf, bound
    grid = Grid.around(mesh.vertices, round(finer * resolution))
    return grid, start_sdf(mesh, grid), hull_sdf(images, grid)


def empty(sdf: Tensor, bound: Tensor) -> bool:
    """Whether no grid point is inside the surface, the zero set of ``max(sdf, bound)``."""
    return not bool(((sdf < 0.0) & (bound < 0.0)).any())


def extracted(sdf: Tensor, bound: Tensor, grid: Grid) -> Mesh:
    """The zero set of ``max(sdf, bound)`` as a mesh with normals."""
    return extract_surface(torch.maximum(sdf, bound), radius=grid.radius).with_normals()


def finished(sdf: Tensor, bound: Tensor, grid: Grid) -> Mesh:
    """The surface without small components, denoised (:func:`~reli3d.fit.facets.flattened`)."""
    mesh = without_degenerate_faces(extracted(sdf, bound, grid).detach())
    mesh = largest_components(mesh, MIN_PART_FRACTION)
    return flattened(mesh).with_normals()


@dataclass(frozen=True)
class ShapeData:
    """Constants of the fit of a surface."""

    grid: Grid
    bound: Tensor
    near: Tensor  # (N,) grid points within the band around the start's surface
    first: Tensor  # (N,) their signed distance at the start
    smooth: Tensor  # of :func:`curvature_weight`, divided by N
    start: Start
    received: Tensor  # (n, n, n, 3) grid of :func:`~reli3d.fit.bounce.gathered`, equal on both sides of a thin wall
    images: InputImages  # for silhouettes
    planes: list[Tensor]  # of :func:`display_planes`, small to large
    colored: list[int]  # views whose colors may be used

    @classmethod
    def of(
        cls,
        start: Start,
        sdf: Tensor,
        bound: Tensor,
        grid: Grid,
        received: Tensor,
        images: InputImages,
        colored: list[int],
    ) -> ShapeData:
        """Resamples the images to the sizes of the fit and computes the weights of the grid's points."""
        sizes = {max(16, round(images.size * s)) for s in (*IMAGE_SCALES, sum(IMAGE_SCALES) / 2)}
        used = images.select(colored)
        planes = [display_planes(used.resized(size)) for size in sorted(sizes)]
        small = images.resized(min(OUTLINE_PIXELS, images.size))
        smooth = curvature_weight(sdf, bound, grid.cell)
        near = torch.nonzero(smooth.reshape(-1))[:, 0]
        smooth = smooth / len(near)
        return cls(grid, bound, near, sdf.reshape(-1)[near], smooth, start, received, small, planes, colored)


def shape_loss(
    unknowns: Unknowns,
    data: ShapeData,
    weights: losses.Weights,
    *,
    progress: float,
    seed: int,
    independent: bool = True,
) -> Tensor:
    """Loss of one step of the surface fit; gradients reach ``unknowns`` but for ``detail`` and ``bend``.

    progress: progress of the fit in [0, 1].  seed: random seed of the step's points, views and light samples.
    independent: as in :func:`~reli3d.fit.losses.estimated_error`.
    """
    rng = torch.Generator().manual_seed(seed)
    mesh = extracted(unknowns.sdf, data.bound, data.grid)
    scene = RayScene(mesh.vertices, mesh.faces)
    views, grid = len(data.images), data.grid
    moved = (unknowns.sdf.reshape(-1).index_select(0, data.near) - data.first) / grid.cell
    loss = weights.curvature * (squared_laplacian(unknowns.sdf, data.smooth) / (grid.cell * grid.cell))
    loss = loss + weights.sdf_change / views * moved.square().mean()
    loss = loss + weights.outline * _outlines(unknowns, data, mesh, scene, rng)
    error = partial(losses.estimated_error, seed=seed, independent=independent)
    return loss + _colors(unknowns, data, mesh, scene, weights, progress, rng, error)


def _outlines(unknowns: Unknowns, data: ShapeData, mesh: Mesh, scene: RayScene, rng) -> Tensor:
    edges, small = mesh_edges(mesh.vertices, mesh.faces), data.images
    total, photographed = small.color.new_zeros(()), small.photographed()
    chosen = torch.randperm(len(small), generator=rng, dtype=torch.int64, device="cpu")[:OUTLINE_VIEWS].tolist()
    for view in chosen:
        camera = corrected(small.camera[view], unknowns.pose[view])
        cover = (primary_hits(scene, camera.detach())[0].face >= 0).float()[..., None]
        cover = antialias(cover, mesh.vertices, mesh.faces, camera, scene, edges=edges)[..., 0]
        total = total + ((cover - small.mask[view]) * photographed[view]).abs().mean()
    return total / len(chosen)


def _colors(unknowns, data, mesh, scene, weights, progress, rng, error) -> Tensor:
    planes = data.planes[min(int(progress * len(data.planes)), len(data.planes) - 1)]
    size, images = planes.shape[-1], data.images.select(data.colored)
    camera = corrected(images.camera.resized(size, size), unknowns.pose[data.colored])
    pick = torch.randint(len(mesh.vertices), (CONSISTENCY_POINTS,), generator=rng, dtype=torch.int64, device="cpu")
    position, normal = (v.index_select(0, pick.to(v.device)) for v in (mesh.vertices, mesh.normals))
    color, cover = view_colors(planes, position, camera)
    weight = view_weights(scene, position, normal, camera) * (cover.detach() > MIN_COVERAGE)
    exposure = unknowns.exposure[data.colored].exp()
    loss = color.new_zeros(())
    if len(data.colored) > 1 and images.light_frame == "object" and len(set(images.light_group)) == 1:
        loss = weights.agreement * losses.agreement(color, weight)  # a point has one color under one lighting
    if weights.shading == 0.0:
        return loss
    row = torch.nonzero(weight.sum(1) > 0.0)[:SHADED_POINTS, 0]
    if len(row) == 0:
        return loss
    view = torch.multinomial(weight[row].cpu(), 1, generator=rng)[:, 0].to(row.device)
    target = srgb_to_linear(color[row, view].detach())
    position, normal = position[row], normal[row]
    change = material_change(unknowns, position)
    logits = sample_grid(data.start.material, position) + change
    points = SurfacePoints(position, normal.detach(), normal, *material_of(logits))
    lights = Lights.of(unknowns, data.start, images)
    wo = unit(camera.c2w[view, :3, 3] - position).detach()
    bounced, exposure = reflected(points, sample_grid(data.received, position)), exposure[view, None]

    def lit(seed: int) -> Tensor:
        shading = partial(radiance, samples=SHADING_SAMPLES, scene=scene, seed=seed)
        return (bounced + lights.evaluate(points, wo, view, shading)) * exposure

    loss = loss + weights.shading * error(lit, target)
    # the same ratio of the terms as in the fit of the maps
    logs = points.base_color.clamp(min=losses.MIN_LINEAR).log()
    loss = loss + weights.shading * weights.palette * losses.palette(logs, target)
    loss = loss + weights.shading * losses.near_base_color(change[:, :3], weights, len(data.colored))
    loss = loss + weights.shading * weights.background * losses.near_background(unknowns, data.start)
    return loss + weights.shading * losses.priors(unknowns, weights, len(data.images))


def fit_shape(
    unknowns: Unknowns,
    data: ShapeData,
    weights: losses.Weights,
    budget: Budget,
    until: float,
    *,
    seed: int,
    cameras: bool,
) -> None:
    """Optimizes ``unknowns.sdf`` jointly with material, lighting and exposures.

    until: of :class:`~reli3d.fit.budget.Part`.  cameras: also optimize the poses.  Ends where the surface is empty.
    """
    surface = EvenAdam(unknowns.sdf)
    rates = {"material": 0.03, "light": 0.02, "exposure": 0.01, **({"pose": 0.0} if cameras else {})}
    changed = {name: unknowns.groups()[name] for name in rates}
    groups = [{"params": changed[name], "lr": rate} for name, rate in rates.items()]
    others = torch.optim.Adam(groups, betas=(0.9, 0.99))
    variables = [unknowns.sdf, *(value for values in changed.values() for value in values)]
    for step, progress in budget.take(Part("shape", until)):
        if empty(unknowns.sdf, data.bound):
            break
        for value in variables:
            value.requires_grad_(True)
        loss = shape_loss(unknowns, data, weights, progress=progress, seed=seed * 1_000_003 + step)
        if cameras:
            others.param_groups[-1]["lr"] = POSE_RATES[0] * (POSE_RATES[1] / POSE_RATES[0]) ** progress
        others.zero_grad()
        gradient, *rest = torch.autograd.grad(loss, variables, allow_unused=True)
        for value, derivative in zip(variables[1:], rest, strict=True):
            value.requires_grad_(False)
            value.grad = derivative
        unknowns.sdf.requires_grad_(False)
        cells = round(BLUR_CELLS[0] * (BLUR_CELLS[1] / BLUR_CELLS[0]) ** progress)
        rate = data.grid.cell * STEP_CELLS[0] * (STEP_CELLS[1] / STEP_CELLS[0]) ** progress
        surface.step(blurred_grid(gradient, cells), rate)
        others.step()
        budget.record("shape", step, float(loss.detach()))
    for value in variables:
        value.requires_grad_(False)
