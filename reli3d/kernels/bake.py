"""Texels of an atlas: which face covers each, attributes there, and the nearest covered texel of every other.

Texel (row y, column x) has its center at (x + 0.5, y + 0.5) in texel units, v down.  A thread owns a tile, a strip or a
row of the output and gathers, so that the result does not depend on the number of threads or the size of the tiles.
"""

import warp as wp

from reli3d.kernels.envelope import NO_SITE_ROWS, lower_envelope

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

ROUNDING = wp.constant(4.0e-7)  # relative error of a float32 cross product, twice over: neighbors leave no crack


@wp.struct
class Tiles:
    """Face corners in texel units, and for each tile ``i`` of the map the faces whose bounding boxes overlap it:
    ``face_list[face_start[i]:face_start[i + 1]]``.
    """

    corners: wp.array2d[wp.vec2]
    face_start: wp.array[wp.int32]
    face_list: wp.array[wp.int32]
    size: int  # texels along the map
    tile: int  # and along a tile


@wp.func
def cross2(a: wp.vec2, b: wp.vec2) -> float:
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def cross2_error(a: wp.vec2, b: wp.vec2) -> float:
    """Bound of the rounding of ``cross2(a, b)``."""
    return ROUNDING * (wp.abs(a[0] * b[1]) + wp.abs(a[1] * b[0]))


@wp.func
def weight_on_segment(a: wp.vec2, b: wp.vec2, p: wp.vec2) -> float:
    """Weight in [0, 1] of ``b`` at the point of the segment nearest to ``p``."""
    e = b - a
    return wp.clamp(wp.dot(p - a, e) / wp.max(wp.dot(e, e), 1.0e-20), 0.0, 1.0)


@wp.func
def tile_box(tiles: Tiles, i: int) -> wp.vec4i:
    """First column, first row, last column and last row of tile ``i``."""
    across = (tiles.size + tiles.tile - 1) // tiles.tile
    x = (i % across) * tiles.tile
    y = (i // across) * tiles.tile
    return wp.vec4i(x, y, wp.min(x + tiles.tile, tiles.size) - 1, wp.min(y + tiles.tile, tiles.size) - 1)


@wp.func
def centers(a: wp.vec2, b: wp.vec2, c: wp.vec2, box: wp.vec4i) -> wp.vec4i:
    """The part of ``box`` whose texels have their centers in the bounding box of ``a``, ``a + b`` and ``a + c``."""
    low = a + wp.min(wp.vec2(), wp.min(b, c)) - wp.vec2(0.5, 0.5)
    high = a + wp.max(wp.vec2(), wp.max(b, c)) - wp.vec2(0.5, 0.5)
    return wp.vec4i(
        wp.max(int(wp.ceil(low[0])), box[0]),
        wp.max(int(wp.ceil(low[1])), box[1]),
        wp.min(int(wp.floor(high[0])), box[2]),
        wp.min(int(wp.floor(high[1])), box[3]),
    )


@wp.kernel
def texels_kernel(
    start: int,
    tiles: Tiles,
    segment_start: wp.array[wp.int32],
    segment_list: wp.array[wp.int32],
    segments: wp.array[wp.int32],
    reach: float,
    # scratch
    distance: wp.array2d[float],
    face: wp.array2d[wp.int32],  # out
    bary: wp.array2d[wp.vec2],  # out
):
    """Fill tile ``i``: the first face over a texel's center; else the nearest border segment within ``reach`` texels.

    ``segments`` holds 3 * face + corner of each edge on a border.  ``bary`` weighs vertices 1 and 2.
    """
    i = start + wp.tid()
    box = tile_box(tiles, i)
    far = reach * reach * 1.0001 + 1.0
    for y in range(box[1], box[3] + 1):
        for x in range(box[0], box[2] + 1):
            face[y, x] = -1
            bary[y, x] = wp.vec2(0.0, 0.0)
            distance[y, x] = far
    for s in range(tiles.face_start[i], tiles.face_start[i + 1]):
        f = tiles.face_list[s]
        a = tiles.corners[f, 0]
        b = tiles.corners[f, 1] - a
        c = tiles.corners[f, 2] - a
        area = cross2(b, c)
        if area != 0.0:
            inverse = 1.0 / area
            over = centers(a, b, c, box)
            for y in range(over[1], over[3] + 1):
                for x in range(over[0], over[2] + 1):
                    if distance[y, x] > 0.0:
                        p = wp.vec2(float(x) + 0.5, float(y) + 0.5) - a
                        w1 = cross2(p, c) * inverse
                        w2 = cross2(b, p) * inverse
                        w0 = 1.0 - w1 - w2
                        slack = (cross2_error(p, c) + cross2_error(b, p)) * wp.abs(inverse)
                        if w1 >= -slack and w2 >= -slack and w0 >= -slack:
                            face[y, x] = f
                            w1 = wp.clamp(w1, 0.0, 1.0)
                            bary[y, x] = wp.vec2(w1, wp.clamp(w2, 0.0, 1.0 - w1))
                            distance[y, x] = 0.0
    for s in range(segment_start[i], segment_start[i + 1]):
        code = segments[segment_list[s]]
        f = code // 3
        k = code % 3
        a = tiles.corners[f, k]
        b = tiles.corners[f, (k + 1) % 3]
        left = wp.max(int(wp.floor(wp.min(a[0], b[0]) - 0.5 - reach)), box[0])
        right = wp.min(int(wp.ceil(wp.max(a[0], b[0]) - 0.5 + reach)), box[2])
        high = wp.max(int(wp.floor(wp.min(a[1], b[1]) - 0.5 - reach)), box[1])
        low = wp.min(int(wp.ceil(wp.max(a[1], b[1]) - 0.5 + reach)), box[3])
        for y in range(high, low + 1):
            for x in range(left, right + 1):
                if distance[y, x] > 0.0:
                    p = wp.vec2(float(x) + 0.5, float(y) + 0.5)
                    t = weight_on_segment(a, b, p)
                    d = wp.length_sq(a + t * (b - a) - p)
                    if d <= reach * reach and d < distance[y, x]:
                        # an exact 0 would lock the texel; it is on the border, any face of it will do
                        distance[y, x] = wp.max(d, 1.0e-12)
                        face[y, x] = f
                        w = wp.vec3()
                        w[k] = 1.0 - t
                        w[(k + 1) % 3] = t
                        bary[y, x] = wp.vec2(w[1], w[2])


@wp.kernel
def nearest_row_kernel(
    start: int,
    valid: wp.array2d[wp.uint8],
    strip: int,
    row: wp.array2d[wp.int32],  # out
):
    """Row of the nearest valid texel of the same column, the upper of two; ``-NO_SITE_ROWS`` without one.

    A thread works on ``strip`` columns: contiguous reads.
    """
    i = start + wp.tid()
    height = valid.shape[0]
    x0 = i * strip
    x1 = wp.min(x0 + strip, valid.shape[1])
    for x in range(x0, x1):
        row[0, x] = wp.where(valid[0, x] != wp.uint8(0), 0, wp.int32(-NO_SITE_ROWS))
    for y in range(1, height):
        for x in range(x0, x1):
            row[y, x] = wp.where(valid[y, x] != wp.uint8(0), y, row[y - 1, x])
    for s in range(1, height):
        y = height - 1 - s
        for x in range(x0, x1):
            below = row[y + 1, x]
            above = row[y, x]
            if below > y and (above < 0 or below - y < y - above):
                row[y, x] = below


@wp.kernel
def nearest_texel_kernel(
    start: int,
    row: wp.array2d[wp.int32],
    # scratch
    site: wp.array2d[wp.int32],
    border: wp.array2d[float],
    source: wp.array2d[wp.int32],  # out
    square: wp.array2d[float],  # out
):
    """Flat index and squared distance of the nearest valid texel for every texel of row ``i``; -1 and inf without one.

    A thread works on one row.
    """
    i = start + wp.tid()
    width = row.shape[1]
    top = lower_envelope(row[i], i, site[i], border[i])
    k = wp.int32(0)
    for x in range(width):
        if top < 0:
            source[i, x] = -1
            square[i, x] = wp.inf
        else:
            while k < top and border[i, wp.min(k + 1, width - 1)] < float(x):
                k += 1
            v = site[i, k]
            r = row[i, v]
            source[i, x] = r * width + v
            square[i, x] = float((r - i) * (r - i) + (x - v) * (x - v))
