"""Adjoint of the dual vertices of :mod:`reli3d.kernels.flexicubes`; the topology is a constant."""

import warp as wp

from reli3d.kernels.flexicubes import (
    SDF_MIN,
    Grid,
    SurfaceCubes,
    Tables,
    Weights,
    corner_index,
    corner_of,
    crossing_fractions,
    exact_position,
    split_index,
    weight,
)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})


@wp.kernel
def dual_vertex_adjoint_kernel(
    start: int,
    surface: SurfaceCubes,
    tables: Tables,
    grid: Grid,
    weights: Weights,
    scale: wp.vec3,
    g_vertices: wp.array[wp.vec3],
    g_sdf: wp.array[float],  # out, zeroed
    g_shift: wp.array[wp.vec3],  # out, zeroed
    g_alpha: wp.array[float],  # out, zeroed
    g_beta: wp.array[float],  # out, zeroed
):
    """One thread per surface cube, which writes its own 8 entries of g_sdf, g_shift, g_alpha and its 12 of g_beta.

    In float64, because differences between crossings and their mean, and between the ends of an edge, cancel.
    """
    s = start + wp.tid()
    cell = surface.cells[s]
    code = surface.resolved[s]
    row = surface.rows[s]
    at = split_index(cell, grid.ny, grid.nz)
    for group in range(surface.counts[s]):
        total = wp.float64(0.0)
        mean = wp.vec3d()
        for e in range(12):
            if tables.group[code * 12 + e] == group:
                a = tables.ends[2 * e]
                b = tables.ends[2 * e + 1]
                fraction = crossing_fractions(
                    weight(weights.alpha, row, 8, a),
                    grid.sdf[corner_index(cell, a, grid.ny, grid.nz)],
                    weight(weights.alpha, row, 8, b),
                    grid.sdf[corner_index(cell, b, grid.ny, grid.nz)],
                )
                x_a = exact_position(corner_of(at, a, grid), grid)
                x_b = exact_position(corner_of(at, b, grid), grid)
                beta_e = wp.float64(weight(weights.beta, row, 12, e))
                mean += (x_a * fraction[1] + x_b * fraction[0]) * beta_e
                total += beta_e
        mean = mean / total
        g = wp.vec3d(wp.cw_mul(g_vertices[surface.base[s] + group], scale)) / total
        for e in range(12):
            if tables.group[code * 12 + e] == group:
                a = tables.ends[2 * e]
                b = tables.ends[2 * e + 1]
                alpha_a = wp.float64(weight(weights.alpha, row, 8, a))
                alpha_b = wp.float64(weight(weights.alpha, row, 8, b))
                sdf_a = grid.sdf[corner_index(cell, a, grid.ny, grid.nz)]
                sdf_b = grid.sdf[corner_index(cell, b, grid.ny, grid.nz)]
                fraction = crossing_fractions(float(alpha_a), sdf_a, float(alpha_b), sdf_b)
                x_a = exact_position(corner_of(at, a, grid), grid)
                x_b = exact_position(corner_of(at, b, grid), grid)
                g_beta[s * 12 + e] = float(wp.dot(x_a * fraction[1] + x_b * fraction[0] - mean, g))
                g_point = g * wp.float64(weight(weights.beta, row, 12, e))
                g_t = wp.dot(x_b - x_a, g_point)
                g_size = g_t * fraction[0] * fraction[1]  # of log |alpha_a sdf_a|; that of b is its negative
                g_alpha[s * 8 + a] = g_alpha[s * 8 + a] + float(g_size / alpha_a)
                g_alpha[s * 8 + b] = g_alpha[s * 8 + b] - float(g_size / alpha_b)
                if wp.max(wp.abs(sdf_a), wp.abs(sdf_b)) >= SDF_MIN:
                    g_t = g_t / fraction[2]
                    if sdf_a < 0.0:
                        g_t = -g_t
                    g_sdf[s * 8 + a] = g_sdf[s * 8 + a] + float(alpha_a * fraction[1] * g_t)
                    g_sdf[s * 8 + b] = g_sdf[s * 8 + b] + float(alpha_b * fraction[0] * g_t)
                g_shift[s * 8 + a] = g_shift[s * 8 + a] + wp.vec3(g_point * fraction[1])
                g_shift[s * 8 + b] = g_shift[s * 8 + b] + wp.vec3(g_point * fraction[0])
