"""The lights of the package: laid out as every other map, of mean radiance 1, and placed as documented."""

import math

import pytest
import torch

from reli3d.render.environment import Environment
from reli3d.render.latlong import texel_solid_angles
from reli3d.render.lights import LIGHTS, sky, studio


@pytest.mark.parametrize("height", [16, 64, 128])
@pytest.mark.parametrize("name", LIGHTS)
def test_their_mean_radiance_is_one(name, height):
    radiance = LIGHTS[name](height).radiance
    assert radiance.shape == (height, 2 * height, 3) and bool((radiance > 0).all())
    mean = (radiance.mean((1, 2)).double() * texel_solid_angles(height, 2 * height)).sum() * 2 * height / (4 * math.pi)
    assert float(mean) == pytest.approx(1.0, abs=1e-5)  # float32 sums


def at(light: Environment, *direction: float) -> torch.Tensor:
    return light.lookup(torch.nn.functional.normalize(torch.tensor(direction), dim=0))


def test_they_shine_from_where_they_should():
    assert at(sky(), 0.5, 0.643, 0.58).mean() > 100 * at(sky(), -0.5, 0.643, -0.58).mean()  # the sun
    assert at(sky(), 0, 1, 0.01)[2] > 2 * at(sky(), 0, 1, 0.01)[0]  # a blue zenith
    assert at(sky(), 0, -1, 0.01)[0] > at(sky(), 0, -1, 0.01)[2]  # brown ground
    for box in ((-0.75, 0.5, 0.6), (0.9, 0.25, 0.35), (0.25, 0.45, -0.9), (0.05, 1.0, 0.0)):
        assert at(studio(), *box).mean() > 5 * at(studio(), box[0], -abs(box[1]) - 0.5, box[2]).mean()


def test_a_finer_map_is_the_same_light():
    """Irradiance of the maps of 64 and 128 rows: edges fade over a texel or two, the rest is the same."""
    for make in LIGHTS.values():
        coarse, fine = make(64).resized(16).irradiance(), make(128).resized(16).irradiance()
        torch.testing.assert_close(coarse.radiance, fine.radiance, rtol=0.08, atol=0)  # the sun is two texels wide
