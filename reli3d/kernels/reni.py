"""RENI++ radiance of one latent in one direction: what depends on the latent alone comes in as numbers.

Source: Gardner, Egger and Smith 2023, "RENI++", arXiv 2311.09361; the published network is 128 wide.  Its attention has
one key, so what it adds to a layer is a constant of the latent.  Directions are world directions, y up; the
network's own frame is (z, x, y).  Rows of matrices are the columns of the network's: ``y = sum_k rows[k] x[k]``.
"""

import warp as wp

from reli3d.kernels.envmap import uv_to_direction
from reli3d.kernels.math import safe_sqrt

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

WIDTH = 128
Row = wp.types.vector(length=WIDTH, dtype=wp.float32)
Part = wp.types.vector(length=16, dtype=wp.float32)  # a register; the compiler keeps longer vectors in memory
CODES = wp.constant(5)  # rows of the first matrix for each feature f: sin f, sin 4f, cos f, cos 4f, f
# Of a layer: the latent's constant; gain and offset of norm 1; offsets of both products; gain and offset of norm 2.
VECTORS = wp.constant(7)
NORM_EPS = wp.constant(1.0e-5)


@wp.func
def joined(a: Part, b: Part, c: Part, d: Part, e: Part, f: Part, g: Part, h: Part) -> Row:
    """One row of eight parts."""
    x = Row()
    for k in range(16):
        x[k] = a[k]
        x[k + 16] = b[k]
        x[k + 32] = c[k]
        x[k + 48] = d[k]
        x[k + 64] = e[k]
        x[k + 80] = f[k]
        x[k + 96] = g[k]
        x[k + 112] = h[k]
    return x


@wp.func
def product(rows: wp.array[Part], first: int, x: Row) -> Row:
    """``sum_k rows[first + k] x[k]``, rows in eight parts."""
    a = Part()
    b = Part()
    c = Part()
    d = Part()
    e = Part()
    f = Part()
    g = Part()
    h = Part()
    r = 8 * first
    for k in range(WIDTH):
        s = x[k]
        a += rows[r] * s
        b += rows[r + 1] * s
        c += rows[r + 2] * s
        d += rows[r + 3] * s
        e += rows[r + 4] * s
        f += rows[r + 5] * s
        g += rows[r + 6] * s
        h += rows[r + 7] * s
        r += 8
    return joined(a, b, c, d, e, f, g, h)


@wp.func
def total(x: Row) -> float:
    """Sum of the entries; eight chains of additions, since one would wait for itself."""
    a = wp.float32(0.0)
    b = wp.float32(0.0)
    c = wp.float32(0.0)
    d = wp.float32(0.0)
    e = wp.float32(0.0)
    f = wp.float32(0.0)
    g = wp.float32(0.0)
    h = wp.float32(0.0)
    for k in range(16):
        a += x[k]
        b += x[k + 16]
        c += x[k + 32]
        d += x[k + 48]
        e += x[k + 64]
        f += x[k + 80]
        g += x[k + 96]
        h += x[k + 112]
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@wp.func
def normalised(x: Row, gain: Row, offset: Row) -> Row:
    """Layer norm."""
    mean = total(x) * (1.0 / 128.0)
    centred = x - Row(mean)
    variance = total(wp.cw_mul(centred, centred)) * (1.0 / 128.0)
    return wp.cw_mul(centred * (1.0 / wp.sqrt(variance + NORM_EPS)), gain) + offset


@wp.func
def code(rows: wp.array[Part], r: int, s: float, s4: float, c: float, c4: float, value: float) -> Part:
    """One part of what a feature adds."""
    return ((rows[r] * s + rows[r + 8] * s4) + (rows[r + 16] * c + rows[r + 24] * c4)) + rows[r + 32] * value


@wp.func
def encoded(latent: wp.array[wp.vec2], rows: wp.array[Part], direction: wp.vec3) -> Row:
    """The first matrix times the codes of all features, and its offset."""
    xy = wp.vec2(direction[2], direction[0])
    count = latent.shape[0]
    r = 8 * CODES * (count + 2)
    a = rows[r]
    b = rows[r + 1]
    c = rows[r + 2]
    d = rows[r + 3]
    e = rows[r + 4]
    f = rows[r + 5]
    g = rows[r + 6]
    h = rows[r + 7]
    r = wp.int32(0)
    for k in range(count + 2):
        value = direction[1]
        if k < count:
            value = wp.dot(latent[k], xy)
        if k > count:
            value = safe_sqrt(wp.dot(xy, xy))
        s1 = wp.sin(value)
        c1 = wp.cos(value)
        s2 = 2.0 * s1 * c1  # the angle doubled twice
        c2 = 1.0 - 2.0 * s1 * s1
        s4 = 2.0 * s2 * c2
        c4 = 1.0 - 2.0 * s2 * s2
        a += code(rows, r, s1, s4, c1, c4, value)
        b += code(rows, r + 1, s1, s4, c1, c4, value)
        c += code(rows, r + 2, s1, s4, c1, c4, value)
        d += code(rows, r + 3, s1, s4, c1, c4, value)
        e += code(rows, r + 4, s1, s4, c1, c4, value)
        f += code(rows, r + 5, s1, s4, c1, c4, value)
        g += code(rows, r + 6, s1, s4, c1, c4, value)
        h += code(rows, r + 7, s1, s4, c1, c4, value)
        r += 8 * CODES
    return joined(a, b, c, d, e, f, g, h)


@wp.func
def eval_reni(
    latent: wp.array[wp.vec2],
    first: wp.array[Part],
    matrices: wp.array[Part],
    vectors: wp.array[Row],
    last: wp.array[Row],
    offset: wp.vec3,
    direction: wp.vec3,
) -> wp.vec3:
    """Radiance from the unit world direction ``direction``.

    latent: horizontal parts of the turned latents.  first: rows for every feature, then the offset.  matrices: 256 rows
    a layer; both cut into eight parts a row.  vectors: ``VECTORS`` a layer.  last: three rows, and ``offset`` with the
    logarithm of the strength.
    """
    x = encoded(latent, first, direction)
    for layer in range(vectors.shape[0] // VECTORS):
        v = layer * VECTORS
        m = layer * 2 * WIDTH
        x = normalised(x + vectors[v], vectors[v + 1], vectors[v + 2])
        h = wp.max(product(matrices, m, x) + vectors[v + 3], Row())
        x = normalised((x + vectors[v + 4]) + product(matrices, m + WIDTH, h), vectors[v + 5], vectors[v + 6])
    return wp.vec3(
        wp.exp(offset[0] + total(wp.cw_mul(last[0], x))),
        wp.exp(offset[1] + total(wp.cw_mul(last[1], x))),
        wp.exp(offset[2] + total(wp.cw_mul(last[2], x))),
    )


@wp.kernel
def eval_reni_kernel(
    start: int,
    # in
    latent: wp.array[wp.vec2],
    first: wp.array[Part],
    matrices: wp.array[Part],
    vectors: wp.array[Row],
    last: wp.array[Row],
    offset: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    # out
    radiance: wp.array[wp.vec3],
):
    i = start + wp.tid()
    radiance[i] = eval_reni(latent, first, matrices, vectors, last, offset[0], direction[i])


@wp.kernel
def decode_reni_kernel(
    start: int,
    # in
    latent: wp.array[wp.vec2],
    first: wp.array[Part],
    matrices: wp.array[Part],
    vectors: wp.array[Row],
    last: wp.array[Row],
    offset: wp.array[wp.vec3],
    height: int,
    # out
    radiance: wp.array[wp.vec3],
):
    i = start + wp.tid()
    u = (float(i % (2 * height)) + 0.5) / float(2 * height)
    v = (float(i // (2 * height)) + 0.5) / float(height)
    direction = uv_to_direction(wp.vec2(u, v))
    radiance[i] = eval_reni(latent, first, matrices, vectors, last, offset[0], direction)
