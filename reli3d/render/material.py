"""Metallic-roughness material in the local frame: normal +z, ``wo`` to the viewer, ``wi`` to the light, both unit.

The formulas stand in ``reli3d.kernels.bsdf``.  ``alpha = roughness**2`` unless the caller says otherwise.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from reli3d._bridge import call, check, empty, launch
from reli3d.kernels import bsdf as kernels
from reli3d.render.sampling import mirror, reflect, sample_cosine, sample_ggx_vndf

PAINTS = ("conserving", "published")  # what the coat leaves to the paint: reli3d.kernels.bsdf


def _flat(items: list[tuple[str, Tensor, int]]) -> tuple[torch.Size, list[Tensor]]:
    """Checked and broadcast operands, flattened to ``(N, k)`` or ``(N,)``; ``items`` hold name, value and last axis."""
    first = items[0][1]
    for name, value, last in items:
        check(name, value, last=last or None, like=first)
    batch = torch.broadcast_shapes(*(v.shape[:-1] if last else v.shape for _, v, last in items))
    flat = [v.expand(*batch, last).reshape(-1, last) if last else v.expand(batch).reshape(-1) for _, v, last in items]
    return batch, flat


def choice(name: str, value: str, allowed: tuple[str, ...]) -> int:
    """Place of ``value`` in ``allowed``; ValueError where it is none of them."""
    if value not in allowed:
        raise ValueError(f"{name}: expected one of {', '.join(allowed)}, got {value}")
    return allowed.index(value)


def eval_bsdf(
    wo: Tensor, wi: Tensor, base_color: Tensor, alpha: Tensor, metallic: Tensor, *, paint: str = "conserving"
) -> Tensor:
    """Value ``(..., 3)`` [1/sr] without the cosine; 0 below the horizon on either side.

    wo, wi: ``(..., 3)`` unit.  base_color: ``(..., 3)`` linear in [0, 1].  alpha, metallic: ``(...)``.  Leading axes
    broadcast.  paint: what the coat leaves to the paint below it, ``conserving`` (1 - F of the surface on the way in
    and out), which never sends out more than comes in, or ``published`` (1 - F of the microfacet), the formula of the
    published model's shader and of glTF 2.0's appendix B.  Gradients reach all five; that of ``alpha`` is 0 below
    ``ALPHA_MIN`` = 1e-3.  Raises ValueError for another ``paint``.
    """
    conserving = int(choice("paint", paint, PAINTS) == 0)
    batch, flat = _flat(
        [("wo", wo, 3), ("wi", wi, 3), ("base_color", base_color, 3), ("alpha", alpha, 0), ("metallic", metallic, 0)]
    )
    kinds = (wp.vec3, wp.vec3, wp.vec3, wp.float32, wp.float32)
    n = flat[0].shape[0]
    (out,) = call(kernels.eval_bsdf_kernel, n, [*zip(flat, kinds), conserving], [((n,), wp.vec3)], device=wo.device)
    return out.reshape(*batch, 3)


def pdf_lobes(wo: Tensor, wi: Tensor, alpha: Tensor) -> Tensor:
    """Densities ``(..., 3)`` [1/sr] at ``wi`` of reflection at a visible normal, at a mirrored one, and the cosine.

    wo, wi: ``(..., 3)`` unit.  alpha: ``(...)``.  No gradient.
    """
    batch, flat = _flat([("wo", wo, 3), ("wi", wi, 3), ("alpha", alpha, 0)])
    ins = [(t.detach().contiguous(), kind) for t, kind in zip(flat, (wp.vec3, wp.vec3, wp.float32))]
    out = empty((flat[0].shape[0],), wp.vec3, wo.device)
    launch(kernels.pdf_lobes_kernel, out.shape[0], [*ins, (out, wp.vec3)], wo.device)
    return out.reshape(*batch, 3)


def sample_bsdf(wo: Tensor, alpha: Tensor, u: Tensor, lobe: str = "visible") -> Tensor:
    """Directions to the light ``(..., 3)`` for uniform ``u (..., 2)``; density: that column of :func:`pdf_lobes`.

    lobe: ``visible`` (reflection at a visible normal), ``mirrored`` (at that normal mirrored about the surface normal)
    or ``cosine``.  A direction below the horizon, or a mirrored normal that faces away from ``wo``, has value and
    density 0.  Antithetic partners are ``visible`` with :func:`~reli3d.render.sampling.opposite` of ``u``, or, as
    published, ``mirrored`` with ``u``.
    Gradients reach ``wo`` and ``alpha``.
    """
    if lobe == "cosine":
        return sample_cosine(u).expand(*torch.broadcast_shapes(wo.shape[:-1], alpha.shape, u.shape[:-1]), 3)
    wm = sample_ggx_vndf(wo, alpha, u)
    if choice("lobe", lobe, ("visible", "mirrored", "cosine")) == 0:
        return reflect(wo, wm)
    wm = mirror(wm)
    wi = reflect(wo, wm)
    away = (wo * wm).sum(-1, keepdim=True) <= 0.0
    return torch.where(away, torch.stack([wi[..., 0], wi[..., 1], -wi[..., 2].abs()], -1), wi)
