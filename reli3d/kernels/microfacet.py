"""GGX microfacet distribution in the local frame: surface normal +z, ``wo`` and ``wi`` unit and leaving the surface."""

import warp as wp

from reli3d.kernels.math import INV_PI, safe_sqrt
from reli3d.kernels.sampling import sample_cap

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})

ALPHA_MIN = wp.constant(1.0e-3)  # roughness 0.032: the lobe is 0.1 degree wide, a tenth of a pixel; Mitsuba's floor too
COS_MIN = wp.constant(1.0e-6)  # about 10 ulp of a unit vector; below it a direction counts as in the surface


@wp.func
def ggx_ndf(wm: wp.vec3, alpha: float) -> float:
    """GGX density of microfacet normals, projected: integral of D cos = 1.  Walter et al. 2007, eq. 33.

    Written with sin^2 from x and y, which keeps float32 exact digits near the peak where 1 - cos^2 cancels.
    """
    a2 = alpha * alpha
    k = a2 * wm[2] * wm[2] + wm[0] * wm[0] + wm[1] * wm[1]
    return a2 * INV_PI / (k * k)


@wp.func
def ggx_root(w: wp.vec3, alpha: float) -> float:
    """``sqrt(alpha^2 sin^2 + cos^2)``: (1 + 2 Lambda) cos, the common part of all Smith terms."""
    return safe_sqrt(alpha * alpha * (w[0] * w[0] + w[1] * w[1]) + w[2] * w[2])


@wp.struct
class Facet:
    """The microfacet that reflects ``wo`` into ``wi``, and the common terms of the BSDF value and the densities."""

    wm: wp.vec3
    cos_m: float  # wo.wm
    per_cos_m: float
    ndf: float
    root_o: float
    root_i: float


@wp.func
def facet_between(wo: wp.vec3, wi: wp.vec3, alpha: float, root_o: float) -> Facet:
    """Half vector and its terms for two directions above the horizon, whose cosines with it are positive.

    root_o: ``ggx_root(wo, alpha)``, independent of ``wi``.
    """
    facet = Facet()
    h = wo + wi
    length = wp.sqrt(wp.dot(h, h))  # 2 wo.wm = 2 wi.wm for unit vectors; positive above the horizon
    per_length = 1.0 / length
    facet.wm = h * per_length
    facet.cos_m = 0.5 * length
    facet.per_cos_m = 2.0 * per_length
    facet.ndf = ggx_ndf(facet.wm, alpha)
    facet.root_o = root_o
    facet.root_i = ggx_root(wi, alpha)
    return facet


@wp.func
def smith_visibility(facet: Facet, wo: wp.vec3, wi: wp.vec3) -> float:
    """Height-correlated Smith G2 over ``4 cos_o cos_i``; both cosines positive.  Heitz 2014, eq. 99."""
    return 0.5 / (wi[2] * facet.root_o + wo[2] * facet.root_i)


@wp.func
def stretch_view(wo: wp.vec3, alpha: float) -> wp.vec3:
    """``wo`` in the space where the GGX distribution is a hemisphere, normalized."""
    return wp.normalize(wp.vec3(alpha * wo[0], alpha * wo[1], wo[2]))


@wp.func
def sample_ggx_vndf(w: wp.vec3, alpha: float, u: wp.vec2) -> wp.vec3:
    """Samples a visible normal with density :func:`pdf_ggx_vndf`.

    w: ``stretch_view(wo, alpha)``.  u: uniform in [0, 1)^2.  Spherical caps, Dupuy and Benyoub 2023, doi
    10.1111/cgf.14867: sample the cap z in [-w.z, 1] of the unit sphere, add ``w``, and transform back.
    """
    h = w + sample_cap(w, u)
    x = alpha * h[0]
    y = alpha * h[1]
    z = wp.max(h[2], COS_MIN)
    return wp.vec3(x, y, z) * (1.0 / wp.sqrt(x * x + y * y + z * z))


@wp.func
def pdf_ggx_vndf(wo: wp.vec3, alpha: float, wm: wp.vec3) -> float:
    """Density [1/sr of ``wm``] of visible normals; 0 for normals that face away from ``wo``.  Heitz 2018, eq. 3."""
    cos_m = wp.dot(wo, wm)
    pdf = wp.float32(0.0)
    if wo[2] > 0.0 and wm[2] > 0.0 and cos_m > 0.0:
        pdf = 2.0 * cos_m * ggx_ndf(wm, alpha) / (wo[2] + ggx_root(wo, alpha))
    return pdf


@wp.func
def pdf_vndf_reflection(facet: Facet, wo: wp.vec3) -> float:
    """Density [1/sr of ``wi``] of ``wo`` reflected at a visible normal: pdf_ggx_vndf / (4 wo.wm).

    Walter et al. 2007, eq. 14."""
    return facet.ndf * (0.5 / (wo[2] + facet.root_o))  # the bracket is the same for all wi


@wp.func
def pdf_vndf_mirrored(facet: Facet, wo: wp.vec3) -> float:
    """Density [1/sr of ``wi``] of ``wo`` reflected at the mirrored visible normal: pdf_ggx_vndf(mirror(wm)) / (4
    wo.wm).

    The mirrored normal has the density of its original, in which D is the same and wo.wm that of the original, and the
    Jacobian of the reflection is that of ``wm`` itself.
    """
    cos_own = wp.max(2.0 * wo[2] * facet.wm[2] - facet.cos_m, 0.0)  # wo.mirror(wm)
    return pdf_vndf_reflection(facet, wo) * cos_own * facet.per_cos_m


@wp.kernel
def sample_ggx_vndf_kernel(
    start: int,
    wo: wp.array[wp.vec3],
    alpha: wp.array[float],
    u: wp.array[wp.vec2],
    wm: wp.array[wp.vec3],  # out
):
    i = start + wp.tid()
    width = wp.max(alpha[i], ALPHA_MIN)
    wm[i] = sample_ggx_vndf(stretch_view(wo[i], width), width, u[i])


@wp.kernel
def pdf_ggx_vndf_kernel(
    start: int,
    wo: wp.array[wp.vec3],
    alpha: wp.array[float],
    wm: wp.array[wp.vec3],
    pdf: wp.array[float],  # out
):
    i = start + wp.tid()
    pdf[i] = pdf_ggx_vndf(wo[i], wp.max(alpha[i], ALPHA_MIN), wm[i])
