"""Steps of the chart atlas: straight cuts, overlapping triangles, splitting by layers, packing.

Coordinates of a chart are plane units with x right and y up; packing works in cells of a few texels.  The kernels named
``*_serial_*`` run one thread: they are sequential by nature (union-find, region growing, greedy packing) and linear.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

DIRECTIONS = wp.constant(8)  # of a straight cut, in [0, 180) degrees

vec8d = wp.types.vector(length=8, dtype=wp.float64)


@wp.func
def side(a: wp.vec2, b: wp.vec2, p: wp.vec2) -> float:
    """Distance of ``p`` to the right of the line from ``a`` to ``b``: outside of a counter-clockwise triangle."""
    e = b - a
    return ((p[0] - a[0]) * e[1] - (p[1] - a[1]) * e[0]) / wp.max(wp.length(e), 1.0e-20)


@wp.func
def separates(a: wp.vec2, b: wp.vec2, p: wp.vec2, q: wp.vec2, r: wp.vec2, slack: float) -> bool:
    """True if the triangle ``p q r`` is right of the line ``a b``, up to ``slack``."""
    return wp.min(side(a, b, p), wp.min(side(a, b, q), side(a, b, r))) >= -slack


@wp.func
def overlap(corners: wp.array2d[wp.vec2], i: int, j: int, slack: float) -> bool:
    """True if two counter-clockwise triangles overlap by more than ``slack`` (separating axes)."""
    a0 = corners[i, 0]
    a1 = corners[i, 1]
    a2 = corners[i, 2]
    b0 = corners[j, 0]
    b1 = corners[j, 1]
    b2 = corners[j, 2]
    if separates(a0, a1, b0, b1, b2, slack) or separates(b0, b1, a0, a1, a2, slack):
        return False
    if separates(a1, a2, b0, b1, b2, slack) or separates(b1, b2, a0, a1, a2, slack):
        return False
    return not (separates(a2, a0, b0, b1, b2, slack) or separates(b2, b0, a0, a1, a2, slack))


@wp.kernel
def overlaps_kernel(
    start: int,
    bvh: wp.uint64, boxes: wp.array[wp.int32], query: wp.array[wp.int32],
    corners: wp.array2d[wp.vec2], chart: wp.array[wp.int32], slack: float,
    offset: wp.array[wp.int64], emit: int,
    count: wp.array[wp.int32], partner: wp.array[wp.int32],  # out
):  # fmt: skip
    """Count (``emit`` 0) or list (1, from ``offset[i]``) the faces of the same chart that overlap face ``query[i]``.

    ``bvh`` holds the boxes of the faces ``boxes`` with the chart number as z, so that charts never meet.
    """
    i = start + wp.tid()
    if emit == 1 and count[i] == 0:
        return
    f = query[i]
    found = wp.int32(0)
    if chart[f] >= 0:
        low = wp.min(corners[f, 0], wp.min(corners[f, 1], corners[f, 2]))
        high = wp.max(corners[f, 0], wp.max(corners[f, 1], corners[f, 2]))
        z = float(chart[f])
        search = wp.bvh_query_aabb(bvh, wp.vec3(low[0], low[1], z), wp.vec3(high[0], high[1], z))
        b = wp.int32(0)
        while wp.bvh_query_next(search, b):
            g = boxes[b]
            if g != f and chart[g] == chart[f] and overlap(corners, f, g, slack):
                if emit == 1:
                    partner[int(offset[i]) + found] = g
                found += 1
    if emit == 0:
        count[i] = found


@wp.kernel
def split_serial_kernel(
    start: int,
    neighbors: wp.array2d[wp.int32], chart: wp.array[wp.int32], seeds: wp.array[wp.int32],
    offset: wp.array[wp.int64], count: wp.array[wp.int32], partner: wp.array[wp.int32], first: int,
    # scratch
    queue: wp.array[wp.int32],
    owner: wp.array[wp.int32],  # out
):  # fmt: skip
    """Grow connected charts without overlap, breadth first, from ``seeds`` in order; they are numbered from ``first``.

    ``owner`` is -1 for unassigned faces.  A face joins unless one of its overlap partners is in the same new
    chart.
    """
    current = int(first)
    for s in range(seeds.shape[0]):
        if owner[seeds[s]] < 0:
            queue[0] = seeds[s]
            head = wp.int32(0)
            tail = wp.int32(1)
            while head < tail:
                f = queue[head]
                head += 1
                if owner[f] < 0:
                    free = wp.int32(1)
                    for k in range(count[f]):
                        if owner[partner[int(offset[f]) + k]] == current:
                            free = 0
                    if free == 1:
                        owner[f] = current
                        for k in range(3):
                            g = neighbors[f, k]
                            if g >= 0 and owner[g] < 0 and chart[g] == chart[f]:
                                queue[tail] = g
                                tail += 1
            current += 1


@wp.kernel
def outline_kernel(
    start: int,
    edge_start: wp.array[wp.int32], edges: wp.array2d[wp.vec2], column_start: wp.array[wp.int32],
    scale: float, margin: float,
    bottom: wp.array[wp.int32], top: wp.array[wp.int32],  # out
):  # fmt: skip
    """Lowest and highest cell that chart ``i`` or its margin touches in each of its columns.

    Its border ``edges`` have minimum 0 on both axes; ``scale`` takes them to cells, ``margin`` [cells] is kept on every
    side.
    """
    i = start + wp.tid()
    base = column_start[i]
    width = column_start[i + 1] - base
    for c in range(width):
        bottom[base + c] = 1 << 30
        top[base + c] = 0
    for e in range(edge_start[i], edge_start[i + 1]):
        p = edges[e, 0] * scale + wp.vec2(margin, margin)
        q = edges[e, 1] * scale + wp.vec2(margin, margin)
        if p[0] > q[0]:
            t = p
            p = q
            q = t
        gradient = (q[1] - p[1]) / wp.max(q[0] - p[0], 1.0e-6)
        first = wp.max(int(wp.floor(p[0] - margin)), 0)
        last = wp.min(int(wp.floor(q[0] + margin)), width - 1)
        for c in range(first, last + 1):
            # part of the segment within the margin of this column
            x0 = wp.clamp(float(c) - margin, p[0], q[0])
            x1 = wp.clamp(float(c + 1) + margin, p[0], q[0])
            y0 = p[1] + gradient * (x0 - p[0])
            y1 = p[1] + gradient * (x1 - p[0])
            if q[0] - p[0] < 1.0e-6:
                y0 = p[1]
                y1 = q[1]
            bottom[base + c] = wp.min(bottom[base + c], int(wp.floor(wp.min(y0, y1) - margin)))
            top[base + c] = wp.max(top[base + c], int(wp.ceil(wp.max(y0, y1) + margin)))


@wp.kernel
def pack_serial_kernel(
    start: int,
    order: wp.array[wp.int32], column_start: wp.array[wp.int32], bottom: wp.array[wp.int32],
    top: wp.array[wp.int32], floor_height: int,
    # scratch
    horizon: wp.array[wp.int32],
    place: wp.array2d[wp.int32], height: wp.array[wp.int32],  # out
):  # fmt: skip
    """Drop charts one after the other onto the horizon, each where it comes to rest lowest; leftmost among equals.

    Levy et al. 2002 (Least squares conformal maps), section 4.2, with the resting height instead of the lost area, and
    each chart also turned by 180 degrees.  ``place``: x, y, 1 if turned, height of the chart.  ``height``: highest
    cell, 2^30 if a chart is wider than the horizon.
    """
    size = horizon.shape[0]
    for x in range(size):
        horizon[x] = floor_height
    highest = int(floor_height)
    for s in range(order.shape[0]):
        i = order[s]
        base = column_start[i]
        width = column_start[i + 1] - base
        if width > size:
            height[0] = 1 << 30
            return
        tall = wp.int32(0)
        for c in range(width):
            tall = wp.max(tall, top[base + c])
        best = int(1 << 30)
        best_x = wp.int32(0)
        turned = wp.int32(0)
        for x in range(size - width + 1):
            for turn in range(2):
                y = wp.int32(0)
                c = wp.int32(0)
                while c < width and y < best:
                    if turn == 0:
                        y = wp.max(y, horizon[x + c] - bottom[base + c])
                    else:
                        y = wp.max(y, horizon[x + c] - (tall - top[base + width - 1 - c]))
                    c += 1
                if y < best:
                    best = y
                    best_x = x
                    turned = turn
        place[i, 0] = best_x
        place[i, 1] = best
        place[i, 2] = turned
        place[i, 3] = tall
        for c in range(width):
            t = wp.where(turned == 1, tall - bottom[base + width - 1 - c], top[base + c])
            horizon[best_x + c] = wp.max(horizon[best_x + c], best + t)
            highest = wp.max(highest, best + t)
    height[0] = highest


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
    along: wp.array[vec8d],  # (P,) border points of the charts, one chart after the other, along the directions
    begin: wp.array[wp.int32],  # (C + 1,) of the charts' points
    at: wp.array3d[wp.float64],  # out: (C, 8, 2) places of the cuts across a direction: the middle, the points' mean
    area: wp.array3d[wp.float64],  # out: (C, 8, 2) of the smallest boxes of both pieces
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
