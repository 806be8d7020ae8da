"""The material's value against a float64 reference, Mitsuba's distribution, reciprocity and energy."""

import numpy as np
import pytest
import torch

from reli3d.render.material import DIFFUSE_MODELS, eval_bsdf, pdf_lobes, sample_bsdf
from reli3d.render.sampling import pdf_ggx_vndf, sample_ggx_vndf, tangent_frame
from tests.support import mitsuba_scene, reference


def pairs(n, seed=0, low=0.02, alpha=None):
    """Directions, base color, GGX width and metallic: every other ``wi`` drawn from the lobe of ``wo`` by the float64
    reference, since independent directions miss a narrow lobe; the rest, and those below ``low``, anyhow."""
    g = torch.Generator().manual_seed(seed)
    d = torch.nn.functional.normalize(torch.randn(2, n, 3, generator=g), dim=-1)
    d[..., 2] = d[..., 2].abs().clamp(min=low)
    wo, wi = torch.nn.functional.normalize(d, dim=-1)
    base, widths, metallic = torch.rand(n, 3, generator=g), torch.rand(n, generator=g), torch.rand(n, generator=g)
    widths = 0.01**widths if alpha is None else torch.full((n,), alpha)
    o = torch.nn.functional.normalize(wo.double(), dim=-1)
    wm = reference.sample_ggx_vndf(o, widths.double(), torch.rand(n, 2, dtype=torch.float64, generator=g))
    lobe = (2.0 * (o * wm).sum(-1, keepdim=True) * wm - o).float()
    drawn = (torch.arange(n) % 2 == 0) & (lobe[:, 2] > low)
    assert drawn.float().mean() > 0.3  # 1/2 less those below the horizon
    return wo, torch.where(drawn[:, None], lobe, wi), base, widths, metallic


@pytest.mark.parametrize("diffuse_model", DIFFUSE_MODELS)
def test_value_and_gradients_equal_the_float64_reference(device, diffuse_model):
    ins = pairs(4000)
    leaf = [v.to(device).requires_grad_() for v in ins]
    doubles = [v.double().requires_grad_() for v in ins]
    wo, wi, *material = leaf
    got, expected = (
        eval_bsdf(wo, *material, wi, diffuse_model=diffuse_model),
        reference.eval_bsdf(*doubles, diffuse_model),
    )
    off = (got.detach().cpu().double() / expected.detach() - 1).abs().amax(-1)
    assert float(off.max()) < 2e-5  # rounding of cosines of 0.02; measured 8e-6, from widths of 0.01 to 1
    weight = torch.randn(got.shape, generator=torch.Generator().manual_seed(1))
    grads = torch.autograd.grad((got * weight.to(device)).sum(), leaf)
    expected_grads = torch.autograd.grad((expected * weight.double()).sum(), doubles)
    for k, (g, t) in enumerate(zip(grads, expected_grads, strict=True)):
        if k < 2:  # the two write cosines differently off the unit sphere: only the tangent part is defined
            g, t = (reference.across(v, doubles[k]) for v in (g, t))
        assert reference.fraction_within(g, t) >= 0.999, k


@pytest.mark.parametrize("diffuse_model", DIFFUSE_MODELS)
def test_reciprocity(device, diffuse_model):
    for alpha in (None, 0.01):  # within so narrow a lobe, and at grazing angles, the facet's cosine must not cancel
        wo, wi, *rest = (v.to(device) for v in pairs(100_000, 1, alpha=alpha))
        a, b = (eval_bsdf(o, *rest, i, diffuse_model=diffuse_model) for o, i in ((wo, wi), (wi, wo)))
        torch.testing.assert_close(a, b, rtol=1e-5, atol=0)  # equal bit for bit on a CPU


@pytest.mark.parametrize("diffuse_model", DIFFUSE_MODELS)
def test_directions_in_and_below_the_horizon_and_extreme_parameters(device, diffuse_model):
    """Both cosines 1e-3, 0 and -0.1 with any other; metallic, base color and width at both ends, and width 0.

    Densities too, and draws for the corners of the unit square.
    """
    z = torch.tensor([1e-3, 0.0, -0.1, 1e-8, 0.3, 1.0, -1.0])
    turn = torch.tensor([0.0, 1e-3, 2.0, torch.pi])
    s = (1 - z * z).clamp(min=0.0).sqrt()
    d = torch.stack([torch.outer(turn.cos(), s), torch.outer(turn.sin(), s), z.expand(4, 7)], -1)
    d, ends = d.reshape(-1, 3).to(device), torch.tensor([0.0, 1.0], device=device)
    wo, wi = d[:, None, None, None, None], d[:, None, None, None]
    alpha, metallic = torch.tensor([0.0, 1e-3, 0.5, 1.0], device=device)[:, None, None], ends[:, None]
    out = eval_bsdf(wo, ends[:, None].expand(2, 3), alpha, metallic, wi, diffuse_model=diffuse_model)
    assert bool(torch.isfinite(out).all()) and float(out.min()) >= 0.0
    below = (wo[..., 2] <= 0.0) | (wi[..., 2] <= 0.0)
    assert float(out[below.expand(out.shape[:-1])].abs().max()) == 0.0 < float(out.max())
    for pdf in (pdf_lobes(wo, alpha, wi), pdf_ggx_vndf(wo, alpha, wi)[..., None]):
        assert bool(torch.isfinite(pdf).all()) and float(pdf.min()) >= 0.0
        assert float(pdf[below.expand(pdf.shape[:-1])].abs().max()) == 0.0 < float(pdf.max())
    end = 1.0 - 2.0**-24
    u = torch.tensor([[0.0, 0.0], [0.0, end], [end, 0.0], [end, end]], device=device)
    wm = sample_ggx_vndf(wo, alpha, u)
    assert float(wm[..., 2].min()) > 0.0
    for drawn in (wm, *(sample_bsdf(wo, alpha, u, lobe=lobe) for lobe in ("visible", "mirrored", "cosine"))):
        torch.testing.assert_close(drawn.norm(dim=-1), torch.ones_like(drawn[..., 0]), atol=1e-5, rtol=0)
        assert bool(torch.isfinite(pdf_lobes(wo, alpha, drawn)).all())


@pytest.mark.slow  # Mitsuba starts its compiler
def test_distribution_equals_mitsubas(device):
    mi = mitsuba_scene.load()
    alpha = 0.2
    wo, wi, *_ = pairs(2000, 4, alpha=alpha)
    wm = torch.nn.functional.normalize(wo + wi, dim=-1)
    one = torch.ones(2000, device=device)  # white metal: D G2 / (4 cos cos)
    got = eval_bsdf(wo.to(device), one[:, None].expand(-1, 3), one * alpha, one, wi.to(device))[:, 0].cpu()
    judge = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, alpha)
    h, o, i = (mi.Vector3f(v.numpy().T.copy()) for v in (wm, wo, wi))
    d = torch.from_numpy(judge.eval(h).numpy())
    g1 = [torch.from_numpy(judge.smith_g1(v, h).numpy()) for v in (o, i)]
    g2 = 1 / (1 / g1[0] + 1 / g1[1] - 1)
    torch.testing.assert_close(got, d * g2 / (4 * wo[:, 2] * wi[:, 2]), rtol=1e-5, atol=0)


@pytest.mark.slow  # Mitsuba starts its compiler
@pytest.mark.parametrize("alpha", [0.01, 0.05, 0.2, 0.6, 1.0])
def test_value_equals_mitsubas_materials(device, alpha):
    """``roughconductor`` (reflectance 1), ``principled`` as a metal, and its coat over black as a dielectric; and below
    that coat ``diffuse``, times what Mitsuba's own coat leaves of it (coat over white metal is its reflectance).

    Mitsuba masks with the product of both G1, which float64 turns into the height-correlated G2, and its coat reflects
    by Fresnel's equations where ours has Schlick's.  Else they are the same formula.  The diffuse lobe
    of ``principled`` is another one (Burley's, with retro-reflection).
    """
    mi = mitsuba_scene.load()
    wo, wi, *_ = pairs(4000, 5, low=0.05, alpha=alpha)
    o, i = wo.double(), wi.double()
    width = torch.tensor(alpha).double()
    lam = [reference.smith_lambda(w, width) for w in (o, i)]
    correlated = ((1 + lam[0]) * (1 + lam[1]) / (1 + lam[0] + lam[1]))[:, None]
    cos_m = (o + i).norm(dim=-1)[:, None] / 2
    t = torch.sqrt(1.5**2 - 1 + cos_m**2)  # Fresnel's equations at refractive index 1.5
    exact = 0.5 * (((cos_m - t) / (cos_m + t)) ** 2 + ((2.25 * cos_m - t) / (2.25 * cos_m + t)) ** 2)
    schlick = lambda cos: 0.04 + 0.96 * (1 - cos) ** 5
    gold = (0.9, 0.6, 0.2)
    rough = {"roughness": alpha**0.5, "specular": 0.5}
    diffuse, black = ({"type": "rgb", "value": v} for v in (list(gold), [0.0, 0.0, 0.0]))
    conductor = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha}
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(wo.numpy().T.copy())

    def theirs(plugin):
        value = mi.load_dict(plugin).eval(mi.BSDFContext(), si, mi.Vector3f(wi.numpy().T.copy()))
        return torch.from_numpy(np.array(value).T).double() / i[:, 2:]

    white, below = theirs(conductor), theirs({"type": "diffuse", "reflectance": diffuse})
    metal = theirs({"type": "principled", "base_color": diffuse, "metallic": 1.0, **rough})
    coat = theirs({"type": "principled", "base_color": black, "metallic": 0.0, **rough})
    to_ours = schlick(cos_m) / exact
    facet = coat / white * to_ours
    in_and_out = [schlick((w[:, 2:] + alpha) / (1 + alpha)) for w in (o, i)]
    cases = [  # base color, metallic, diffuse model, value
        ((1.0, 1.0, 1.0), 1.0, "published", white * correlated),
        (gold, 1.0, "published", metal * correlated),
        ((0.0, 0.0, 0.0), 0.0, "published", coat * to_ours * correlated),
        (gold, 0.0, "published", below * (1 - facet) + coat * to_ours * correlated),
        (gold, 0.0, "conserving", below * (1 - in_and_out[0]) * (1 - in_and_out[1]) + coat * to_ours * correlated),
    ]
    for base, metallic, name, expected in cases:
        values = (wo, torch.tensor(base), torch.tensor(alpha), torch.tensor(metallic), wi)
        got = eval_bsdf(*(v.to(device) for v in values), diffuse_model=name).cpu().double()
        # Mitsuba's own float32, too: measured 6e-6 at width 0.01, 2e-6 at width 1
        assert float((got / expected - 1).abs().max()) < 1e-5, (base, metallic, name)


def test_frames_are_rotations_to_the_normal(device):
    normal = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    normal = torch.cat([normal, torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])]).to(device).requires_grad_()
    frame = tangent_frame(normal)
    eye = torch.eye(3, device=device).expand(len(normal), 3, 3)
    torch.testing.assert_close(frame @ frame.mT, eye, atol=1e-6, rtol=0)  # float32
    torch.testing.assert_close(torch.linalg.det(frame), torch.ones_like(normal[:, 0]), atol=1e-6, rtol=0)
    assert torch.equal(frame[:, 2], normal)
    (gradient,) = torch.autograd.grad(frame.square().sum(), normal)
    assert bool(gradient.isfinite().all())
