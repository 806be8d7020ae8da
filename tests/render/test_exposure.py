"""Exposure of photographs of an asset under estimated lighting: a white, mirror-like ball shows constant lighting."""

import pytest
import torch

from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.rays import RayScene
from reli3d.render import exposure
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.exposure import MAX_TINT, base_color_factor, estimate_base_color_and_light, photograph_ratio
from tests.support.scenes import ball, textures

SIZE = (160, 224)


@pytest.fixture
def scene(device):
    """A white metal ball of roughness 0.2 in light of 0.4, three cameras, and which pixels show nothing but it."""
    plain = ball(device)
    light = Environment.constant(torch.full((3,), 0.4, device=device))
    asset = Asset(plain.mesh, textures(4, device, (1.0, 1.0, 1.0), roughness=0.2, metallic=1.0), light)
    eyes = torch.tensor([[0.0, 0.3, 2.5], [2.0, 1.0, 0.4], [-1.5, 0.8, -1.2]], device=device)
    c2w = look_at(eyes, torch.zeros(3, device=device), torch.tensor([0.0, 1.0, 0.0], device=device))
    camera = Camera.from_fov(c2w, 0.7, SIZE[1], SIZE[0])
    return asset, camera, torch.ones(3, *SIZE, dtype=torch.bool, device=device)


def photographs(device, *radiance):
    """Of three cameras, in one linear color."""
    return linear_to_srgb(torch.tensor(radiance, device=device)).expand(3, *SIZE, 3).contiguous()


def ratio(asset, images, inside, camera):
    found = photograph_ratio(asset, images, inside, camera, RayScene(asset.mesh.vertices, asset.mesh.faces))
    assert found.shape == (3,)
    return float(found.mean())


@pytest.mark.parametrize("factor", [0.25, 1.0, 2.0])
def test_the_factor_between_light_and_photograph_is_found(device, scene, factor):
    asset, camera, inside = scene
    images = photographs(device, 0.4 * factor, 0.4 * factor, 0.4 * factor)
    # single scattering loses under 1 % at this roughness, rays over the facets of the ball's rim 1 % more, BLACK 0.3 %
    assert ratio(asset, images, inside, camera) == pytest.approx(factor, rel=0.02)


def test_pixels_that_are_cut_off_or_outside_do_not_count(device, scene):
    asset, camera, inside = scene
    images = photographs(device, 0.4, 0.4, 0.4)
    plain = ratio(asset, images, inside, camera)
    images[0] = 1.0  # overexposed
    images[1, :, :100] = 0.0
    inside[1, :, :100] = False
    assert ratio(asset, images, inside, camera) == pytest.approx(plain, rel=0.01)
    inside[1] = True
    assert ratio(asset, images, inside, camera) < 0.9 * plain


def test_pixels_and_rays_meet(device, scene):
    """A photograph that is bright in one half only: the mean is that of the half of the ball it shows."""
    asset, camera, inside = scene
    images = photographs(device, 0.0, 0.0, 0.0)
    images[:, :, : SIZE[1] // 2] = linear_to_srgb(torch.tensor(0.4)).item()
    assert ratio(asset, images, inside, camera) == pytest.approx(0.5, abs=0.02)  # the grid is symmetric


def test_where_nothing_is_seen_nothing_changes(device, scene):
    asset, camera, inside = scene
    images = photographs(device, 0.1, 0.1, 0.1)
    assert ratio(asset, images, torch.zeros_like(inside), camera) == 1.0


def colored(device, scene, *color):
    """The ball of ``scene`` with the linear base ``color``."""
    asset, camera, inside = scene
    maps = textures(4, device, color, roughness=0.6, metallic=0.0)
    return Asset(asset.mesh, maps, asset.environment), camera, inside


def factor(asset, images, inside, camera):
    rays = RayScene(asset.mesh.vertices, asset.mesh.faces)
    return base_color_factor(asset, images, inside, camera, rays).cpu()


def test_the_tint_of_photographs_goes_to_the_light(device, scene):
    asset, camera, inside = scene
    rays = RayScene(asset.mesh.vertices, asset.mesh.faces)
    found = photograph_ratio(asset, photographs(device, 0.36, 0.4, 0.44), inside, camera, rays).cpu()
    # one percent from single scattering and the rim, as above
    torch.testing.assert_close(found, torch.tensor([0.9, 1.0, 1.1]), rtol=0.03, atol=0)
    strong = photograph_ratio(asset, photographs(device, 0.1, 0.4, 0.4), inside, camera, rays).cpu()
    # the red of 0.25 over the mean of 0.75 is cut off at 1 / MAX_TINT, the others have 1 / 0.75; the brightness stays
    assert float(strong[1] / strong[0]) == pytest.approx(MAX_TINT / 0.75, rel=0.03)
    assert float(strong.mean()) == pytest.approx(0.75, rel=0.03)


def test_the_most_likely_base_color_is_the_mean_of_three_normal_distributions(device, scene):
    """Where base color, light and prediction are at the prior means nothing changes; else each pulls by its weight."""
    prior = float(torch.tensor(exposure.ALBEDO).exp())
    lit = prior * float(torch.tensor(exposure.LIGHT).exp())
    asset, camera, inside = colored(device, scene, prior, prior, prior)
    # two conversions to sRGB and back in float32
    plain = factor(asset, photographs(device, lit, lit, lit), inside, camera)
    torch.testing.assert_close(plain, torch.ones(3), rtol=1e-4, atol=0)
    weights = torch.tensor(
        [s**-2.0 for s in (exposure.ALBEDO_SPREAD, exposure.LIGHT_SPREAD, exposure.PREDICTION_SPREAD)]
    )
    weights = weights / weights.sum()
    dark = factor(asset, photographs(device, *3 * [lit / 3]), inside, camera)
    torch.testing.assert_close(dark, torch.full((3,), float((1 / 3) ** weights[1])), rtol=1e-4, atol=0)
    bright, *_ = colored(device, scene, *3 * [prior * 2])
    again = factor(bright, photographs(device, lit, lit, lit), inside, camera)
    torch.testing.assert_close(again, torch.full((3,), float(2.0 ** (weights[2] - 1))), rtol=1e-4, atol=0)


def test_a_base_color_more_saturated_than_the_images_is_reduced(device, scene):
    """A dark gray thing, guessed blue: the photographs are nearly gray."""
    asset, camera, inside = colored(device, scene, 0.03, 0.1, 0.15)
    images = photographs(device, 0.010, 0.013, 0.018)
    base_color = torch.tensor([0.03, 0.1, 0.15]) * factor(asset, images, inside, camera)
    assert 1.5 < float(base_color[2] / base_color[0]) < 3.5 and float(base_color.mean()) < 0.08
    assert torch.equal(factor(asset, images, torch.zeros_like(inside), camera), torch.ones(3))


def test_the_estimated_asset_shows_the_photographs_color(device, scene):
    asset, camera, inside = colored(device, scene, 0.03, 0.1, 0.15)
    images = photographs(device, 0.010, 0.013, 0.018)
    rays = RayScene(asset.mesh.vertices, asset.mesh.faces)
    after = estimate_base_color_and_light(asset, images, inside, camera, rays)
    found = photograph_ratio(after, images, inside, camera, rays).cpu()
    # same seed and samples, so only the tint that the light may not take, and BLACK, are left
    torch.testing.assert_close(found, torch.ones(3), rtol=0.1, atol=0)
    expected = factor(asset, images, inside, camera) * torch.tensor([0.03, 0.1, 0.15])
    got = after.textures.base_color[0, 0].cpu()
    torch.testing.assert_close(got, expected, rtol=1e-3, atol=0)
