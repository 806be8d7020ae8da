"""Metallic-roughness BSDF in the local frame: normal +z, ``wo`` towards the viewer, ``wi`` to the light, both unit.

f = T (1 - metallic) base / pi + D G2 F / (4 cos_o cos_i) [1/sr], without the cosine; linear Rec. 709.
F = F0 + (1 - F0)(1 - wo.wm)^5 (Schlick 1994), F0 = 0.04 for dielectrics, the base color for metals.
``conserving`` (Shirley et al. 1997): T = (1 - F(c_o)) (1 - F(c_i)), 1 - c = (1 - cos) / (1 + alpha), dielectric F0.
``published`` (glTF 2.0, appendix B): T = 1 - F of the microfacet, which creates energy at grazing views.
"""

import warp as wp

from reli3d.kernels.math import INV_PI
from reli3d.kernels.microfacet import (
    ALPHA_MIN,
    COS_MIN,
    Facet,
    facet_between,
    ggx_root,
    pdf_vndf_mirrored,
    pdf_vndf_reflection,
    smith_visibility,
)
from reli3d.kernels.sampling import pdf_cosine

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})

F0_DIELECTRIC = wp.constant(0.04)  # refractive index 1.5; glTF 2.0 appendix B and ReLi3D


@wp.func
def schlick(f0: wp.vec3, cos_m: float) -> wp.vec3:
    """Fresnel reflectance at the cosine between ``wo`` and the microfacet normal."""
    m = wp.clamp(1.0 - cos_m, 0.0, 1.0)
    m2 = m * m
    return f0 + (wp.vec3(1.0, 1.0, 1.0) - f0) * (m2 * m2 * m)


@wp.func
def base_reflectance(base_color: wp.vec3, metallic: float) -> wp.vec3:
    """F0: linear interpolation from 0.04 to the base color by ``metallic``."""
    return wp.vec3(F0_DIELECTRIC, F0_DIELECTRIC, F0_DIELECTRIC) * (1.0 - metallic) + base_color * metallic


@wp.func
def coat_schlick(cos: float) -> float:
    """:func:`schlick` of the dielectric coat."""
    m = wp.clamp(1.0 - cos, 0.0, 1.0)
    m2 = m * m
    return F0_DIELECTRIC + (1.0 - F0_DIELECTRIC) * (m2 * m2 * m)


@wp.func
def coat_cosine(cos: float, alpha: float) -> float:
    """Cosine at which Schlick's formula bounds the directional albedo of the rough coat for a direction of ``cos``.

    Roughness attenuates the rise of the Fresnel term at grazing angles.  The directional albedo of both layers then
    stays below 1 for every alpha, base color and metallic (tests/render/test_energy.py) and above 0.75 for white;
    without attenuation (alpha 0 here) that of a rough white dielectric would fall to 0.1 at the horizon.
    """
    return 1.0 - (1.0 - cos) / (1.0 + alpha)


@wp.func
def eval_bsdf(
    facet: Facet, wo: wp.vec3, wi: wp.vec3, base_color: wp.vec3, alpha: float, metallic: float, conserving: int
) -> wp.vec3:
    """BSDF value [1/sr], without the cosine, for two directions above the horizon and the facet between them."""
    one = wp.vec3(1.0, 1.0, 1.0)
    f0 = base_reflectance(base_color, metallic)
    fresnel = schlick(f0, facet.cos_m)
    specular = facet.ndf * smith_visibility(facet, wo, wi)
    transmitted = one - fresnel  # energy transmitted to the diffuse layer
    if conserving != 0:
        t_o = 1.0 - coat_schlick(coat_cosine(wo[2], alpha))
        t_i = 1.0 - coat_schlick(coat_cosine(wi[2], alpha))
        transmitted = one * (t_o * t_i)
    return wp.cw_mul(transmitted, base_color) * ((1.0 - metallic) * INV_PI) + fresnel * specular


@wp.func
def pdf_lobes(facet: Facet, wo: wp.vec3, wi: wp.vec3) -> wp.vec3:
    """Densities [1/sr] of the BSDF sampling strategies at ``wi``: visible normals, mirrored normals, cosine."""
    return wp.vec3(pdf_vndf_reflection(facet, wo), pdf_vndf_mirrored(facet, wo), pdf_cosine(wi))


@wp.kernel
def eval_bsdf_kernel(
    start: int,
    wo: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    base_color: wp.array[wp.vec3],
    alpha: wp.array[float],
    metallic: wp.array[float],
    conserving: int,
    value: wp.array[wp.vec3],  # out
):
    i = start + wp.tid()
    value[i] = wp.vec3(0.0, 0.0, 0.0)
    if wo[i][2] > COS_MIN and wi[i][2] > COS_MIN:
        width = wp.max(alpha[i], ALPHA_MIN)
        facet = facet_between(wo[i], wi[i], width, ggx_root(wo[i], width))
        value[i] = eval_bsdf(facet, wo[i], wi[i], base_color[i], width, metallic[i], conserving)


@wp.kernel(enable_backward=False)
def pdf_lobes_kernel(
    start: int,
    wo: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    alpha: wp.array[float],
    pdf: wp.array[wp.vec3],  # out
):
    i = start + wp.tid()
    pdf[i] = wp.vec3(0.0, 0.0, 0.0)
    if wo[i][2] > COS_MIN and wi[i][2] > COS_MIN:
        width = wp.max(alpha[i], ALPHA_MIN)
        pdf[i] = pdf_lobes(facet_between(wo[i], wi[i], width, ggx_root(wo[i], width)), wo[i], wi[i])
