"""``bench.studies.estimators``: what it calls the truth is what the photographs show."""

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from bench.studies import estimators
from reli3d.eval.metrics import psnr
from reli3d.geometry.camera import Camera
from reli3d.nn.reni import map_directions
from reli3d.render.environment import Environment
from reli3d.synthetic.procedural import make_object
from reli3d.synthetic.samples import ObjectSurface, synthesize


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    light = 0.2 + 3.0 * map_directions(32)[..., :1].clamp(min=0).expand(-1, -1, 3).contiguous()
    sample = synthesize(ObjectSurface(make_object(3)), light, np.random.default_rng(3), size=64, views=6)
    path = tmp_path_factory.mktemp("estimators") / "0000000003.safetensors"
    save_file(sample, path)
    return path


def test_the_true_object_in_the_light_of_the_photographs_is_the_photographs(path):
    sample = load_file(path)
    light = Environment(sample["environment"].float())
    truth = estimators.truth_of(path, torch.rand(2, 8, 16, 3, generator=torch.Generator().manual_seed(0)))
    thing = ObjectSurface(make_object(3))
    for v, camera in enumerate(truth.cameras):
        radiance, _ = estimators.rendered(thing, camera, light, v)
        photograph = truth.views.images[v] * truth.views.masks[v][..., None]
        inside = truth.views.masks[v] > 0.99
        got = estimators.linear_to_srgb(radiance.clamp(0.0, 1.0))
        # eight rays of light a pixel in the photograph: some hundredths of noise, no more
        assert psnr(got[inside], photograph[inside]) > 28
        assert float((got - photograph)[inside].mean()) == pytest.approx(0.0, abs=0.01)


def test_two_lights_and_views_are_compared_at_their_exposure(path):
    maps = torch.rand(3, 8, 16, 3, generator=torch.Generator().manual_seed(0))
    truth = estimators.truth_of(path, maps)
    again = estimators.truth_of(path, maps)
    assert len(truth.relit) == 2 and all(len(views) == estimators.SEEN for views in truth.relit)
    assert torch.equal(truth.relit[0][0], again.relit[0][0]) and not torch.equal(truth.relit[0][0], truth.relit[1][0])
    assert all(isinstance(c, Camera) and (c.width, c.height) == (64, 64) for c in truth.cameras)
    assert len(truth.read.inputs) == estimators.READ


def test_the_arms_take_as_many_samples_and_differ_in_the_renderer_alone():
    arms = list(estimators.ARMS.values())
    assert arms[1].samples == (sum(arms[0].samples), 0, 0) and arms[1].shadows and arms[0].shadows
    assert [a.renderer for a in arms] == ["monte_carlo", "monte_carlo", "gaussians"]
    assert len({(a.image_size, a.batch, a.rate, a.weights, a.steps) for a in arms}) == 1


def test_cells_have_the_mean_its_interval_and_the_seeds():
    values = np.stack([np.full(20, 1.0), np.full(20, 2.0), np.full(20, 4.5)])
    assert estimators.cell(values) == "2.500 (2.500 to 2.500); 1.000 to 4.500"
