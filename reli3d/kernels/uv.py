"""Steps of the chart atlas: connected charts, overlapping triangles, splitting by layers, outlines and packing.

Coordinates of a chart are plane units with x right and y up; packing works in cells of a few texels.  The kernels named
``*_serial_*`` run one thread: they are sequential by nature (union-find, region growing, greedy packing) and linear.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})


@wp.func
def root_of(parent: wp.array(dtype=wp.int32), i: int) -> int:
    """Smallest member of the set of ``i``; halves the path on its way."""
    r = int(i)
    while parent[r] != r:
        parent[r] = parent[parent[r]]
        r = parent[r]
    return r


@wp.kernel
def components_serial_kernel(
    start: int,
    # in
    neighbours: wp.array2d(dtype=wp.int32), group: wp.array(dtype=wp.int32), count: int,
    # out
    parent: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Faces joined across an edge where both have the same ``group``; ``parent`` becomes the smallest face of each set."""
    for i in range(count):
        parent[i] = i
    for i in range(count):
        for k in range(3):
            j = neighbours[i, k]
            if j > i:
                if group[j] == group[i]:
                    a = root_of(parent, i)
                    b = root_of(parent, j)
                    if a < b:
                        parent[b] = a
                    elif b < a:
                        parent[a] = b
    for i in range(count):  # every parent is smaller and already final
        parent[i] = parent[parent[i]]


@wp.func
def side(a: wp.vec2, b: wp.vec2, p: wp.vec2) -> float:
    """Distance of ``p`` to the right of the line from ``a`` to ``b``; positive is outside of a counter-clockwise triangle."""
    e = b - a
    return ((p[0] - a[0]) * e[1] - (p[1] - a[1]) * e[0]) / wp.max(wp.length(e), 1.0e-20)


@wp.func
def separates(a: wp.vec2, b: wp.vec2, p: wp.vec2, q: wp.vec2, r: wp.vec2, slack: float) -> bool:
    """True if the triangle ``p q r`` lies right of the line ``a b``, up to ``slack``."""
    return wp.min(side(a, b, p), wp.min(side(a, b, q), side(a, b, r))) >= -slack


@wp.func
def overlap(corners: wp.array2d(dtype=wp.vec2), i: int, j: int, slack: float) -> bool:
    """True if two counter-clockwise triangles share more than a strip of width ``slack`` (separating axes)."""
    a0 = corners[i, 0]
    a1 = corners[i, 1]
    a2 = corners[i, 2]
    b0 = corners[j, 0]
    b1 = corners[j, 1]
    b2 = corners[j, 2]
    if separates(a0, a1, b0, b1, b2, slack):
        return False
    if separates(a1, a2, b0, b1, b2, slack):
        return False
    if separates(a2, a0, b0, b1, b2, slack):
        return False
    if separates(b0, b1, a0, a1, a2, slack):
        return False
    if separates(b1, b2, a0, a1, a2, slack):
        return False
    return not separates(b2, b0, a0, a1, a2, slack)


@wp.kernel
def overlaps_kernel(
    start: int,
    # in
    bvh: wp.uint64, lower: wp.array(dtype=wp.vec3), upper: wp.array(dtype=wp.vec3), corners: wp.array2d(dtype=wp.vec2),
    chart: wp.array(dtype=wp.int32), slack: float, offset: wp.array(dtype=wp.int64), emit: int,
    # out
    count: wp.array(dtype=wp.int32), partner: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Count (``emit`` 0) or list (1, from ``offset[i]``) the faces of the same chart that overlap face ``i``.

    ``bvh`` holds the boxes of the faces with the chart number as z, so that charts never meet.
    """
    i = start + wp.tid()
    if emit == 1 and count[i] == 0:
        return
    found = int(0)
    query = wp.bvh_query_aabb(bvh, lower[i], upper[i])
    j = int(0)
    while wp.bvh_query_next(query, j):
        if j != i and chart[j] == chart[i] and chart[i] >= 0:
            if overlap(corners, i, j, slack):
                if emit == 1:
                    partner[int(offset[i]) + found] = j
                found += 1
    if emit == 0:
        count[i] = found


@wp.kernel
def split_serial_kernel(
    start: int,
    # in
    neighbours: wp.array2d(dtype=wp.int32), chart: wp.array(dtype=wp.int32), seeds: wp.array(dtype=wp.int32),
    offset: wp.array(dtype=wp.int64), count: wp.array(dtype=wp.int32), partner: wp.array(dtype=wp.int32), first: int,
    # scratch
    queue: wp.array(dtype=wp.int32),
    # out
    owner: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Grow connected charts without overlap, breadth first, from ``seeds`` in order; they are numbered from ``first``.

    ``owner`` is -1 for the faces to share out.  A face joins unless one of its overlap partners is in the same new chart.
    """
    current = int(first)
    for s in range(seeds.shape[0]):
        if owner[seeds[s]] < 0:
            queue[0] = seeds[s]
            head = int(0)
            tail = int(1)
            while head < tail:
                f = queue[head]
                head += 1
                if owner[f] < 0:
                    free = int(1)
                    for k in range(count[f]):
                        if owner[partner[int(offset[f]) + k]] == current:
                            free = 0
                    if free == 1:
                        owner[f] = current
                        for k in range(3):
                            g = neighbours[f, k]
                            if g >= 0:
                                if owner[g] < 0 and chart[g] == chart[f]:
                                    queue[tail] = g
                                    tail += 1
            current += 1


@wp.kernel
def outline_kernel(
    start: int,
    # in
    edge_start: wp.array(dtype=wp.int32), edges: wp.array2d(dtype=wp.vec2), column_start: wp.array(dtype=wp.int32),
    scale: float, margin: float,
    # out
    bottom: wp.array(dtype=wp.int32), top: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Lowest and highest cell that chart ``i`` or its margin touches in each of its columns.

    Its border ``edges`` have minimum 0 on both axes; ``scale`` takes them to cells, ``margin`` [cells] is kept on every side.
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
        slope = (q[1] - p[1]) / wp.max(q[0] - p[0], 1.0e-6)
        first = wp.max(int(wp.floor(p[0] - margin)), 0)
        last = wp.min(int(wp.floor(q[0] + margin)), width - 1)
        for c in range(first, last + 1):
            # part of the segment within the margin of this column
            x0 = wp.clamp(float(c) - margin, p[0], q[0])
            x1 = wp.clamp(float(c + 1) + margin, p[0], q[0])
            y0 = p[1] + slope * (x0 - p[0])
            y1 = p[1] + slope * (x1 - p[0])
            if q[0] - p[0] < 1.0e-6:
                y0 = p[1]
                y1 = q[1]
            bottom[base + c] = wp.min(bottom[base + c], int(wp.floor(wp.min(y0, y1) - margin)))
            top[base + c] = wp.max(top[base + c], int(wp.ceil(wp.max(y0, y1) + margin)))


@wp.kernel
def pack_serial_kernel(
    start: int,
    # in
    order: wp.array(dtype=wp.int32), column_start: wp.array(dtype=wp.int32), bottom: wp.array(dtype=wp.int32),
    top: wp.array(dtype=wp.int32), floor_height: int,
    # scratch
    horizon: wp.array(dtype=wp.int32),
    # out
    place: wp.array2d(dtype=wp.int32), height: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Drop charts one after the other onto the horizon, each where it comes to rest lowest; leftmost among equals.

    Levy et al. 2002 (Least squares conformal maps), section 4.2, with the resting height instead of the lost area.
    ``height`` is the final highest cell, 2^30 if a chart is wider than the horizon.
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
        best = int(1 << 30)
        best_x = int(0)
        for x in range(size - width + 1):
            y = int(0)
            c = int(0)
            while c < width:
                y = wp.max(y, horizon[x + c] - bottom[base + c])
                c += 1
                if y >= best:
                    c = width
            if y < best:
                best = y
                best_x = x
        place[i, 0] = best_x
        place[i, 1] = best
        for c in range(width):
            t = best + top[base + c]
            horizon[best_x + c] = wp.max(horizon[best_x + c], t)
            highest = wp.max(highest, t)
    height[0] = highest
