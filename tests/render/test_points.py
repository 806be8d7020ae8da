"""Inputs of the shader: rows, numbers, parts of points."""

import pytest
import torch

from reli3d.render.environment import Environment
from reli3d.render.gaussians import SphericalGaussians, shade_gaussians
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from tests.support.scenes import shadow_caster, sky
from tests.support.surfaces import points


def test_one_row_and_plain_numbers_hold_for_all_points(device):
    """Equal bit for bit to the expanded values, and gradients that are the rows' sums."""
    normal, wo = (v.to(device) for v in points(300))
    light = Environment(sky().radiance.to(device))
    color = torch.tensor([0.8, 0.5, 0.2], device=device)
    one = torch.full((300,), 0.3, device=device)
    full = [v.requires_grad_() for v in (color.expand(300, 3).contiguous(), one, one.clone())]
    expected = shade(SurfacePoints(normal, normal, normal, *full), wo, light)
    assert torch.equal(expected, shade(SurfacePoints(normal, normal, normal, color, 0.3, one[:1]), wo, light))
    few = [v.clone().requires_grad_() for v in (color[None], one.detach()[0], one.detach()[:1])]
    got = shade(SurfacePoints(normal, normal, normal, *few), wo, light)
    assert torch.equal(got, expected)
    many, sums = torch.autograd.grad(expected.sum(), full), torch.autograd.grad(got.sum(), few)
    for a, b in zip(many, sums):
        torch.testing.assert_close(a.sum(0), b.reshape(a.shape[1:]), rtol=1e-5, atol=1e-5)  # 300 float32 numbers
    flat = shade(SurfacePoints(normal, normal[0], normal[:1], 0.5, 0.3, 0), wo[0], light)
    rows = [v.expand(300, 3) for v in (normal[:1], normal[:1], color.new_full((1, 3), 0.5))]
    assert torch.equal(flat, shade(SurfacePoints(normal, *rows, one, 0 * one), wo[:1].expand(300, 3), light))


def test_a_part_of_points_has_the_bits_of_the_whole(device):
    """With shadows, whose rays are traced in chunks; none and no samples too."""
    normal, wo = (v.to(device) for v in points(6000))
    whole, light = SurfacePoints(normal, normal, normal, normal.abs(), 0.3, 0.0), Environment(sky().radiance.to(device))
    scene, ids = shadow_caster(device), torch.arange(700, 900, dtype=torch.int32, device=device)
    part = shade(whole[700:900], wo[700:900], light, scene=scene, pixels=ids)
    assert len(part) == 200 and torch.equal(part, shade(whole, wo, light, scene=scene)[700:900])
    assert shade(whole[:0], wo[:0], light).shape == (0, 3)
    assert float(shade(whole, wo, light, options=ShadeOptions(samples=(0, 0, 0))).abs().max()) == 0.0


@pytest.mark.parametrize("name", ["normal", "ng", "base_color", "roughness", "metallic", "position", "wo"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_values_that_are_not_finite_give_nan_in_their_row_only(device, name, value):
    """Minima and maxima of the formulas would make a plausible color of it."""
    normal, wo = (v.to(device) for v in points(40))
    light = Environment(sky().radiance.to(device))
    lobe = SphericalGaussians(normal[:1], normal.new_tensor([3.0]), normal.new_ones(1, 3))
    finish = dict(base_color=normal.abs(), roughness=normal[:, 0].abs(), metallic=normal[:, 1].abs())
    values = dict(position=0.3 * normal, ng=normal, normal=normal, **finish, wo=wo)
    broken = {k: v.clone() for k, v in values.items()}
    broken[name][7].fill_(value) if broken[name].ndim == 1 else broken[name][7, 1:2].fill_(value)
    scenes = None, shadow_caster(device), shadow_caster(device, "warp")
    calls = [lambda p, wo, s=s: shade(p, wo, light, scene=s) for s in scenes]
    if name not in ("position", "ng"):  # which play no part in it
        calls += [lambda p, wo: shade_gaussians(p, wo, lobe)]
    for call in calls:
        (*whole, wo), (*parts, bad_wo) = values.values(), broken.values()
        expected, got = call(SurfacePoints(*whole), wo), call(SurfacePoints(*parts), bad_wo)
        assert bool(expected.isfinite().all()) and bool(got[7].isnan().all())
        rest = torch.arange(40, device=device) != 7
        assert torch.equal(got[rest], expected[rest])


def test_directions_and_ranges_are_checked_on_request(device):
    normal, wo = (v.to(device) for v in points(30))
    light, requested = Environment(sky().radiance.to(device)), ShadeOptions(check_inputs=True)
    good = dict(position=normal, ng=normal, normal=normal, base_color=normal.abs(), roughness=0.5, metallic=1.0)
    valid = SurfacePoints(**good)
    assert torch.equal(shade(valid, wo, light, options=requested), shade(valid, wo, light))
    for name, value in (
        ("normal", 1.01 * normal),
        ("ng", 0.0 * normal),
        ("base_color", 1.5),
        ("roughness", -0.1),
        ("metallic", torch.nan),
        ("position", normal / 0.0),
    ):
        wrong = SurfacePoints(**{**good, name: value})
        with pytest.raises(ValueError, match=f"^{name}: expected .* in row 0$"):
            shade(wrong, wo, light, options=requested)
        shade(wrong, wo, light)  # else it goes into the formulas as it is
    wo[3] *= 2.0
    with pytest.raises(ValueError, match="^wo: expected unit vectors, got .* in row 3$"):
        shade(valid, wo, light, options=requested)
