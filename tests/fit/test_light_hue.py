"""The start's lighting becomes less saturated, and colors of diffuse surfaces stay the same."""

from dataclasses import replace

import pytest
import torch

from reli3d.fit import refine as fit
from reli3d.fit.light_hue import CHROMATICITY_WEIGHT, MAX_FACTOR, with_neutral_light
from reli3d.render.environment import Environment
from tests.support import small_scene


def lit(color) -> Environment:
    rows = torch.linspace(2.0, 0.1, 16)[:, None, None]
    return Environment((rows * torch.tensor(color)).expand(16, 32, 3).contiguous())


def test_the_log_chromaticity_of_the_lighting_is_scaled_and_products_stay_the_same():
    start = replace(small_scene.ball(), environment=lit([1.2, 1.0, 0.8]))
    got = with_neutral_light(start)
    before, after = (a.light.radiance[3, 5].log() for a in (start, got))
    torch.testing.assert_close(after - after.mean(), CHROMATICITY_WEIGHT * (before - before.mean()))
    assert float(after.mean()) == pytest.approx(float(before.mean()), abs=1e-6)  # the brightness stays
    products = [a.textures.base_color * a.light.radiance[3, 5] for a in (start, got)]
    torch.testing.assert_close(*products)


def test_gray_and_black_lighting_stay_the_same_and_strong_colors_change_by_a_limited_factor():
    for color in ([0.7, 0.7, 0.7], [0.0, 0.0, 0.0]):
        start = replace(small_scene.ball(), environment=lit(color))
        got = with_neutral_light(start)
        torch.testing.assert_close(got.light.radiance, start.light.radiance)
        torch.testing.assert_close(got.textures.base_color, start.textures.base_color)
    start = replace(small_scene.ball(), environment=lit([1.0, 0.0, 0.0]))
    ratio = with_neutral_light(start).textures.base_color / start.textures.base_color
    assert float(ratio.max()) <= MAX_FACTOR + 1e-5 and float(ratio.min()) >= 1.0 / MAX_FACTOR - 1e-5


def test_a_fit_starts_from_the_lighting_of_the_given_chromaticity():
    true = replace(small_scene.ball(), environment=lit([1.2, 1.0, 0.8]))
    views = small_scene.input_views(true, 3, 24)
    start = replace(true, environment=Environment(0.7 * true.light.radiance))
    slopes = []
    for weight in (0.0, 0.5, 1.0):
        options = fit.RefineOptions(16, light_chromaticity=weight)
        result = fit.refine(start, views, steps=3, options=options)
        assert result.changed
        got, given = (a.light.radiance.mean((0, 1)).log() for a in (result.asset, start))
        slopes.append(float((got[0] - got[2]) / (given[0] - given[2])))
    assert slopes == pytest.approx([0.0, 0.5, 1.0], abs=0.1)  # three steps hardly change the lighting
