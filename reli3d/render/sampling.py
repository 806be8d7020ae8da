"""Sampling of directions in the local frame (normal +z), their densities, and Halton points.

Samplers take ``u``, uniform in [0, 1)^2.  Leading axes broadcast; tensors are float32 on one device.
"""

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from reli3d._bridge import call, check
from reli3d.kernels import microfacet


def sample_cosine(u: Tensor) -> Tensor:
    """Cosine-weighted directions ``(..., 3)`` for ``u (..., 2)``; density: cos / pi.  No gradient."""
    check("u", u, last=2)
    square, angle = u.detach()[..., 0], 2.0 * torch.pi * u.detach()[..., 1]
    radius = square.sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), (1.0 - square).sqrt()], -1)


def broadcast_call(kernel, items: list[tuple[str, Tensor, int]], *plain) -> Tensor:
    """The output of ``kernel(start, *operands, *plain)`` at all broadcast operands, by :func:`reli3d._bridge.call`.

    items: name, value and length of the last axis of each operand, 0 for numbers.  Raises TypeError unless float32,
    ValueError for a wrong shape or device and for shapes that do not broadcast.
    """
    first = items[0][1]
    for name, value, last in items:
        check(name, value, last=last or None, like=first)
    shapes = [tuple(v.shape[:-1] if last else v.shape) for _, v, last in items]
    try:
        batch = torch.broadcast_shapes(*shapes)
    except RuntimeError:
        names, got = (", ".join(map(str, part)) for part in ([name for name, _, _ in items], shapes))
        raise ValueError(f"{names}: expected shapes that broadcast, got {got}") from None
    flat = [v.expand(*batch, last).reshape(-1, last) if last else v.expand(batch).reshape(-1) for _, v, last in items]
    (out,) = call(kernel, batch.numel(), [*flat, *plain], [(batch.numel(),)])
    return out.reshape((*batch, *out.shape[1:]))


def sample_ggx_vndf(wo: Tensor, alpha: Tensor, u: Tensor) -> Tensor:
    """Samples unit GGX microfacet normals ``(..., 3)`` visible from ``wo``, local frame (+z is the surface normal).

    wo: ``(..., 3)`` unit, z > 0; otherwise the samples are undefined, with density 0.  alpha: tensor ``(...)``, GGX
    width ``roughness**2`` in (0, 1], floored at 1e-3.  u: ``(..., 2)`` uniform in [0, 1).  Leading axes broadcast.
    Gradients reach ``wo`` and ``alpha``; ``u`` is a constant.  Raises TypeError unless float32, ValueError for a wrong
    shape or device.  Source: Dupuy and Benyoub 2023, spherical caps.  Density: :func:`pdf_ggx_vndf`.

    >>> wo, alpha = torch.tensor([0.6, 0.0, 0.8]), torch.tensor(0.25)
    >>> wm = reli3d.sample_ggx_vndf(wo, alpha, torch.rand(4096, 2))
    """
    items = [("wo", wo, 3), ("alpha", alpha, 0), ("u", u.detach(), 2)]
    return broadcast_call(microfacet.sample_ggx_vndf_kernel, items)


def pdf_ggx_vndf(wo: Tensor, alpha: Tensor, wm: Tensor) -> Tensor:
    """Density ``(...)`` [1/sr, in ``wm``] of :func:`sample_ggx_vndf`.

    0 unless ``wm . wo``, ``wm.z`` and ``wo.z`` are positive.  wo, wm: ``(..., 3)`` unit, local
    frame.  alpha: as in the sampler, with its floor.  Leading axes broadcast.  Gradients reach ``wo``, ``alpha`` and
    ``wm``.  Divide by ``4 wo.wm`` for the density of the reflected direction, which may be below the
    surface (where :func:`pdf_bsdf` is 0).  Raises TypeError unless float32, ValueError for a wrong shape or device.

    >>> wm = reli3d.sample_ggx_vndf(wo, alpha, u)
    >>> density = reli3d.pdf_ggx_vndf(wo, alpha, wm)
    """
    return broadcast_call(microfacet.pdf_ggx_vndf_kernel, [("wo", wo, 3), ("alpha", alpha, 0), ("wm", wm, 3)])


def antithetic(u: Tensor) -> Tensor:
    """Random numbers ``(..., 2)`` of the antithetic partners of visible-normal samples drawn with ``u (..., 2)``.

    ``((u1 + 1/2) mod 1, 1 - 2^-24 - u2)``: the partner is on the opposite side of the lobe.  Uniform if ``u`` is.  For
    multiples of 2^-24 the map is exact and its own inverse.  The estimate is the mean of a pair; it has less variance
    than that of two independent samples if the partners' values are negatively correlated, as are derivatives with
    respect to ``alpha`` or the normal.  No gradient: samplers treat ``u`` as a constant.  Raises TypeError unless
    float32, ValueError for a wrong shape.

    >>> partners = reli3d.antithetic(u)
    >>> first, second = (reli3d.sample_bsdf(wo, alpha, v) for v in (u, partners))
    """
    check("u", u, last=2)
    turn, height = u.unbind(-1)
    return torch.stack([torch.where(turn < 0.5, turn + 0.5, turn - 0.5), (1.0 - 2.0**-24) - height], -1)


def tangent_frame(normal: Tensor) -> Tensor:
    """Rotations ``(..., 3, 3)`` to the local frame: rows tangent, bitangent, normal; ``local = frame @ world``.

    normal: ``(..., 3)`` unit.  Right-handed.  Continuous except where ``z`` of the normal changes sign.  Gradients
    reach ``normal``.  Raises TypeError unless float32, ValueError for a wrong shape.  Source: Duff et al. 2017,
    Building an Orthonormal Basis, Revisited.

    >>> frame = reli3d.tangent_frame(normal)
    >>> local, world = (frame @ wo[..., None])[..., 0], (frame.mT @ wi[..., None])[..., 0]
    """
    check("normal", normal, last=3)
    x, y, z = normal.unbind(-1)
    sign = torch.where(z < 0.0, -1.0, 1.0).to(z)
    a = -1.0 / (sign + z)
    b = x * y * a
    rows = [1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y, x, y, z]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def reflect(wo: Tensor, wm: Tensor) -> Tensor:
    """Mirror reflection ``(..., 3)`` of ``wo`` about the microfacet normal ``wm``: ``2 (wo.wm) wm - wo``.

    wo, wm: ``(..., 3)`` unit, any common frame.  Gradients reach both.  Raises TypeError unless float32, ValueError for
    a wrong shape or device.

    >>> wm = reli3d.sample_ggx_vndf(wo, alpha, u)
    >>> wi = reli3d.reflect(wo, wm)
    """
    check("wo", wo, last=3)
    check("wm", wm, last=3, like=wo)
    return 2.0 * (wo * wm).sum(-1, keepdim=True) * wm - wo


@lru_cache(16)
def halton(count: int) -> Tensor:
    """Points 1 to ``count`` of the Halton sequence in bases 2 and 3, ``(count, 2)`` in [0, 1), on the CPU."""
    points = np.zeros((count, 2))
    for axis, base in enumerate((2, 3)):
        rest, scale = np.arange(1, count + 1), 1.0
        while rest.any():  # the digits, mirrored at the radix point
            scale /= base
            points[:, axis] += rest % base * scale
            rest //= base
    return torch.from_numpy(points.astype(np.float32).clip(max=1.0 - 2.0**-24))
