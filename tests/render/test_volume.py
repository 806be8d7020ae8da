"""Ray marching against a plain loop over steps, compositing against a float64 reference, closed forms and a descent."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from reli3d.geometry.triplane import sample_triplane
from reli3d.render.volume import OccupancyGrid, composite, march_rays
from tests.support.rays import packed
from tests.support.reference import fraction_within, grid_samples


def rays(device, n=64, seed=0, radius=0.8):
    rng = torch.Generator().manual_seed(seed)
    origins = normalize(torch.randn(n, 3, generator=rng), dim=-1) * 2.5
    origins[::5] *= 0.1  # some start inside
    aim = (torch.rand(n, 3, generator=rng) * 2 - 1) * radius * 1.2  # some miss
    return origins.to(device), normalize(aim - origins, dim=-1).to(device)


def random_grid(device, resolution=12, fraction=0.3, seed=1):
    cells = torch.rand(resolution, resolution, resolution, generator=torch.Generator().manual_seed(seed)) < fraction
    return OccupancyGrid(cells.to(device), 0.8)


def full_grid(resolution, radius, device):
    return OccupancyGrid(torch.ones(*[resolution] * 3, dtype=torch.bool, device=device), radius)


def in_float64(samples, density, color):
    """The transmittance product in float64, padded to rays x samples, by autograd."""
    counts = samples.first.long().diff().cpu()
    n, longest = len(counts), int(counts.max()) if len(counts) else 0
    ray, first = samples.ray.long().cpu(), samples.first.long().cpu()
    slot = torch.arange(len(ray)) - first[ray]
    own = torch.zeros(n, longest, dtype=torch.float64).index_put((ray, slot), density.clamp(min=0.0) * samples.step)
    c = torch.zeros(n, longest, 3, dtype=torch.float64).index_put((ray, slot), color)
    t = torch.zeros(n, longest, dtype=torch.float64).index_put((ray, slot), samples.t.cpu().double())
    through = torch.exp(-own)
    before = torch.cat([torch.ones(n, 1, dtype=torch.float64), torch.cumprod(through, 1)[:, :-1]], 1)
    weight = before * (1.0 - through)
    return (weight[..., None] * c).sum(1), weight.sum(1), (weight * t).sum(1)


def test_samples_are_the_steps_in_occupied_cells(device):
    """Every step of every ray, one by one in float64; only samples within rounding of a cell's border may differ."""
    grid, (origins, directions) = random_grid(device), rays(device)
    step, size = 0.013, 12
    shift = torch.rand(64, generator=torch.Generator().manual_seed(3)).to(device)
    samples = march_rays(origins, directions, grid, step, near=0.1, far=3.0, shift=shift)
    assert samples.first[0] == 0 and samples.first[-1] == len(samples.t) == len(samples.ray)
    cells = grid.occupied.cpu()
    missing = extra = 0
    for i in range(64):
        o, d = origins[i].cpu().double(), directions[i].cpu().double()
        low, high = ((-0.8 - o) / d).minimum((0.8 - o) / d).max(), ((-0.8 - o) / d).maximum((0.8 - o) / d).min()
        low, high = max(float(low), 0.1), min(float(high), 3.0)
        k = torch.arange(max(0, math.ceil((high - low) / step) + 1), dtype=torch.float64)
        t = low + (k + float(shift[i])) * step
        t = t[t < high]
        p = ((o + t[:, None] * d + 0.8) * (size / 1.6)).clamp(0, size - 1e-9)
        clear = ((p - p.round()).abs() > 1e-4).all(1)
        index = p.long()
        expected = t[cells[index[:, 0], index[:, 1], index[:, 2]] & clear]
        own = samples.t[samples.first[i] : samples.first[i + 1]].cpu().double()
        assert bool((samples.ray[samples.first[i] : samples.first[i + 1]] == i).all())
        assert len(own) < 2 or float(own.diff().min()) > 0.99 * step
        missing += int(((expected[:, None] - own[None]).abs() > 1e-5).all(1).sum())
        sure = t[clear]
        empty = sure[~torch.isin(sure, expected)]
        extra += int(((own[:, None] - empty[None]).abs() < 1e-5).sum())
    assert missing == 0 and extra == 0 and len(samples.t) > 1000


def test_odd_rays_have_no_samples(device):
    grid = full_grid(4, 1.0, device)
    bad = [[math.nan, 0, 0], [0, 0, 0], [0, 0, 0], [5.0, 0, 0], [0, 0, -3.0]]
    directions = [[1.0, 0, 0], [0, 0, 0], [math.inf, 0, 0], [0, 0, 1.0], [0, 0, 1.0]]
    samples = march_rays(*(torch.tensor(v, device=device) for v in (bad, directions)), grid, 0.25)
    assert samples.first.tolist() == [0, 0, 0, 0, 0, 8]
    torch.testing.assert_close(samples.t.cpu(), 2.125 + 0.25 * torch.arange(8), rtol=1e-6, atol=0)
    empty = march_rays(torch.zeros(0, 3, device=device), torch.zeros(0, 3, device=device), grid, 0.1)
    assert empty.first.tolist() == [0] and len(empty.t) == 0
    out = composite(torch.zeros(8, device=device), torch.ones(8, 3, device=device), samples)
    assert float(out.color.abs().max()) == 0.0 and float(out.opacity.max()) == 0.0


def test_uniform_fog_follows_beer_and_lambert(device):
    grid, density = full_grid(8, 1.0, device), 1.7
    o, d = torch.tensor([[0.0, 0, -3]], device=device), torch.tensor([[0.0, 0, 1]], device=device)
    samples = march_rays(o, d, grid, 1.0 / 512)
    n = len(samples.t)
    out = composite(torch.full((n,), density, device=device), torch.full((n, 3), 0.4, device=device), samples)
    left = math.exp(-density * 2.0)
    expected = 1.0 - left
    assert abs(float(out.opacity[0]) - expected) < 1e-5  # sum of 1024 float32 thicknesses
    torch.testing.assert_close(out.color.cpu(), torch.full((1, 3), 0.4 * expected), rtol=2e-5, atol=0)
    mean = (1.0 - left * (1.0 + density * 2.0)) / density + 2.0 * expected  # int t sigma e^(-sigma t)
    assert abs(float(out.depth[0]) - mean) < 1e-4 * mean  # midpoint rule


COUNTS = [0, 1, 7, 200, 0, 33, 64, 5]


def test_composite_and_gradients_match_the_float64_reference(device):
    samples, density, color = packed(COUNTS, device)
    own = [v.clone().requires_grad_() for v in (density, color)]
    far = [v.detach().cpu().double().requires_grad_() for v in (density, color)]
    out, expected = composite(*own, samples), in_float64(samples, *far)
    rng = torch.Generator().manual_seed(4)
    loss = ref = 0.0
    for got, exact in zip((out.color, out.opacity, out.depth), expected, strict=True):
        torch.testing.assert_close(got.detach().cpu().double(), exact.detach(), rtol=1e-5, atol=1e-6)
        weight = torch.randn(exact.shape, generator=rng)
        loss, ref = loss + (got * weight.to(device)).sum(), ref + (exact * weight.double()).sum()
    for g, t in zip(torch.autograd.grad(loss, own), torch.autograd.grad(ref, far), strict=True):
        # float32 exponentials of sums of up to 200 terms
        torch.testing.assert_close(g.cpu().double(), t, rtol=1e-4, atol=2e-6)


def test_a_triplane_is_marched_and_composited_as_in_float64(device):
    """The first training stage: occupancy of the field, samples, features, heads, color and opacity of rays; values
    and gradients to planes and heads, as docs/library.md joins them."""
    rng = torch.Generator().manual_seed(8)
    radius = 0.8
    leaves = [torch.randn(1, 3, 4, 6, 6, generator=rng), torch.randn(4, 12, generator=rng) * 0.7]
    planes, heads = (v.to(device).requires_grad_() for v in leaves)

    def field(points, planes, heads, read):
        value = read(planes, points[None] / radius)[0] @ heads.T
        return torch.nn.functional.softplus(6.0 * value[:, 0] - 12.0), torch.sigmoid(value[:, 1:])

    density_at = lambda points: field(points, planes, heads, sample_triplane)[0]
    grid = OccupancyGrid.of_density(density_at, 16, radius, threshold=1.0, device=device)
    origins, directions = rays(device, 300, 9)
    samples = march_rays(origins, directions, grid, 0.02)
    assert 0.2 < float(grid.occupied.float().mean()) < 0.9 and len(samples.t) > 3000
    out = composite(*field(samples.positions(origins, directions), planes, heads, sample_triplane), samples)
    far = [v.double().requires_grad_() for v in leaves]
    o, d, t, ray = (v.cpu() for v in (origins.double(), directions.double(), samples.t.double(), samples.ray.long()))
    expected = in_float64(samples, *field(o[ray] + t[:, None] * d[ray], *far, grid_samples))
    weight = [torch.rand(v.shape, generator=rng) for v in expected[:2]]
    loss = ref = 0.0
    for got, exact, w in zip((out.color, out.opacity), expected, weight):
        torch.testing.assert_close(got.detach().cpu().double(), exact.detach(), rtol=1e-4, atol=1e-6)
        loss, ref = loss + (got * w.to(device)).sum(), ref + (exact * w.double()).sum()
    opacity = out.opacity.detach()
    assert float(opacity.max()) > 0.9 and float(opacity.std()) > 0.1
    for g, t in zip(torch.autograd.grad(loss, (planes, heads)), torch.autograd.grad(ref, far), strict=True):
        assert fraction_within(g, t) >= 0.999


def test_faint_and_opaque_media_keep_their_digits(device):
    for scale in (1e-6, 1e-3, 30.0, 1e4, 1e30, math.inf):
        samples, density, color = packed([40, 3], device)
        density = density.abs() * scale
        own, far = density.clone().requires_grad_(), density.cpu().double().clamp(max=1e35).requires_grad_()
        got, expected = composite(own, color, samples), in_float64(samples, far, color.cpu().double())
        torch.testing.assert_close(got.opacity.detach().cpu().double(), expected[1].detach(), rtol=2e-6, atol=0)
        (g,) = torch.autograd.grad(got.color.sum() + got.depth.sum(), own)
        (t,) = torch.autograd.grad(expected[0].sum() + expected[2].sum(), far)
        assert bool(torch.isfinite(g).all())
        torch.testing.assert_close(g.cpu().double(), t, rtol=1e-4, atol=1e-5 * float(t.abs().max()) + 1e-30)


def test_occupancy_of_a_field_covers_it_and_changes_no_image(device):
    def field(p):
        return 40.0 * (p.norm(dim=-1) < 0.45).float()

    grid = OccupancyGrid.of_density(field, 16, 0.8, threshold=0.5, device=device)
    assert 0.05 < float(grid.occupied.float().mean()) < 0.45  # the ball fills 0.09 of the cube, a cell more around it
    origins, directions = rays(device, 200, 6)
    outs = []
    for g in (grid, full_grid(16, 0.8, device)):
        samples = march_rays(origins, directions, g, 0.02)
        p = samples.positions(origins, directions)
        outs.append((len(p), composite(field(p), p.abs(), samples)))
    assert outs[0][0] < 0.5 * outs[1][0]
    torch.testing.assert_close(outs[0][1].opacity, outs[1][1].opacity, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(outs[0][1].color, outs[1][1].color, rtol=1e-5, atol=1e-6)


def test_bad_input_is_named(device):
    grid, (o, d) = full_grid(4, 1.0, device), rays(device, 4)
    samples, density, color = packed([3], device)
    for call, message in (
        (lambda: march_rays(o, d, grid, 0.0), "step"),
        (lambda: march_rays(o, d, grid, 0.1, near=2.0, far=1.0), "near"),
        (lambda: march_rays(o, d, grid, 0.1, shift=torch.ones(4, device=device)), "shift"),
        (lambda: march_rays(o, d[:2], grid, 0.1), "directions: expected shape"),
        (lambda: OccupancyGrid(torch.ones(2, 3, 2, dtype=torch.bool, device=device), 1.0), "occupied: expected"),
        (lambda: composite(density[:2], color, samples), "density: expected"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
