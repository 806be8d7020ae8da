"""The surface: levels on a grid, extracted at every step, held by silhouettes, agreement of the views and shading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import interpolate, max_pool3d

from reli3d.fit import losses
from reli3d.fit.bounce import thrown_back
from reli3d.fit.budget import Budget
from reli3d.fit.facets import flattened
from reli3d.fit.fields import EvenAdam, blurred_grid
from reli3d.fit.photographs import WHITE, Photographs
from reli3d.fit.seen import COVERED, display_planes, seen_colors, sight
from reli3d.fit.shading import radiance
from reli3d.fit.unknowns import Start, Unknowns, corrected, environment, material_change, material_of, unit
from reli3d.geometry.distance import signed_distance
from reli3d.geometry.grid import sample_grid
from reli3d.geometry.hull import hull_distance, mask_distance
from reli3d.geometry.mesh import Mesh, largest_components, vertex_normals
from reli3d.geometry.rays import RayScene
from reli3d.geometry.surface import extract_surface
from reli3d.render.color import srgb_to_linear
from reli3d.render.gbuffer import primary_hits
from reli3d.render.points import SurfacePoints
from reli3d.render.silhouette import antialias, mesh_edges

MARGIN = 3  # cells around the object
BAND = 4.0  # cells from the surface within which the level's distance is exact at the start
THICK = 3.0  # cells of depth that a thick part has: the level's ridge then lies outside the band, or nearly
THIN = 0.02  # share of the curvature's weight in thin parts: a sheet of three cells keeps two thirds of its depth
MUCH = 0.2  # share of thin points from which the grid gets finer: chairs, blades and sails have 0.3 to 1, others 0.1
FINER = 2.0  # times as many cells a side, at most
LARGEST = 4_500_000  # points of a finer grid, about: a step then takes twice the time of one on the usual grid
COARSE = 4  # cells of the grid along a cell of the one that is asked first
POINTS, SHADED = 8192, 3072  # on the surface, a step, whose colours are compared, and that are shaded
OUTLINES, OUTLINE_PIXELS = 2, 160  # views a step whose outlines are compared, and their size
SAMPLES = (8, 8, 2)
RATE = (0.6, 0.08)  # largest move of the surface in a step, in cells, at the start and the end
BLUR = (8, 2)  # cells over which a move is spread, at the start and the end
DETAIL = (0.25, 1.0)  # of the photographs' size, in which colours are compared at the start and the end
SMALLEST_PART = 0.01  # share of the faces below which a separate piece is dropped


@dataclass(frozen=True)
class Grid:
    """A grid of ``shape`` points, ``cell`` apart, whose centre is 0."""

    shape: tuple[int, int, int]
    cell: float

    @classmethod
    def around(cls, vertices: Tensor, resolution: int) -> Grid:
        """About ``resolution`` cells along the longest side of what ``vertices`` span around 0."""
        reach = vertices.abs().amax(0)
        cell = 2.0 * float(reach.max()) / resolution
        return cls(tuple(2 * (math.ceil(r / cell) + MARGIN) + 1 for r in reach.tolist()), cell)

    @property
    def radius(self) -> tuple[float, ...]:
        """Half extents."""
        return tuple(0.5 * self.cell * (n - 1) for n in self.shape)

    def points(self, device) -> Tensor:
        """``(X, Y, Z, 3)``."""
        axes = [torch.linspace(-r, r, n, device=device, dtype=torch.float32) for r, n in zip(self.radius, self.shape)]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)


@torch.no_grad()
def start_level(mesh: Mesh, grid: Grid) -> Tensor:
    """Signed distance of a closed mesh at the points of ``grid``: exact within ``BAND`` cells, blended beyond."""
    at = grid.points(mesh.vertices.device)
    few = tuple(max(2, (n - 1) // COARSE + 1) for n in grid.shape)
    axes = [torch.linspace(-r, r, n, device=at.device, dtype=torch.float32) for r, n in zip(grid.radius, few)]
    coarse = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    coarse = signed_distance(mesh.vertices, mesh.faces, coarse.reshape(-1, 3)).reshape(few)
    level = interpolate(coarse[None, None], grid.shape, mode="trilinear", align_corners=True)[0, 0].contiguous()
    apart = max(2.0 * r / (n - 1) for r, n in zip(grid.radius, few))
    near = level.abs() < BAND * grid.cell + apart  # the blend errs by less than half the coarse cell's diagonal
    level[near] = signed_distance(mesh.vertices, mesh.faces, at[near])
    return level


@torch.no_grad()
def bound_level(photographs: Photographs, grid: Grid) -> Tensor:
    """Level of the visual hull of all masks: no surface lies outside any silhouette."""
    at = grid.points(photographs.mask.device).reshape(-1, 3)
    inside = hull_distance(at, mask_distance(photographs.mask), photographs.camera)
    return -inside.reshape(grid.shape)


@torch.no_grad()
def curvature_share(level: Tensor, bound: Tensor, cell: float) -> Tensor:
    """How much :func:`losses.curvature` counts at each point of the grid, ``(X, Y, Z)``.

    1 near parts at least ``2 THICK`` cells thick, ``THIN`` near thinner ones, 0 beyond ``BAND`` cells from the surface.
    The level of a thin part has its ridge next to the surface.  A weaker ridge has less curvature, so the term would
    remove the part.  Points of depth ``THICK`` are the core of thick parts; what is farther from every core than the
    band reaches is thin.
    """
    core = (torch.maximum(level, bound) < -THICK * cell).to(level)[None, None]
    reach = round(THICK + BAND) + 1
    for axis in range(3):
        size, pad = [1, 1, 1], [0, 0, 0]
        size[axis], pad[axis] = 2 * reach + 1, reach
        core = max_pool3d(core, size, 1, pad)
    return torch.where(core[0, 0] > 0.0, 1.0, THIN) * (level.abs() < BAND * cell)


def start_grid(mesh: Mesh, photographs: Photographs, resolution: int) -> tuple[Grid, Tensor, Tensor]:
    """The grid of a closed mesh, the level of the mesh on it and that of the masks' hull.

    About ``resolution`` cells along the longest side, up to ``FINER`` times as many where much of the surface is thin,
    as far as the grid has about ``LARGEST`` points: a sheet of two cells loses its holes and rims.
    """
    grid = Grid.around(mesh.vertices, resolution)
    level, bound = start_level(mesh, grid), bound_level(photographs, grid)
    share = curvature_share(level, bound, grid.cell)
    finer = min(FINER, (LARGEST / math.prod(grid.shape)) ** (1.0 / 3.0))
    if finer <= 1.0 or int((share == THIN).sum()) <= MUCH * int((share > 0.0).sum()):
        return grid, level, bound
    grid = Grid.around(mesh.vertices, round(finer * resolution))
    return grid, start_level(mesh, grid), bound_level(photographs, grid)


def extracted(level: Tensor, bound: Tensor, grid: Grid) -> Mesh:
    """The surface of the level within the bound, with normals."""
    mesh = extract_surface(torch.maximum(level, bound), radius=grid.radius)
    return Mesh(mesh.vertices, mesh.faces, vertex_normals(mesh.vertices, mesh.faces))


def finished(level: Tensor, bound: Tensor, grid: Grid) -> Mesh:
    """The surface without small loose pieces and without the grid's own ripple."""
    mesh = largest_components(extracted(level, bound, grid).detach(), SMALLEST_PART)
    return flattened(mesh).with_normals()


@dataclass(frozen=True)
class ShapeData:
    """What does not change while the surface does."""

    grid: Grid
    bound: Tensor
    near: Tensor  # (N,) grid points within the band around the start's surface
    first: Tensor  # (N,) their level at the start
    smooth: Tensor  # of :func:`curvature_share`, divided by N
    start: Start
    received: Tensor  # (n, n, n, 3) of :func:`~reli3d.fit.bounce.gathered` in space, both sides of a thin wall alike
    photographs: Photographs  # for outlines
    planes: list[Tensor]  # of :func:`display_planes`, small to large
    colored: list[int]  # views whose colours may be used

    @classmethod
    def of(
        cls,
        start: Start,
        level: Tensor,
        bound: Tensor,
        grid: Grid,
        received: Tensor,
        photographs: Photographs,
        colored: list[int],
    ) -> ShapeData:
        """Photographs in the sizes that a fit asks for."""
        sizes = sorted({max(16, round(photographs.size * s)) for s in (DETAIL[0], sum(DETAIL) / 2, DETAIL[1])})
        used = photographs.select(colored)
        planes = [display_planes(used.resized(size)) for size in sizes]
        small = photographs.resized(min(OUTLINE_PIXELS, photographs.size))
        smooth = curvature_share(level, bound, grid.cell)
        near = torch.nonzero(smooth.reshape(-1))[:, 0]
        smooth = smooth / len(near)
        return cls(grid, bound, near, level.reshape(-1)[near], smooth, start, received, small, planes, colored)


def shape_loss(
    unknowns: Unknowns,
    data: ShapeData,
    weights: losses.Weights,
    *,
    progress: float,
    seed: int,
    independent: bool = True,
) -> Tensor:
    """Loss of one step over the surface, with gradients to every part of ``unknowns`` but the detail.

    progress: in [0, 1], how far the fit is; seed: of the step's points, views and light samples.  independent: two
    estimates of the shading; False gives the value whose slope the gradient is, for tests.
    """
    rng = torch.Generator().manual_seed(seed)
    mesh = extracted(unknowns.level, data.bound, data.grid)
    scene = RayScene(mesh.vertices, mesh.faces)
    views, grid = len(data.photographs), data.grid
    moved = (unknowns.level.reshape(-1).index_select(0, data.near) - data.first) / grid.cell
    loss = weights.curvature * losses.curvature(unknowns.level, grid.cell, data.smooth)
    loss = loss + weights.stay / views * moved.square().mean()
    loss = loss + weights.outline * _outlines(unknowns, data, mesh, scene, rng)
    loss = loss + _colors(unknowns, data, mesh, scene, weights, progress, rng, seed, independent)
    return loss


def _outlines(unknowns: Unknowns, data: ShapeData, mesh: Mesh, scene: RayScene, rng) -> Tensor:
    edges, small = mesh_edges(mesh.vertices, mesh.faces), data.photographs
    total = small.color.new_zeros(())
    chosen = torch.randperm(len(small), generator=rng, dtype=torch.int64, device="cpu")[:OUTLINES].tolist()
    for view in chosen:
        camera = corrected(small.camera[view], unknowns.pose[view])
        cover = (primary_hits(scene, camera.detach())[0].face >= 0).float()[..., None]
        cover = antialias(cover, mesh.vertices, mesh.faces, camera, scene, edges=edges)[..., 0]
        total = total + losses.outline(cover, small.mask[view])
    return total / len(chosen)


def _colors(unknowns, data, mesh, scene, weights, progress, rng, seed, independent) -> Tensor:
    planes = data.planes[min(int(progress * len(data.planes)), len(data.planes) - 1)]
    size, photographs = planes.shape[-1], data.photographs.select(data.colored)
    camera = corrected(photographs.camera.resized(size, size), unknowns.pose[data.colored])
    pick = torch.randint(len(mesh.vertices), (POINTS,), generator=rng, dtype=torch.int64, device="cpu").to(
        mesh.vertices.device
    )
    position, normal = (v.index_select(0, pick) for v in (mesh.vertices, mesh.normals))
    color, cover = seen_colors(planes, position, camera)
    weight = sight(scene, position, normal, camera) * (cover.detach() > COVERED)
    exposure = unknowns.exposure[data.colored].exp()
    loss = weights.agreement * losses.agreement(color, weight) if len(data.colored) > 1 else color.new_zeros(())
    if weights.shading == 0.0:
        return loss
    row = torch.nonzero(weight.sum(1) > 0.0)[:SHADED, 0]
    if len(row) == 0:
        return loss
    view = torch.multinomial(weight[row].cpu(), 1, generator=rng)[:, 0].to(row.device)
    target = srgb_to_linear(color[row, view].detach())
    position, normal = position[row], normal[row]
    change = material_change(unknowns, position)
    logits = sample_grid(data.start.material, position) + change
    points = SurfacePoints(position, normal.detach(), normal, *material_of(logits))
    light = environment(unknowns, data.start)
    wo = unit(camera.c2w[view, :3, 3] - position).detach()
    bounced, exposure = thrown_back(points, sample_grid(data.received, position)), exposure[view, None]
    image = (bounced + radiance(points, wo, light, samples=SAMPLES, scene=scene, seed=2 * seed)) * exposure
    other = image
    if independent:
        with torch.no_grad():
            other = (bounced + radiance(points, wo, light, samples=SAMPLES, scene=scene, seed=2 * seed + 1)) * exposure
    loss = loss + weights.shading * losses.display_error(image, other, target, target > WHITE)
    # as strong beside the shading as in the fit of the maps
    loss = loss + weights.shading * weights.palette * losses.palette(
        points.base_color.clamp(min=losses.DARK).log(), target
    )
    loss = loss + weights.shading * losses.near_paint(change[:, :3], weights, len(data.colored))
    return loss + weights.shading * losses.priors(unknowns, weights, len(data.photographs))


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
    """Move ``unknowns.level``, and with it what else :func:`shape_loss` reaches, until ``until`` of the budget."""
    level = EvenAdam(unknowns.level)
    rates = {"material": 0.03, "light": 0.02, "exposure": 0.01, **({"pose": 2e-4} if cameras else {})}
    changed = {name: unknowns.groups()[name] for name in rates}
    groups = [{"params": changed[name], "lr": rate} for name, rate in rates.items()]
    others = torch.optim.Adam(groups, betas=(0.9, 0.99))
    wanted = [unknowns.level, *(value for values in changed.values() for value in values)]
    for step, progress in budget.part("shape", until):
        for value in wanted:
            value.requires_grad_(True)
        loss = shape_loss(unknowns, data, weights, progress=progress, seed=seed * 1_000_003 + step)
        others.zero_grad()
        gradient, *rest = torch.autograd.grad(loss, wanted, allow_unused=True)
        for value, slope in zip(wanted[1:], rest, strict=True):
            value.requires_grad_(False)
            value.grad = slope
        unknowns.level.requires_grad_(False)
        cells = round(BLUR[0] * (BLUR[1] / BLUR[0]) ** progress)
        rate = data.grid.cell * RATE[0] * (RATE[1] / RATE[0]) ** progress
        level.step(blurred_grid(gradient, cells), rate)
        others.step()
        budget.tell("shape", step, float(loss.detach()))
    for value in wanted:
        value.requires_grad_(False)
