"""Metallic-roughness material in the local frame: normal +z, ``wo`` to the viewer, ``wi`` to the light, both unit.

Argument order: ``wo``, the material, then ``wi`` (to evaluate) or ``u`` (to sample ``wi``).  ``alpha`` is the GGX
width, ``roughness**2``.  The formulas are in ``reli3d.kernels.bsdf``.

Antithetic pairs: lobe ``visible`` with ``u`` and with ``antithetic(u)``, averaged; or, as in ReLi3D, ``visible`` and
``mirrored`` with the same ``u``, each sample's value times cosine divided by the sum of both lobes' densities at its
direction, then added.  Directions below the horizon, and those about a mirrored normal that faces away, have value and
density 0.  Densities have no gradient: detach the directions to differentiate a Monte Carlo estimate.
"""

import torch
from torch import Tensor

from reli3d.kernels import bsdf as kernels
from reli3d.render.sampling import broadcast_call, reflect, sample_cosine, sample_ggx_vndf

DIFFUSE_MODELS = ("conserving", "published")  # energy transmitted to the diffuse layer: reli3d.kernels.bsdf
LOBES = ("visible", "mirrored", "cosine")  # in the order of the kernel's columns


def choice(name: str, value: str, allowed: tuple[str, ...]) -> int:
    """Index of ``value`` in ``allowed``; raises ValueError for other values."""
    if value not in allowed:
        raise ValueError(f"{name}: expected one of {', '.join(allowed)}, got {value}")
    return allowed.index(value)


def eval_bsdf(
    wo: Tensor, base_color: Tensor, alpha: Tensor, metallic: Tensor, wi: Tensor, *, diffuse_model: str = "conserving"
) -> Tensor:
    """Metallic-roughness BSDF ``(..., 3)`` [1/sr], without the cosine; 0 if ``wo`` or ``wi`` is below the horizon.

    wo, wi: ``(..., 3)`` unit, local frame.  base_color: ``(..., 3)`` linear in [0, 1].  alpha, metallic: tensors
    ``(...)``, GGX width ``roughness**2`` and [0, 1].  Leading axes broadcast.  diffuse_model: ``conserving`` (the
    specular layer attenuates the diffuse one) or ``published`` (ReLi3D; glTF 2.0, appendix B; can exceed albedo 1).

    Gradients reach all five tensors; that of ``alpha`` is 0 below ``ALPHA_MIN`` = 1e-3.  Raises TypeError unless
    float32, ValueError for a wrong shape, device or model.  Source: glTF 2.0; GGX of Walter et al. 2007 with Smith's
    height-correlated masking-shadowing.

    >>> up, half = torch.tensor([0.0, 0.0, 1.0]), torch.tensor(0.5)
    >>> value = reli3d.eval_bsdf(up, torch.full((3,), 0.8), half, half, up)
    """
    conserving = int(choice("diffuse_model", diffuse_model, DIFFUSE_MODELS) == 0)
    material = [("base_color", base_color, 3), ("alpha", alpha, 0), ("metallic", metallic, 0)]
    return broadcast_call(kernels.eval_bsdf_kernel, [("wo", wo, 3), ("wi", wi, 3), *material], conserving)


def sample_bsdf(wo: Tensor, alpha: Tensor, u: Tensor, *, lobe: str = "visible") -> Tensor:
    """Unit directions ``wi (..., 3)`` from one lobe of the BSDF, with the density :func:`pdf_bsdf`.

    wo: ``(..., 3)`` unit, local frame, z > 0, else density 0.  alpha: tensor ``(...)``, ``roughness**2``.  u:
    ``(..., 2)`` uniform in [0, 1).  lobe: ``visible`` (``wo`` reflected about a visible normal), ``mirrored`` (about
    that normal turned by pi; only together with ``visible``, by MIS) or ``cosine``.

    Gradients reach ``wo`` and ``alpha``.  Raises TypeError unless float32, ValueError for a wrong shape, device or
    lobe.  Source: Dupuy and Benyoub 2023.

    >>> wi = reli3d.sample_bsdf(wo, alpha, u).detach()
    >>> density = reli3d.pdf_bsdf(wo, alpha, wi).clamp(min=1e-12)  # 0 below the horizon, where the value is 0 too
    >>> weight = reli3d.eval_bsdf(wo, color, alpha, metallic, wi) * wi[:, 2:] / density[:, None]
    """
    if choice("lobe", lobe, LOBES) == 2:
        return sample_cosine(u).expand(*torch.broadcast_shapes(wo.shape[:-1], alpha.shape, u.shape[:-1]), 3)
    wm = sample_ggx_vndf(wo, alpha, u)
    if lobe == "visible":
        return reflect(wo, wm)
    wm = wm * wm.new_tensor([-1.0, -1.0, 1.0])  # turned by pi about the surface normal
    wi = reflect(wo, wm)
    away = (wo * wm).sum(-1, keepdim=True) <= 0.0
    return torch.where(away, torch.stack([wi[..., 0], wi[..., 1], -wi[..., 2].abs()], -1), wi)


def pdf_bsdf(wo: Tensor, alpha: Tensor, wi: Tensor, *, lobe: str = "visible") -> Tensor:
    """Density ``(...)`` [1/sr] of :func:`sample_bsdf` at ``wi``; 0 below the horizon.

    wo, wi: ``(..., 3)`` unit, local frame.  alpha: tensor ``(...)``, GGX width.  Leading axes broadcast.  lobe: as in
    :func:`sample_bsdf`.  No gradient: to differentiate an estimate, detach ``wi`` too, which fixes the directions;
    :func:`pdf_ggx_vndf` has gradients.  The density can be 0: clamp it before dividing.  For ``visible`` and ``cosine``
    clamping adds no bias, because the BSDF is also 0 wherever the density is 0.  An estimate with ``mirrored`` alone is
    biased: combine it with ``visible``.  Raises TypeError unless float32, ValueError for a wrong shape or device, or an
    unknown lobe.

    >>> wi = reli3d.sample_bsdf(wo, alpha, u)
    >>> density = reli3d.pdf_bsdf(wo, alpha, wi)
    """
    return pdf_lobes(wo, alpha, wi)[..., choice("lobe", lobe, LOBES)]


@torch.no_grad()
def pdf_lobes(wo: Tensor, alpha: Tensor, wi: Tensor) -> Tensor:
    """:func:`pdf_bsdf` for each of :data:`LOBES`, ``(..., 3)``."""
    return broadcast_call(kernels.pdf_lobes_kernel, [("wo", wo, 3), ("wi", wi, 3), ("alpha", alpha, 0)])
