"""Turntables: positions of a fixed camera by what does not change between images, and the axis of its views."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from reli3d.capture import capture as function
from reli3d.capture import moving
from reli3d.capture.mapping import Map
from reli3d.capture.turntable import on_turntable, rotates, turntable_positions
from reli3d.errors import InputError
from tests.support.mapped import overlap, view

SIZE = 320, 240


def noise(rng, width: int, height: int, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize(rng.integers(0, 255, (height, width, 3), dtype=np.uint8), size)


def turning(count: int, seed: int = 0) -> list[np.ndarray]:
    """Images of a patch that changes before a background that does not."""
    rng = np.random.default_rng(seed)
    images = [noise(rng, 40, 30, SIZE)] * count
    images = [image.copy() for image in images]
    for image in images:
        image[80:200, 100:220] = noise(rng, 12, 12, (120, 120))
    return images


def test_a_fixed_camera_and_a_turning_object_are_a_turntable():
    rng = np.random.default_rng(0)
    images = turning(10)
    ground_truth = np.zeros(SIZE[::-1], bool)
    ground_truth[80:200, 100:220] = True
    (position,) = turntable_positions(images)
    assert position.images == tuple(range(10)) and overlap(position.region, ground_truth) > 0.8  # found at 160 pixels
    for image in images:  # the table reaches the border on three sides
        image[150:] = noise(rng, 32, 9, (320, 90))
    ground_truth[150:] = True
    (position,) = turntable_positions(images)
    assert overlap(position.region, ground_truth) > 0.8


def test_a_turntable_that_is_photographed_from_several_heights():
    low, high = turning(9, 1), [np.roll(image, 30, 0) for image in turning(8, 2)]
    assert turntable_positions(low + high[:7]) == []  # too few to tell a position from a burst of hand-held images
    assert len(turntable_positions(low + high[:7], fixed=True)) == 2
    for image in low + high:
        image[:50] = 128  # a wall without texture
    mixed = [image for pair in zip(low, high, strict=False) for image in pair] + low[8:]
    positions = turntable_positions(mixed)
    assert [p.images for p in positions] == [(0, 2, 4, 6, 8, 10, 12, 14, 16), (1, 3, 5, 7, 9, 11, 13, 15)]
    for position, top in zip(positions, (80, 110), strict=True):
        ground_truth = np.zeros(SIZE[::-1], bool)
        ground_truth[top : top + 120, 100:220] = True
        assert overlap(position.region, ground_truth) > 0.8


def test_a_camera_that_moves_is_not_a_turntable():
    background = noise(np.random.default_rng(0), 40, 30, SIZE)
    moving = [np.roll(background, 9 * k, 1) for k in range(10)]
    for image in moving:
        image[:60] = 255  # an overexposed sky
    assert turntable_positions(moving) == []
    (position,) = turntable_positions(moving, fixed=True)
    assert position.images == tuple(range(10))


@pytest.mark.parametrize("step, reason", [(0.0, "features that do not turn"), (3.0, "an object that stands out")])
def test_a_fixed_camera_and_a_table_that_does_not_turn_are_refused(step, reason, monkeypatch, tmp_path):
    """Views of a table that does not turn are equal; those of a hand-held arc of 24 degrees are not.

    step: degrees between neighboring views.  The maps have no points, and hence no object.
    """
    (tmp_path / "photographs").mkdir()
    views = []
    for k, image in enumerate(turning(9)):
        cv2.imwrite(str(tmp_path / "photographs" / f"{k}.png"), image)
        azimuth, height = np.radians(step * k), 1.0 + 0.1 * step * (k % 2)
        views.append(view(k, np.array([3 * np.cos(azimuth), 3 * np.sin(azimuth), height])))
    found = Map(tuple(views), np.zeros((0, 3)), np.zeros(0), np.zeros(0), ())
    for module in (function, moving):
        monkeypatch.setattr(module, "map_photos", lambda *_: found)
    with pytest.raises(InputError, match=reason):
        function.capture(tmp_path / "photographs", tmp_path / "object")


@pytest.mark.parametrize(
    "tilt, height, fixed", [(0.0, 0.0, True), (0.3, 0.003, True), (3.0, 0.0, False), (0.0, 0.2, False)]
)
def test_views_of_a_turntable_have_one_axis_in_camera_axes(tilt, height, fixed):
    """tilt: degrees by which every second camera is tilted.  height: of every second camera, over the distance."""
    views = []
    for k, azimuth in enumerate(2 * np.pi * np.arange(15) / 20):  # three quarters of a turn
        shown = view(k, 3.0 * np.array([np.cos(azimuth), np.sin(azimuth), 0.5]))
        tilted = cv2.Rodrigues(np.radians([tilt * (k % 2), 0, 0]))[0]
        moved = shown.translation + [0, 3.0 * height * (k % 2), 0]
        views.append(replace(shown, rotation=tilted @ shown.rotation, translation=tilted @ moved))
    assert on_turntable(views) == fixed
    assert rotates(views) and not rotates([views[0]] * 15)
    assert not on_turntable(views[:2]) and not on_turntable([views[0]] * 15)  # a camera that is fixed to the object
