"""Look-up of points in a grid of features, channel last: one thread a point, all channels of its eight neighbours."""

import warp as wp

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})


@wp.func
def between_points(x: float, count: int) -> wp.vec2:
    """Index of the lower of two grid points about coordinate ``x``, counted in cells, and the place between them.

    Beyond the outermost points theirs is taken.  count: at least 2.
    """
    u = wp.clamp(x, 0.0, float(count - 1))
    low = float(wp.min(int(u), count - 2))
    return wp.vec2(low, u - low)


@wp.kernel
def sample_grid_kernel(
    start: int,
    # in
    grid: wp.array4d[float],  # (X, Y, Z, C)
    points: wp.array[wp.vec3],  # (N,) in [-1, 1], which spans the outermost grid points
    # out
    features: wp.array2d[float],  # (N, C)
):
    n = start + wp.tid()
    p = points[n]
    x = between_points(0.5 * (p[0] + 1.0) * float(grid.shape[0] - 1), grid.shape[0])
    y = between_points(0.5 * (p[1] + 1.0) * float(grid.shape[1] - 1), grid.shape[1])
    z = between_points(0.5 * (p[2] + 1.0) * float(grid.shape[2] - 1), grid.shape[2])
    i = int(x[0])
    j = int(y[0])
    k = int(z[0])
    for c in range(grid.shape[3]):
        low = wp.lerp(
            wp.lerp(grid[i, j, k, c], grid[i, j, k + 1, c], z[1]),
            wp.lerp(grid[i, j + 1, k, c], grid[i, j + 1, k + 1, c], z[1]),
            y[1],
        )
        high = wp.lerp(
            wp.lerp(grid[i + 1, j, k, c], grid[i + 1, j, k + 1, c], z[1]),
            wp.lerp(grid[i + 1, j + 1, k, c], grid[i + 1, j + 1, k + 1, c], z[1]),
            y[1],
        )
        features[n, c] = wp.lerp(low, high, x[1])
