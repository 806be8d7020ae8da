"""Adjoint of the dual vertices of :mod:`reli3d.kernels.flexicubes`; the topology is a constant."""

import warp as wp

from reli3d.kernels.flexicubes import LEVEL_MIN, cell_position, corner_index, end_shares, split_index, weight

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})


@wp.kernel
def dual_vertex_adjoint_kernel(
    start: int,
    # in
    cells: wp.array[wp.int32], resolved: wp.array[wp.int32], rows: wp.array[wp.int32], counts: wp.array[wp.int32],
    base: wp.array[wp.int32], group: wp.array[wp.int32], ends: wp.array[wp.int32],
    level: wp.array[float], shift: wp.array[wp.vec3], alpha: wp.array[float], beta: wp.array[float],
    ny: int, nz: int, cubes: wp.vec3i, pad: int, scale: wp.vec3,
    g_vertices: wp.array[wp.vec3],
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
        mean = wp.vec3()
        for e in range(12):
            if group[resolved[s] * 12 + e] == own:
                a = ends[2 * e]
                b = ends[2 * e + 1]
                ways = end_shares(weight(alpha, row, 8, a), level[corner_index(cell, a, ny, nz)],
                                  weight(alpha, row, 8, b), level[corner_index(cell, b, ny, nz)])  # fmt: skip
                x_a = cell_position(at, a, shift, cubes, pad)
                x_b = cell_position(at, b, shift, cubes, pad)
                beta_e = weight(beta, row, 12, e)
                mean += (x_a + float(ways[0]) * (x_b - x_a)) * beta_e
                total += beta_e
        mean = mean / total
        g = wp.cw_mul(g_vertices[base[s] + own], scale)
        for e in range(12):
            if group[resolved[s] * 12 + e] == own:
                a = ends[2 * e]
                b = ends[2 * e + 1]
                alpha_a = weight(alpha, row, 8, a)
                alpha_b = weight(alpha, row, 8, b)
                level_a = level[corner_index(cell, a, ny, nz)]
                level_b = level[corner_index(cell, b, ny, nz)]
                ways = end_shares(alpha_a, level_a, alpha_b, level_b)
                t = float(ways[0])
                rest = float(ways[1])
                x_a = cell_position(at, a, shift, cubes, pad)
                x_b = cell_position(at, b, shift, cubes, pad)
                g_beta[s * 12 + e] = wp.dot(x_a + t * (x_b - x_a) - mean, g) / total
                g_point = weight(beta, row, 12, e) / total * g
                g_t = wp.dot(x_b - x_a, g_point)
                g_alpha[s * 8 + a] = g_alpha[s * 8 + a] + t * rest / alpha_a * g_t
                g_alpha[s * 8 + b] = g_alpha[s * 8 + b] - t * rest / alpha_b * g_t
                if wp.max(wp.abs(level_a), wp.abs(level_b)) >= LEVEL_MIN:
                    if level_a < 0.0:
                        g_t = -g_t
                    g_level[s * 8 + a] = g_level[s * 8 + a] + float(wp.float64(alpha_a) * ways[1] / ways[2]) * g_t
                    g_level[s * 8 + b] = g_level[s * 8 + b] + float(wp.float64(alpha_b) * ways[0] / ways[2]) * g_t
                g_shift[s * 8 + a] = g_shift[s * 8 + a] + rest * g_point
                g_shift[s * 8 + b] = g_shift[s * 8 + b] + t * g_point
