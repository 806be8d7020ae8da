"""Ray marching through an occupancy grid and compositing of its samples, forward and adjoint.

The grid fills the cube [-radius, radius]^3 with R^3 cells, index (x, y, z).  Samples lie at the midpoints of equal
steps from the ray's entry into the cube, shifted by a fraction of a step; those in occupied cells are kept.  One thread
per ray; its samples are contiguous, ``first[i]`` to ``first[i + 1]``.

Transmittance is ``T = exp(-sum)`` of the accumulated optical depth.  The adjoint is analytic.
"""

import warp as wp

from reli3d.kernels.math import MIN_DIRECTION, cube_range

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

STEPS_MAX = wp.constant(1 << 24)  # float32 counts steps exactly up to here
MAX_OPTICAL_DEPTH = wp.constant(80.0)  # optical depth at which marching ends: exp(-80) is 2e-35


@wp.func
def cell_of(p: float, radius: float, size: int) -> int:
    """Cell of a coordinate, clamped to the grid."""
    return wp.clamp(int(wp.floor((p + radius) * (0.5 * float(size) / radius))), 0, size - 1)


@wp.func
def cell_exit(origin: wp.vec3, direction: wp.vec3, radius: float, size: int, x: int, y: int, z: int) -> float:
    """Distance at which a ray leaves a cell."""
    edge = 2.0 * radius / float(size)
    cell = wp.vec3(float(x), float(y), float(z))
    t = wp.float32(3.0e38)
    for k in range(3):
        if wp.abs(direction[k]) > MIN_DIRECTION:
            face = cell[k] + wp.where(direction[k] > 0.0, 1.0, 0.0)
            t = wp.min(t, (face * edge - radius - origin[k]) / direction[k])
    return t


@wp.func
def next_sample(
    occupied: wp.array3d[wp.uint8],
    origin: wp.vec3,
    direction: wp.vec3,
    range_: wp.vec2,
    radius: float,
    step: float,
    shift: float,
    index: int,
) -> int:
    """First step from ``index`` on with its sample in an occupied cell, or -1; empty cells are skipped entirely."""
    size = occupied.shape[0]
    k = index
    found = wp.int32(-1)
    t = range_[0] + (float(k) + shift) * step
    while found < 0 and t < range_[1] and k < STEPS_MAX:
        p = origin + direction * t
        x = cell_of(p[0], radius, size)
        y = cell_of(p[1], radius, size)
        z = cell_of(p[2], radius, size)
        if occupied[x, y, z] != wp.uint8(0):
            found = k
        else:
            leave = cell_exit(origin, direction, radius, size, x, y, z)
            ahead = wp.min((leave - range_[0]) / step - shift, 2.0e7)
            # a step less than the exit, so that rounding skips no sample of the next cell
            k = wp.max(k + 1, int(wp.ceil(ahead)) - 1)
            t = range_[0] + (float(k) + shift) * step
    return found


@wp.func
def absorbed(thickness: float) -> float:
    """``1 - exp(-thickness)`` without its cancellation."""
    x = thickness
    value = x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x / 24.0)))
    if x > 0.05:  # where the series' next term, x^4 / 120, is a last digit
        value = 1.0 - wp.exp(-x)
    return value


@wp.func
def step_thickness(density: float, step: float) -> float:
    """Optical depth of one step, in [0, MAX_OPTICAL_DEPTH]."""
    return wp.clamp(density * step, 0.0, MAX_OPTICAL_DEPTH)


@wp.kernel
def samples_kernel(
    start: int,
    occupied: wp.array3d[wp.uint8],
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    shift: wp.array[float],
    radius: float,
    step: float,
    near: float,
    far: float,
    emit: int,
    first: wp.array[wp.int32],
    count: wp.array[wp.int32],  # out
    t: wp.array[float],  # out
):
    """Count (``emit`` 0) or list (1, from ``first[i]``) the samples of ray ``i``."""
    i = start + wp.tid()
    if emit == 1 and count[i] == 0:
        return
    o = origins[i]
    d = directions[i]
    s = shift[i % shift.shape[0]]
    r = cube_range(o, d, radius, near, far)
    total = wp.int32(0)
    k = next_sample(occupied, o, d, r, radius, step, s, 0)
    while k >= 0 and (emit == 0 or total < count[i]):
        if emit == 1:
            t[first[i] + total] = r[0] + (float(k) + s) * step
        total = total + 1
        k = next_sample(occupied, o, d, r, radius, step, s, k + 1)
    if emit == 0:
        count[i] = total


@wp.kernel
def composite_kernel(
    start: int,
    density: wp.array[float],
    color: wp.array[wp.vec3],
    t: wp.array[float],
    first: wp.array[wp.int32],
    step: float,
    out: wp.array[wp.vec3],  # out
    opacity: wp.array[float],  # out
    depth: wp.array[float],  # out
):
    """Emission and absorption, Max 1995: a sample counts ``T (1 - exp(-density step))`` of its color and distance."""
    i = start + wp.tid()
    thickness = wp.float32(0.0)
    total = wp.vec3(0.0, 0.0, 0.0)
    distance = wp.float32(0.0)
    k = first[i]
    while k < first[i + 1] and thickness < MAX_OPTICAL_DEPTH:
        layer = step_thickness(density[k], step)
        weight = wp.exp(-thickness) * absorbed(layer)
        total = total + color[k] * weight
        distance = distance + t[k] * weight
        thickness = thickness + layer
        k = k + 1
    out[i] = total
    opacity[i] = absorbed(thickness)
    depth[i] = distance


@wp.kernel
def composite_adjoint_kernel(
    start: int,
    density: wp.array[float],
    color: wp.array[wp.vec3],
    t: wp.array[float],
    first: wp.array[wp.int32],
    step: float,
    g_out: wp.array[wp.vec3],
    g_opacity: wp.array[float],
    g_depth: wp.array[float],
    g_density: wp.array[float],  # out
    g_color: wp.array[wp.vec3],  # out
):
    """Back to front: with e the adjoint of a sample's weight, d loss / d own thickness = T_after e - sum behind of w e.

    The thickness before a sample is the whole one less the samples; that one is below 2 MAX_OPTICAL_DEPTH, so the
    rounding of it is below 1e-5.  Samples that no light passes keep the zeros that the gradients hold before; an output
    without rows is left out.
    """
    i = start + wp.tid()
    begin = first[i]
    end = begin
    thickness = wp.float32(0.0)
    while end < first[i + 1] and thickness < MAX_OPTICAL_DEPTH:
        thickness = thickness + step_thickness(density[end], step)
        end = end + 1
    last = wp.exp(-thickness)
    behind = wp.float32(0.0)
    for j in range(begin, end):
        k = begin + end - 1 - j
        layer = step_thickness(density[k], step)
        after = wp.exp(-thickness)
        thickness = wp.max(thickness - layer, 0.0)
        weight = wp.exp(-thickness) * absorbed(layer)
        e = wp.dot(g_out[i], color[k]) + g_depth[i] * t[k]
        if g_color.shape[0] != 0:
            g_color[k] = g_out[i] * weight
        if g_density.shape[0] != 0 and density[k] > 0.0:
            g_density[k] = step * (after * e - behind + g_opacity[i] * last)
        behind = behind + weight * e
