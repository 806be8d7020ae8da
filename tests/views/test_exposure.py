"""Photographs of different exposure are scaled to one exposure by their EXIF data."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

import reli3d
from reli3d.io.images import with_exposure
from reli3d.render.color import linear_to_srgb, srgb_to_linear

SIZE, TIMES = 48, (1 / 50, 1 / 100, 1 / 200)  # 2 EV
BRIGHTEST = 0.9  # linear, of the object at 1/100


def radiance() -> torch.Tensor:
    """``(S, S, 3)``, from 0.05 to BRIGHTEST, at 1/100."""
    ramp = torch.linspace(0.05, BRIGHTEST, SIZE)
    return torch.stack([ramp.expand(SIZE, SIZE), ramp[:, None].expand(SIZE, SIZE), torch.full((SIZE, SIZE), 0.2)], -1)


def folder(path, exposed=TIMES, stated=TIMES, f_number=4.0, iso=200):
    """An object folder; images exposed for ``exposed`` seconds, with ``stated`` in the EXIF data (None: nothing)."""
    alpha = np.zeros((SIZE, SIZE, 1), np.uint8)
    alpha[8:40, 8:40] = 255
    frames = []
    for k, (time, written) in enumerate(zip(exposed, stated, strict=True)):
        color = linear_to_srgb((radiance() * time * 100.0).clamp(0.0, 1.0))
        pixels = np.concatenate([(255 * color + 0.5).byte().numpy(), alpha], -1)
        data = None if written is None else (written, f_number, iso)
        Image.fromarray(pixels).save(path / f"{k}.png", exif=with_exposure(data))
        angle = 2.0 * k
        pose = np.eye(4)
        pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        pose[:3, 3] = 2.0 * pose[:3, 2]
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    (path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    return path


def test_images_are_scaled_to_the_mean_exposure_and_saturated_pixels_stay_white(tmp_path):
    views = reli3d.load_views(folder(tmp_path))
    for image, time in zip(views.images, TIMES, strict=True):
        seen = (radiance() * time * 100.0 < 0.96) & (radiance() < 0.96)
        difference = (srgb_to_linear(image) - radiance()).abs()
        assert float(difference[seen].max()) < 0.02  # quantization of 8 bits, times 2
    assert bool((views.images[0][radiance() * 2.0 > 1.0] == 1.0).all())
    assert any("differ by 2.0 EV (EXIF); scaled" in note for note in views.notes)


@pytest.mark.parametrize(
    ("exposed", "stated", "note"),
    [
        ((1 / 100,) * 3, TIMES, "left as they are"),  # edited to equal brightness
        (TIMES, (None,) * 3, None),
        (TIMES, (1 / 50, None, 1 / 200), None),
        ((1 / 100,) * 3, (1 / 100,) * 3, None),
    ],
)
def test_other_images_stay_as_they_are(tmp_path, exposed, stated, note):
    views = reli3d.load_views(folder(tmp_path, exposed, stated))
    found = [n for n in views.notes if "EV" in n]
    assert len(found) == (note is not None) and all(note in n for n in found)
    for k, image in enumerate(views.images):
        stored = np.asarray(Image.open(tmp_path / f"{k}.png"))[..., :3]
        assert torch.equal((255.0 * image).round().byte(), torch.tensor(stored))


def test_broken_exposures_count_as_unknown(tmp_path):
    views = reli3d.load_views(folder(tmp_path, f_number=0.0))
    assert not [note for note in views.notes if "EV" in note]
