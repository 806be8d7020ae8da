"""Constants and small vector functions of the kernels.  Local frames have the surface normal on +z."""

import warp as wp

# Warp's own thresholds, for modules whose functions hand structs and tables on: 1.4 times faster, longer to compile
INLINE = "-mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
# a product and its sum rounded once, as on CUDA: a tenth faster
CONTRACT = "-ffp-contract=fast"

PI = wp.constant(3.14159265358979)
INV_PI = wp.constant(0.318309886183791)
TINY = wp.constant(1.0e-12)  # floor of a squared length: its root, 1e-6, is above float32 noise of a unit vector
MIN_DIRECTION = wp.constant(1.0e-12)  # a direction's component below it never leaves its slab


@wp.func
def safe_sqrt(x: float) -> float:
    """``sqrt(max(x, 0))`` with a finite derivative at 0."""
    return wp.sqrt(wp.max(x, TINY))


@wp.func
def largest(v: wp.vec3) -> float:
    """The largest magnitude of the components."""
    return wp.max(wp.abs(v[0]), wp.max(wp.abs(v[1]), wp.abs(v[2])))


@wp.func
def cube_range(origin: wp.vec3, direction: wp.vec3, radius: float, near: float, far: float) -> wp.vec2:
    """Entry and exit of a ray in the cube, within [near, far]; entry >= exit for none.  Kay and Kajiya 1986."""
    low = wp.float32(near)
    high = wp.float32(far)
    if not (wp.isfinite(origin) and wp.isfinite(direction)) or wp.length_sq(direction) < MIN_DIRECTION * MIN_DIRECTION:
        high = -1.0
    for k in range(3):
        if wp.abs(direction[k]) > MIN_DIRECTION:
            a = (-radius - origin[k]) / direction[k]
            b = (radius - origin[k]) / direction[k]
            low = wp.max(low, wp.min(a, b))
            high = wp.min(high, wp.max(a, b))
        else:
            if wp.abs(origin[k]) > radius:
                high = -1.0
    return wp.vec2(low, high)


@wp.func
def tangent_frame(n: wp.vec3) -> wp.mat33:
    """Rotation whose rows are tangent, bitangent and ``n`` (unit): local = frame @ world.

    Duff et al. 2017, Building an Orthonormal Basis, Revisited: no branch on the direction, continuous but at n.z = 0-.
    """
    s = wp.where(n[2] < 0.0, -1.0, 1.0)
    a = -1.0 / (s + n[2])
    b = n[0] * n[1] * a
    return wp.mat33(1.0 + s * n[0] * n[0] * a, s * b, -s * n[0], b, s + n[1] * n[1] * a, -n[1], n[0], n[1], n[2])


@wp.func
def turn_cos_sin(u: float) -> wp.vec2:
    """Cosine and sine of ``2 pi u`` for u in [-1, 1]; error below 1e-7.  Minimax polynomials on an eighth of a turn.

    Half the time of the C library's pair, which the samplers would otherwise spend most of their time in.
    """
    q = wp.floor(4.0 * u + 0.5)
    r = u - 0.25 * q
    s = r * r
    sine = r * (6.28318522 + s * (-41.34162804 + s * (81.5881248 - s * 75.24006876)))
    cosine = 1.0 + s * (-19.73920865 + s * (64.93931625 + s * (-85.4428553 + s * 59.22049738)))
    k = int(q) & 3
    c = wp.float32(cosine)
    d = wp.float32(sine)
    if k == 1:
        c = -sine
        d = cosine
    if k == 2:
        c = -cosine
        d = -sine
    if k == 3:
        c = sine
        d = -cosine
    return wp.vec2(c, d)


@wp.func
def turn_atan2(y: float, x: float) -> float:
    """``atan2(y, x) / 2 pi`` in [-0.5, 0.5], error below 1e-7; 0 for two zeros.  Minimax polynomial of the ratio."""
    ax = wp.abs(x)
    ay = wp.abs(y)
    a = wp.min(ax, ay) / wp.max(wp.max(ax, ay), 1.0e-30)
    s = a * a
    s2 = s * s  # in pairs of terms, which a processor computes side by side (Estrin)
    low = (0.1591548373 - s * 0.05304612102) + s2 * (0.03174594531 - s * 0.02213627035)
    high = (0.01534602811 - s * 0.008898712858) + s2 * (0.00347958921 - s * 0.0006453017162)
    t = a * (low + s2 * s2 * high)
    if ay > ax:
        t = 0.25 - t
    if x < 0.0:
        t = 0.5 - t
    if y < 0.0:
        t = -t
    return t
