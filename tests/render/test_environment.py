"""Environment maps: orientation, lookup with gradients, importance sampling."""

import math

import numpy as np
import pytest
import torch

from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions, lat_long_texels, quarter_turn
from tests.support import chi2, mitsuba_scene, reference


def directions(n, seed=0):
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=torch.Generator().manual_seed(seed)), dim=-1)


def maps():
    g = torch.Generator().manual_seed(3)
    one = torch.zeros(10, 100, 3)
    one[4, 37] = 1.0
    sun = torch.rand(32, 64, 3, generator=g)
    sun[5, 9] = 1e6
    gap, line = torch.rand(32, 64, 3, generator=g), torch.rand(32, 64, 3, generator=g)
    gap[10:14] = 0.0  # the filter of the CDF leaves two of them black
    line[11] = 0.0
    return {
        "one texel": one,
        "constant": torch.ones(100, 100, 3),
        "3 x 2": torch.ones(2, 3, 3),
        "sun": sun,
        "four black rows": gap,
        "one black row": line,
        "odd": torch.rand(17, 33, 3, generator=g) ** 4,
    }


def test_axes_are_those_of_the_convention(device):
    marks = torch.zeros(4, 8, 3, device=device)
    marks[:, 3:5, 0] = 1.0  # center: +X
    marks[:, 5:7, 1] = 1.0  # right of it: +Z
    marks[0, :, 2] = 1.0  # first row: +Y
    env = Environment(marks)
    axes = torch.tensor([[1.0, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1], [0, 1, 0], [0, -1, 0]], device=device)
    expected = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 0], [1, 0, 1], [1, 0, 0]], device=device)
    torch.testing.assert_close(env.lookup(axes), expected, atol=1e-5, rtol=0)  # at a pole u is 0.5


def test_texels_are_found_from_their_directions_and_looked_up_there(device):
    d = lat_long_directions(16, device=device)
    texels, weight = lat_long_texels(d.reshape(-1, 3), 16)
    assert torch.equal(texels.gather(1, weight.argmax(1, keepdim=True))[:, 0], torch.arange(512, device=device))
    torch.testing.assert_close(weight.amax(1), torch.ones(512, device=device), atol=1e-4, rtol=0)  # of float32 angles
    radiance = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(2)).to(device)
    # u errs by 1e-7, a texel is 1 / 32 wide
    torch.testing.assert_close(Environment(radiance).lookup(d), radiance, atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match="maps: expected a width that is a multiple of 4, got 6"):
        quarter_turn(torch.ones(3, 6, 3), 1)


def test_directions_of_the_published_parametrization(goldens):
    data = np.load(goldens / "env_parametrisation.npz")
    uv, expected = data["uv"].reshape(-1, 2), torch.from_numpy(data["uv_direction"].reshape(-1, 3))
    ramp = torch.zeros(64, 128, 3)
    ramp[..., 0] = (torch.arange(128) + 0.5) / 128
    ramp[..., 1] = ((torch.arange(64) + 0.5) / 64)[:, None]
    got = Environment(quarter_turn(ramp, -1)).lookup(expected)[:, :2].numpy()
    inside = (uv[:, 0] > 0.01) & (uv[:, 0] < 0.99) & (uv[:, 1] > 0.01) & (uv[:, 1] < 0.99)
    assert np.abs(got - uv)[inside].max() < 1e-5


def test_lookup_and_its_gradient_equal_the_float64_reference(device):
    g = torch.Generator().manual_seed(1)
    radiance, d = torch.rand(9, 18, 3, generator=g), directions(20_000)
    weight = torch.rand(20_000, 3, generator=g)  # of one sign: sums that cancel have no digits left
    ins = [radiance.to(device).requires_grad_(), d.to(device).requires_grad_()]
    got = Environment(ins[0]).lookup(ins[1])
    doubles = [radiance.double().requires_grad_(), d.double().requires_grad_()]
    expected = reference.lookup_envmap(*doubles)
    # 1e-7 of u times 18 texels, with margin
    torch.testing.assert_close(got.cpu().double(), expected, rtol=0, atol=2e-5)
    assert reference.fraction_within(got, expected) >= 0.999
    grads = torch.autograd.grad((got * weight.to(device)).sum(), ins)
    expected_grads = torch.autograd.grad((expected * weight.double()).sum(), doubles)
    assert reference.fraction_within(grads[0], expected_grads[0]) >= 0.999
    # a direction may sit on a kink between texels
    assert reference.rows_within(*(reference.across(v, d) for v in (grads[1], expected_grads[1]))) >= 0.999


@pytest.mark.parametrize("name", chi2.MAPS)
def test_samples_fall_on_texels_by_their_density(device, name):
    env = Environment(maps()["sun" if name == "next to the sun" else name].to(device))
    height, width = env.radiance.shape[:2]
    u = torch.rand(1_000_000, 2, generator=torch.Generator().manual_seed(chi2.MAPS.index(name))).to(device)
    density = env.pdf
    if name == "next to the sun":  # one sample in a thousand: numbers that leave out its row and both neighbors
        rows, heights = env.cdf.rows.double()
        gap = float(rows[7] - rows[4])
        first = u[:, 0].double() * (1.0 - gap)
        u[:, 0] = torch.where(first < rows[4], first, first + gap).float().clamp(max=1.0 - 2.0**-24)
        near = lambda d: (d[:, 1] <= heights[4]) & (d[:, 1] >= heights[7])
        density = lambda d: torch.where(near(d), 0.0, env.pdf(d) / (1.0 - gap))
    d, pdf = env.sample(u)
    grid = chi2.Map(height, width, 2 if height * width > 1000 else 5)
    chi2.check(grid, d, density, finest=16)
    down, across = grid.places(d)
    off = [(v * n - (v * n).round()).abs() for v, n in ((down, height), (across, width))]
    inner = (off[0] > 1e-4) & (off[1] > 1e-4)  # of a texel; float32 angles are 1e-5 of one, a border's side is a toss
    assert ((env.pdf(d) / pdf - 1).abs() < 1e-5)[inner].all() and float(inner.float().mean()) > 0.99
    y, x = ((torch.arange(n, device=device) + 0.5) / n for n in (height, width))
    centers = grid.at(y.repeat_interleave(width).double(), x.repeat(height).double())[0].float()
    assert torch.equal(env.pdf(centers).reshape(height, width), env.cdf.density)  # exactly 0 where nothing is lit


@pytest.mark.parametrize("name", maps())
def test_density_is_the_light_of_a_texel_by_its_solid_angle(device, name):
    """Per sr: the mean of the bilinear luminance over the texel, by the integral of it over the sphere.  Each quarter
    of a texel is bilinear, so its mean is the value in its middle.  A constant map gives the uniform sphere."""
    map_ = maps()[name]
    height, width = map_.shape[:2]
    light = (map_.double() @ torch.tensor([0.2126, 0.7152, 0.0722]).double())[..., None].expand(-1, -1, 3)
    mean = torch.zeros(height, width, dtype=torch.float64)
    for a, b in ((0.25, 0.25), (0.25, 0.75), (0.75, 0.25), (0.75, 0.75)):
        phi = ((torch.arange(width).double() + a) / width - 0.5) * 2.0 * math.pi
        theta = (torch.arange(height).double()[:, None] + b) / height * math.pi
        axes = [theta.sin() * phi.cos(), theta.cos().expand(height, width), theta.sin() * phi.sin()]
        mean += reference.lookup_envmap(light, torch.stack(axes, -1))[..., 0] / 4.0
    edge = torch.cos(torch.arange(height + 1).double() / height * math.pi)
    angle = (edge[:-1] - edge[1:])[:, None] * 2.0 * math.pi / width
    d = directions(20_000, 4).double()
    across = (torch.atan2(d[:, 2], d[:, 0]) / (2.0 * math.pi) + 0.5) * width
    down = torch.acos(d[:, 1]) / math.pi * height
    inside = ((across - across.round()).abs() > 1e-4) & ((down - down.round()).abs() > 1e-4)  # off a texel's border
    d, column, row = d[inside], across[inside].long(), down[inside].long()
    got = Environment(map_.to(device)).pdf(d.float().to(device)).cpu().double()
    off = got - (mean / (mean * angle).sum())[row, column]
    # mass of a texel: two differences of float32 sums of up to 1, a rounding of 3e-8 at either end
    assert float((off * angle[row, 0]).abs().max()) < 1.2e-7
    if name in ("constant", "3 x 2"):  # the first row of 100 holds 2.5e-4 of the mass
        limit = {"constant": 2.5e-4, "3 x 2": 1e-6}[name]
        assert float((got * 4.0 * math.pi - 1.0).abs().max()) < limit


@pytest.mark.parametrize("name", maps())
def test_weights_are_bounded_so_no_sample_is_a_firefly(device, name):
    env = Environment(maps()[name].to(device))
    d, pdf = env.sample(torch.rand(50_000, 2, generator=torch.Generator().manual_seed(6)).to(device))
    weight = env.lookup(d) @ torch.tensor([0.2126, 0.7152, 0.0722], device=device) / pdf
    # a bilinear value is at most its texel's four corners; the CDF holds at least (1/8)^2 of each
    assert float(weight.max()) <= 16.5 * float(weight.mean())


def test_table_of_a_black_map_is_the_uniform_sphere_and_bad_texels_are_named(device):
    d, pdf = Environment(torch.zeros(4, 8, 3, device=device)).sample(torch.rand(1000, 2, device=device))
    torch.testing.assert_close(pdf, torch.full_like(pdf, 1 / (4 * math.pi)), rtol=1e-5, atol=0)
    bad = torch.zeros(4, 8, 3, device=device)
    bad[1, 2, 0] = float("nan")
    for call, message in ((lambda: Environment(bad).cdf, "finite"), (lambda: Environment(bad[:0]), r"\(H, W, 3\)")):
        with pytest.raises(ValueError, match=f"radiance: expected {message}"):
            call()
    assert Environment(torch.ones(2, 4, 3, device=device)).lookup(torch.zeros(0, 3, device=device)).shape == (0, 3)


def test_rotation_turns_the_light_about_y(device):
    env = Environment(torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(2)).to(device))
    yaw = 2 * math.pi * 5 / 32
    c, s = math.cos(yaw), math.sin(yaw)
    turn = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], device=device)
    d = directions(500).to(device)
    torch.testing.assert_close(env.rotated(yaw).lookup(d @ turn.T), env.lookup(d), atol=1e-4, rtol=0)
    there_and_back = env.rotated(0.3).rotated(-0.3).radiance.mean((0, 1))
    torch.testing.assert_close(there_and_back, env.radiance.mean((0, 1)), rtol=1e-5, atol=0)


@pytest.mark.slow  # Mitsuba starts its compiler
def test_lookup_equals_mitsubas_map():
    mi = mitsuba_scene.load()
    env = Environment(torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(2)))
    d = directions(4000)
    scene = mi.load_dict({"type": "scene", "light": mitsuba_scene.environment(mi, env.radiance)})
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(d.numpy().T.copy()))
    si = scene.ray_intersect(ray)
    got = np.array(scene.environment().eval(si)).T
    assert np.abs(got - env.lookup(d).numpy()).max() < 2e-3  # Mitsuba's map stores half floats


def test_irradiance_of_a_constant_and_of_a_gradient(device):
    """Of radiance a + b w.d, integrated analytically: pi a + 2 pi b w.n / 3.

    Texels of 16 rows integrate to 0.3 % of the largest value (their solid angles are exact, the cosine is taken in
    the middle).
    """
    along = (lat_long_directions(16, device=device) @ torch.tensor([0.36, 0.8, 0.48], device=device))[..., None]
    expected = (2.0 * torch.pi + 2.0 * torch.pi / 3.0 * along).expand(-1, -1, 3)
    got = Environment((2.0 + along).expand(-1, -1, 3).contiguous()).irradiance().radiance
    torch.testing.assert_close(got, expected, rtol=0, atol=3e-3 * float(expected.max()))


def test_enlarging_is_periodic_in_azimuth():
    radiance = torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(0))
    larger = Environment(radiance).resized(24).radiance
    turned = Environment(radiance.roll(5, 1)).resized(24).radiance
    torch.testing.assert_close(turned, larger.roll(15, 1), rtol=0, atol=1e-5)
    torch.testing.assert_close(larger[1::3, 1::3], radiance, rtol=0, atol=1e-5)  # at the centers of the texels


def test_constant_lighting_takes_numbers_or_a_tensor():
    light = Environment.constant([0.5, 1, 2.0], height=4)
    assert light.radiance.shape == (4, 8, 3) and light.radiance.dtype == torch.float32
    assert torch.equal(light.radiance, Environment.constant(torch.tensor([0.5, 1.0, 2.0]), height=4).radiance)
    assert light.radiance[3, 7].tolist() == [0.5, 1.0, 2.0]
    with pytest.raises(ValueError, match=r"^rgb: expected shape \(3,\), got \(2,\)$"):
        Environment.constant([0.5, 1.0])
