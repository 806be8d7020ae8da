"""Exposure of photographs of an asset under estimated lighting: a white, mirror-like ball shows constant lighting."""

import math

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
EVERYWHERE = torch.ones(3, *SIZE, dtype=torch.bool)


class Place:
    """A ball in light of 0.4, three cameras; base color, roughness and metallic of the ball as given."""

    def __init__(self, device, color=(1.0, 1.0, 1.0), roughness=0.2, metallic=1.0):
        light = Environment.constant(torch.full((3,), 0.4, device=device))
        self.asset = Asset(ball(device).mesh, textures(4, device, color, roughness, metallic), light)
        self.rays, self.device = RayScene(self.asset.mesh.vertices, self.asset.mesh.faces), device
        eyes = torch.tensor([[0.0, 0.3, 2.5], [2.0, 1.0, 0.4], [-1.5, 0.8, -1.2]], device=device)
        self.camera = Camera.from_fov(look_at(eyes), 0.7, SIZE[1], SIZE[0])

    def photographs(self, *radiance):
        """Of three cameras, in one linear color."""
        return linear_to_srgb(torch.tensor(radiance, device=self.device)).expand(3, *SIZE, 3).contiguous()

    def of(self, function, images, inside=EVERYWHERE):
        """``function(asset, images, inside, ...)`` of the module."""
        found = function(self.asset, images, inside.to(self.device), self.camera, self.rays)
        return found if isinstance(found, Asset) else found.cpu()


@pytest.fixture
def white(device):
    return Place(device)


@pytest.mark.parametrize("factor", [0.25, 1.0, 2.0])
def test_the_factor_between_light_and_photograph_is_found(white, factor):
    found = white.of(photograph_ratio, white.photographs(*3 * [0.4 * factor]))
    # single scattering loses under 1 % at this roughness, rays over the facets of the ball's rim 1 % more, BLACK 0.3 %
    assert found.shape == (3,) and float(found.mean()) == pytest.approx(factor, rel=0.02)
    assert float(white.of(photograph_ratio, white.photographs(0.1, 0.1, 0.1), ~EVERYWHERE).mean()) == 1.0


def test_pixels_that_are_cut_off_or_outside_do_not_count(white):
    images, inside = white.photographs(0.4, 0.4, 0.4), EVERYWHERE.clone()
    plain = float(white.of(photograph_ratio, images).mean())
    images[0] = 1.0  # overexposed
    images[1, :, :100] = 0.0
    inside[1, :, :100] = False
    assert float(white.of(photograph_ratio, images, inside).mean()) == pytest.approx(plain, rel=0.01)
    assert float(white.of(photograph_ratio, images).mean()) < 0.9 * plain


def test_pixels_and_rays_meet(white):
    """A photograph that is bright in one half only: the mean is that of the half of the ball it shows."""
    images = white.photographs(0.0, 0.0, 0.0)
    images[:, :, : SIZE[1] // 2] = linear_to_srgb(torch.tensor(0.4)).item()
    assert float(white.of(photograph_ratio, images).mean()) == pytest.approx(0.5, abs=0.02)  # the grid is symmetric


def test_the_tint_of_photographs_goes_to_the_light(white):
    found = white.of(photograph_ratio, white.photographs(0.36, 0.4, 0.44))
    # one percent from single scattering and the rim, as above
    torch.testing.assert_close(found, torch.tensor([0.9, 1.0, 1.1]), rtol=0.03, atol=0)
    strong = white.of(photograph_ratio, white.photographs(0.1, 0.4, 0.4))
    # the red of 0.25 over the mean of 0.75 is cut off at 1 / MAX_TINT, the others have 1 / 0.75; the brightness stays
    assert float(strong[1] / strong[0]) == pytest.approx(MAX_TINT / 0.75, rel=0.03)
    assert float(strong.mean()) == pytest.approx(0.75, rel=0.03)


def test_the_most_likely_base_color_is_the_mean_of_three_normal_distributions(device):
    """Where base color, light and prediction are at the prior means nothing changes; else each pulls by its weight."""
    prior = math.exp(exposure.ALBEDO)
    lit = prior * math.exp(exposure.LIGHT)
    spreads = exposure.ALBEDO_SPREAD, exposure.LIGHT_SPREAD, exposure.PREDICTION_SPREAD
    weights = [s**-2.0 / sum(k**-2.0 for k in spreads) for s in spreads]
    for guess, seen, expected in (
        (prior, lit, 1.0),
        (prior, lit / 3, (1 / 3) ** weights[1]),
        (2 * prior, lit, 2.0 ** (weights[2] - 1)),
    ):
        place = Place(device, 3 * (guess,), 0.6, 0.0)
        found = place.of(base_color_factor, place.photographs(*3 * [seen]))
        # two conversions to sRGB and back in float32
        torch.testing.assert_close(found, torch.full((3,), expected), rtol=1e-4, atol=0)


def test_a_base_color_more_saturated_than_the_images_is_reduced_and_shows_their_color(device):
    """A dark gray thing, guessed blue: the photographs are nearly gray."""
    guess = torch.tensor([0.03, 0.1, 0.15])
    place = Place(device, guess.tolist(), 0.6, 0.0)
    images = place.photographs(0.010, 0.013, 0.018)
    base_color = guess * place.of(base_color_factor, images)
    assert 1.5 < float(base_color[2] / base_color[0]) < 3.5 and float(base_color.mean()) < 0.08
    assert torch.equal(place.of(base_color_factor, images, ~EVERYWHERE), torch.ones(3))
    place.asset = place.of(estimate_base_color_and_light, images)
    torch.testing.assert_close(place.asset.textures.base_color[0, 0].cpu(), base_color, rtol=1e-3, atol=0)
    # same seed and samples, so only the tint that the light may not take, and BLACK, are left
    torch.testing.assert_close(place.of(photograph_ratio, images), torch.ones(3), rtol=0.1, atol=0)
