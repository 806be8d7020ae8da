"""Explicit adjoint of the estimator of ``reli3d.kernels.shade``.

Detached sampling: directions, densities, weights and visibility are those of the forward pass and constants, which
leaves the gradient unbiased because the integrand's domain, the sphere, does not depend on the parameters (Zeltner et
al. 2021, Monte Carlo Estimators for Differential Light Transport, detached sampling).  The samples are drawn again
from seed and indices, so nothing per sample is in memory but the visibility bits.
"""

import warp as wp

from reli3d.kernels.bsdf import F0_DIELECTRIC, base_reflectance, coat_cosine, coat_schlick, eval_bsdf, schlick
from reli3d.kernels.envmap import add_texels, lookup_envmap_uv
from reli3d.kernels.math import CONTRACT, INLINE, INV_PI
from reli3d.kernels.microfacet import ALPHA_MIN, smith_visibility
from reli3d.kernels.shade import COS_VIEW_MIN, Draw, Light, Plan, Points, Surface, draw_sample, make_surface

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": f"-march=native {INLINE} {CONTRACT}"})


@wp.struct
class SurfaceGradient:
    """Adjoints of one hit; ``n`` in the local frame, of the adjusted normal."""

    n: wp.vec3
    base_color: wp.vec3
    alpha: float
    metallic: float


@wp.func
def schlick_d_f0(cos: float) -> float:
    """dF / dF0 of :func:`schlick`: 1 - (1 - cos)^5."""
    rest = wp.max(1.0 - cos, 0.0)
    return 1.0 - rest * rest * rest * rest * rest


@wp.func
def schlick_turn(cos: float) -> float:
    """-dF / dcos of :func:`schlick` over 1 - F0: 5 (1 - cos)^4."""
    rest = wp.max(1.0 - cos, 0.0)
    return 5.0 * rest * rest * rest * rest


@wp.func
def add_sample_gradient(
    total: SurfaceGradient, surface: Surface, d: Draw, conserving: int, value: wp.vec3, weight: wp.vec3
) -> SurfaceGradient:
    """``total`` plus the adjoint of ``dot(weight, value cos_i)``; ``value`` is the material's, ``weight`` holds the
    output's adjoint, light and factor."""
    out = total
    one = wp.vec3(1.0, 1.0, 1.0)
    facet = d.facet
    wo = surface.wo
    wi = d.wi
    wm = facet.wm
    base_color = surface.base_color
    alpha = surface.alpha
    metallic = surface.metallic
    f0 = base_reflectance(base_color, metallic)
    fresnel = schlick(f0, facet.cos_m)
    d_fresnel = schlick_d_f0(facet.cos_m)
    visibility = smith_visibility(facet, wo, wi)
    specular = facet.ndf * visibility
    diffuse = (1.0 - metallic) * INV_PI
    g = weight * wi[2]
    g_transmitted = wp.cw_mul(g, base_color) * diffuse
    transmitted = one - fresnel
    d_transmitted = one * (-d_fresnel)  # with respect to F0
    if conserving != 0:
        c_o = coat_cosine(wo[2], alpha)
        c_i = coat_cosine(wi[2], alpha)
        t_o = 1.0 - coat_schlick(c_o)
        t_i = 1.0 - coat_schlick(c_i)
        transmitted = one * (t_o * t_i)
        d_transmitted = wp.vec3(0.0, 0.0, 0.0)  # the coat's F0 is constant
        g_c = wp.dot(g_transmitted, one) * ((1.0 - F0_DIELECTRIC) / (1.0 + alpha))
        g_o = g_c * t_i * schlick_turn(c_o)  # with respect to cos_o
        g_i = g_c * t_o * schlick_turn(c_i)
        out.n = out.n + wo * g_o + wi * g_i
        out.alpha = out.alpha + g_o * (1.0 - c_o) + g_i * (1.0 - c_i)
    g_f0 = g * (specular * d_fresnel) + wp.cw_mul(g_transmitted, d_transmitted)
    out.base_color = out.base_color + wp.cw_mul(g, transmitted) * diffuse + g_f0 * metallic
    out.metallic = out.metallic + wp.dot(g_f0, base_color - one * F0_DIELECTRIC)
    out.metallic = out.metallic - wp.dot(g, wp.cw_mul(transmitted, base_color)) * INV_PI
    g_specular = wp.dot(g, fresnel) * specular
    a2 = alpha * alpha
    inverse_k = 1.0 / (a2 * wm[2] * wm[2] + wm[0] * wm[0] + wm[1] * wm[1])
    inverse_o = 1.0 / facet.root_o
    inverse_i = 1.0 / facet.root_i
    log_e = 2.0 * visibility  # 1 / E with V = 1 / (2 E), E = cos_i root_o + cos_o root_i
    sin2_o = wo[0] * wo[0] + wo[1] * wo[1]
    sin2_i = wi[0] * wi[0] + wi[1] * wi[1]
    d_alpha = 2.0 / alpha - 4.0 * alpha * wm[2] * wm[2] * inverse_k
    d_alpha = d_alpha - log_e * alpha * (wi[2] * sin2_o * inverse_o + wo[2] * sin2_i * inverse_i)
    out.alpha = out.alpha + g_specular * d_alpha
    d_m = 4.0 * wm[2] * (1.0 - a2) * inverse_k
    d_o = -log_e * (wi[2] * wo[2] * (1.0 - a2) * inverse_o + facet.root_i)
    d_i = -log_e * (wo[2] * wi[2] * (1.0 - a2) * inverse_i + facet.root_o)
    out.n = out.n + wm * (g_specular * d_m) + wo * (g_specular * d_o) + wi * (g_specular * d_i + wp.dot(weight, value))
    return out


@wp.kernel
def shade_adjoint_kernel(
    start: int,
    first: int,
    points: Points,
    light: Light,
    plan: Plan,
    visible: wp.array2d[wp.int32],
    g_out: wp.array[wp.vec3],
    g_normal: wp.array[wp.vec3],  # out
    g_base_color: wp.array[wp.vec3],  # out
    g_alpha: wp.array[float],  # out
    g_metallic: wp.array[float],  # out
    g_radiance: wp.array2d[wp.vec3],  # out
):
    """Adjoints of the hits from ``first``; ``g_radiance`` is added to.  An output without rows is left out."""
    i = first + start + wp.tid()
    material = g_normal.shape[0] + g_base_color.shape[0] + g_alpha.shape[0] + g_metallic.shape[0]
    surface = make_surface(plan, points, i)
    total = SurfaceGradient()
    g = g_out[i]
    for s in range(plan.n_environment + plan.n_visible + plan.n_cosine):
        if (visible[i, s // 32] >> (s & 31)) & 1 != 0:
            d = draw_sample(surface, plan, light, s)
            if d.factor > 0.0:  # one in the horizon may have been above it as the forward kernel rounds
                radiance = lookup_envmap_uv(light.radiance, d.uv)
                value = eval_bsdf(
                    d.facet, surface.wo, d.wi, surface.base_color, surface.alpha, surface.metallic, plan.conserving
                )
                scale = d.factor * d.wi[2]
                top = plan.clamp / float(d.count)
                g_output = wp.vec3(0.0, 0.0, 0.0)  # the output's adjoint, 0 where the clamp held
                for c in range(3):
                    if value[c] * scale * radiance[c] < top:
                        g_output[c] = g[c]
                if material != 0:
                    weight = wp.cw_mul(g_output, radiance) * d.factor
                    total = add_sample_gradient(total, surface, d, plan.conserving, value, weight)
                if g_radiance.shape[0] != 0:
                    add_texels(g_radiance, d.uv, wp.cw_mul(g_output, value) * scale)
    if g_normal.shape[0] != 0:
        wo = points.wo[i]
        side = wp.where(wp.dot(points.ng[i], wo) < 0.0, -1.0, 1.0)
        g_n = wp.transpose(surface.frame) * total.n
        facing = points.normal[i] * side
        cos_o = wp.dot(facing, wo)
        if cos_o < COS_VIEW_MIN:  # through normalize(n + wo (c - n.wo))
            m = facing + wo * (COS_VIEW_MIN - cos_o)
            length = wp.length(m)
            m = m / length
            g_n = (g_n - m * wp.dot(m, g_n)) / length
            g_n = g_n - wo * wp.dot(wo, g_n)
        g_normal[i] = g_n * side
    if g_base_color.shape[0] != 0:
        g_base_color[i] = total.base_color
    if g_metallic.shape[0] != 0:
        g_metallic[i] = total.metallic
    if g_alpha.shape[0] != 0 and points.alpha[i] >= ALPHA_MIN:
        g_alpha[i] = total.alpha
