"""Metallic-roughness material in the local frame: normal +z, ``wo`` to the viewer, ``wi`` to the light, both unit.

f = (1 - F) (1 - metallic) base / pi + D G2 F / (4 cos_o cos_i), F = F0 + (1 - F0)(1 - wo.wm)^5 (Schlick 1994),
F0 = 0.04 for dielectrics and the base colour for metals.  Linear Rec. 709; values are 1/sr and lack the cosine.
"""

import warp as wp

from reli3d.kernels.math import INV_PI
from reli3d.kernels.microfacet import (
    ALPHA_MIN,
    COS_MIN,
    ggx_ndf,
    pdf_vndf_partner,
    pdf_vndf_reflection,
    smith_visibility,
)
from reli3d.kernels.sampling import pdf_cosine

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})

F0_DIELECTRIC = wp.constant(0.04)  # refractive index 1.5; glTF 2.0 appendix B and the published model


@wp.func
def schlick(f0: wp.vec3, cos_m: float) -> wp.vec3:
    """Fresnel reflectance at the cosine between ``wo`` and the microfacet normal."""
    m = wp.clamp(1.0 - cos_m, 0.0, 1.0)
    m2 = m * m
    return f0 + (wp.vec3(1.0, 1.0, 1.0) - f0) * (m2 * m2 * m)


@wp.func
def base_reflectance(base_color: wp.vec3, metallic: float) -> wp.vec3:
    """F0: 0.04 blended to the base colour by ``metallic``."""
    return wp.vec3(F0_DIELECTRIC, F0_DIELECTRIC, F0_DIELECTRIC) * (1.0 - metallic) + base_color * metallic


@wp.func
def eval_bsdf(wo: wp.vec3, wi: wp.vec3, base_color: wp.vec3, alpha: float, metallic: float) -> wp.vec3:
    """The value of the material [1/sr]; 0 where either direction is below the horizon."""
    value = wp.vec3(0.0, 0.0, 0.0)
    if wo[2] > COS_MIN and wi[2] > COS_MIN:
        wm = wp.normalize(wo + wi)
        fresnel = schlick(base_reflectance(base_color, metallic), wp.dot(wo, wm))
        specular = ggx_ndf(wm, alpha) * smith_visibility(wo, wi, alpha)
        diffuse = wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - fresnel, base_color) * ((1.0 - metallic) * INV_PI)
        value = diffuse + fresnel * specular
    return value


@wp.func
def pdf_lobes(wo: wp.vec3, wi: wp.vec3, alpha: float) -> wp.vec3:
    """Densities [1/sr] of the material strategies at ``wi``: visible normals, their mirrored partners, cosine."""
    pdf = wp.vec3(0.0, 0.0, 0.0)
    if wo[2] > COS_MIN and wi[2] > COS_MIN:
        wm = wp.normalize(wo + wi)
        pdf = wp.vec3(pdf_vndf_reflection(wo, alpha, wm), pdf_vndf_partner(wo, alpha, wm), pdf_cosine(wi))
    return pdf


@wp.kernel
def eval_bsdf_kernel(
    start: int,
    # in
    wo: wp.array(dtype=wp.vec3), wi: wp.array(dtype=wp.vec3), base_color: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=float), metallic: wp.array(dtype=float),
    # out
    value: wp.array(dtype=wp.vec3),
):  # fmt: skip
    i = start + wp.tid()
    value[i] = eval_bsdf(wo[i], wi[i], base_color[i], wp.max(alpha[i], ALPHA_MIN), metallic[i])


@wp.kernel(enable_backward=False)
def pdf_lobes_kernel(
    start: int,
    # in
    wo: wp.array(dtype=wp.vec3), wi: wp.array(dtype=wp.vec3), alpha: wp.array(dtype=float),
    # out
    pdf: wp.array(dtype=wp.vec3),
):  # fmt: skip
    i = start + wp.tid()
    pdf[i] = pdf_lobes(wo[i], wi[i], wp.max(alpha[i], ALPHA_MIN))
