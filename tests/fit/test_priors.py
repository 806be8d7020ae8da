"""The priors of the lighting lose weight where many views constrain it."""

import pytest
import torch

from reli3d.fit.losses import LIGHT_PRIOR_VIEWS, Weights, priors
from reli3d.fit.unknowns import Unknowns


def of_lights(views: int, lights: int) -> float:
    """The priors of one change of the lighting, given to each of ``lights`` lightings, and nothing else."""
    unknowns = Unknowns.zero(torch.ones(2, 2, 2), views, 4, lights)
    for grid in unknowns.light:
        grid[:] = torch.linspace(-1, 1, grid[0].numel()).view(grid[0].shape)
    return float(priors(unknowns, Weights(), views))


def test_priors_of_the_lighting_fall_with_the_squared_number_of_views_per_lighting():
    most = LIGHT_PRIOR_VIEWS
    for lights in (1, 2):
        full = of_lights(most * lights, lights)
        assert full > 0 and of_lights(most * lights // 2, lights) == pytest.approx(full)
        assert of_lights(2 * most * lights, lights) == pytest.approx(full / 4)
