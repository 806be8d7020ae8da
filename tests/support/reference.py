"""The renderer's formulas in float64 and plain torch, written from the papers, differentiable by autograd.

Directions are in the local frame, normal +z.  Shapes ``(..., 3)`` and ``(...)``; everything float64.
"""

import numpy as np
import torch
from torch import Tensor


def random_pairs(count: int, *, seed: int = 0, sample: int = 0, dimension: int = 0) -> Tensor:
    """The shader's random numbers ``(count, 2)``: pcg4d of Jarzynski and Olano 2020, 24 bits of its first two words."""
    v = [np.arange(count, dtype=np.uint32), *(np.full(count, k, np.uint32) for k in (sample, dimension, seed))]
    v = [x * np.uint32(1664525) + np.uint32(1013904223) for x in v]
    for shift in (16, None):
        for k, (a, b) in enumerate(((1, 3), (2, 0), (0, 1), (1, 2))):
            v[k] = v[k] + v[a] * v[b]
        v = v if shift is None else [x ^ (x >> np.uint32(shift)) for x in v]
    return torch.from_numpy(np.stack([(x >> np.uint32(8)) * 2.0**-24 for x in v[:2]], -1).astype(np.float32))


def fraction_within(got: Tensor, expected: Tensor, relative: float = 1e-4) -> float:
    """Fraction of the entries of ``got`` within ``relative`` of ``expected``.

    Entries below 1e-3, the floor of Mitsuba's own gradient tests, or below a hundredth of the median of those that are
    not 0, are judged as if they were as large: sums of float32 keep no more digits.
    """
    got, expected = (v.detach().cpu().double().reshape(-1) for v in (got, expected))
    if expected.numel() == 0:
        return 1.0
    finite = expected[expected.isfinite() & (expected != 0.0)].abs()
    floor = max(1e-3, 1e-2 * float(finite.median()) if finite.numel() else 0.0)
    near = (got == expected) | ((got - expected).abs() <= relative * expected.abs().clamp(min=floor))
    return float(torch.where(expected.isfinite(), near, got == expected).double().mean())


def rows_within(got: Tensor, expected: Tensor, relative: float = 1e-4) -> float:
    """The same of vectors ``(N, ...)``, by their lengths: for gradients on a sphere or in a plane, of which only the
    vector means something and single components vanish."""
    got, expected = (v.detach().cpu().double().reshape(len(v), -1) for v in (got, expected))
    length = expected.norm(dim=-1)
    floor = max(1e-3, 1e-2 * float(length.median()))
    return float(((got - expected).norm(dim=-1) <= relative * length.clamp(min=floor)).double().mean())


def across(gradient: Tensor, direction: Tensor) -> Tensor:
    """The part of ``gradient (N, 3)`` that turns ``direction``; the rest is undefined for a unit vector.  float64."""
    gradient, d = (v.detach().cpu().double() for v in (gradient, direction))
    d = torch.nn.functional.normalize(d, dim=-1)
    return gradient - (gradient * d).sum(-1, keepdim=True) * d


def ggx_ndf(wm: Tensor, alpha: Tensor) -> Tensor:
    """Walter et al. 2007, eq. 33, in the tangent form."""
    cos2 = wm[..., 2] ** 2
    tan2 = (1.0 - cos2) / cos2
    return alpha**2 / (torch.pi * cos2**2 * (alpha**2 + tan2) ** 2)


def smith_lambda(w: Tensor, alpha: Tensor) -> Tensor:
    """Heitz 2014, eq. 72."""
    tan2 = (1.0 - w[..., 2] ** 2) / w[..., 2] ** 2
    return 0.5 * (torch.sqrt(1.0 + alpha**2 * tan2) - 1.0)


def pdf_ggx_vndf(wo: Tensor, alpha: Tensor, wm: Tensor) -> Tensor:
    """Heitz 2018, eq. 3."""
    g1 = 1.0 / (1.0 + smith_lambda(wo, alpha))
    return g1 * (wo * wm).sum(-1).clamp(min=0.0) * ggx_ndf(wm, alpha) / wo[..., 2]


def sample_ggx_vndf(wo: Tensor, alpha: Tensor, u: Tensor) -> Tensor:
    """Dupuy and Benyoub 2023, listing 1."""
    stretch = torch.stack([alpha, alpha, torch.ones_like(alpha)], -1)
    w = torch.nn.functional.normalize(wo * stretch, dim=-1)
    phi, z = 2.0 * torch.pi * u[..., 0], (1.0 - u[..., 1]) * (1.0 + w[..., 2]) - w[..., 2]
    r = torch.sqrt((1.0 - z * z).clamp(min=0.0))
    h = w + torch.stack([r * torch.cos(phi), r * torch.sin(phi), z], -1)
    return torch.nn.functional.normalize(h * stretch, dim=-1)


def eval_bsdf(
    wo: Tensor, wi: Tensor, base_color: Tensor, alpha: Tensor, metallic: Tensor, diffuse_model: str = "conserving"
) -> Tensor:
    """Lambert below Schlick, GGX with height-correlated Smith; directions above the horizon.

    The diffuse lobe loses the energy that the surface reflects on the way in and out, with 1 - cos divided by
    1 + alpha, or, ``published``, that of the microfacet.
    """
    wm = torch.nn.functional.normalize(wo + wi, dim=-1)
    f0 = 0.04 * (1.0 - metallic[..., None]) + base_color * metallic[..., None]
    schlick = lambda cos: f0 + (1.0 - f0) * (1.0 - cos) ** 5
    fresnel = schlick((wo * wm).sum(-1, keepdim=True))
    left = 1.0 - fresnel
    if diffuse_model == "conserving":
        cosines = ((w[..., 2:] + alpha[..., None]) / (1.0 + alpha[..., None]) for w in (wo, wi))
        left_o, left_i = (0.96 * (1.0 - (1.0 - cos) ** 5) for cos in cosines)  # of the dielectric alone
        left = left_o * left_i
    g2 = 1.0 / (1.0 + smith_lambda(wo, alpha) + smith_lambda(wi, alpha))
    specular = ggx_ndf(wm, alpha) * g2 / (4.0 * wo[..., 2] * wi[..., 2])
    return left * (1.0 - metallic[..., None]) * base_color / torch.pi + fresnel * specular[..., None]


def reflected_visible_normal(wo: Tensor, alpha: Tensor, u: Tensor, mirrored: bool) -> Tensor:
    """``wo`` mirrored at a visible normal or at that turned by pi; below the horizon where the latter looks away."""
    wm = sample_ggx_vndf(wo, alpha, u) * wo.new_tensor([-1.0, -1.0, 1.0] if mirrored else [1.0, 1.0, 1.0])
    cos = (wo * wm).sum(-1, keepdim=True)
    wi = 2.0 * cos * wm - wo
    under = wi * wi.new_tensor([1.0, 1.0, -1.0]) * torch.where(wi[..., 2:] < 0.0, wi.new_tensor([1.0, 1.0, -1.0]), 1.0)
    return torch.where((cos <= 0.0) & torch.tensor(mirrored), under, wi)


def sg_ends(sharpness: Tensor) -> tuple[Tensor, Tensor]:
    """Integrals over 2 pi of a lobe times the clamped cosine, its axis along the normal and against it."""
    s, e = sharpness, torch.exp(-sharpness)
    return (s - 1.0 + e) / s**2, e * (1.0 - e * (1.0 + s)) / s**2


def sg_cosine_integral(sharpness: Tensor, cos: Tensor) -> Tensor:
    """After Tokuyoshi et al. 2024, with the width that ``reli3d.kernels.sg`` fits."""
    s = sharpness
    t = torch.sqrt(0.5 * s * (s**2 + 2.978423 * s) / (s**2 + 3.05127513 * s + 14.27419507))
    bell = (torch.exp(-(t**2)) - torch.exp(-((t * cos) ** 2))) / t
    part = 0.5 * (cos * torch.erfc(-t * cos) + torch.erfc(t) - bell / torch.pi**0.5)
    along, against = sg_ends(s)
    return 2.0 * torch.pi * (against + (along - against) * part.clamp(0.0, 1.0))


def sg_irradiance(normal: Tensor, axis: Tensor, sharpness: Tensor, amplitude: Tensor) -> Tensor:
    """``(N, 3)`` at unit normals from K lobes."""
    return sg_cosine_integral(sharpness, (normal @ axis.T).clamp(-1.0, 1.0)) @ amplitude


# (1 + x)^-2 as a sum of weight exp(-rate x): GGX's slopes as a mixture of normals, fitted in reli3d.kernels.sg
GGX_NORMALS = ((0.01271983, 0.08227587), (0.15480422, 0.41751521), (0.51788954, 1.38313102), (0.31433217, 3.80806021))


def shade_gaussians(
    normal: Tensor,
    wo: Tensor,
    base_color: Tensor,
    alpha: Tensor,
    metallic: Tensor,
    axis: Tensor,
    sharpness: Tensor,
    amplitude: Tensor,
) -> Tensor:
    """``(N, 3)``: Wang et al. 2009, section 4, for each of four lobes of normals and K of light, and the diffuse part
    with one Fresnel factor, at the axis of the light's product with the cosine (a lobe of sharpness 2.133)."""
    dot = lambda a, b: (a * b).sum(-1, keepdim=True)
    n, o, base, alpha, metallic = (v[:, None] for v in (normal, wo, base_color, alpha[:, None], metallic[:, None]))
    s = sharpness[:, None]  # everything (N, K, .) from here
    f0 = 0.04 * (1.0 - metallic) + base * metallic
    schlick = lambda p: f0 + (1.0 - f0) * (1.0 - dot(o, torch.nn.functional.normalize(o + p, dim=-1))) ** 5
    middle = torch.nn.functional.normalize(axis * s + n * 2.133, dim=-1)
    cos_l = dot(n, axis.expand(len(n), -1, -1)).clamp(-1.0, 1.0)
    out = (1.0 - schlick(middle)) * base * (1.0 - metallic) / torch.pi * sg_cosine_integral(s, cos_l)
    cos_o = dot(n, o).clamp(min=1e-6)
    mirror = 2.0 * cos_o * n - o
    root = lambda cos: torch.sqrt(alpha**2 + (1.0 - alpha**2) * cos**2)
    for weight, rate in GGX_NORMALS:
        own = 2.0 * rate / alpha**2
        scale = weight / rate / (2.0 * torch.pi * sg_ends(own)[0])
        warped = own / (4.0 * cos_o)
        product = axis * s + mirror * warped
        length = product.norm(dim=-1, keepdim=True)
        p = product / length
        cos_i = dot(n, p).clamp(min=0.0)
        visibility = 0.5 / (cos_i * root(cos_o) + cos_o * root(cos_i))
        peak = torch.exp(length - s - warped)
        out = out + schlick(p) * scale * peak * sg_cosine_integral(length, dot(n, p)) * visibility
    return (out * amplitude).sum(1)


def sphere_grid(height: int) -> tuple[Tensor, Tensor]:
    """Midpoints ``(2 height^2, 3)`` in cos theta and phi about +y, and the solid angle of each."""
    y = (torch.arange(height, dtype=torch.float64) + 0.5) / height * 2 - 1
    phi = (torch.arange(2 * height, dtype=torch.float64) + 0.5) / height * torch.pi
    y, phi = torch.meshgrid(y, phi, indexing="ij")
    s = torch.sqrt(1 - y * y)
    d = torch.stack([s * torch.cos(phi), y, s * torch.sin(phi)], -1).reshape(-1, 3)
    return d, torch.tensor(4 * torch.pi / len(d), dtype=torch.float64)


def lookup_envmap(radiance: Tensor, d: Tensor) -> Tensor:
    """Bilinear lat-long lookup by grid_sample on a map padded by its own wrap; row 0 +Y, center column +X."""
    height, width = radiance.shape[:2]
    u = (torch.atan2(d[..., 2], d[..., 0]) / (2 * torch.pi) + 0.5) * width + 1.0
    v = torch.acos(d[..., 1].clamp(-1, 1)) / torch.pi * height
    padded = torch.cat([radiance[:, -1:], radiance, radiance[:, :1]], 1).permute(2, 0, 1)[None]
    grid = torch.stack([u / (width + 2) * 2 - 1, v / height * 2 - 1], -1).reshape(1, 1, -1, 2)
    out = torch.nn.functional.grid_sample(padded, grid, align_corners=False, padding_mode="border")
    return out[0, :, 0].T.reshape(*d.shape)


def direct_light(
    normal: Tensor,
    wo: Tensor,
    base_color: Tensor,
    alpha: Tensor,
    metallic: Tensor,
    radiance: Tensor,
    height: int = 256,
    diffuse_model: str = "conserving",
) -> Tensor:
    """Radiance ``(3,)`` of one unshadowed point by midpoint quadrature over the sphere."""
    d, angle = sphere_grid(height)
    d = d[(d @ normal) > 1e-6]
    helper = torch.eye(3, dtype=torch.float64)[normal.abs().argmin()]
    t = torch.nn.functional.normalize(torch.linalg.cross(helper, normal), dim=-1)
    frame = torch.stack([t, torch.linalg.cross(normal, t), normal])
    wi, o = d @ frame.T, (frame @ wo).expand(len(d), 3)
    value = eval_bsdf(o, wi, base_color.expand(len(d), 3), alpha.expand(len(d)), metallic.expand(len(d)), diffuse_model)
    return (value * wi[:, 2:] * lookup_envmap(radiance, d)).sum(0) * angle


def grid_samples(planes, points):
    """The definition through grid_sample: planes XY, XZ, YZ, first coordinate along W."""
    out = []
    for k, axes in enumerate(([0, 1], [0, 2], [1, 2])):
        grid = points[..., axes].unsqueeze(1)
        got = torch.nn.functional.grid_sample(planes[:, k], grid, align_corners=False, padding_mode="zeros")
        out.append(got.squeeze(2).transpose(1, 2))
    return torch.cat(out, -1)


def decode_normals(encoded: Tensor, normal: Tensor, tangent: Tensor) -> Tensor:
    """Unit world-space normals of normal map values ``(..., 3)``, as a renderer decodes them."""
    t, local = tangent[..., :3], encoded * 2.0 - 1.0
    b = torch.linalg.cross(normal, t) * tangent[..., 3:]
    return torch.nn.functional.normalize(local[..., :1] * t + local[..., 1:2] * b + local[..., 2:] * normal, dim=-1)
