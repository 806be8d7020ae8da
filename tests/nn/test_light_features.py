"""Lighting features against Lambert's law under lights of known irradiance."""

import pytest
import torch
from torch.nn.functional import normalize

from reli3d.nn.heads import COLOR_MARGIN
from reli3d.nn.light_features import MIN_BRIGHTNESS, Shading, brightness_over_normal, harmonics, palette_of, unshaded
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.transfer import spherical_harmonics


def normals(n: int) -> torch.Tensor:
    return normalize(torch.randn(n, 3, generator=torch.Generator().manual_seed(0)), dim=-1)


def test_the_polynomials_span_the_spherical_harmonics():
    n = normals(200)
    own, other = harmonics(n).double(), spherical_harmonics(n.double())[:, :9]
    left = own - other @ torch.linalg.lstsq(other, own).solution
    assert float(left.abs().max()) < 1e-5  # float32 normals
    assert int(torch.linalg.matrix_rank(own)) == 9


def test_base_color_averages_out_and_the_light_remains():
    """Surface of random albedo under irradiance a + b.n in two colors: the fit recovers the relative irradiance.

    4000 points with 30 % albedo noise determine 9 numbers to about 1 %; the ridge shrinks the linear terms by 6 %
    (2 % against the variance 1/3 of a coordinate).
    """
    n = normals(4000)
    light = torch.stack([1.0 + 0.5 * n[:, 1], 1.0 - 0.3 * n[:, 0], torch.ones(4000)], -1)
    albedo = 0.4 * (1 + 0.3 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(1)))
    fit = brightness_over_normal(light * albedo, torch.ones(4000), n)
    torch.testing.assert_close(harmonics(n) @ fit, light / light.mean(0), rtol=0, atol=0.06)


def test_unobserved_points_have_no_weight():
    n = normals(2000)
    color = 0.5 + 0.3 * n[:, 1:2].expand(-1, 3)
    visible = (n[:, 1] > 0).float()
    spoilt = torch.where(visible[:, None] > 0, color, torch.full_like(color, 7.0))
    got, expected = (brightness_over_normal(c, visible, n) for c in (spoilt, color))
    torch.testing.assert_close(got, expected, rtol=1e-3, atol=1e-3)


def test_nothing_seen_and_black_give_one():
    n = normals(100)
    for color, visible in ((torch.zeros(100, 3), torch.ones(100)), (torch.zeros(100, 3), torch.zeros(100))):
        fit = brightness_over_normal(color, visible, n)
        torch.testing.assert_close(harmonics(n) @ fit, torch.ones(100, 3), rtol=0, atol=1e-5)
    assert torch.isfinite(brightness_over_normal(torch.rand(3, 3), torch.ones(3), normals(3))).all()


def test_the_palette_is_weighted_by_visibility():
    color = torch.cat([torch.full((30, 3), 0.25), torch.full((10, 3), 0.9)])
    visible = (torch.arange(40) < 30).float()
    got = palette_of(color, color.sqrt(), visible)
    torch.testing.assert_close(got[:3], torch.full((3,), 0.25).logit(), rtol=0, atol=1e-4)
    torch.testing.assert_close(got[3:6], torch.full((3,), 0.5).logit(), rtol=0, atol=1e-4)
    assert float(got[6:].max()) < 1e-2  # all visible points have one color
    both = palette_of(color, color, torch.ones(40))
    values = color.logit()[:, 0]
    assert float(both[6]) == pytest.approx(float(values.std(correction=0)), rel=1e-4)


def test_shade_divides_in_linear_light():
    albedo = torch.rand(100, 3) * 0.6 + 0.1
    shaded = linear_to_srgb(srgb_to_linear(albedo) * 0.3)
    torch.testing.assert_close(unshaded(shaded, torch.full_like(albedo, 0.3)), albedo, rtol=1e-4, atol=1e-5)


def test_features_in_their_order():
    n, color = normals(50), torch.rand(50, 3)
    observed = torch.zeros(9, 3)
    observed[0], observed[2] = 1.0, 2.0  # 1 + 2 y, negative below
    light = Environment.constant(torch.tensor([1.0, 2.0, 3.0])).irradiance()
    got = Shading(light, observed, torch.arange(12.0)).features(n, color)
    assert got.shape == (50, Shading.WIDTH)
    torch.testing.assert_close(got[:, :3], n)
    expected = torch.log(torch.tensor([1.0, 2.0, 3.0]) + 0.01)
    torch.testing.assert_close(got[:, 3:6], expected.expand(50, 3), rtol=0, atol=5e-3)  # the map's 16 rows
    brightness = (1 + 2 * n[:, 1]).clamp(min=MIN_BRIGHTNESS)
    torch.testing.assert_close(got[:, 6], torch.log(brightness), rtol=1e-4, atol=1e-5)
    unlit = unshaded(color, brightness[:, None].expand(-1, 3)).clamp(COLOR_MARGIN, 1 - COLOR_MARGIN)
    torch.testing.assert_close(got[:, 9:12], unlit.logit(), rtol=1e-3, atol=1e-3)
    assert torch.equal(got[:, 12:], torch.arange(12.0).expand(50, 12))
