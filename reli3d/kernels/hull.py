"""Signed distance of pixels to a mask's contour, and of points to the visual hull of several masks.

Pixel (row y, column x) has its center at (x + 0.5, y + 0.5).  The contour is where the mask, bilinear between pixel
centers, is 0.5: in a *cell* of four neighboring centers one or two segments (marching squares).  Cell (y, x) has the
pixels (y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1); there are (H - 1) * (W - 1).
"""

import warp as wp

from reli3d.kernels.bilinear import look_up
from reli3d.kernels.envelope import NO_SITE_ROWS, lower_envelope
from reli3d.kernels.projection import project_point

wp.set_module_options(
    # functions that several kernels call: a call copies the arrays' shapes and strides
    {"enable_backward": False, "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=5000"}
)

BEHIND = wp.constant(-1.0e3)  # world units: distance of a point behind a camera, below any other
REACHED = wp.constant(1.0e-3)  # world units: a ray this close to the hull has hit it
STEP_FACTOR = wp.constant(0.7)  # of sphere tracing, because distances are up to 1 / cos^2 of an angle too long
STEP_MIN = wp.constant(4.0e-3)  # world units: thinner parts of the hull may be missed
STEP_MAX = wp.constant(0.25)
LEAST_STEP = wp.constant(1.0e-6)  # of the distance from the camera: smaller steps are lost in float32
DEPTH_MIN = wp.constant(1.0e-4)  # world units: points closer to a camera's plane count as behind it
EXACT_PIXELS = wp.constant(4.0)  # beyond, other segments are at most sqrt(16.5) - 4 = 0.06 pixels nearer
SEGMENT_PIXELS = wp.constant(16.0)  # beyond, the end of a segment is at most 0.25 / 16 pixels farther than the segment


@wp.struct
class Views:
    """Silhouette distances ``(V, H, W)`` and the cameras of the V views."""

    distance: wp.array3d[float]
    c2w: wp.array[wp.mat44]
    intrinsics: wp.array[wp.vec4]


@wp.func
def distance_in_view(point: wp.vec3, view: int, views: Views) -> float:
    """Silhouette distance where a point projects, times the size of a pixel at its depth."""
    k = views.intrinsics[view]
    q = project_point(point, views.c2w[view], k)
    if q[2] > DEPTH_MIN:  # False for NaN too
        return look_up(views.distance, view, q[0], q[1]) * q[2] * 2.0 / (k[0] + k[1])
    return BEHIND


@wp.func
def distance_to_hull(point: wp.vec3, views: Views, far: float) -> float:
    """Minimum of :func:`distance_in_view` over the views; stops at the first view below ``-far``."""
    best = wp.float32(-BEHIND)
    view = wp.int32(0)
    while view < views.c2w.shape[0] and best >= -far:
        best = wp.min(best, distance_in_view(point, view, views))
        view += 1
    return best


@wp.kernel
def hull_distance_kernel(
    start: int,
    points: wp.array[wp.vec3],
    views: Views,
    far: float,
    hull: wp.array[float],  # out
):
    i = start + wp.tid()
    hull[i] = distance_to_hull(points[i], views, far)


@wp.kernel
def mirror_residual_kernel(
    start: int,
    points: wp.array2d[wp.vec3],  # (R, D) along rays
    known: wp.array2d[bool],  # (R, D) whether the point is in the hull
    normal: wp.array[wp.vec3],  # (P,) of planes, unit
    offset: wp.array[float],  # (P,)
    most: float,
    views: Views,
    residual: wp.array2d[float],  # out: (P, R)
):
    """Least distance outside the hull of the mirror images of a ray's known points, at most ``most``."""
    i = start + wp.tid()
    plane = i // points.shape[0]
    ray = i % points.shape[0]
    n = normal[plane]
    best = wp.float32(-most)
    k = wp.int32(0)
    while k < points.shape[1] and best < 0.0:
        if known[ray, k]:
            p = points[ray, k]
            mirrored = p - 2.0 * (wp.dot(n, p) - offset[plane]) * n
            best = wp.max(best, distance_to_hull(mirrored, views, -best))
        k += 1
    residual[plane, ray] = wp.max(-best, 0.0)


@wp.func
def march(o: wp.vec3, d: wp.vec3, begin: float, end: float, least_step: float, views: Views):
    """Whether sphere tracing of ``o + t d`` from ``begin`` to ``end`` hits the hull, and t there or closest to it."""
    sign = wp.where(end < begin, -1.0, 1.0)
    unit = 1.0 / wp.length(d)
    t = wp.float32(begin)
    nearest = wp.float32(begin)
    best = wp.float32(BEHIND)
    while sign * (end - t) >= 0.0 and best < -REACHED:
        h = distance_to_hull(o + d * t, views, -BEHIND)
        if h > best:
            best = h
            nearest = t
        t += sign * wp.max(wp.clamp(-h * STEP_FACTOR, STEP_MIN, STEP_MAX) * unit, least_step)
    return best >= -REACHED, nearest


@wp.kernel
def hull_span_kernel(
    start: int,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    radius: float,
    views: Views,
    span: wp.array[wp.vec2],  # out
):
    """Sphere tracing from both ends of a ray's chord in the sphere of ``radius`` around the origin."""
    i = start + wp.tid()
    o = origins[i]
    d = directions[i]
    a = wp.dot(d, d)
    b = wp.dot(o, d)
    half = wp.sqrt(wp.max(b * b - a * (wp.dot(o, o) - radius * radius), 0.0)) / a
    low = -b / a - half
    high = -b / a + half
    hit, first = march(o, d, low, high, LEAST_STEP * high, views)
    last = wp.float32(first)  # of a ray that misses the hull both are its closest approach
    if hit:
        again, back = march(o, d, high, first, LEAST_STEP * high, views)
        if again:
            last = back
    span[i] = wp.vec2(first, last)


@wp.func
def squared_to_segment(p: wp.vec2, a: wp.vec2, b: wp.vec2) -> float:
    ab = b - a
    t = wp.clamp(wp.dot(p - a, ab) / wp.max(wp.dot(ab, ab), 1.0e-12), 0.0, 1.0)
    away = p - a - ab * t
    return wp.dot(away, away)


@wp.func
def crossing(a: float, b: float) -> float:
    """Parameter in [0, 1] at which linear interpolation from ``a`` to ``b`` is 0.5."""
    return wp.clamp((0.5 - a) / (b - a), 0.0, 1.0)


@wp.func
def squared_to_contour(mask: wp.array3d[float], view: int, y: int, x: int, p: wp.vec2) -> float:
    """Squared distance of ``p`` (column, row in pixel centers) to the contour inside cell (y, x); inf without any."""
    m00 = mask[view, y, x]
    m01 = mask[view, y, x + 1]
    m10 = mask[view, y + 1, x]
    m11 = mask[view, y + 1, x + 1]
    q = p - wp.vec2(float(x), float(y))
    top = (m00 >= 0.5) != (m01 >= 0.5)
    bottom = (m10 >= 0.5) != (m11 >= 0.5)
    left = (m00 >= 0.5) != (m10 >= 0.5)
    right = (m01 >= 0.5) != (m11 >= 0.5)
    if not (top or bottom or left or right):
        return wp.inf
    t = wp.vec2(crossing(m00, m01), 0.0)  # undefined and unused where the contour does not cross a side
    b = wp.vec2(crossing(m10, m11), 1.0)
    l = wp.vec2(0.0, crossing(m00, m10))
    r = wp.vec2(1.0, crossing(m01, m11))
    if top and bottom and left and right:
        # saddle: the corners with the sign of the center are joined, the other two are cut off
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
    mask: wp.array3d[float],
    row: wp.array3d[float],  # out
):
    """Row of the nearest contour crossing in a pixel's column; ``NO_SITE_ROWS`` away if there is none.

    One thread per column.
    """
    i = start + wp.tid()
    height = mask.shape[1]
    width = mask.shape[2]
    view = i // width
    x = i % width
    last = wp.float32(-NO_SITE_ROWS)
    for y in range(height):
        row[view, y, x] = last
        if y + 1 < height:
            a = mask[view, y, x]
            b = mask[view, y + 1, x]
            if (a >= 0.5) != (b >= 0.5):
                last = float(y) + crossing(a, b)
    last = wp.float32(2.0 * NO_SITE_ROWS)
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
    row: wp.array3d[float],
    # scratch
    apex: wp.array3d[wp.int32],
    begin: wp.array3d[float],
    nearest: wp.array3d[wp.int32],  # out
):
    """Column of the nearest crossing, given the nearest one of each column in ``row``; -1 without any.  One thread per
    row.
    """
    i = start + wp.tid()
    view = i // row.shape[1]
    y = i % row.shape[1]
    top = lower_envelope(row[view, y], y, apex[view, y], begin[view, y])
    k = wp.int32(0)
    for x in range(row.shape[2]):
        while k < top and begin[view, y, k + 1] < float(x):
            k += 1
        nearest[view, y, x] = wp.where(top < 0, -1, apex[view, y, k])


@wp.kernel
def mask_distance_kernel(
    start: int,
    mask: wp.array3d[float],
    row: wp.array3d[float],
    nearest_x: wp.array3d[wp.int32],
    column: wp.array3d[float],
    nearest_y: wp.array3d[wp.int32],
    far: float,
    distance: wp.array3d[float],  # out
):
    """Signed distance to the contour, ``far`` without one.

    The nearest crossing with any column (``row``, ``nearest_x``) or row (``column``, ``nearest_y``, both transposed) is
    an end of a segment.  The distance is evaluated to the segments of the two cells at that crossing, and also to those
    of their neighbors if it is closer than EXACT_PIXELS.
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
    neighbors = wp.int32(1)  # the cell's lower neighbors, which have the same crossing
    if best < EXACT_PIXELS * EXACT_PIXELS:
        neighbors = 2
    if best > SEGMENT_PIXELS * SEGMENT_PIXELS:
        neighbors = -1  # no cell
    for v in range(cell_y - 1, cell_y + neighbors):
        for u in range(cell_x - 1, cell_x + neighbors):
            if v >= 0 and v < height - 1 and u >= 0 and u < width - 1:
                best = wp.min(best, squared_to_contour(mask, view, v, u, p))
    distance[view, y, x] = wp.where(mask[view, y, x] >= 0.5, wp.sqrt(best), -wp.sqrt(best))
