"""Calibration restores the part of a surface that training removes."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from reli3d.geometry.distance import signed_distance
from reli3d.nn.local import LocalField, LocalReconstructor
from reli3d.nn.presets import SMALL
from reli3d.synthetic.procedural import make_object
from reli3d.train.calibrate import MAX_ERROR, MIN_ERROR, calibrate, normal_map_error, one_standard_error_choice
from tests.support.stages import SEEDS


class _Thin(LocalReconstructor):
    """Knows the shape of one object exactly, and draws it 1.5 units too thin."""

    def encode(self, *inputs, **options):
        known = super().encode(*inputs, **options)
        return _ThinField(*(getattr(known, f.name) for f in dataclasses.fields(known)))


class _ThinField(LocalField):
    def _sdf_within(self, points, bound):
        distance = signed_distance(*self.model.shape, points.contiguous())
        return distance / self.model.preset.softness + 1.5 - self._offset()


def test_calibration_restores_the_missing_part(folder, tmp_path):
    """The best offset is the one that was taken away, from one view and from many, to a step of the offsets."""
    seed = SEEDS[0]
    (tmp_path / f"{seed}.safetensors").write_bytes((folder / f"{seed:010d}.safetensors").read_bytes())
    shape = make_object(seed)
    torch.manual_seed(0)
    # the cells of a coarser grid shift the best offset by a step
    model = _Thin(dataclasses.replace(SMALL, resolution=64)).eval()
    model.shape = torch.from_numpy(shape.vertices), torch.from_numpy(shape.faces)
    tried = calibrate(model, tmp_path, objects=1)
    preset = model.preset
    assert set(tried) == {1, 4} and max(tried[1].values()) > 0.9
    assert tried[1][1.5] > tried[1][0.0] + 0.02
    assert abs(preset.offset_one_view - 1.5) <= 0.25
    assert abs(preset.offset_many_views - 1.5) <= 0.25
    with pytest.raises(ValueError, match=r"expected \*.safetensors"):
        calibrate(model, tmp_path / "none")


def test_the_error_of_a_normal_map_is_its_squared_difference_over_the_area_of_the_object():
    """Two overlapping intervals with an angle between their normals: in the overlap |a - b|^2, elsewhere 1."""
    column = torch.arange(1000)
    filled, masked = column < 600, (column >= 100) & (column < 800)
    angle = torch.tensor(0.4, dtype=torch.float64)
    got, wanted = torch.tensor([[0.0, 0.0, 2.0]]), torch.stack([angle.sin(), 0 * angle, angle.cos()])[None].float()
    value = normal_map_error(got.expand(1000, 3), filled, wanted.expand(1000, 3), masked)
    expected = (500 * (2 - 2 * math.cos(0.4)) + 100 + 200) / 700
    assert abs(value - math.log(expected)) < 1e-5  # float32 sums
    assert normal_map_error(wanted, filled[100:101], wanted, masked[100:101]) == math.log(MIN_ERROR)
    assert normal_map_error(got.expand(1000, 3), column < 900, wanted.expand(1000, 3), column < 20) == MAX_ERROR


def test_the_first_choice_within_a_standard_error_of_the_best_is_taken():
    rng = np.random.default_rng(0)
    offset = rng.normal(0, 5, (32, 1))  # objects differ far more than choices do: differences count, not means
    noise = rng.normal(0, 1, (32, 4))
    errors = offset + np.array([1.0, 0.02, 0.0, 0.4]) + 0.3 * (noise - noise.mean(0))
    assert one_standard_error_choice(errors) == 1  # 0.02 is within 0.3 sqrt(2 / 32) = 0.075, 1.0 is not
    assert one_standard_error_choice(offset + np.array([0.2, 0.1, 0.0, 0.4])) == 2  # no noise, no tie
    assert one_standard_error_choice(np.array([[3.0, 1.0, 2.0]])) == 1
