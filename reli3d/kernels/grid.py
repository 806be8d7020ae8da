"""Regular grids: trilinear interpolation (a thread per point) and the squared Laplacian (a thread per row)."""

import warp as wp

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})


@wp.func
def between_points(x: float, count: int) -> wp.vec2:
    """Lower grid index and fraction in [0, 1] for linear interpolation at ``x``, in cells, clamped to the grid.

    count: grid points along the axis, at least 2.
    """
    u = wp.clamp(x, 0.0, float(count - 1))
    low = float(wp.min(int(u), count - 2))
    return wp.vec2(low, u - low)


@wp.func
def trilinear(grid: wp.array4d[float], x: wp.vec2, y: wp.vec2, z: wp.vec2, c: int) -> float:
    """Value of channel ``c`` at the place that :func:`between_points` gives along each axis."""
    i = int(x[0])
    j = int(y[0])
    k = int(z[0])
    v00 = wp.lerp(grid[i, j, k, c], grid[i, j, k + 1, c], z[1])
    v01 = wp.lerp(grid[i, j + 1, k, c], grid[i, j + 1, k + 1, c], z[1])
    v10 = wp.lerp(grid[i + 1, j, k, c], grid[i + 1, j, k + 1, c], z[1])
    v11 = wp.lerp(grid[i + 1, j + 1, k, c], grid[i + 1, j + 1, k + 1, c], z[1])
    return wp.lerp(wp.lerp(v00, v01, y[1]), wp.lerp(v10, v11, y[1]), x[1])


@wp.kernel
def sample_grid_kernel(
    start: int,
    grid: wp.array4d[float],  # (X, Y, Z, C)
    points: wp.array[wp.vec3],  # (N,) in [-1, 1], which spans the outermost grid points
    features: wp.array2d[float],  # out: (N, C)
):
    n = start + wp.tid()
    p = points[n]
    x = between_points(0.5 * (p[0] + 1.0) * float(grid.shape[0] - 1), grid.shape[0])
    y = between_points(0.5 * (p[1] + 1.0) * float(grid.shape[1] - 1), grid.shape[1])
    z = between_points(0.5 * (p[2] + 1.0) * float(grid.shape[2] - 1), grid.shape[2])
    for c in range(grid.shape[3]):
        features[n, c] = trilinear(grid, x, y, z, c)


@wp.func
def laplacian(values: wp.array3d[float], i: int, j: int, k: int) -> float:
    """7-point Laplacian at an inner point: the sum of the six neighbors minus six times the value."""
    return (
        (values[i + 1, j, k] + values[i - 1, j, k])
        + (values[i, j + 1, k] + values[i, j - 1, k])
        + (values[i, j, k + 1] + values[i, j, k - 1])
        - 6.0 * values[i, j, k]
    )


@wp.func
def value_or_zero(values: wp.array3d[float], i: int, j: int, k: int) -> float:
    """Value of the grid, 0 outside."""
    if i < 0 or j < 0 or k < 0 or i >= values.shape[0] or j >= values.shape[1] or k >= values.shape[2]:
        return 0.0
    return values[i, j, k]


@wp.kernel(enable_backward=False)
def weighted_laplacian_kernel(
    start: int,
    field: wp.array3d[float],
    weight: wp.array3d[float],
    product: wp.array3d[float],  # out: weight * laplacian, 0 at the border
    total: wp.array[float],  # out: sum of weight * laplacian**2 over a row of the grid
):
    row = start + wp.tid()
    i = row // field.shape[1]
    j = row % field.shape[1]
    last = field.shape[2] - 1
    inside = i > 0 and j > 0 and i < field.shape[0] - 1 and j < field.shape[1] - 1
    amount = wp.float32(0.0)
    for k in range(field.shape[2]):
        product[i, j, k] = 0.0
        if inside and k > 0 and k < last and weight[i, j, k] != 0.0:
            value = laplacian(field, i, j, k)
            product[i, j, k] = weight[i, j, k] * value
            amount += weight[i, j, k] * value * value
    total[row] = amount


@wp.kernel(enable_backward=False)
def weighted_laplacian_adjoint_kernel(
    start: int,
    product: wp.array3d[float],
    scale: wp.array[float],  # one number
    g_field: wp.array3d[float],  # out
):
    """Gradient of the weighted squared Laplacian; the Laplacian is self-adjoint."""
    row = start + wp.tid()
    i = row // product.shape[1]
    j = row % product.shape[1]
    last = product.shape[2] - 1
    inside = i > 0 and j > 0 and i < product.shape[0] - 1 and j < product.shape[1] - 1
    for k in range(product.shape[2]):
        value = wp.float32(0.0)
        if inside and k > 0 and k < last:
            value = laplacian(product, i, j, k)
        else:
            value = (
                value_or_zero(product, i + 1, j, k)
                + value_or_zero(product, i - 1, j, k)
                + value_or_zero(product, i, j + 1, k)
                + value_or_zero(product, i, j - 1, k)
                + value_or_zero(product, i, j, k + 1)
                + value_or_zero(product, i, j, k - 1)
            )
        g_field[i, j, k] = 2.0 * scale[0] * value
