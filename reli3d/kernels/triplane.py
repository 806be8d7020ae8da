"""Bilinear gather from three axis-aligned feature planes, and its two adjoints.

Planes are channel-last, ``(P = 3 * batch, H, W, Q)`` of :data:`vec8` blocks, flattened: texel (y, x), block q of
plane ``p`` is at ``((p * H + y) * W + x) * Q + q``.  Plane 0 takes (x, y) of a point, plane 1 (x, z), plane 2 (y,
z), the first along W.  A coordinate in [-1, 1] spans the texel borders (align_corners False); texels outside the
plane are zero.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

vec8 = wp.types.vector(length=8, dtype=wp.float32)  # one AVX register; a plane's channels are padded to blocks of it


@wp.struct
class Sizes:
    """Points of each triplane; texels and blocks of channels of a plane."""

    points: int
    height: int
    width: int
    blocks: int


ONE, HALF, MINUS = (wp.constant(wp.float64(v)) for v in (1.0, 0.5, -1.0))


@wp.func
def texel_position(point: wp.vec3, plane: int, sizes: Sizes) -> wp.vec2d:
    """Column and row of ``point`` in texel centers, as far outside as needed: -1 and below has no texel.

    In float64: float32 would leave 1.5e-5 of a texel of 300, and a value of that part of what neighbors differ by.
    """
    a = wp.float64(point[plane // 2])
    b = wp.float64(point[(plane + 3) // 2])
    width = wp.float64(sizes.width)
    height = wp.float64(sizes.height)
    return wp.vec2d(((a + ONE) * width - ONE) * HALF, ((b + ONE) * height - ONE) * HALF)


@wp.func
def fraction(at: wp.float64, k: int) -> float:
    """Place between texel centers ``k`` and ``k + 1``, in [0, 1]."""
    return wp.float32(at - wp.float64(k))


@wp.func
def touches(at: wp.vec2d, sizes: Sizes) -> bool:
    """Whether any texel has a weight; False for NaN, so that the conversion to int below is defined."""
    inside_x = at[0] > MINUS and at[0] < wp.float64(sizes.width)
    return inside_x and at[1] > MINUS and at[1] < wp.float64(sizes.height)


@wp.func
def texel(planes: wp.array[vec8], base: int, x: int, y: int, sizes: Sizes) -> vec8:
    """Block of texel (y, x), zero outside; ``base`` is that of texel (0, 0)."""
    if x < 0 or x >= sizes.width or y < 0 or y >= sizes.height:
        return vec8()
    return planes[base + (y * sizes.width + x) * sizes.blocks]


@wp.func
def corner_weights(u: float, v: float) -> wp.vec4:
    """Weights of texels (y, x), (y, x + 1), (y + 1, x) and (y + 1, x + 1)."""
    return wp.vec4((1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v)


@wp.func
def blend(values: wp.array[vec8], top: int, bottom: int, step: int, w: wp.vec4) -> vec8:
    """Weighted sum of two neighbors at ``top`` and two at ``bottom``."""
    upper = values[top] * w[0] + values[top + step] * w[1]
    return upper + values[bottom] * w[2] + values[bottom + step] * w[3]


@wp.kernel
def sample_kernel(
    start: int,
    planes: wp.array[vec8],
    points: wp.array[wp.vec3],
    order: wp.array[wp.int32],
    sizes: Sizes,
    split: int,
    features: wp.array[vec8],  # out
):
    """A thread is a plane, a point and every ``split``-th block; points come by ``order`` if that has entries."""
    i = start + wp.tid()
    first = i % split
    i = i // split
    width = sizes.width
    blocks = sizes.blocks
    slab = i // sizes.points  # batch * 3 + plane
    point = i % sizes.points
    if order.shape[0] > 0:
        point = order[i]
    point += (slab // 3) * sizes.points
    out = (point * 3 + slab % 3) * blocks
    at = texel_position(points[point], slab % 3, sizes)
    if not touches(at, sizes):
        for q in range(first, blocks, split):
            features[out + q] = vec8()
        return
    x = int(wp.floor(at[0]))
    y = int(wp.floor(at[1]))
    w = corner_weights(fraction(at[0], x), fraction(at[1], y))
    base = slab * sizes.height * width * blocks
    if x >= 0 and y >= 0 and x + 1 < width and y + 1 < sizes.height:
        top = base + (y * width + x) * blocks
        for q in range(first, blocks, split):
            features[out + q] = blend(planes, top + q, top + width * blocks + q, blocks, w)
    else:
        for q in range(first, blocks, split):
            features[out + q] = (
                texel(planes, base + q, x, y, sizes) * w[0]
                + texel(planes, base + q, x + 1, y, sizes) * w[1]
                + texel(planes, base + q, x, y + 1, sizes) * w[2]
                + texel(planes, base + q, x + 1, y + 1, sizes) * w[3]
            )


@wp.func
def copy_row(planes: wp.array[float], slab: int, y: int, channels: int, sizes: Sizes, scratch: wp.array[vec8], to: int):
    """Texel row ``y`` of channel-first planes to ``to``, channel-last with a zero texel at both ends, or all zero."""
    height = sizes.height
    width = sizes.width
    blocks = sizes.blocks
    for q in range(blocks):
        for x in range(width + 2):
            value = vec8()
            if y >= 0 and y < height and x > 0 and x <= width:
                at = ((slab * channels + q * 8) * height + y) * width + x - 1
                for c in range(8):
                    if q * 8 + c < channels:
                        value[c] = planes[at + c * height * width]
            scratch[to + x * blocks + q] = value


@wp.kernel
def sample_rows_kernel(
    start: int,
    planes: wp.array[float],
    points: wp.array[wp.vec3],
    order: wp.array[wp.int32],
    edges: wp.array[wp.int32],
    sizes: Sizes,
    channels: int,
    bands: int,
    # scratch
    scratch: wp.array[vec8],
    features: wp.array[vec8],  # out
):
    """As :func:`sample_kernel` from channel-first planes: a thread is a band of rows of cells of a plane.

    It keeps the two rows of texels that a row of cells needs, channel-last, in its own ``scratch``, which stays in the
    cache.  ``order`` and ``edges`` as for :func:`planes_adjoint_kernel`.
    """
    i = start + wp.tid()
    height = sizes.height
    width = sizes.width
    blocks = sizes.blocks
    slab = i // bands
    band = i % bands
    plane = slab % 3
    offset = (slab // 3) * sizes.points
    stride = (width + 2) * blocks
    held = wp.int32(-2)
    for row in range(band * (height + 1) // bands, (band + 1) * (height + 1) // bands):
        begin = edges[slab * (height + 2) + row]
        end = edges[slab * (height + 2) + row + 1]
        if begin < end:
            top = (2 * i + row % 2) * stride
            bottom = (2 * i + (row + 1) % 2) * stride
            if held != row - 1:
                copy_row(planes, slab, row - 1, channels, sizes, scratch, top)
            copy_row(planes, slab, row, channels, sizes, scratch, bottom)
            held = row
            for k in range(begin, end):
                point = order[slab * sizes.points + k] + offset
                at = texel_position(points[point], plane, sizes)
                x = int(wp.floor(at[0]))
                w = corner_weights(fraction(at[0], x), fraction(at[1], row - 1))
                left = (x + 1) * blocks
                out = (point * 3 + plane) * blocks
                for q in range(blocks):
                    features[out + q] = blend(scratch, top + left + q, bottom + left + q, blocks, w)
    if band == bands - 1:
        for k in range(edges[slab * (height + 2) + height + 1], sizes.points):
            out = ((order[slab * sizes.points + k] + offset) * 3 + plane) * blocks
            for q in range(blocks):
                features[out + q] = vec8()


@wp.kernel
def points_adjoint_kernel(
    start: int,
    planes: wp.array[vec8],
    points: wp.array[wp.vec3],
    g_features: wp.array[vec8],
    sizes: Sizes,
    g_points: wp.array[wp.vec3],  # out
):
    """Gradient of the features with respect to a point; one-sided, towards +, at a texel center."""
    point = start + wp.tid()
    height = sizes.height
    width = sizes.width
    blocks = sizes.blocks
    g = wp.vec3()
    for plane in range(3):
        at = texel_position(points[point], plane, sizes)
        if touches(at, sizes):
            x = int(wp.floor(at[0]))
            y = int(wp.floor(at[1]))
            u = fraction(at[0], x)
            v = fraction(at[1], y)
            base = ((point // sizes.points) * 3 + plane) * height * width * blocks
            across = vec8()
            down = vec8()
            for q in range(blocks):
                g_out = g_features[(point * 3 + plane) * blocks + q]
                c00 = texel(planes, base + q, x, y, sizes)
                c01 = texel(planes, base + q, x + 1, y, sizes)
                c10 = texel(planes, base + q, x, y + 1, sizes)
                c11 = texel(planes, base + q, x + 1, y + 1, sizes)
                across += wp.cw_mul(g_out, (c01 - c00) * (1.0 - v) + (c11 - c10) * v)
                down += wp.cw_mul(g_out, (c10 - c00) * (1.0 - u) + (c11 - c01) * u)
            one = vec8(1.0)
            g_first = wp.dot(across, one) * 0.5 * float(width)
            g_second = wp.dot(down, one) * 0.5 * float(height)
            if plane == 0:
                g += wp.vec3(g_first, g_second, 0.0)
            elif plane == 1:
                g += wp.vec3(g_first, 0.0, g_second)
            else:
                g += wp.vec3(0.0, g_first, g_second)
    g_points[point] = g


@wp.kernel
def cell_key_kernel(
    start: int,
    points: wp.array[wp.vec3],
    sizes: Sizes,
    bins: int,
    keys: wp.array[wp.int32],  # out
):
    """``row * bins + bin``: the row of cells ``floor(y) + 1`` of a point in a plane, and which part of it.

    A row has ``bins`` parts; a point that misses the plane has the row ``height + 1``.
    """
    i = start + wp.tid()
    height = sizes.height
    width = sizes.width
    point = i // 3
    plane = i % 3
    at = texel_position(points[point], plane, sizes)
    key = (height + 1) * bins
    if touches(at, sizes):
        key = (int(wp.floor(at[1])) + 1) * bins
        key += wp.min(int(wp.float32(at[0] + ONE) * float(bins) / float(width + 1)), bins - 1)
    batch = point // sizes.points
    keys[(batch * 3 + plane) * sizes.points + point % sizes.points] = key


@wp.func
def add_texel(g_planes: wp.array[vec8], base: int, x: int, y: int, sizes: Sizes, value: vec8):
    """Addition without atomics: the caller owns the rows of the texel."""
    if x >= 0 and x < sizes.width and y >= 0 and y < sizes.height:
        at = base + (y * sizes.width + x) * sizes.blocks
        g_planes[at] = g_planes[at] + value


@wp.kernel
def planes_adjoint_kernel(
    start: int,
    points: wp.array[wp.vec3],
    g_features: wp.array[vec8],
    order: wp.array[wp.int32],
    edges: wp.array[wp.int32],
    sizes: Sizes,
    segments: int,
    row_parity: int,
    parity: int,
    split: int,
    g_planes: wp.array[vec8],  # out
):
    """Gradient of the planes: a thread adds the points of one segment of a row of cells, for every ``split``-th channel
    block, to the two adjacent rows of texels.

    A launch covers the rows of ``row_parity`` and their segments of ``parity`` (``segments`` each, of at least 8
    cells), so that no two threads write the same texel.  ``order``: points of every plane sorted by row and segment;
    ``edges (P, (height + 1) * segments + 1)``: start of each segment.
    """
    i = start + wp.tid()
    height = sizes.height
    width = sizes.width
    blocks = sizes.blocks
    first = i % split
    i = i // split
    across = (segments + 1 - parity) // 2
    segment = (i % across) * 2 + parity
    i = i // across
    rows = (height + 2 - row_parity) // 2
    row = (i % rows) * 2 + row_parity
    slab = i // rows  # batch * 3 + plane
    plane = slab % 3
    y = row - 1
    base = slab * height * width * blocks
    at_edge = slab * ((height + 1) * segments + 1) + row * segments + segment
    for k in range(edges[at_edge], edges[at_edge + 1]):
        point = (slab // 3) * sizes.points + order[slab * sizes.points + k]
        at = texel_position(points[point], plane, sizes)
        x = int(wp.floor(at[0]))
        u = fraction(at[0], x)
        v = fraction(at[1], y)
        source = (point * 3 + plane) * blocks
        if x >= 0 and y >= 0 and x + 1 < width and y + 1 < height:
            top = base + (y * width + x) * blocks
            bottom = top + width * blocks
            for q in range(first, blocks, split):
                g = g_features[source + q]
                g_top = g * (1.0 - v)
                g_bottom = g * v
                g_planes[top + q] = g_planes[top + q] + g_top * (1.0 - u)
                g_planes[top + blocks + q] = g_planes[top + blocks + q] + g_top * u
                g_planes[bottom + q] = g_planes[bottom + q] + g_bottom * (1.0 - u)
                g_planes[bottom + blocks + q] = g_planes[bottom + blocks + q] + g_bottom * u
        else:
            for q in range(first, blocks, split):
                g = g_features[source + q]
                add_texel(g_planes, base + q, x, y, sizes, g * ((1.0 - u) * (1.0 - v)))
                add_texel(g_planes, base + q, x + 1, y, sizes, g * (u * (1.0 - v)))
                add_texel(g_planes, base + q, x, y + 1, sizes, g * ((1.0 - u) * v))
                add_texel(g_planes, base + q, x + 1, y + 1, sizes, g * (u * v))
