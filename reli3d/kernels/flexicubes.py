"""FlexiCubes (Shen et al. 2023), forward: classifies the cubes, resolves ambiguous ones, places the dual vertices and
emits the quads.

The grid has ``nx * ny * nz`` vertices; vertex (i, j, k) has the index ``(i * ny + j) * nz + k``.  A cube has the index
of its lowest corner, so there is no cube at the last index of an axis.  Inside is sdf < 0.  If ``pad`` is 1, the grid
was padded by one layer of vertices with a positive value, which lie at the positions of the border vertices.  The cubes
of this layer have zero thickness and cap the surface flat at the box.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

SDF_MIN = wp.constant(1.0e-20)  # gradients scale with 1 / sdf: 0 for an edge with both ends below this magnitude


@wp.struct
class Grid:
    """Field values of the padded grid, offsets of the unpadded vertices (empty for none), and the shape.

    ``cubes`` is the number of unpadded cubes along each axis.
    """

    sdf: wp.array[float]
    shift: wp.array[wp.vec3]
    ny: int
    nz: int
    cubes: wp.vec3i
    pad: int


@wp.struct
class SurfaceCubes:
    """Arrays with one entry for each cube with a sign change.

    cells: index of the cube.  resolved: its case after :func:`resolve_kernel`.  rows: its row in the weights, -1 in the
    padding.  counts: number of its dual vertices.  base: index of the first of these.  ``slot`` has an entry for each
    grid vertex: the position in the other arrays of the cube of that index.
    """

    cells: wp.array[wp.int32]
    resolved: wp.array[wp.int32]
    rows: wp.array[wp.int32]
    counts: wp.array[wp.int32]
    base: wp.array[wp.int32]
    slot: wp.array[wp.int32]


@wp.struct
class Tables:
    """The tables ``group``, ``ends`` and ``around`` of :mod:`reli3d.kernels.flexicubes_tables`, flattened."""

    group: wp.array[wp.int32]
    ends: wp.array[wp.int32]
    around: wp.array[wp.int32]


@wp.struct
class Weights:
    """FlexiCubes weights: ``alpha``, 8 for each surface cube, and ``beta``, 12 for each; an empty array means 1."""

    alpha: wp.array[float]
    beta: wp.array[float]


@wp.func
def split_index(index: int, ny: int, nz: int) -> wp.vec3i:
    return wp.vec3i(index // (ny * nz), (index // nz) % ny, index % nz)


@wp.func
def corner_index(cell: int, corner: int, ny: int, nz: int) -> int:
    return cell + (corner & 1) * ny * nz + (corner >> 1 & 1) * nz + (corner >> 2)


@wp.func
def inside_bit(sdf: wp.array[float], index: int) -> int:
    return wp.where(sdf[index] < 0.0, 1, 0)


@wp.func
def shift_of(vertex: wp.vec3i, grid: Grid) -> wp.vec3:
    """Deformation of an unpadded grid vertex."""
    if grid.shift.shape[0] == 0:
        return wp.vec3()
    return grid.shift[(vertex[0] * (grid.cubes[1] + 1) + vertex[1]) * (grid.cubes[2] + 1) + vertex[2]]


@wp.func
def corner_of(at: wp.vec3i, corner: int, grid: Grid) -> wp.vec3i:
    """Unpadded grid vertex at a corner of the cube whose lowest padded vertex is ``at``."""
    v = at + wp.vec3i(corner & 1, corner >> 1 & 1, corner >> 2) - wp.vec3i(grid.pad)
    return wp.min(wp.max(v, wp.vec3i()), grid.cubes)


@wp.func
def grid_position(v: wp.vec3i, grid: Grid) -> wp.vec3:
    """Position of an unpadded grid vertex in [-0.5, 0.5]^3 plus deformation."""
    p = wp.cw_div(wp.vec3(v), wp.vec3(grid.cubes)) - wp.vec3(0.5)
    return p + shift_of(v, grid)


@wp.func
def exact_position(v: wp.vec3i, grid: Grid) -> wp.vec3d:
    """:func:`grid_position` plus 0.5 in float64, for differences."""
    return wp.cw_div(wp.vec3d(v), wp.vec3d(grid.cubes)) + wp.vec3d(shift_of(v, grid))


@wp.func
def weight(values: wp.array[float], row: int, width: int, column: int) -> float:
    """Entry of a weight; 1 for the padding's cubes (row -1) and where no weights are given."""
    if row < 0 or values.shape[0] == 0:
        return 1.0
    return values[row * width + column]


@wp.func
def crossing_fractions(alpha_a: float, sdf_a: float, alpha_b: float, sdf_b: float) -> wp.vec3d:
    """Distance of the crossing from a and from b as fractions of the edge, and |alpha_a sdf_a| + |alpha_b sdf_b|.

    In float64: the products leave the range of float32, and 1 - fraction cancels near an end.
    """
    a = wp.float64(alpha_a) * wp.abs(wp.float64(sdf_a))
    b = wp.float64(alpha_b) * wp.abs(wp.float64(sdf_b))
    return wp.vec3d(a / (a + b), b / (a + b), a + b)


@wp.func
def column_bits(sdf: wp.array[float], index: int, step_x: int, step_y: int, has_x: bool, has_y: bool) -> int:
    """Inside bits of four grid vertices with one z, as corners 0 to 3 of a cube; 0 outside the grid."""
    bits = inside_bit(sdf, index)
    if has_x:
        bits += inside_bit(sdf, index + step_x) << 1
    if has_y:
        bits += inside_bit(sdf, index + step_y) << 2
    if has_x and has_y:
        bits += inside_bit(sdf, index + step_x + step_y) << 3
    return bits


@wp.kernel
def classify_kernel(
    start: int,
    sdf: wp.array[float],
    nx: int,
    ny: int,
    nz: int,
    codes: wp.array[wp.uint8],  # out
    crossed: wp.array[wp.uint8],  # out
):
    """Case of each cube, and the crossed edges of each vertex.

    codes: the case, a bit for each inside corner; 0 for all cubes without a sign change.  crossed: which edges of the
    vertex get a quad: bit 0 the edge along y, bit 1 along z, bit 2 along x.  An edge belongs to the end that comes
    first in EDGES: the low end along x and z, the high end along y.  One thread per column of vertices along z, so that
    neighboring cubes reuse four corners.
    """
    i = start + wp.tid()
    base = i * nz
    step = ny * nz
    x = i // ny
    y = i % ny
    has_x = x + 1 < nx
    has_y = y + 1 < ny
    inner_x = x > 0 and has_x
    inner_y = y > 0 and has_y
    low = column_bits(sdf, base, step, nz, has_x, has_y)
    for z in range(nz):
        v = base + z
        has_z = z + 1 < nz
        inner_z = z > 0 and has_z
        high = wp.int32(0)
        if has_z:
            high = column_bits(sdf, v + 1, step, nz, has_x, has_y)
        code = low + (high << 4)
        if code == 255 or not (has_x and has_y and has_z):
            code = 0
        codes[v] = wp.uint8(code)
        edges = wp.int32(0)
        if inner_x and inner_z and y > 0:
            edges += (low & 1) ^ inside_bit(sdf, v - nz)
        if inner_x and inner_y and has_z:
            edges += ((low ^ high) & 1) << 1
        if inner_y and inner_z and has_x:
            edges += ((low ^ (low >> 1)) & 1) << 2
        crossed[v] = wp.uint8(edges)
        low = high


@wp.kernel
def resolve_kernel(
    start: int,
    cells: wp.array[wp.int32],
    codes: wp.array[wp.uint8],
    neighbor: wp.array[wp.int32],
    count: wp.array[wp.int32],
    ny: int,
    nz: int,
    resolved: wp.array[wp.int32],  # out
    counts: wp.array[wp.int32],  # out
    slot: wp.array[wp.int32],  # out
):
    """Resolved case of a surface cube: the complement of its case if it shares its ambiguous face with a cube that is
    ambiguous at the same face (C16 and C19 of Wenger 2013), else the case itself.
    """
    s = start + wp.tid()
    cell = cells[s]
    code = int(codes[cell])
    face = neighbor[code]
    if face >= 0:
        axis = face // 2
        at = split_index(cell, ny, nz)
        step = wp.where(axis == 2, 1, wp.where(axis == 1, nz, ny * nz))
        if face % 2 == 1:
            if neighbor[int(codes[cell + step])] == face - 1:
                code = 255 - code
        elif at[axis] > 0 and neighbor[int(codes[cell - step])] == face + 1:
            code = 255 - code
    resolved[s] = code
    counts[s] = count[code]
    slot[cell] = s


@wp.kernel
def dual_vertex_kernel(
    start: int,
    cube: wp.array[wp.int32],
    group: wp.array[wp.int32],
    surface: SurfaceCubes,
    tables: Tables,
    grid: Grid,
    weights: Weights,
    scale: wp.vec3,
    vertices: wp.array[wp.vec3],  # out
):
    """Dual vertex ``group`` of surface cube ``cube``: the mean, weighted by beta, of the zero crossings on its edges.

    A group is a set of crossed edges of a cube that share one dual vertex.  NaN if a weight of these edges is not
    positive.
    """
    v = start + wp.tid()
    s = cube[v]
    cell = surface.cells[s]
    code = surface.resolved[s]
    row = surface.rows[s]
    at = split_index(cell, grid.ny, grid.nz)
    total = wp.float32(0.0)
    point = wp.vec3()
    for e in range(12):
        if tables.group[code * 12 + e] == group[v]:
            a = tables.ends[2 * e]
            b = tables.ends[2 * e + 1]
            alpha_a = weight(weights.alpha, row, 8, a)
            alpha_b = weight(weights.alpha, row, 8, b)
            beta_e = weight(weights.beta, row, 12, e)
            sdf_a = grid.sdf[corner_index(cell, a, grid.ny, grid.nz)]
            sdf_b = grid.sdf[corner_index(cell, b, grid.ny, grid.nz)]
            t = float(crossing_fractions(alpha_a, sdf_a, alpha_b, sdf_b)[0])
            x_a = grid_position(corner_of(at, a, grid), grid)
            x_b = grid_position(corner_of(at, b, grid), grid)
            if not (alpha_a > 0.0 and alpha_b > 0.0 and beta_e > 0.0):
                beta_e = wp.nan
            point += (x_a + t * (x_b - x_a)) * beta_e
            total += beta_e
    vertices[v] = wp.cw_mul(point / total, scale)


@wp.kernel
def quad_kernel(
    start: int,
    origin: wp.array[wp.int32],
    direction: wp.array[wp.int32],
    surface: SurfaceCubes,
    tables: Tables,
    grid: Grid,
    gamma: wp.array[float],
    quads: wp.array[wp.int32],  # out
    split: wp.array[float],  # out
):
    """The quad of a crossed edge: the dual vertices of its four cubes, counter-clockwise seen from outside.

    origin: the vertex to which the edge belongs.  direction: 0 for the edge along -y, 1 along z, 2 along x, the bits of
    :func:`classify_kernel`.  split: gamma of each of the four cubes.
    """
    q = start + wp.tid()
    v = origin[q]
    first = grid.ny * grid.nz  # steps across the edge; the larger first
    second = grid.nz
    lowest = v
    axis = 2
    if direction[q] == 0:
        second = 1
        lowest = v - grid.nz
        axis = 1
    if direction[q] == 2:
        first = grid.nz
        second = 1
        axis = 0
    outward = grid.sdf[v] < 0.0
    for corner in range(4):
        # the order around the edge is 0, 1, 3, 2; seen from the other end 2, 3, 1, 0
        turn = wp.where(outward, 3 - corner, corner)
        n = turn ^ (turn >> 1)
        cell = lowest - first * (1 - (n >> 1)) - second * (1 - (n & 1))
        s = surface.slot[cell]
        edge = surface.resolved[s] * 12 + tables.around[axis * 4 + n]
        quads[q * 4 + corner] = surface.base[s] + tables.group[edge]
        split[q * 4 + corner] = weight(gamma, surface.rows[s], 1, 0)
