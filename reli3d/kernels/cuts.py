"""Straight cuts of charts: what the boxes of the two pieces would measure."""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

DIRECTIONS = wp.constant(8)  # in [0, 180) degrees

vec8d = wp.types.vector(length=8, dtype=wp.float64)


@wp.func
def smallest_box(extent: vec8d) -> wp.float64:
    """Least area of a box along one of the directions and the one at a right angle to it."""
    least = extent[0] * extent[4]
    for k in range(1, 4):
        least = wp.min(least, extent[k] * extent[k + 4])
    return least


@wp.kernel
def cuts_kernel(
    start: int,
    # in
    along: wp.array[vec8d],  # (P,) border points of the charts, one chart after the other, along the directions
    begin: wp.array[wp.int32],  # (C + 1,) of the charts' points
    # out
    at: wp.array3d[wp.float64],  # (C, 8, 2) places of the cuts across a direction: the middle, and the points' mean
    area: wp.array3d[wp.float64],  # (C, 8, 2) of the smallest boxes of both pieces
):
    i = start + wp.tid()
    kind = i % 2
    k = i // 2 % DIRECTIONS
    chart = i // (2 * DIRECTIONS)
    first = begin[chart]
    low = along[first][k]
    high = low
    total = wp.float64(0.0)
    for p in range(first, begin[chart + 1]):
        value = along[p][k]
        low = wp.min(low, value)
        high = wp.max(high, value)
        total += value
    place = wp.float64(0.5) * (high + low)
    if kind == 1:
        place = total / wp.float64(begin[chart + 1] - first)
    never = wp.float64(1.0e300)
    low0 = vec8d(never)
    low1 = vec8d(never)
    high0 = vec8d(-never)
    high1 = vec8d(-never)
    for p in range(first, begin[chart + 1]):
        v = along[p]
        if v[k] > place:
            low1 = wp.min(low1, v)
            high1 = wp.max(high1, v)
        else:
            low0 = wp.min(low0, v)
            high0 = wp.max(high0, v)
    both = wp.float64(0.0)
    if low0[0] < never:
        both += smallest_box(high0 - low0)
    if low1[0] < never:
        both += smallest_box(high1 - low1)
    at[chart, k, kind] = place
    area[chart, k, kind] = both
