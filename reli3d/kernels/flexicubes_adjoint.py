"""Adjoint of the dual vertices of :mod:`reli3d.kernels.flexicubes`; the topology is a constant."""

import warp as wp

from reli3d.kernels.flexicubes import corner_index, grid_position, split_index, weight

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})


@wp.kernel
def dual_vertex_adjoint_kernel(
    start: int,
    # in
    cells: wp.array[wp.int32], resolved: wp.array[wp.int32], rows: wp.array[wp.int32], counts: wp.array[wp.int32],
    base: wp.array[wp.int32], group: wp.array[wp.int32], ends: wp.array[wp.int32],
    level: wp.array[float], shift: wp.array[wp.vec3], alpha: wp.array[float], beta: wp.array[float],
    ny: int, nz: int, cubes: wp.vec3i, pad: int, scale: wp.vec3,
    vertices: wp.array[wp.vec3], g_vertices: wp.array[wp.vec3],
    # out, zeroed
    g_level: wp.array[float], g_shift: wp.array[wp.vec3], g_alpha: wp.array[float], g_beta: wp.array[float],
):  # fmt: skip
    """A thread is a surface cube and owns its 8 entries of g_level, g_shift, g_alpha and its 12 of g_beta."""
    s = start + wp.tid()
    cell = cells[s]
    row = rows[s]
    at = split_index(cell, ny, nz)
    for own in range(counts[s]):
        total = wp.float32(0.0)
        for e in range(12):
            if group[resolved[s] * 12 + e] == own:
                total += weight(beta, row, 12, e)
        mean = wp.cw_div(vertices[base[s] + own], scale)
        g = wp.cw_mul(g_vertices[base[s] + own], scale) / total
        for e in range(12):
            if group[resolved[s] * 12 + e] == own:
                a = ends[2 * e]
                b = ends[2 * e + 1]
                alpha_a = weight(alpha, row, 8, a)
                alpha_b = weight(alpha, row, 8, b)
                beta_e = weight(beta, row, 12, e)
                level_a = level[corner_index(cell, a, ny, nz)]
                level_b = level[corner_index(cell, b, ny, nz)]
                inverse = 1.0 / (alpha_a * level_a - alpha_b * level_b)
                t = alpha_a * level_a * inverse
                x_a = grid_position(at + wp.vec3i(a & 1, a >> 1 & 1, a >> 2), shift, cubes, pad)
                x_b = grid_position(at + wp.vec3i(b & 1, b >> 1 & 1, b >> 2), shift, cubes, pad)
                g_beta[s * 12 + e] = wp.dot(x_a + t * (x_b - x_a) - mean, g)
                g_point = beta_e * g
                g_t = wp.dot(x_b - x_a, g_point)
                g_a = (1.0 - t) * inverse * g_t  # of alpha * level at the two ends
                g_b = t * inverse * g_t
                g_level[s * 8 + a] = g_level[s * 8 + a] + g_a * alpha_a
                g_level[s * 8 + b] = g_level[s * 8 + b] + g_b * alpha_b
                g_alpha[s * 8 + a] = g_alpha[s * 8 + a] + g_a * level_a
                g_alpha[s * 8 + b] = g_alpha[s * 8 + b] + g_b * level_b
                g_shift[s * 8 + a] = g_shift[s * 8 + a] + (1.0 - t) * g_point
                g_shift[s * 8 + b] = g_shift[s * 8 + b] + t * g_point
