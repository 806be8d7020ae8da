"""The measures on held-out objects: each against a case whose answer is known."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from reli3d.errors import InputError
from reli3d.eval import heldout
from reli3d.eval.heldout import evaluate, light_error, mean_environment, scaled_square_error, square_error, summary
from reli3d.geometry.mesh import Mesh
from reli3d.nn.weights import load_model
from reli3d.pipeline import NoSurface
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions
from reli3d.synthetic.procedural import make_object
from reli3d.synthetic.samples import ObjectSurface, synthesize

FAR = Mesh(torch.eye(3) * 1e-3 + 50.0, torch.tensor([[0, 1, 2]], dtype=torch.int32))
AWAY = SimpleNamespace(mesh=FAR, textures=None, light=Environment(torch.ones(32, 64, 3)))  # in no camera's view


def test_a_factor_a_channel_is_forgiven_and_a_pattern_is_not():
    ground_truth = torch.rand(400, 3) * 0.6 + 0.2
    dimmed = linear_to_srgb(srgb_to_linear(ground_truth) * torch.tensor([0.5, 0.9, 0.7]))
    assert square_error(dimmed, ground_truth) > 1e-3
    assert scaled_square_error(dimmed, ground_truth) < 1e-9
    white = scaled_square_error(torch.ones_like(ground_truth), ground_truth)
    assert white == pytest.approx(float(ground_truth.var(0).mean()), rel=0.05)


def test_light_error_forgives_exposure_alone():
    sky = 0.5 + lat_long_directions(32)[..., 1:2].clamp(min=0).expand(-1, -1, 3)
    assert light_error(sky * 7.0 + 0.06, sky) < 1e-3  # 0.06 = 6 * 0.01: the floor is scaled too
    assert light_error(sky.flip(0), sky) > 0.3


def test_two_ways_to_average():
    rows = [{"iou": 0.5, "x_mse": 1e-2}, {"iou": 1.0, "x_mse": 1e-4}]
    got = summary(rows)
    assert got["x_psnr"] == pytest.approx(30.0) and got["iou"] == pytest.approx(0.75) and got["objects"] == 2
    assert got["x_psnr_pooled"] == pytest.approx(-10 * np.log10((1e-2 + 1e-4) / 2), abs=1e-3)


def test_an_empty_field_counts_as_nothing_found_and_spoils_no_mean(monkeypatch):
    """A network without surface, then one whose object is outside all cameras' views of the reference."""
    seed = 1_000_000_002
    light, rng = torch.ones(32, 64, 3), np.random.default_rng(seed)
    sample = synthesize(ObjectSurface(make_object(seed)), light, rng, size=48, views=12)

    def none(*args, **kwargs):
        raise NoSurface("sdf", "expected a surface, got none")

    monkeypatch.setattr(heldout, "reconstruct", none)
    row = evaluate(None, sample, seed, 4, light)
    assert row == {"empty": 1.0, "iou": 0.0}
    got = summary([row, {"empty": 0.0, "iou": 1.0, "x_mse": 1e-3}])
    assert (got["objects"], got["empty"], got["iou"]) == (2, 0.5, 0.5) and got["x_psnr"] == pytest.approx(30.0)
    monkeypatch.setattr(heldout, "reconstruct", lambda *args, **kwargs: AWAY)
    looked, seen = [], heldout.seen_colors
    monkeypatch.setattr(heldout, "seen_colors", lambda s, camera, at: looked.append(camera.c2w) or seen(s, camera, at))
    row = evaluate(None, sample, seed, 4, light)
    assert torch.equal(torch.stack(looked[::2]), sample["c2w"][-8:])  # none of the views that are input
    assert (row["empty"], row["iou"]) == (0.0, 0.0) and not any(key.endswith("mse") for key in row)


def test_a_sample_of_another_object_is_refused(monkeypatch):
    seed, light = 1_000_000_002, torch.ones(32, 64, 3)
    other = synthesize(ObjectSurface(make_object(seed + 1)), light, np.random.default_rng(0), size=48, views=9)
    monkeypatch.setattr(heldout, "reconstruct", lambda *args, **kwargs: AWAY)
    with pytest.raises(InputError, match=f"another object in the sample of seed {seed}"):
        evaluate(None, other, seed, 1, light)


@pytest.mark.slow
def test_the_shipped_weights_beat_a_guess_on_an_object():
    """One held-out object end to end: shape far better than chance, light better than the mean of two other skies."""
    seed = 1_000_000_002
    light = 0.2 + 3.0 * lat_long_directions(32)[..., 1:2].clamp(min=0).expand(-1, -1, 3).contiguous()
    sample = synthesize(ObjectSurface(make_object(seed)), light, np.random.default_rng(seed), views=12)
    side = 0.2 + lat_long_directions(32)[..., :1].abs().expand(-1, -1, 3)
    mean = mean_environment(torch.stack([torch.ones(32, 64, 3), side]))
    got = evaluate(load_model("small"), sample, seed, 4, mean)
    assert got["iou"] > 0.6
    assert got["light_error"] < got["mean_light_error"]
    assert 0.0 < got["base_color_scaled_mse"] < 0.1
