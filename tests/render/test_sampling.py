"""Samplers of directions against their densities, and the random numbers."""

import math

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from reli3d.render.environment import Environment
from reli3d.render.material import eval_bsdf, pdf_bsdf, pdf_lobes, sample_bsdf
from reli3d.render.sampling import antithetic, halton, pdf_ggx_vndf, sample_cosine, sample_ggx_vndf
from tests.support import chi2, reference
from tests.support.surfaces import lit, on_ball

N = 1_000_000


def view(deg, device, phi=0.4):
    t = math.radians(deg)
    return torch.tensor([math.sin(t) * math.cos(phi), math.sin(t) * math.sin(phi), math.cos(t)], device=device)


def uniform(n, device, seed=7):
    return torch.rand(n, 2, generator=torch.Generator().manual_seed(seed)).to(device)


def lobe_cases():
    """Every lobe; by default one azimuth of each but the narrowest and those of which few draws are valid."""
    for seed, (alpha, deg, phi, drawn) in enumerate((*lobe, drawn) for lobe in chi2.LOBES for drawn in chi2.DRAWS):
        rare = drawn == "mirrored" and (deg == 89 and alpha >= 0.1 or deg == 80 and alpha == 1.0)
        even = (chi2.ALPHAS.index(alpha) + chi2.DEGREES.index(deg) + chi2.AZIMUTHS.index(phi)) % 2 == 0
        marks = () if (even or deg == 0) and alpha > 0.02 and not rare else pytest.mark.slow
        yield pytest.param(alpha, deg, phi, drawn, seed, marks=marks, id=f"{drawn}-{alpha}-{deg}-{phi}")


@pytest.mark.parametrize("alpha, deg, phi, drawn, seed", list(lobe_cases()))
def test_lobes_follow_their_densities(device, alpha, deg, phi, drawn, seed):
    """Visible normals, directions reflected at them and at either kind of partner: a million draws, or 1e5 valid."""
    wo, a, g = view(deg, device, phi), torch.tensor(alpha, device=device), torch.Generator().manual_seed(seed)
    grid = chi2.Sphere(45 if alpha > 0.2 else 81 if alpha > 0.05 else 141)
    if drawn == "half vector":
        wm = sample_ggx_vndf(wo, a, torch.rand(N, 2, generator=g).to(device))
        wrong = {"width": lambda m: pdf_ggx_vndf(wo, 1.02 * a, m)}
        return chi2.check(grid, wm, lambda m: pdf_ggx_vndf(wo, a, m), wrong)
    valid, total = [], 0
    while sum(map(len, valid)) < 100_000:
        u = torch.rand(N, 2, generator=g).to(device)
        wi = sample_bsdf(wo, a, antithetic(u)) if drawn == "opposite" else sample_bsdf(wo, a, u, lobe=drawn)
        valid.append(wi[wi[:, 2] > 1e-6])
        total += N
    k = int(drawn == "mirrored")
    pdf = lambda d: pdf_bsdf(wo, a, d, lobe="mirrored" if k else "visible")
    wrong = {"width": lambda d: pdf_lobes(wo, 1.02 * a, d)[:, k]}
    if deg >= 45:  # near the normal mirrored ones have almost the density of their originals
        wrong["the other's"] = lambda d: pdf_lobes(wo, a, d)[:, 1 - k]
    if deg == 89 and (drawn == "mirrored" or alpha < 0.05):  # a degree or less from the horizon
        whole = chi2.masses(chi2.Sphere(141), pdf, device).sum()
        assert not chi2.lost(sum(map(len, valid)), whole, total)
        grid = chi2.Window(wo, alpha, drawn == "mirrored")
        wrong["view"] = lambda d: pdf_lobes(view(89.1, device, phi), a, d)[:, k]
    return chi2.check(grid, torch.cat(valid), pdf, wrong, total)


def pdf_cosine(wi):
    return wi[..., 2].clamp(min=0.0) / math.pi


def test_cosine_follows_its_density(device):
    wrong = {"exponent": lambda d: 2.05 / (2 * math.pi) * d[:, 2].clamp(min=0.0) ** 1.05}
    chi2.check(chi2.Sphere(45), sample_cosine(uniform(N, device)), pdf_cosine, wrong)
    u, wo, a = uniform(1000, device), view(60, device), torch.tensor(0.3, device=device)
    wi = sample_cosine(u)
    assert torch.equal(sample_bsdf(wo, a, u, lobe="cosine"), wi)
    got = pdf_bsdf(wo, a, wi, lobe="cosine")
    torch.testing.assert_close(got, pdf_cosine(wi), rtol=1e-6, atol=0)  # 1 / pi is rounded


def test_one_direction_without_leading_axes_is_a_row_of_many(device):
    wo, alpha, u = view(40, device), torch.tensor(0.3, device=device), uniform(1, device)[0]
    other, half = view(20, device), torch.full_like(alpha, 0.5)
    calls = {
        sample_ggx_vndf: (wo, alpha, u),
        pdf_ggx_vndf: (wo, alpha, other),
        sample_bsdf: (wo, alpha, u),
        pdf_bsdf: (wo, alpha, other),
        eval_bsdf: (wo, other.abs(), alpha, half, other),
    }
    for function, values in calls.items():
        (row,) = function(*(v[None] for v in values))
        assert torch.equal(function(*values), row), function.__name__


def test_opposite_numbers_are_each_of_them_once(device):
    """Of all 2^24 values, on either axis: uniform numbers stay uniform, and twice the map is the identity."""
    every = torch.arange(2**24, dtype=torch.float64, device=device) / 2**24
    u = torch.stack([every.float(), every.float().flip(0)], -1)
    got = antithetic(u)
    assert torch.equal(antithetic(got), u)
    assert bool(((got[:, 0].double() - every).abs() == 0.5).all())
    assert torch.equal(got[:, 1].double(), every)


@pytest.mark.parametrize("pairs", ["opposite", "mirrored"])
@pytest.mark.parametrize("points", ["random", "halton"])
def test_pairs_of_the_shader_are_those_of_the_samplers(device, points, pairs):
    """One pair a point under even light: value over the sum of both densities, of which each is its own sample's."""
    n, seed = 20_000, 3
    g = torch.Generator().manual_seed(5)
    up = torch.tensor([0.0, 0.0, 1.0], device=device).expand(n, 3)  # whose frame is the world
    wo = normalize(torch.rand(n, 3, generator=g) - torch.tensor([0.5, 0.5, -0.1]), dim=-1).to(device)
    base, rough, metal = (torch.rand(n, *k, generator=g).to(device) for k in ((3,), (), ()))
    u = reference.random_pairs(n, seed=seed, sample=0, dimension=1).to(device)
    if points == "halton":
        u = (u + halton(1).to(device)) % 1.0
    pair = ("visible", u), ("mirrored", u)
    if pairs == "opposite":
        pair = ("visible", u), ("visible", antithetic(u))
    expected = torch.zeros(n, 3, device=device)
    for lobe, numbers in pair:
        wi = sample_bsdf(wo, rough**2, numbers, lobe=lobe)
        lobes = pdf_lobes(wo, rough**2, wi)
        density = sum(lobes[:, int(name == "mirrored"), None] for name, _ in pair)
        expected += torch.where(wi[:, 2:] > 1e-6, eval_bsdf(wo, base, rough**2, metal, wi) * wi[:, 2:] / density, 0.0)
    env = Environment(torch.full((4, 8, 3), 0.7, device=device))
    drawn = on_ball(up, wo, base, rough, metal)
    got = lit(drawn, env, samples=(0, 2, 0), seed=seed, sequence=points, antithetic=pairs)
    # sharp lobes have few digits of the half vector
    assert reference.fraction_within(got.cpu(), 0.7 * expected.cpu()) > 0.999


@pytest.mark.parametrize("pairs", ["opposite", "mirrored"])
@pytest.mark.parametrize("alpha, deg", chi2.MIXTURES)
def test_the_mixture_of_all_strategies_follows_the_sum_of_their_densities(device, alpha, deg, pairs):
    """The denominator of the balance heuristic: draws of every strategy by its fraction, invalid ones counted."""
    map_ = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(3)) ** 4
    wo, a, env = view(deg, device), torch.tensor(alpha, device=device), Environment(map_.to(device))
    per, seed = N // 64, 10 * chi2.MIXTURES.index((alpha, deg))
    u = [uniform(per * k, device, seed + i) for i, k in enumerate((20, 20, 20, 4))]
    partner = ("mirrored", u[2]) if pairs == "mirrored" else ("visible", antithetic(u[2]))
    drawn = [sample_bsdf(wo, a, v, lobe=lobe) for lobe, v in (("visible", u[1]), partner, ("cosine", u[3]))]
    draws = [env.sample(u[0])[0], *drawn]
    wi = torch.cat(draws)
    # below the horizon the map's samples count too: the domain is the sphere, and the lobes' fraction there is lost
    kept = torch.cat([torch.ones(len(draws[0]), dtype=torch.bool, device=device), torch.cat(draws[1:])[:, 2] > 1e-6])

    def mixture(d, table=20):
        lobes = pdf_lobes(wo, a, d)
        visible = lobes[:, 0] + lobes[:, int(pairs == "mirrored")]
        return (table * env.pdf(d) + (30 - table / 2) * visible + 4 * lobes[:, 2]) / 64

    wrong = {"counts": lambda d: mixture(d, 21)}
    # the map's borders run through the cells: 16 midpoints a side leave some 1e-3 of a cell's mass
    chi2.check(chi2.Sphere(45 if alpha > 0.2 else 81), wi[kept], mixture, wrong, len(wi), finest=16)


def test_map_samples_return_to_the_numbers_they_came_from(device):
    """Inversion: the CDF of rows and columns at a sample's place gives ``u`` back."""
    map_ = torch.rand(17, 33, 3, generator=torch.Generator().manual_seed(3)) ** 4
    env, u = Environment(map_.to(device)), uniform(20_000, device)
    d = env.sample(u)[0].double()
    rows, columns = env.cdf.rows[0].double(), env.cdf.columns.double()
    across = (torch.atan2(d[:, 2], d[:, 0]) / (2 * math.pi) + 0.5) * 33
    down = torch.acos(d[:, 1].clamp(-1, 1)) / math.pi * 17
    r, c = down.long().clamp(0, 16), across.long().clamp(0, 32)
    top, bottom = torch.cos(math.pi * r / 17), torch.cos(math.pi * (r + 1) / 17)
    first = torch.lerp(rows[r], rows[r + 1], (top - d[:, 1]) / (top - bottom))
    second = torch.lerp(columns[r, c], columns[r, c + 1], across - c)
    off = torch.stack([first, second], -1) - u
    # float32 angles are 1e-7 of a turn, 4e-6 of a texel, and a texel holds up to a tenth of the mass of its row
    assert float(off.abs().max()) < 1e-4


def test_random_pairs_are_uniform_independent_and_addressed():
    u = reference.random_pairs(200_000, seed=3, sample=5, dimension=1).numpy()
    assert u.min() >= 0.0 and u.max() < 1.0
    counts, _, _ = np.histogram2d(u[:, 0], u[:, 1], bins=32, range=[[0, 1], [0, 1]])
    stat = ((counts - counts.mean()) ** 2 / counts.mean()).sum()
    assert abs(stat - 1023) < 4.5 * (2 * 1023) ** 0.5  # chi-square of 1024 cells
    for other in ({"seed": 4}, {"sample": 6}, {"dimension": 2}):
        v = reference.random_pairs(200_000, **{"seed": 3, "sample": 5, "dimension": 1, **other}).numpy()
        assert abs(np.corrcoef(u.ravel(), v.ravel())[0, 1]) < 4.5 / 400_000**0.5
    assert np.array_equal(u[:100], reference.random_pairs(100, seed=3, sample=5, dimension=1).numpy())


def test_streams_have_distinct_states():
    """A million pairs of 48 bits from ten streams of neighboring counters; by chance 0.002 would be equal."""
    streams = [{name: k} for name in ("seed", "sample", "dimension") for k in (1, 2, 1 << 16)]
    streams[-1] = {"seed": 1, "sample": 1, "dimension": 1}
    u = torch.cat([reference.random_pairs(100_000, **stream) for stream in ({}, *streams)])
    bits = (u.double() * 2**24).long()
    assert len(torch.unique(bits[:, 0] * 2**24 + bits[:, 1])) == len(u)


def test_halton_points_are_the_radical_inverses():
    expected = [[1 / 2, 1 / 3], [1 / 4, 2 / 3], [3 / 4, 1 / 9], [1 / 8, 4 / 9], [5 / 8, 7 / 9], [3 / 8, 2 / 9]]
    torch.testing.assert_close(halton(6), torch.tensor(expected), rtol=0, atol=1e-7)


def test_bad_input_is_named(device):
    wo, alpha, u = torch.rand(4, 3, device=device), torch.rand(4, device=device), torch.rand(4, 2, device=device)
    with pytest.raises(ValueError, match="u: expected shape"):
        sample_ggx_vndf(wo, alpha, wo)
    with pytest.raises(ValueError, match="lobe: expected"):
        sample_bsdf(wo, alpha, u, lobe="other")
    with pytest.raises(ValueError, match=r"wo, alpha, u: expected shapes that broadcast, got .*\(3,\).*\(4,\)"):
        sample_ggx_vndf(wo[:3], alpha, u[:3])
    assert sample_ggx_vndf(wo[:0], alpha[:0], u[:0]).shape == (0, 3)
