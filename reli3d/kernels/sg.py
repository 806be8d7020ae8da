"""Spherical Gaussians: integrals against a clamped cosine, and direct light of the material from a mixture.

A lobe is ``amplitude exp(sharpness (axis . w - 1))`` with a unit axis.  Directions are unit.  Everything is
differentiable; loops over lobes carry a sum and nothing else, which Warp's adjoint gets right.
"""

import warp as wp

from reli3d.kernels.bsdf import base_reflectance, schlick
from reli3d.kernels.math import INV_PI, PI
from reli3d.kernels.microfacet import ALPHA_MIN, COS_MIN

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})

SHARPNESS_MIN = wp.constant(0.01)  # a lobe within 2 % of constant; keeps 1 / sharpness and its derivative finite
SERIES = wp.constant(0.5)  # where derivatives of the closed forms, which cancel, and of the series both err by 1e-5
COSINE_SHARPNESS = wp.constant(2.133)  # of the Gaussian nearest to a clamped cosine, Wang et al. 2009

# (1 + x)^-2 = sum of weight exp(-rate x), fitted over x in [0, 300] to 6e-4: GGX's slope distribution as normals
GGX_WEIGHT = wp.constant(wp.vec4(0.01271983, 0.15480422, 0.51788954, 0.31433217))
GGX_RATE = wp.constant(wp.vec4(0.08227587, 0.41751521, 1.38313102, 3.80806021))


@wp.func
def cosine_integral_ends(sharpness: float) -> wp.vec2:
    """Integrals of a lobe times the clamped cosine, its axis along the normal and against it, over 2 pi / sharpness."""
    s = sharpness
    e = wp.exp(-s)
    # sums over k from 2 to 8 of (-x)^(k - 2) / k! and of (k - 1) (-x)^(k - 2) / k!
    x = wp.min(s, SERIES)  # the adjoint passes here for any s, and its powers must not overflow
    toward = 1.0 / 2.0 - x * (
        1.0 / 6.0 - x * (1.0 / 24.0 - x * (1.0 / 120.0 - x * (1.0 / 720.0 - x * (1.0 / 5040.0 - x / 40320.0))))
    )
    against = 1.0 / 2.0 - x * (
        1.0 / 3.0 - x * (1.0 / 8.0 - x * (1.0 / 30.0 - x * (1.0 / 144.0 - x * (1.0 / 840.0 - x / 5760.0))))
    )
    toward = toward * x
    against = against * x
    if s > SERIES:
        toward = 1.0 - (1.0 - e) / s
        against = (1.0 - e) / s - e
    return wp.vec2(toward, e * against)


@wp.func
def cosine_fraction(sharpness: float, cos_axis: float) -> float:
    """``cosine_integral`` divided by 2 pi / sharpness, which tends to the cosine for narrow lobes."""
    s = sharpness
    c = wp.clamp(cos_axis, -1.0, 1.0)
    t = wp.sqrt(0.5 * s * (s * s + 2.978423 * s) / (s * s + 3.05127513 * s + 14.27419507))
    bell = wp.exp(-t * t) - wp.exp(-t * t * c * c)
    part = 0.5 * (c * wp.erfc(-t * c) + wp.erfc(t)) - 0.28209479 * bell / t
    ends = cosine_integral_ends(s)
    return ends[1] + (ends[0] - ends[1]) * wp.clamp(part, 0.0, 1.0)


@wp.func
def cosine_integral(sharpness: float, cos_axis: float) -> float:
    """Integral over the sphere of a lobe of amplitude 1 times the clamped cosine; error below 0.2 % of its maximum.

    Exact at the two ends (axis along and against the normal).  Between them, after Tokuyoshi et al. 2024,
    Hierarchical Light Sampling with Accurate Spherical Gaussian Lighting, the derivative with respect to the cosine is
    an error function; its width ``t`` is fitted here to quadrature over sharpness 0.05 to 3000.
    """
    s = wp.max(sharpness, SHARPNESS_MIN)
    return 2.0 * PI / s * cosine_fraction(s, cos_axis)


@wp.func
def specular_lobe(
    n: wp.vec3, wo: wp.vec3, f0: wp.vec3, alpha: float, axis: wp.vec3, sharpness: float, rate: float, weight: float
) -> wp.vec3:
    """Reflected radiance of one light lobe by one normal distribution of microfacet slopes.

    Wang et al. 2009, All-Frequency Rendering of Dynamic, Spatially-Varying Reflectance, section 4: the microfacet lobe
    is warped to the mirror direction, its product with the light is again a lobe, and the smooth factors are evaluated
    at that lobe's axis.  The cosine is integrated with the product instead of evaluated there, so horizons stay smooth.
    Sharpnesses are divided by that of the warped lobe, because the height of a narrow lobe scales with alpha^-2 and its
    area with alpha^2, and their product, especially its gradient, would lose digits.
    """
    cos_o = wp.max(wp.dot(n, wo), COS_MIN)
    of_normals = 2.0 * rate / (alpha * alpha)
    warped = of_normals / (4.0 * cos_o)
    ratio = sharpness / warped
    mirror = n * (2.0 * cos_o) - wo
    v = axis * ratio + mirror
    length = wp.max(wp.length(v), SHARPNESS_MIN / warped)  # of the product, over that of the warped lobe
    p = v / length
    chord = axis - mirror
    drop = sharpness * wp.dot(chord, chord) / (ratio + 1.0 + length)  # sharpness + warped - that of the product
    scale = weight / rate / cosine_integral_ends(of_normals)[0]  # the projected integral of normals: weight / rate
    height = scale * 4.0 * cos_o / length * wp.exp(-drop)
    cos_i = wp.max(wp.dot(n, p), 0.0)
    h = wp.normalize(wo + p)
    a2 = alpha * alpha
    root_o = wp.sqrt(a2 + (1.0 - a2) * cos_o * cos_o)
    root_i = wp.sqrt(a2 + (1.0 - a2) * cos_i * cos_i)
    visibility = 0.5 / (cos_i * root_o + cos_o * root_i)
    total = height * cosine_fraction(length * warped, wp.dot(n, p)) * visibility
    return schlick(f0, wp.max(wp.dot(wo, h), 0.0)) * total


@wp.func
def shade_lobe(
    n: wp.vec3, wo: wp.vec3, base_color: wp.vec3, alpha: float, metallic: float, axis: wp.vec3, sharpness: float
) -> wp.vec3:
    """Radiance towards ``wo`` per unit amplitude of one lobe of light."""
    f0 = base_reflectance(base_color, metallic)
    s = wp.max(sharpness, SHARPNESS_MIN)
    v = axis * s + n * COSINE_SHARPNESS  # about where the light that a diffuse surface takes from the lobe comes from
    d = v / wp.max(wp.length(v), SHARPNESS_MIN)
    h = wp.normalize(wo + d)
    fresnel = schlick(f0, wp.max(wp.dot(wo, h), 0.0))
    diffuse = cosine_integral(s, wp.dot(n, axis)) * INV_PI * (1.0 - metallic)
    out = wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - fresnel, base_color) * diffuse
    for j in range(4):
        out = out + specular_lobe(n, wo, f0, alpha, axis, s, GGX_RATE[j], GGX_WEIGHT[j])
    return out


@wp.kernel
def shade_sg_kernel(
    start: int,
    normal: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    base_color: wp.array[wp.vec3],
    alpha: wp.array[float],
    metallic: wp.array[float],
    axis: wp.array[wp.vec3],
    sharpness: wp.array[float],
    amplitude: wp.array[wp.vec3],
    out: wp.array[wp.vec3],  # out
):
    i = start + wp.tid()
    a = wp.max(alpha[i], ALPHA_MIN)
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(axis.shape[0]):
        lobe = shade_lobe(normal[i], wo[i], base_color[i], a, metallic[i], axis[k], sharpness[k])
        total += wp.cw_mul(amplitude[k], lobe)
    out[i] = total
