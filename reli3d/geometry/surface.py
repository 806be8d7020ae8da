"""FlexiCubes isosurface extraction (Shen et al. 2023, Flexible Isosurface Extraction, SIGGRAPH).

A grid of X * Y * Z cubes fills the box [-radius, radius]^3.  Grid vertices ``(X + 1, Y + 1, Z + 1)`` and cubes ``(X, Y,
Z)`` are in C order.  Corners of a cube are numbered x + 2y + 4z for x, y, z in {0, 1}; edges as in
``kernels.flexicubes_tables.EDGES``.  Vertices and faces are in the order of the authors' code, bitwise identical for
any number of threads; faces are counter-clockwise seen from the positive side.  A positive field gives an empty mesh, a
negative one the box if ``closed``.  Not implemented: the paper's tetrahedra, and dual vertices placed by the field's
gradient.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
import warp as wp
from torch import Tensor

from reli3d._bridge import check, launch, once_differentiable, struct_of, tensor_of
from reli3d.geometry.mesh import Mesh
from reli3d.kernels import flexicubes as kernels
from reli3d.kernels.flexicubes_tables import tables


@dataclass(frozen=True)
class CubeWeights:
    """FlexiCubes' parameters of a grid of ``(X, Y, Z)`` cubes, float32; None: no offsets, or weights of 1.

    deformation: ``(X+1, Y+1, Z+1, 3)`` offsets of the grid vertices in units of the box's side, 2 radius.  Positive
    weights: alpha ``(K, 8)`` of corners, beta ``(K, 12)`` of edges, gamma ``(K,)`` of quads.  cubes: ``(K,)`` int64,
    from :func:`reli3d.geometry.surface.surface_cubes`, the cubes of the rows; None: all, in C order.

    >>> sdf = torch.rand(5, 5, 5) - 0.5
    >>> mesh = reli3d.extract_surface(sdf, radius=1.0, weights=reli3d.CubeWeights(beta=torch.ones(64, 12)))
    """

    deformation: Tensor | None = None
    alpha: Tensor | None = None
    beta: Tensor | None = None
    gamma: Tensor | None = None
    cubes: Tensor | None = None


UNIT_WEIGHTS = CubeWeights()


@dataclass(frozen=True)
class _Topology:
    """Connectivity of the extracted surface, integer; constant under differentiation."""

    shape: tuple[int, ...]  # (3,) vertices of the grid, padded
    cubes: tuple[int, ...]  # (3,) before padding
    pad: int
    cells: Tensor  # (S,) surface cubes, by index of their lowest vertex
    rows: Tensor  # (S,) their row in the weights, -1 for a cube of the padding
    resolved: Tensor  # (S,) case whose groups they use
    counts: Tensor  # (S,) dual vertices
    base: Tensor  # (S,) the first one
    slot: Tensor  # (vertices of the grid,) surface cube of a cell; undefined elsewhere

    @cached_property
    def owner(self) -> Tensor:
        """Surface cube ``(D,)`` of every dual vertex."""
        counts, order = self.counts.long(), torch.argsort(self.base)
        return torch.repeat_interleave(order, counts[order])

    @cached_property
    def surface(self) -> kernels.SurfaceCubes:
        names = ("cells", "rows", "resolved", "counts", "base", "slot")
        return struct_of(kernels.SurfaceCubes, **{name: getattr(self, name) for name in names})

    def grid(self, sdf: Tensor, shift: Tensor) -> kernels.Grid:
        """The kernels' grid of the padded ``sdf`` and the offsets before padding, of which there may be none."""
        (_, ny, nz), cubes, shift = self.shape, wp.vec3i(*self.cubes), shift.view(-1, 3)
        return struct_of(kernels.Grid, sdf=sdf.view(-1), shift=shift, ny=ny, nz=nz, cubes=cubes, pad=self.pad)


@lru_cache(8)
def tables_on(device: torch.device) -> dict[str, Tensor]:
    return {name: torch.from_numpy(value.reshape(-1)).to(device) for name, value in tables()._asdict().items()}


@lru_cache(8)
def _struct_of_tables(device: torch.device) -> kernels.Tables:
    table = tables_on(device)
    return struct_of(kernels.Tables, **{name: table[name] for name in ("group", "ends", "around")})


def surface_cubes(sdf: Tensor) -> Tensor:
    """Indices ``(x * Y + y) * Z + z`` of cubes with a sign change, ``(K,)`` int64 ascending; only their weights count.

    sdf: ``(X + 1, Y + 1, Z + 1)`` float32.
    """
    _check_sdf(sdf)
    case, _ = _classify(sdf.detach().contiguous())
    return case[:-1, :-1, :-1].reshape(-1).nonzero().squeeze(1)


def surface_points(sdf: Tensor, cubes: Tensor) -> tuple[Tensor, Tensor]:
    """The grid vertices on which the surface depends: ascending indices ``(N,)`` in ``sdf.view(-1)``, and the positions
    ``(K, 8)`` in this list of the corners of ``cubes (K,)``, the surface cubes.
    """
    i, j, k = torch.unravel_index(cubes, [n - 1 for n in sdf.shape])
    corners = corners_of((i * sdf.shape[1] + j) * sdf.shape[2] + k, sdf.shape)
    needed = torch.zeros_like(sdf, dtype=torch.bool, memory_format=torch.contiguous_format)
    for side in range(3):  # where the inside reaches the box, the cap uses the vertices of the border
        for end in (0, -1):
            needed.select(side, end)[sdf.select(side, end) < 0] = True
    needed.view(-1)[corners] = True
    return needed.view(-1).nonzero()[:, 0], (torch.cumsum(needed.view(-1), 0) - 1)[corners]


def extract_surface(
    sdf: Tensor,
    *,
    radius: float | Sequence[float],
    weights: CubeWeights = UNIT_WEIGHTS,
    closed: bool = True,
    center: bool = False,
) -> Mesh:
    """Isosurface ``sdf == 0`` of a grid over ``[-radius, radius]^3`` by FlexiCubes (Shen et al. 2023), without normals.

    sdf: ``(X+1, Y+1, Z+1)`` float32, negative inside.  radius: one or three numbers.  weights: a
    :class:`~reli3d.geometry.surface.CubeWeights`.  closed: capped at the box.  center: four triangles per quad.

    Gradients reach sdf, deformation, alpha, beta and, with ``center``, gamma.  Raises TypeError for a wrong dtype,
    ValueError for wrong shapes or values, or 2^31 vertices.

    >>> x = torch.linspace(-1, 1, 17)
    >>> ball = reli3d.extract_surface((x**2 + x[:, None] ** 2 + x[:, None, None] ** 2).sqrt() - 0.5, radius=1.0)
    """
    sdf, cubes, gamma = tensor_of(sdf), tensor_of(weights.cubes, torch.int64), tensor_of(weights.gamma)
    deformation, alpha, beta = (tensor_of(v) for v in (weights.deformation, weights.alpha, weights.beta))
    extent = check_fields(sdf, radius, CubeWeights(deformation, alpha, beta, gamma, cubes))
    topology, padded, crossed = topology_of(sdf.detach().contiguous(), cubes, closed)
    scale = tuple(2.0 * float(r) for r in extent)
    vertices = _DualVertices.apply(topology, scale, padded, sdf, deformation, alpha, beta)
    if not bool(torch.isfinite(vertices.detach()).all()):
        raise ValueError("alpha, beta, deformation: expected positive weights and finite offsets, got others")
    if gamma is not None and not bool((gamma.detach() > 0).all()):
        raise ValueError("gamma: expected positive weights, got others")
    quads, split = _quads(topology, padded, crossed, gamma)
    if center:
        return _with_centers(vertices, quads, split if gamma is None else _gamma_of(topology, quads, gamma))
    first = split[:, 0] * split[:, 2] > split[:, 1] * split[:, 3]
    faces = torch.where(first[:, None], quads[:, [0, 1, 2, 0, 2, 3]], quads[:, [0, 1, 3, 3, 1, 2]])
    return Mesh(vertices, faces.reshape(-1, 3))


def check_fields(sdf: Tensor, radius: float | Sequence[float], weights: CubeWeights) -> list[float]:
    """The three radii.  Raises the errors of :func:`extract_surface` for invalid arguments."""
    _check_sdf(sdf)
    size = tuple(n - 1 for n in sdf.shape)
    extent = [radius] * 3 if isinstance(radius, (int, float)) else list(radius)
    if len(extent) != 3 or not all(0.0 < r < float("inf") for r in extent):
        raise ValueError(f"radius: expected one or three positive numbers, got {radius}")
    count = size[0] * size[1] * size[2]
    if weights.cubes is not None:
        check("cubes", weights.cubes, like=sdf, dtype=torch.int64)
        count = len(weights.cubes)
    shapes = {"deformation": (*sdf.shape, 3), "alpha": (count, 8), "beta": (count, 12), "gamma": (count,)}
    for name, shape in shapes.items():
        value = getattr(weights, name)
        if value is not None:
            check(name, value, like=sdf, shape=shape)
    return extent


def _check_sdf(sdf: Tensor) -> None:
    check("sdf", sdf)
    if sdf.ndim != 3 or min(sdf.shape) < 2:
        raise ValueError(f"sdf: expected shape (X + 1, Y + 1, Z + 1) with a cube at least, got {tuple(sdf.shape)}")
    if (sdf.shape[0] + 2) * (sdf.shape[1] + 2) * (sdf.shape[2] + 2) >= 2**31:
        raise ValueError(f"sdf: expected fewer than 2**31 grid vertices, got {tuple(sdf.shape)}")
    if not bool(torch.isfinite(sdf.detach()).all()):
        raise ValueError("sdf: expected finite values, got NaN or infinity")


def _classify(sdf: Tensor) -> tuple[Tensor, Tensor]:
    case, crossed = torch.empty_like(sdf, dtype=torch.uint8), torch.empty_like(sdf, dtype=torch.uint8)
    arguments = [sdf.view(-1), *sdf.shape, case.view(-1), crossed.view(-1)]
    launch(kernels.classify_kernel, sdf.shape[0] * sdf.shape[1], arguments, sdf.device)
    return case, crossed


def topology_of(sdf: Tensor, cubes: Tensor | None, closed: bool) -> tuple[_Topology, Tensor, Tensor]:
    """Topology, padded sdf, and the crossed edges of the padded grid's vertices."""
    device, size = sdf.device, tuple(n - 1 for n in sdf.shape)
    border = [sdf[0], sdf[-1], sdf[:, 0], sdf[:, -1], sdf[:, :, 0], sdf[:, :, -1]]
    pad = int(closed and any(bool((side < 0).any()) for side in border))
    if pad:
        sdf = torch.nn.functional.pad(sdf, (1,) * 6, value=1.0)
    case, crossed = _classify(sdf)
    cells = case.view(-1).nonzero().squeeze(1)
    i, j, k = (index - pad for index in torch.unravel_index(cells, sdf.shape))
    real = (i >= 0) & (j >= 0) & (k >= 0) & (i < size[0]) & (j < size[1]) & (k < size[2])
    rows = torch.where(real, (i * size[1] + j) * size[2] + k, -1)
    if cubes is not None:
        if not torch.equal(rows[real], cubes):
            count = int(real.sum())
            raise ValueError(f"cubes: expected surface_cubes(sdf), {count} of them, got {len(cubes)} others")
        rows = torch.where(real, torch.cumsum(real, 0) - 1, -1)
    cells, rows = cells.to(torch.int32), rows.to(torch.int32)
    resolved, counts = torch.empty_like(cells), torch.empty_like(cells)
    slot = torch.empty(sdf.numel(), dtype=torch.int32, device=device)
    table = tables_on(device)
    given = [cells, case.view(-1), table["neighbor"], table["count"], *sdf.shape[1:]]
    launch(kernels.resolve_kernel, len(cells), [*given, resolved, counts, slot], device)
    base = torch.zeros_like(counts)
    start = 0
    for n in range(1, 5):  # the published order: cubes with one dual vertex first, then those with two, ...
        mine = counts == n
        base += torch.where(mine, (torch.cumsum(mine, 0, dtype=torch.int32) - 1) * n + start, 0)
        start += n * int(mine.sum())
    return _Topology(tuple(sdf.shape), size, pad, cells, rows, resolved, counts, base, slot), sdf, crossed


def _scatter(index: Tensor, values: Tensor, length: int) -> Tensor:
    """Sum of ``values (M, C)`` by ``index (M,)`` into ``(length, C)``; on CPU in the order of the list."""
    out = values.new_zeros(length, values.shape[1])
    return out.scatter_add_(0, index[:, None].expand_as(values), values)


class _DualVertices(torch.autograd.Function):
    """Own adjoint: the topology is discrete, and a thread a cube with a gather by vertex needs no atomics."""

    @staticmethod
    def forward(ctx, topology, scale, padded, sdf, deformation, alpha, beta):
        t, device = topology, sdf.device
        cube = t.owner.to(torch.int32)
        group = torch.arange(len(cube), dtype=torch.int32, device=device) - t.base[t.owner]
        vertices = torch.empty(len(cube), 3, device=device, dtype=torch.float32)
        arguments = [cube, group, *_DualVertices.arguments(t, padded, (deformation, alpha, beta), scale), vertices]
        launch(kernels.dual_vertex_kernel, len(cube), arguments, device)
        ctx.topology, ctx.scale = topology, scale
        ctx.save_for_backward(padded, sdf, deformation, alpha, beta)
        return vertices

    @staticmethod
    def arguments(t: _Topology, padded: Tensor, given: Sequence[Tensor | None], scale: tuple) -> list:
        none = padded.new_empty(0)
        shift, alpha, beta = (none if v is None else v.detach().contiguous().view(-1) for v in given)
        weights = struct_of(kernels.Weights, alpha=alpha, beta=beta)
        return [t.surface, _struct_of_tables(padded.device), t.grid(padded, shift), weights, wp.vec3(*scale)]

    @staticmethod
    @once_differentiable
    def backward(ctx, g_vertices):
        from reli3d.kernels import flexicubes_adjoint

        t, device = ctx.topology, g_vertices.device
        padded, sdf, *given = ctx.saved_tensors
        n = len(t.cells)
        g_sdf, g_alpha, g_beta = (torch.zeros(n, width, device=device, dtype=torch.float32) for width in (8, 8, 12))
        g_shift = torch.zeros(n, 8, 3, device=device, dtype=torch.float32)
        adjoints = [g_sdf.view(-1), g_shift.view(-1, 3), g_alpha.view(-1), g_beta.view(-1)]
        arguments = [*_DualVertices.arguments(t, padded, given, ctx.scale), g_vertices.contiguous(), *adjoints]
        launch(flexicubes_adjoint.dual_vertex_adjoint_kernel, n, arguments, device)
        corner = corner_vertices(t).view(-1)
        grads: list[Tensor | None] = [None, None, None, None]
        if ctx.needs_input_grad[3]:
            grads[0] = _scatter(corner, g_sdf.view(-1, 1), sdf.numel()).view(sdf.shape)
        if ctx.needs_input_grad[4]:
            grads[1] = _scatter(corner, g_shift.view(-1, 3), sdf.numel()).view(*sdf.shape, 3)
        real = t.rows >= 0
        for i, value, g in ((2, given[1], g_alpha), (3, given[2], g_beta)):
            if ctx.needs_input_grad[3 + i] and value is not None:
                every = torch.zeros_like(value)
                every[t.rows[real].long()] = g[real]
                grads[i] = every
        return None, None, None, *grads


def corners_of(cells: Tensor, shape: Sequence[int]) -> Tensor:
    """Grid vertices ``(S, 8)`` at the corners of cubes ``(S,)``, given by their lowest vertices; shape: of the grid."""
    k = torch.arange(8, device=cells.device, dtype=torch.int64)
    return cells.long()[:, None] + ((k & 1) * shape[1] + (k >> 1 & 1)) * shape[2] + (k >> 2)


def corner_vertices(t: _Topology) -> Tensor:
    """Unpadded grid vertex at every corner of the surface cubes, ``(S, 8)``; padding maps to the border vertex."""
    corners = corners_of(t.cells, t.shape)
    if t.pad == 0:  # the common case, about 10 times faster
        return corners
    at = torch.stack(torch.unravel_index(corners, t.shape), -1) - t.pad
    at = torch.minimum(at.clamp(min=0), torch.tensor(t.cubes, device=at.device, dtype=torch.int64))
    return (at[..., 0] * (t.cubes[1] + 1) + at[..., 1]) * (t.cubes[2] + 1) + at[..., 2]


def _quads(t: _Topology, padded: Tensor, crossed: Tensor, gamma: Tensor | None) -> tuple[Tensor, Tensor]:
    """Dual vertices of every quad ``(Q, 4)`` and the gammas of their cubes ``(Q, 4)``, in the published order."""
    device = padded.device
    starts = crossed.view(-1).nonzero().squeeze(1)
    bits = torch.tensor([1, 2, 4], dtype=torch.uint8, device=device)
    which, direction = (crossed.view(-1)[starts][:, None] & bits).nonzero(as_tuple=True)
    origin, direction = starts[which].to(torch.int32), direction.to(torch.int32)
    quads = torch.empty(len(origin), 4, dtype=torch.int32, device=device)
    split = torch.empty(len(origin), 4, device=device, dtype=torch.float32)
    weights = padded.new_empty(0) if gamma is None else gamma.detach().contiguous()
    inputs = [origin, direction, t.surface, _struct_of_tables(device), t.grid(padded, padded.new_empty(0)), weights]
    launch(kernels.quad_kernel, len(origin), [*inputs, quads.view(-1), split.view(-1)], device)
    return quads, split


def _gamma_of(t: _Topology, quads: Tensor, gamma: Tensor) -> Tensor:
    """Gamma of the cubes of every quad, ``(Q, 4)``, with its gradient; 1 in the padding."""
    rows = t.rows.long()[t.owner[quads.long()]]
    return torch.where(rows >= 0, gamma.index_select(0, rows.clamp(min=0).view(-1)).view_as(rows), 1.0)


def _with_centers(vertices: Tensor, quads: Tensor, gamma: Tensor) -> Mesh:
    """Four triangles a quad around the mean of its diagonals' midpoints, each weighted by the gammas at its ends."""
    # the backward of index_select sums in index order, that of advanced indexing in any order
    corner = vertices.index_select(0, quads.view(-1).long()).view(-1, 4, 3)
    gamma = gamma.double()  # products of small weights underflow in float32
    one, other = gamma[:, 0] * gamma[:, 2], gamma[:, 1] * gamma[:, 3]
    weight = (one / (one + other)).float()[:, None]
    # twice the difference of the midpoints, which nearly coincide on smooth surfaces: from edges, to keep digits
    difference = (corner[:, 0] - corner[:, 1]) + (corner[:, 2] - corner[:, 3])
    middle = 0.5 * (corner[:, 1] + corner[:, 3] + weight * difference)
    index = torch.arange(len(quads), dtype=torch.int32, device=quads.device) + len(vertices)
    faces = torch.stack([torch.stack([quads[:, k], quads[:, (k + 1) % 4], index], -1) for k in range(4)], 1)
    return Mesh(torch.cat([vertices, middle]), faces.reshape(-1, 3))
