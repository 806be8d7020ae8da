"""Samplers of directions against their densities, and the random numbers."""

import math

import numpy as np
import pytest
import torch

from reli3d.render.environment import Environment
from reli3d.render.material import pdf_lobes, sample_bsdf
from reli3d.render.sampling import (
    halton,
    pdf_cosine,
    pdf_ggx_vndf,
    random_pairs,
    sample_cosine,
    sample_ggx_vndf,
)
from tests import chi2, reference

QUICK = [(alpha, deg) for alpha in (0.1, 0.5, 1.0) for deg in (0, 45, 80)]
FULL = [(alpha, deg) for alpha in (0.02, 0.05, 0.1, 0.25, 0.5, 1.0) for deg in (0, 15, 45, 80, 89)]
LEVEL = chi2.sidak()
N = 100_000


def view(deg, device, phi=0.4):
    t = math.radians(deg)
    return torch.tensor([math.sin(t) * math.cos(phi), math.sin(t) * math.sin(phi), math.cos(t)], device=device)


def uniform(n, device, seed=7):
    return torch.rand(n, 2, generator=torch.Generator().manual_seed(seed)).to(device)


def grid(alpha):
    """Cells and quadrature: narrow lobes need both finer; axis x, so that no lobe sits in the fan around the pole."""
    if alpha < 0.1:
        return {"res": 141, "ires": 32, "up": 0}  # with 16 chi-square changes by 0.09 of 890 (alpha 0.02, 1e6 samples)
    return {"res": 41, "ires": 8, "up": 0} if alpha > 0.2 else {"res": 81, "ires": 8, "up": 0}


def check_lobe(alpha, deg, device, n, phi=0.4):
    wo, a, u = view(deg, device, phi), torch.tensor(alpha, device=device), uniform(n, device)
    p = chi2.p_value(sample_ggx_vndf(wo, a, u), lambda m: pdf_ggx_vndf(wo, a, m), **grid(alpha))
    assert p > LEVEL, f"half vector, p = {p}"
    grazing = deg > 85 and alpha < 0.3  # a reflected lobe is then less than a degree wide beside the horizon
    for k, lobe in enumerate(("visible", "partner", "cosine")):
        wi = sample_bsdf(wo, a, u, lobe)
        wi = wi[wi[:, 2] > 1e-6]
        pdf = lambda d, k=k: pdf_lobes(wo, d, a)[:, k]  # noqa: E731
        if grazing and alpha < 0.1 and lobe != "cosine":  # too narrow for a grid on the sphere
            p = chi2.window_p_value(wi, pdf, wo, alpha, total=n)
        else:
            p = chi2.p_value(wi, pdf, total=n, **({"res": 41, "ires": 48, "up": 0} if grazing else grid(alpha)))
        assert p > LEVEL, f"{lobe}, p = {p}"


@pytest.mark.parametrize("alpha, deg", QUICK)
def test_lobes_follow_their_densities(device, alpha, deg):
    check_lobe(alpha, deg, device, N)


@pytest.mark.slow
@pytest.mark.parametrize("phi", [0.4, 3.9])
@pytest.mark.parametrize("alpha, deg", FULL)
def test_lobes_follow_their_densities_with_a_million_samples(device, alpha, deg, phi):
    check_lobe(alpha, deg, device, 1_000_000, phi)


MIX = (20, 20, 20, 4)  # map, visible normals, their partners, cosine


@pytest.mark.parametrize("alpha, deg", [(0.1, 45), (0.5, 80), (1.0, 0)])
def test_the_mixture_of_all_strategies_follows_the_sum_of_their_densities(device, alpha, deg):
    """What the balance heuristic divides by: draws of every strategy in its share, invalid ones counted."""
    map_ = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(3)) ** 4
    wo, a, env = view(deg, device), torch.tensor(alpha, device=device), Environment(map_.to(device))
    per = N // sum(MIX)
    draws = [env.sample(uniform(per * MIX[0], device, 1))[0]]
    draws += [sample_bsdf(wo, a, uniform(per * k, device, 2 + i), lobe)
              for i, (k, lobe) in enumerate(zip(MIX[1:], ("visible", "partner", "cosine"), strict=True))]  # fmt: skip
    wi = torch.cat(draws)
    # below the horizon the map's own samples count too: the whole sphere is the domain, the lobes' share there is lost
    kept = torch.cat([torch.ones(len(draws[0]), dtype=torch.bool, device=device), torch.cat(draws[1:])[:, 2] > 1e-6])

    def mixture(d, counts=MIX):
        lobes = pdf_lobes(wo, d, a)
        return (counts[0] * env.pdf(d) + (lobes * lobes.new_tensor(counts[1:])).sum(-1)) / sum(MIX)

    options = {**grid(alpha), "total": len(wi)}
    assert chi2.p_value(wi[kept], mixture, **options) > LEVEL
    assert chi2.p_value(wi[kept], lambda d: mixture(d, (26, 17, 17, 4)), **options) < LEVEL


def test_map_samples_return_to_the_numbers_they_came_from(device):
    """Inversion: the CDF of rows and columns at a sample's place gives ``u`` back."""
    map_ = torch.rand(17, 33, 3, generator=torch.Generator().manual_seed(3)) ** 4
    env, u = Environment(map_.to(device)), uniform(20_000, device)
    d = env.sample(u)[0].double()
    rows, columns = env.table.rows[0].double(), env.table.columns.double()
    across = (torch.atan2(d[:, 0], -d[:, 2]) / (2 * math.pi) + 0.5) * 33
    down = torch.acos(d[:, 1].clamp(-1, 1)) / math.pi * 17
    r, c = down.long().clamp(0, 16), across.long().clamp(0, 32)
    top, bottom = torch.cos(math.pi * r / 17), torch.cos(math.pi * (r + 1) / 17)
    first = torch.lerp(rows[r], rows[r + 1], (top - d[:, 1]) / (top - bottom))
    second = torch.lerp(columns[r, c], columns[r, c + 1], across - c)
    off = torch.stack([first, second], -1) - u
    # float32 angles are 1e-7 of a turn, 4e-6 of a texel, and a texel holds up to a tenth of the mass of its row
    assert float(off.abs().max()) < 1e-4


def test_directions_return_to_the_numbers_they_came_from(device):
    """Inversion of the cosine's disk and of the cap: stretched by 1 / alpha, a visible normal is half way between the
    stretched view and the cap's point."""
    u = uniform(20_000, device)
    wi = sample_cosine(u).double()
    turn = (torch.atan2(wi[:, 1], wi[:, 0]) / (2 * math.pi)) % 1.0
    off = torch.stack([1.0 - wi[:, 2] ** 2 - u[:, 0], (turn - u[:, 1] + 0.5) % 1.0 - 0.5], -1)
    sure = u[:, 0] > 1e-3  # nearer to the pole the azimuth has fewer digits
    assert float(off[:, 0].abs().max()) < 1e-6 and float(off[sure, 1].abs().max()) < 1e-5
    for alpha, deg in QUICK:
        wo, a = view(deg, device), torch.tensor(alpha, device=device)
        wm = sample_ggx_vndf(wo, a, u).double()
        stretch = torch.tensor([alpha, alpha, 1.0], dtype=torch.float64, device=device)
        w = torch.nn.functional.normalize(wo.double() * stretch, dim=-1)
        h = torch.nn.functional.normalize(wm / stretch, dim=-1)
        cap = 2.0 * (h @ w)[:, None] * h - w
        first = (torch.atan2(cap[:, 1], cap[:, 0]) / (2 * math.pi)) % 1.0
        second = 1.0 - (cap[:, 2] + w[2]) / (1.0 + w[2])
        sure = (cap[:, 2].abs() < 0.999) & (wm[:, 2] > 1e-3)  # off the poles and off the floor of the normal's height
        off = torch.stack([(first - u[:, 0] + 0.5) % 1.0 - 0.5, second - u[:, 1]], -1)[sure]
        # 1e-7 of a unit normal, some ten times that where it is far from the view and stretched
        assert float(off.abs().max()) < 1e-4 and float(sure.double().mean()) > 0.95, (alpha, deg)


def test_cosine_follows_its_density(device):
    assert chi2.p_value(sample_cosine(uniform(N, device)), pdf_cosine) > LEVEL


def test_the_test_has_power(device):
    """A density 2 % too large, small or wide, 3 % off along one axis, swapped axes and the original's density for the
    partner are all refused; the true one is not."""
    wo, a, u = view(60, device), torch.tensor(0.5, device=device), uniform(1_000_000, device)
    wm = sample_ggx_vndf(wo, a, u)
    tilted = lambda m: pdf_ggx_vndf(wo, a, m) * (1.0 + 0.03 * m[:, 0])  # noqa: E731
    assert chi2.p_value(wm, tilted, res=15, ires=96) < LEVEL  # ires 24 lacks 1e-4 of the mass: refuses anything
    for scale, width in ((1.02, 1.0), (0.98, 1.0), (1.0, 1.02), (1.0, 0.98)):
        wrong = lambda m, s=scale, b=a * width: s * pdf_ggx_vndf(wo, b, m)  # noqa: E731
        assert chi2.p_value(wm, wrong, res=15, ires=96) < LEVEL, (scale, width)
    assert chi2.p_value(wm, lambda m: pdf_ggx_vndf(wo, a, m), res=15, ires=96) > LEVEL
    assert chi2.p_value(wm[:, [1, 0, 2]], lambda m: pdf_ggx_vndf(wo, a, m)) < LEVEL
    wi = sample_bsdf(wo, a, u, "partner")
    above = wi[:, 2] > 1e-6
    assert chi2.p_value(wi[above], lambda d: pdf_lobes(wo, d, a)[:, 0], total=len(u)) < LEVEL


@pytest.mark.parametrize("alpha", [0.02, 0.05])
def test_the_window_on_a_grazing_lobe_has_power(device, alpha):
    wo, a, u = view(89, device), torch.tensor(alpha, device=device), uniform(2_000_000, device)
    wi = [v[v[:, 2] > 1e-6] for v in (sample_bsdf(wo, a, u, lobe) for lobe in ("visible", "partner"))]

    def p(drawn, lobe, scale=1.0, width=1.0, seen=wo):
        pdf = lambda d: scale * pdf_lobes(seen, d, a * width)[:, lobe]  # noqa: E731
        return chi2.window_p_value(wi[drawn], pdf, wo, alpha, total=len(u), res=24)

    for lobe in (0, 1):
        assert p(lobe, lobe) > LEVEL
        assert p(lobe, 1 - lobe) < LEVEL  # the other's density
        for wrong in ({"scale": 1.02}, {"scale": 0.98}, {"width": 1.02}, {"width": 0.98}, {"seen": view(89.1, device)}):
            assert p(lobe, lobe, **wrong) < LEVEL, (lobe, wrong)


@pytest.mark.parametrize("alpha, deg", QUICK)
def test_visible_normal_density_integrates_to_one(device, alpha, deg):
    wo, a = view(deg, device), torch.tensor(alpha, device=device)
    mass = chi2.cell_masses(lambda m: pdf_ggx_vndf(wo, a, m), 151, 6, 0, device).sum()
    assert abs(mass - 1.0) < 1e-3  # midpoint rule on 0.2 degree cells against a lobe of 6 degrees and the cut wo.wm = 0


def test_visible_normals_equal_their_float64_twin(device):
    g = torch.Generator().manual_seed(1)
    n = 4000
    wo = torch.nn.functional.normalize(torch.rand(n, 3, generator=g) + torch.tensor([-0.5, -0.5, 0.02]), dim=-1)
    wo[:, 2] = wo[:, 2].abs().clamp(min=0.01)
    wo = torch.nn.functional.normalize(wo, dim=-1)
    alpha, u = 0.02 + 0.98 * torch.rand(n, generator=g), torch.rand(n, 2, generator=g)
    u[:, 1] = u[:, 1] * 0.98  # the rim of the cap, where a root has infinite slope, is left out of the gradient
    ins = [wo.to(device).requires_grad_(), alpha.to(device).requires_grad_()]
    got = sample_ggx_vndf(*ins, u.to(device))
    twin = [wo.double().requires_grad_(), alpha.double().requires_grad_()]
    want = reference.sample_ggx_vndf(*twin, u.double())
    # float32: 1e-7 grows by 1 / alpha where the lobe is stretched
    torch.testing.assert_close(got.cpu().double(), want, rtol=0, atol=2e-5)
    weight = torch.randn(n, 3, generator=g)
    grads = torch.autograd.grad((got * weight.to(device)).sum(), ins)
    truth = torch.autograd.grad((want * weight.double()).sum(), twin)
    assert all(reference.share_within(a, b) >= 0.999 for a, b in zip(grads, truth, strict=True))


def test_density_equals_its_float64_twin(device):
    g = torch.Generator().manual_seed(2)
    n = 4000
    wo, wm = (torch.nn.functional.normalize(torch.rand(n, 3, generator=g) + 0.02, dim=-1) for _ in range(2))
    alpha = 0.02 + 0.98 * torch.rand(n, generator=g)
    got = pdf_ggx_vndf(wo.to(device), alpha.to(device), wm.to(device)).cpu().double()
    want = reference.pdf_ggx_vndf(wo.double(), alpha.double(), wm.double())
    assert ((got / want - 1).abs() < 1e-4).all()  # relative, from 1e-7 in the cosine of wm against alpha^2 = 4e-4


def test_random_pairs_are_uniform_independent_and_addressed(device):
    u = random_pairs(200_000, seed=3, sample=5, dimension=1, device=device).cpu().numpy()
    assert u.min() >= 0.0 and u.max() < 1.0
    counts, _, _ = np.histogram2d(u[:, 0], u[:, 1], bins=32, range=[[0, 1], [0, 1]])
    stat = ((counts - counts.mean()) ** 2 / counts.mean()).sum()
    assert abs(stat - 1023) < 4.5 * (2 * 1023) ** 0.5  # chi-square of 1024 cells
    for other in ({"seed": 4}, {"sample": 6}, {"dimension": 2}):
        v = random_pairs(200_000, **{"seed": 3, "sample": 5, "dimension": 1, **other}, device=device).cpu().numpy()
        assert abs(np.corrcoef(u.ravel(), v.ravel())[0, 1]) < 4.5 / 400_000**0.5
    assert np.array_equal(u[:100], random_pairs(100, seed=3, sample=5, dimension=1, device=device).cpu().numpy())


def test_no_two_streams_share_a_state(device):
    """A million pairs of 48 bits from ten streams of neighbouring counters; by chance 0.002 would be equal."""
    streams = [{}, {"seed": 1}, {"seed": 2}, {"seed": 1 << 16}, {"sample": 1}, {"sample": 2}, {"sample": 1 << 16},
               {"dimension": 1}, {"dimension": 2}, {"seed": 1, "sample": 1, "dimension": 1}]  # fmt: skip
    u = torch.cat([random_pairs(100_000, **stream, device=device) for stream in streams])
    bits = (u.double() * 2**24).long()
    assert len(torch.unique(bits[:, 0] * 2**24 + bits[:, 1])) == len(u)


def test_halton_points_are_the_radical_inverses(device):
    want = [[1 / 2, 1 / 3], [1 / 4, 2 / 3], [3 / 4, 1 / 9], [1 / 8, 4 / 9], [5 / 8, 7 / 9], [3 / 8, 2 / 9]]
    torch.testing.assert_close(halton(6, device=device).cpu(), torch.tensor(want), rtol=0, atol=1e-7)


def test_bad_input_is_named(device):
    wo, alpha, u = torch.rand(4, 3, device=device), torch.rand(4, device=device), torch.rand(4, 2, device=device)
    with pytest.raises(TypeError, match="wo: expected torch.float32"):
        sample_ggx_vndf(wo.double(), alpha, u)
    with pytest.raises(ValueError, match="u: expected shape"):
        sample_ggx_vndf(wo, alpha, wo)
    with pytest.raises(ValueError, match="lobe: expected"):
        sample_bsdf(wo, alpha, u, "other")
    assert sample_ggx_vndf(wo[:0], alpha[:0], u[:0]).shape == (0, 3)
