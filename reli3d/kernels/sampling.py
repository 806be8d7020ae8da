"""Hemisphere sampling in the local frame: normal +z, directions unit and leaving the surface."""

import warp as wp

from reli3d.kernels.math import INV_PI, safe_sqrt, turn_cos_sin
from reli3d.kernels.random import TO_UNIT

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})


@wp.func
def sample_cosine(u: wp.vec2) -> wp.vec3:
    """Direction for uniform ``u`` in [0, 1)^2; density :func:`pdf_cosine`.

    Malley's method: a uniform point of the unit disk, projected up to the hemisphere.
    """
    r = wp.sqrt(u[0])
    a = turn_cos_sin(u[1])
    return wp.vec3(r * a[0], r * a[1], wp.sqrt(1.0 - u[0]))


@wp.func
def pdf_cosine(wi: wp.vec3) -> float:
    """Density [1/sr]; 0 below the horizon."""
    return wp.max(wi[2], 0.0) * INV_PI


@wp.func
def sample_cap(w: wp.vec3, u: wp.vec2) -> wp.vec3:
    """Point of the unit sphere with z in [-w.z, 1], uniform in area."""
    a = turn_cos_sin(u[0])
    z = (1.0 - u[1]) * (1.0 + w[2]) - w[2]
    r = safe_sqrt(1.0 - z * z)
    return wp.vec3(r * a[0], r * a[1], z)


@wp.func
def opposite(u: wp.vec2) -> wp.vec2:
    """Random numbers of the antithetic partner of a visible normal sampled with ``u``.

    On the spherical cap (:func:`sample_cap`) the azimuth is rotated by pi and the height is reversed: a point at the
    fraction u[1] of the cap's height goes to 1 - u[1] - 2^-24.  Exact for multiples of 2^-24, the grid of the random
    numbers, so the result is uniform too.
    """
    return wp.vec2(u[0] + wp.where(u[0] < 0.5, 0.5, -0.5), (1.0 - TO_UNIT) - u[1])


@wp.func
def mirror(wm: wp.vec3) -> wp.vec3:
    """``wm`` rotated by pi about the surface normal."""
    return wp.vec3(-wm[0], -wm[1], wm[2])


@wp.func
def reflect(wo: wp.vec3, wm: wp.vec3) -> wp.vec3:
    """``wo`` reflected about the microfacet normal ``wm``."""
    return wm * (2.0 * wp.dot(wo, wm)) - wo
