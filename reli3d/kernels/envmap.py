"""Lat-long environment maps: lookup, importance sampling.

The upper edge is +Y, the horizontal center +X, and +Z is right of it: with phi = 2 pi u - pi and theta = pi v the
direction is (cos phi sin theta, cos theta, sin phi sin theta).  A texel has its center at ((column + .5) / W, (row +
.5) / H). Radiance is bilinear between centers, periodic in u, constant beyond the first and last row.  Sampling is
piecewise constant over texels with respect to solid angle; densities are per steradian.
"""

import warp as wp

from reli3d.kernels.math import CONTRACT, INLINE, INV_PI, TINY, safe_sqrt, turn_atan2, turn_cos_sin

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": f"-march=native {INLINE} {CONTRACT}"})


@wp.func
def direction_to_uv(d: wp.vec3) -> wp.vec2:
    """Map coordinates in [0, 1]^2 of the unit direction ``d``; at the poles u is 0.5 and its gradient finite."""
    s = safe_sqrt(d[0] * d[0] + d[2] * d[2])
    return wp.vec2(0.5 + turn_atan2(d[2], d[0]), 2.0 * turn_atan2(s, d[1]))


@wp.struct
class Texels:
    """The four texels about a point of the map: rows, columns, and the position of the point between them in [0, 1]."""

    r0: int
    r1: int
    c0: int
    c1: int
    fx: float
    fy: float


@wp.func
def four_texels(height: int, width: int, uv: wp.vec2) -> Texels:
    """Neighbors for bilinear lookup: periodic in u, the border's row beyond the first and the last."""
    x = uv[0] * float(width) - 0.5
    y = uv[1] * float(height) - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    out = Texels()
    out.fx = x - float(column)
    out.fy = y - float(row)
    out.c0 = wp.min(wp.where(column < 0, width - 1, column), width - 1)
    out.c1 = wp.where(out.c0 == width - 1, 0, out.c0 + 1)
    out.r0 = wp.clamp(row, 0, height - 1)
    out.r1 = wp.clamp(row + 1, 0, height - 1)
    return out


@wp.func
def lookup_envmap_uv(radiance: wp.array2d[wp.vec3], uv: wp.vec2) -> wp.vec3:
    """Bilinear radiance at map coordinates in [0, 1]^2."""
    at = four_texels(radiance.shape[0], radiance.shape[1], uv)
    top = radiance[at.r0, at.c0] * (1.0 - at.fx) + radiance[at.r0, at.c1] * at.fx
    bottom = radiance[at.r1, at.c0] * (1.0 - at.fx) + radiance[at.r1, at.c1] * at.fx
    return top * (1.0 - at.fy) + bottom * at.fy


@wp.func
def add_texels(g_radiance: wp.array2d[wp.vec3], uv: wp.vec2, g: wp.vec3):
    """Adjoint of :func:`lookup_envmap_uv` in the texels: ``g`` is spread over the four."""
    at = four_texels(g_radiance.shape[0], g_radiance.shape[1], uv)
    top = g * (1.0 - at.fy)
    bottom = g * at.fy
    wp.atomic_add(g_radiance, at.r0, at.c0, top * (1.0 - at.fx))
    wp.atomic_add(g_radiance, at.r0, at.c1, top * at.fx)
    wp.atomic_add(g_radiance, at.r1, at.c0, bottom * (1.0 - at.fx))
    wp.atomic_add(g_radiance, at.r1, at.c1, bottom * at.fx)


@wp.func
def upper_cell(cdf: wp.array2d[float], guide: wp.array2d[wp.int32], row: int, u: float) -> int:
    """Index k with ``cdf[row, k] <= u < cdf[row, k + 1]``; such a cell has positive probability.

    Chen and Asau 1974: ``guide[row, j]`` is the cell of u = j / n, from which one step is expected for any CDF.  The
    first two are tested without a branch, which a processor could not predict, and in parallel.
    """
    n = guide.shape[1]
    k = guide[row, wp.min(int(u * float(n)), n - 1)]
    steps = wp.where(cdf[row, k + 1] <= u, 1, 0) + wp.where(cdf[row, wp.min(k + 2, n)] <= u, 1, 0)
    k = wp.min(k + steps, n - 1)
    while k < n - 1 and cdf[row, k + 1] <= u:
        k = k + 1
    return k


@wp.struct
class MapSample:
    """A sampled point of the map and its unit direction."""

    uv: wp.vec2
    direction: wp.vec3


@wp.func
def sample_envmap(
    rows: wp.array2d[float],
    columns: wp.array2d[float],
    row_guide: wp.array2d[wp.int32],
    column_guide: wp.array2d[wp.int32],
    u: wp.vec2,
) -> MapSample:
    """Point of the map for uniform ``u`` in [0, 1)^2; density :func:`pdf_envmap_uv`.

    rows: ``(2, H + 1)``, CDF of the rows and height of their edges; columns: ``(H, W + 1)`` CDF within each row.
    Inversion, monotone in both numbers, so stratified ``u`` stay stratified.  Within a texel uniform in solid angle.
    """
    height = columns.shape[0]
    width = columns.shape[1] - 1
    r = upper_cell(rows, row_guide, 0, u[0])
    c = upper_cell(columns, column_guide, r, u[1])
    a = rows[0, r]
    b = columns[r, c]
    in_row = (u[0] - a) / (rows[0, r + 1] - a)
    in_column = (u[1] - b) / (columns[r, c + 1] - b)
    top = rows[1, r]
    bottom = rows[1, r + 1]
    y = top + (bottom - top) * in_row
    s = safe_sqrt(1.0 - y * y)
    v = 2.0 * turn_atan2(s, y) * float(height)
    v = wp.clamp(v, float(r), float(r) + 0.99999)  # float32 arc cosine near a pole may leave the row
    out = MapSample()
    out.uv = wp.vec2((float(c) + wp.min(in_column, 0.99999)) / float(width), v / float(height))
    turn = turn_cos_sin(out.uv[0])
    out.direction = wp.vec3(-turn[0] * s, y, -turn[1] * s)
    return out


@wp.func
def pdf_envmap_uv(density: wp.array2d[float], uv: wp.vec2) -> float:
    """Density [1/sr] of :func:`sample_envmap` at map coordinates."""
    height = density.shape[0]
    width = density.shape[1]
    r = wp.clamp(int(uv[1] * float(height)), 0, height - 1)
    c = wp.clamp(int(uv[0] * float(width)), 0, width - 1)
    return density[r, c]


@wp.kernel
def lookup_envmap_kernel(
    start: int,
    radiance: wp.array2d[wp.vec3],
    directions: wp.array[wp.vec3],
    out: wp.array[wp.vec3],  # out
):
    i = start + wp.tid()
    out[i] = lookup_envmap_uv(radiance, direction_to_uv(directions[i]))


@wp.kernel
def lookup_adjoint_kernel(
    start: int,
    first: int,
    radiance: wp.array2d[wp.vec3],
    directions: wp.array[wp.vec3],
    g_out: wp.array[wp.vec3],
    g_radiance: wp.array2d[wp.vec3],  # out
    g_directions: wp.array[wp.vec3],  # out
):
    """Adjoints of the lookups from ``first``; an output without rows is left out.  ``g_radiance`` is added to.

    u and v are angles: their derivatives are those of atan2(z, x) / 2 pi and atan2(sqrt(x^2 + z^2), y) / pi.
    """
    i = first + start + wp.tid()
    d = directions[i]
    uv = direction_to_uv(d)
    g = g_out[i]
    if g_radiance.shape[0] != 0:
        add_texels(g_radiance, uv, g)
    if g_directions.shape[0] != 0:
        height = radiance.shape[0]
        width = radiance.shape[1]
        at = four_texels(height, width, uv)
        a = wp.dot(g, radiance[at.r0, at.c0])
        b = wp.dot(g, radiance[at.r0, at.c1])
        c = wp.dot(g, radiance[at.r1, at.c0])
        e = wp.dot(g, radiance[at.r1, at.c1])
        g_u = ((b - a) * (1.0 - at.fy) + (e - c) * at.fy) * float(width) * 0.5 * INV_PI
        g_v = ((c - a) * (1.0 - at.fx) + (e - b) * at.fx) * float(height) * INV_PI
        square = d[0] * d[0] + d[2] * d[2]
        s = safe_sqrt(square)
        g_azimuth = g_u / wp.max(square, TINY)
        g_polar = g_v / (s * s + d[1] * d[1])
        g_directions[i] = wp.vec3(
            d[0] * d[1] / s * g_polar - d[2] * g_azimuth, -s * g_polar, d[2] * d[1] / s * g_polar + d[0] * g_azimuth
        )


@wp.kernel
def sample_envmap_kernel(
    start: int,
    rows: wp.array2d[float],
    columns: wp.array2d[float],
    row_guide: wp.array2d[wp.int32],
    column_guide: wp.array2d[wp.int32],
    density: wp.array2d[float],
    u: wp.array[wp.vec2],
    directions: wp.array[wp.vec3],  # out
    pdf: wp.array[float],  # out
):
    i = start + wp.tid()
    drawn = sample_envmap(rows, columns, row_guide, column_guide, u[i])
    directions[i] = drawn.direction
    pdf[i] = pdf_envmap_uv(density, drawn.uv)


@wp.kernel
def pdf_envmap_kernel(
    start: int,
    density: wp.array2d[float],
    directions: wp.array[wp.vec3],
    pdf: wp.array[float],  # out
):
    i = start + wp.tid()
    pdf[i] = pdf_envmap_uv(density, direction_to_uv(directions[i]))
