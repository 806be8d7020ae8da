"""Shared numbers and small vector functions of the kernels.  Local frames have the surface normal on +z."""

import warp as wp

PI = wp.constant(3.14159265358979)
INV_PI = wp.constant(0.318309886183791)
TINY = wp.constant(1.0e-12)  # floor of a squared length: its root, 1e-6, is above float32 noise of a unit vector


@wp.func
def safe_sqrt(x: float) -> float:
    """``sqrt(max(x, 0))`` with a finite slope at 0."""
    return wp.sqrt(wp.max(x, TINY))


@wp.func
def tangent_frame(n: wp.vec3) -> wp.mat33:
    """Rotation whose rows are tangent, bitangent and ``n`` (unit): local = frame @ world.

    Duff et al. 2017, Building an Orthonormal Basis, Revisited: no branch on the direction, continuous but at n.z = 0-.
    """
    s = wp.float32(1.0)
    if n[2] < 0.0:
        s = -1.0
    a = -1.0 / (s + n[2])
    b = n[0] * n[1] * a
    return wp.mat33(1.0 + s * n[0] * n[0] * a, s * b, -s * n[0],
                    b, s + n[1] * n[1] * a, -n[1],
                    n[0], n[1], n[2])  # fmt: skip
