"""Calibration restores the part of a surface that training removes."""

import dataclasses

import numpy as np
import pytest
import torch

from reli3d.geometry.distance import signed_distance
from reli3d.nn.local import LocalField, LocalReconstructor
from reli3d.nn.presets import SMALL
from reli3d.synthetic.procedural import make_object
from reli3d.train.calibrate import MAX_MISMATCH, MIN_RATIO_DIFFERENCE, calibrate, mismatch, one_standard_error_choice
from tests.support.stages import SEEDS


class _Thin(LocalReconstructor):
    """Knows the shape of one object exactly, and draws it 1.5 units too thin."""

    def encode_for_inference(self, *inputs, mirrored=0):
        known = super().encode_for_inference(*inputs, mirrored=mirrored)
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


def test_mismatch_is_the_error_of_an_image_in_one_color_at_its_best_brightness():
    rng = np.random.default_rng(0)
    for fraction in (0.1, 0.5, 0.9):
        expected = rng.random(5000) < 0.4
        got = np.where(rng.random(5000) < fraction, expected, rng.random(5000) < 0.5)
        both = (expected & got).sum()
        _, residual, _, _ = np.linalg.lstsq(got[:, None].astype(float), expected.astype(float), rcond=None)
        value = mismatch(int(both), int(got.sum()), int(expected.sum()))
        assert abs(value - np.log(residual[0] / both)) < 1e-9
    assert mismatch(0, 10, 10) == mismatch(1, 1000, 1000) == MAX_MISMATCH
    assert mismatch(10, 10, 10) == np.log(MIN_RATIO_DIFFERENCE)


def test_the_first_choice_within_a_standard_error_of_the_best_is_taken():
    rng = np.random.default_rng(0)
    offset = rng.normal(0, 5, (32, 1))  # objects differ far more than choices do: differences count, not means
    noise = rng.normal(0, 1, (32, 4))
    errors = offset + np.array([1.0, 0.02, 0.0, 0.4]) + 0.3 * (noise - noise.mean(0))
    assert one_standard_error_choice(errors) == 1  # 0.02 is within 0.3 sqrt(2 / 32) = 0.075, 1.0 is not
    assert one_standard_error_choice(offset + np.array([0.2, 0.1, 0.0, 0.4])) == 2  # no noise, no tie
    assert one_standard_error_choice(np.array([[3.0, 1.0, 2.0]])) == 1
