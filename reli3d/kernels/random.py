"""Counter-based random numbers: a pure function of (seed, pixel, sample, dimension), so results do not depend on
chunking, on threads or on order.  Also the Cranley-Patterson rotation of points.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

TO_UNIT = wp.constant(5.9604644775390625e-08)  # 2^-24: all multiples below 1 are exact in float32


@wp.func
def pcg4d(a: wp.uint32, b: wp.uint32, c: wp.uint32, d: wp.uint32) -> wp.vec4ui:
    """Four 32-bit hashes of four counters.  Jarzynski and Olano 2020, Hash Functions for GPU Rendering, JCGT 9(3)."""
    m = wp.uint32(1664525)
    k = wp.uint32(1013904223)
    x = a * m + k
    y = b * m + k
    z = c * m + k
    w = d * m + k
    x = x + y * w
    y = y + z * x
    z = z + x * y
    w = w + y * z
    s = wp.uint32(16)
    x = x ^ (x >> s)
    y = y ^ (y >> s)
    z = z ^ (z >> s)
    w = w ^ (w >> s)
    x = x + y * w
    y = y + z * x
    z = z + x * y
    w = w + y * z
    return wp.vec4ui(x, y, z, w)


@wp.func
def unit_float(bits: wp.uint32) -> float:
    """The upper 24 bits as a float in [0, 1)."""
    return float(bits >> wp.uint32(8)) * TO_UNIT


@wp.func
def random_pair(seed: int, pixel: int, sample: int, dimension: int) -> wp.vec2:
    """Two uniform numbers in [0, 1)."""
    h = pcg4d(wp.uint32(pixel), wp.uint32(sample), wp.uint32(dimension), wp.uint32(seed))
    return wp.vec2(unit_float(h[0]), unit_float(h[1]))


@wp.func
def rotate_point(point: wp.vec2, shift: wp.vec2) -> wp.vec2:
    """``(point + shift) mod 1``.  Cranley and Patterson 1976: every point is uniform, the set stays even."""
    x = point[0] + shift[0]
    y = point[1] + shift[1]
    return wp.vec2(wp.min(x - wp.floor(x), 1.0 - TO_UNIT), wp.min(y - wp.floor(y), 1.0 - TO_UNIT))
