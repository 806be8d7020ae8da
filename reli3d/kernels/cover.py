"""Silhouette coverage: the minimum of a signed field along pixel rays, and the field lowered where rays miss.

The grid ``(X, Y, Z)`` fills the cube [-radius, radius]^3, its outermost points on the faces; negative is inside.
"""

import warp as wp

from reli3d.kernels.bilinear import look_up
from reli3d.kernels.grid import between_points, trilinear
from reli3d.kernels.math import cube_range
from reli3d.kernels.projection import project_point

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

LEAST_STEP = wp.constant(1.0e-6)  # of the distance from the camera: smaller steps are lost in float32
STEP_CELLS = wp.constant(0.5)  # between two samples of the field along a ray
BLOCK_CELLS = wp.constant(4)  # side of a block whose minimum is known
INSET_PIXELS = wp.constant(1.0)  # least distance to the silhouette's edge, whose pixels mix with the background


@wp.func
def out_of_block(cell: wp.vec3, along: wp.vec3, block: wp.vec3i) -> float:
    """Ray parameter at which the ray ``cell + t * along``, in units of cells, leaves ``block``."""
    far = wp.float32(3.0e38)
    for axis in range(3):
        if along[axis] != 0.0:
            side = float((block[axis] + wp.where(along[axis] > 0.0, 1, 0)) * BLOCK_CELLS)
            far = wp.min(far, (side - cell[axis]) / along[axis])
    return far


@wp.kernel
def residual_kernel(
    start: int,
    sdf: wp.array4d[float],  # of one channel
    lowest: wp.array3d[float],  # of each block of BLOCK_CELLS cells a side, border included
    distance: wp.array3d[float],
    c2w: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    radius: float,
    depth: float,
    field_max: float,
    stride: int,
    residual: wp.array3d[float],  # out: (V, H // stride, W // stride)
):
    """Coverage residual of a pixel: the amount by which the minimum of the field along its ray exceeds ``-depth``.

    0 outside the silhouette, and for minima of at least ``field_max``.
    """
    n = start + wp.tid()
    rows = residual.shape[1]
    columns = residual.shape[2]
    view = n // (rows * columns)
    i = (n // columns) % rows
    j = n % columns
    x = (float(j) + 0.5) * float(stride)
    y = (float(i) + 0.5) * float(stride)
    residual[view, i, j] = 0.0
    if look_up(distance, view, x, y) > INSET_PIXELS:
        k = intrinsics[view]
        pose = c2w[view]
        origin = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3])
        direction = wp.normalize(wp.transform_vector(pose, wp.vec3((x - k[2]) / k[0], (k[3] - y) / k[1], -1.0)))
        size = wp.vec3(float(sdf.shape[0] - 1), float(sdf.shape[1] - 1), float(sdf.shape[2] - 1))
        scale = size * (0.5 / radius)  # cells per unit length
        span = cube_range(origin, direction, radius, 0.0, 3.0e38)
        step = wp.max(STEP_CELLS / wp.max(wp.max(scale[0], scale[1]), scale[2]), LEAST_STEP * span[1])
        t = span[0]
        least = wp.float32(field_max)
        while t < span[1] and least > -depth:
            p = origin + direction * t
            cell = wp.cw_mul(p + wp.vec3(radius, radius, radius), scale)
            block = wp.vec3i(
                wp.clamp(int(cell[0]) // BLOCK_CELLS, 0, lowest.shape[0] - 1),
                wp.clamp(int(cell[1]) // BLOCK_CELLS, 0, lowest.shape[1] - 1),
                wp.clamp(int(cell[2]) // BLOCK_CELLS, 0, lowest.shape[2] - 1),
            )
            if lowest[block[0], block[1], block[2]] < least:
                x_at = between_points(cell[0], sdf.shape[0])
                y_at = between_points(cell[1], sdf.shape[1])
                z_at = between_points(cell[2], sdf.shape[2])
                least = wp.min(least, trilinear(sdf, x_at, y_at, z_at, 0))
            else:  # no sample in this block can lower the minimum
                end = t + out_of_block(cell, wp.cw_mul(direction, scale), block) - step
                while t < end:
                    t += step
            t += step
        if least < field_max:
            residual[view, i, j] = wp.max(least + depth, 0.0)


@wp.kernel
def lower_kernel(
    start: int,
    sdf: wp.array3d[float],
    bound: wp.array3d[float],
    residual: wp.array3d[float],
    c2w: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    radius: float,
    field_max: float,
    stride: int,
    lowered: wp.array3d[float],  # out
):
    """Field minus the largest coverage residual of the rays through a point, clamped from below to ``bound``."""
    n = start + wp.tid()
    z = n % sdf.shape[2]
    y = (n // sdf.shape[2]) % sdf.shape[1]
    x = n // (sdf.shape[2] * sdf.shape[1])
    value = sdf[x, y, z]
    if wp.abs(value) < field_max:
        edge = 2.0 * radius
        p = wp.vec3(
            edge * float(x) / float(sdf.shape[0] - 1) - radius,
            edge * float(y) / float(sdf.shape[1] - 1) - radius,
            edge * float(z) / float(sdf.shape[2] - 1) - radius,
        )
        most = wp.float32(0.0)
        for view in range(c2w.shape[0]):
            q = project_point(p, c2w[view], intrinsics[view]) / float(stride)
            inside = q[0] > 0.0 and q[0] < float(residual.shape[2]) and q[1] > 0.0 and q[1] < float(residual.shape[1])
            if inside and q[2] > 0.0:
                most = wp.max(most, look_up(residual, view, q[0], q[1]))
        value = wp.max(value - most, bound[x, y, z])
    lowered[x, y, z] = value
