"""Parts of a capture by themselves: support plane, masks by color, and masks cut off by the border."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from reli3d.capture.masks import cleaned, key_mask, touches_border
from reli3d.capture.report import CaptureReport, check, widest_gap
from reli3d.capture.scene import find_plane
from tests.support.mapped import overlap


def test_the_support_plane_is_the_largest_area_and_not_the_most_points():
    """A cube of 6,000 points on a table of 800: the plane is the table, not a face of the cube."""
    rng = np.random.default_rng(0)
    table = np.concatenate([rng.uniform(-1, 1, (800, 2)), rng.normal(0, 0.002, (800, 1))], 1)
    faces = []
    for axis in range(3):
        for side in (-0.2, 0.2):
            face = rng.uniform(-0.2, 0.2, (1000, 3))
            face[:, axis] = side
            faces.append(face + [0, 0, 0.2])
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    eyes = np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(24, 1.0)], 1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = np.concatenate([table, *faces]) @ turn.T + [3, 4, 5]
    plane = find_plane(points, eyes @ turn.T + [3, 4, 5], 2.2)
    assert plane is not None
    assert plane.normal @ turn[:, 2] > np.cos(np.radians(0.5))  # noise of 0.002 over a side of 2
    assert abs(plane.height(np.array([[3.0, 4.0, 5.0]]))[0]) < 0.005
    assert find_plane(rng.normal(size=(500, 3)), eyes, 2.2) is None  # a cloud has none


def test_masks_by_color():
    image = np.full((200, 300, 3), (200, 205, 210), np.uint8)
    cv2.circle(image, (150, 100), 50, (120, 40, 30), -1)
    image = np.clip(image + np.random.default_rng(0).normal(0, 3, image.shape), 0, 255).astype(np.uint8)
    ground_truth = np.zeros((200, 300), np.uint8)
    cv2.circle(ground_truth, (150, 100), 50, 255, -1)
    assert overlap(key_mask(image), ground_truth) > 0.97  # half a pixel of the circle's edge is 2 %
    noise = np.random.default_rng(1).integers(0, 255, (200, 300, 3), dtype=np.uint8)
    assert key_mask(noise) is None


def test_islands_and_holes_of_a_mask():
    mask = np.zeros((200, 200), np.uint8)
    mask[50:150, 50:150] = 255
    mask[90:110, 90:110] = 0  # 4 % of the area: the hole of a handle stays
    mask[60:62, 60:62] = 0  # noise
    mask[10:20, 10:20] = 255  # an island without a seed
    mask[170:190, 170:190] = 255  # one with a seed
    result = cleaned(mask, np.array([[100.0, 60.0], [180.0, 180.0]]))
    assert result[100, 100] == 0 and result[61, 61] == 255 and result[15, 15] == 0 and result[180, 180] == 255


def test_a_mask_that_is_cut_off_touches_the_border():
    mask = np.zeros((100, 100), np.uint8)
    mask[20:80, 20:80] = 255
    assert not touches_border(mask)
    mask[20:80, 80:] = 255
    assert touches_border(mask)


def ring(count: int, elevation: float, end: float = 360.0) -> np.ndarray:
    azimuth, e = np.radians(np.arange(count) * end / count), np.radians(elevation)
    return 3.0 * np.stack([np.cos(e) * np.sin(azimuth), np.full(count, np.sin(e)), np.cos(e) * np.cos(azimuth)], -1)


def test_the_widest_gap_of_rings_of_cameras():
    """Closed forms; directions are sampled every degree."""
    assert widest_gap(ring(12, 0.0)) == pytest.approx(30.0, abs=1.0)
    slant = 2 * np.degrees(np.arcsin(np.cos(np.radians(30)) * np.sin(np.radians(15))))
    assert widest_gap(ring(12, 30.0)) == pytest.approx(slant, abs=1.0)
    assert widest_gap(ring(8, 0.0, 240.0)) == pytest.approx(360 - 210, abs=1.0)  # the last is at 210 degrees
    assert widest_gap(ring(60, 85.0)) == pytest.approx(2 * (85 - 45), abs=1.0)  # from above no side is seen
    assert widest_gap(np.concatenate([ring(12, 30.0), ring(12, -40.0)])) < 30


@pytest.mark.parametrize(
    "values, shown",
    [
        ({"registered": 43, "images": 54}, "43 of 54 images registered, at least 80 %"),
        ({"gap": 60.4}, "a sector of 60.4 degrees, less than 60 "),
        ({"agreement": 0.849}, "fills 84.9 % of a mask, at least 85 %"),
        ({"mask_fraction": 0.0297}, "covers 2.97 % of an image, at least 3 %"),
        ({"epipolar_fit": 0.798}, "79.8 % of the matches on the object fit the cameras, at least 80 %"),
    ],
)
def test_a_failed_check_names_a_value_outside_its_bound(values, shown):
    passing = {"images": 20, "registered": 20, "object_points": 500, "agreement": 0.95, "mask_fraction": 0.1}
    report = CaptureReport(**{**passing, **values})
    check(report)
    assert len(report.failed) == 1 and shown in report.failed[0]
