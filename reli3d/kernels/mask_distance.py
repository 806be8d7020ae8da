"""Signed distance of pixels to a mask's contour.

Pixel (row y, column x) has its centre at (x + 0.5, y + 0.5).  The contour is where the mask, bilinear between pixel
centres, is 0.5: in a *cell* of four neighbouring centres one or two segments (marching squares).  Cell (y, x) has the
pixels (y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1); there are (H - 1) * (W - 1).
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

NEVER = wp.constant(65536.0)  # rows to a crossing where a column has none: beyond any image
NEAR = wp.constant(4.0)  # pixels; beyond, other segments are at most sqrt(16.5) - 4 = 0.06 pixels nearer
FAR = wp.constant(16.0)  # pixels; beyond, the end of a segment is at most 0.25 / 16 pixels farther than the segment


@wp.func
def crosses(mask: wp.array3d[float], view: int, y: int, x: int) -> bool:
    """Whether the contour runs through a cell."""
    count = wp.int32(0)
    for k in range(4):
        if mask[view, y + k // 2, x + k % 2] >= 0.5:
            count += 1
    return count > 0 and count < 4


@wp.func
def squared_to_segment(p: wp.vec2, a: wp.vec2, b: wp.vec2) -> float:
    ab = b - a
    t = wp.clamp(wp.dot(p - a, ab) / wp.max(wp.dot(ab, ab), 1.0e-12), 0.0, 1.0)
    away = p - a - ab * t
    return wp.dot(away, away)


@wp.func
def crossing(a: float, b: float) -> float:
    """Where between 0 and 1 a value that runs from ``a`` to ``b`` is 0.5."""
    return wp.clamp((0.5 - a) / (b - a), 0.0, 1.0)


@wp.func
def squared_to_contour(mask: wp.array3d[float], view: int, y: int, x: int, p: wp.vec2) -> float:
    """Squared distance of ``p`` (column, row in pixel centres) to the contour inside cell (y, x), which it crosses."""
    m00 = mask[view, y, x]
    m01 = mask[view, y, x + 1]
    m10 = mask[view, y + 1, x]
    m11 = mask[view, y + 1, x + 1]
    q = p - wp.vec2(float(x), float(y))
    top = (m00 >= 0.5) != (m01 >= 0.5)
    bottom = (m10 >= 0.5) != (m11 >= 0.5)
    left = (m00 >= 0.5) != (m10 >= 0.5)
    right = (m01 >= 0.5) != (m11 >= 0.5)
    t = wp.vec2()
    b = wp.vec2()
    l = wp.vec2()
    r = wp.vec2()
    if top:
        t = wp.vec2(crossing(m00, m01), 0.0)
    if bottom:
        b = wp.vec2(crossing(m10, m11), 1.0)
    if left:
        l = wp.vec2(0.0, crossing(m00, m10))
    if right:
        r = wp.vec2(1.0, crossing(m01, m11))
    if top and bottom and left and right:
        # saddle: the corners with the sign of the centre are joined, the other two are cut off
        if (0.25 * (m00 + m01 + m10 + m11) >= 0.5) == (m00 >= 0.5):
            return wp.min(squared_to_segment(q, t, r), squared_to_segment(q, l, b))
        return wp.min(squared_to_segment(q, t, l), squared_to_segment(q, r, b))
    one = t
    other = b
    if left and top:
        other = l
    if right and top:
        other = r
    if left and bottom:
        one = l
    if right and bottom:
        one = r
    if left and right:
        one = l
        other = r
    return squared_to_segment(q, one, other)


@wp.kernel
def column_kernel(
    start: int,
    # in
    mask: wp.array3d[float],
    # out
    row: wp.array3d[float],
):
    """Row of the nearest crossing of the contour with a pixel's column, ``NEVER`` away without one; a thread is a
    column."""
    i = start + wp.tid()
    height = mask.shape[1]
    width = mask.shape[2]
    view = i // width
    x = i % width
    last = wp.float32(-NEVER)
    for y in range(height):
        row[view, y, x] = last
        if y + 1 < height:
            a = mask[view, y, x]
            b = mask[view, y + 1, x]
            if (a >= 0.5) != (b >= 0.5):
                last = float(y) + crossing(a, b)
    last = wp.float32(2.0 * NEVER)
    for k in range(height):
        y = height - 1 - k
        if y + 1 < height:
            a = mask[view, y, x]
            b = mask[view, y + 1, x]
            if (a >= 0.5) != (b >= 0.5):
                last = float(y) + crossing(a, b)
        if last - float(y) < float(y) - row[view, y, x]:
            row[view, y, x] = last


@wp.kernel
def row_kernel(
    start: int,
    # in
    row: wp.array3d[float],
    # scratch
    apex: wp.array3d[wp.int32],
    begin: wp.array3d[float],
    # out
    nearest: wp.array3d[wp.int32],
):
    """Column whose crossing, at its ``row``, is the nearest one of all columns; -1 without any.  A thread is a row.

    Lower envelope of parabolas, Felzenszwalb and Huttenlocher 2012, Distance Transforms of Sampled Functions.
    """
    i = start + wp.tid()
    height = row.shape[1]
    width = row.shape[2]
    view = i // height
    y = i % height
    top = wp.int32(-1)
    for x in range(width):
        dy = row[view, y, x] - float(y)
        if wp.abs(dy) < 0.5 * NEVER:
            height_x = dy * dy + float(x * x)
            at = wp.float32(-1.0e9)
            search = top >= 0
            while search:
                other = apex[view, y, top]
                dy = row[view, y, other] - float(y)
                at = (height_x - (dy * dy + float(other * other))) / float(2 * (x - other))
                if at > begin[view, y, top]:
                    search = False
                else:
                    top -= 1
                    if top < 0:
                        at = -1.0e9
                        search = False
            top += 1
            apex[view, y, top] = x
            begin[view, y, top] = at
    k = wp.int32(0)
    for x in range(width):
        while k < top and begin[view, y, k + 1] < float(x):
            k += 1
        if top < 0:
            nearest[view, y, x] = -1
        else:
            nearest[view, y, x] = apex[view, y, k]


@wp.kernel
def mask_distance_kernel(
    start: int,
    # in
    mask: wp.array3d[float],
    row: wp.array3d[float],
    nearest_x: wp.array3d[wp.int32],
    column: wp.array3d[float],
    nearest_y: wp.array3d[wp.int32],
    far: float,
    # out
    distance: wp.array3d[float],
):
    """Signed distance to the contour, ``far`` without one.

    The nearest crossing with any column (``row``, ``nearest_x``) or row (``column``, ``nearest_y``, both transposed)
    is an end of a segment; measured are the segments of the cells beside it, and of their neighbours where it is
    near.
    """
    i = start + wp.tid()
    height = mask.shape[1]
    width = mask.shape[2]
    view = i // (height * width)
    y = (i // width) % height
    x = i % width
    p = wp.vec2(float(x), float(y))
    best = far * far
    cell_x = wp.int32(-9)
    cell_y = wp.int32(-9)
    near_x = nearest_x[view, y, x]
    near_y = nearest_y[view, x, y]
    if near_x >= 0:
        at = wp.vec2(float(near_x), row[view, y, near_x])
        cell_x = near_x
        cell_y = int(at[1])
        best = wp.length_sq(at - p)
    if near_y >= 0:
        at = wp.vec2(column[view, x, near_y], float(near_y))
        if wp.length_sq(at - p) < best:
            cell_x = int(at[0])
            cell_y = near_y
            best = wp.length_sq(at - p)
    reach = wp.int32(1)  # the cell's lower neighbours, which share the crossing
    if best < NEAR * NEAR:
        reach = 2
    if best > FAR * FAR:
        reach = -1  # no cell
    for v in range(cell_y - 1, cell_y + reach):
        for u in range(cell_x - 1, cell_x + reach):
            inner = v >= 0 and v < height - 1 and u >= 0 and u < width - 1
            if inner and crosses(mask, view, v, u):
                best = wp.min(best, squared_to_contour(mask, view, v, u, p))
    if mask[view, y, x] >= 0.5:
        distance[view, y, x] = wp.sqrt(best)
    else:
        distance[view, y, x] = -wp.sqrt(best)
