"""Turntables: positions of a fixed camera by what does not change between images, and the axis of its views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from reli3d.capture import capture as function
from reli3d.capture import mapping, turntable
from reli3d.capture.mapping import Map, View
from reli3d.capture.report import CaptureReport
from reli3d.capture.turntable import Position, on_turntable, rotates, turntable_positions
from reli3d.errors import InputError
from tests.support.mapped import overlap, view

SIZE = 320, 240


def quiet(stage: str, done: int, total: int) -> None:
    """No progress."""


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


def test_images_between_the_positions_are_left_out():
    low, high = turning(12, 1), [np.roll(image, 30, 0) for image in turning(9, 2)]
    low[11] = low[10].copy()  # the table paused
    between = [np.roll(image, 10 + 7 * k, (0, 1)) for k, image in enumerate(turning(4, 3))]
    positions = turntable_positions(low + between + high)
    assert [len(p.images) for p in positions] == [12, 9]
    assert not {12, 13, 14, 15} & {k for p in positions for k in p.images}
    assert turntable_positions(low[:8] + between + high[:3]) == []  # fewer than 80 % have a position


def test_a_turntable_fills_more_of_the_image_from_above():
    low, high = turning(9, 1), turning(9, 2)
    rng = np.random.default_rng(3)
    for image in high:
        image[:] = np.roll(image, 30, 0)
        image[60:] = noise(rng, 40, 23, (320, 180))
    assert [len(p.images) for p in turntable_positions(low + high)] == [9, 9]


def test_a_camera_may_be_turned_to_portrait_at_one_height():
    low, high = turning(9, 1), [np.rot90(image).copy() for image in turning(8, 2)]
    first, second = turntable_positions(low + high)
    assert first.region.shape == (240, 320) and second.region.shape == (320, 240)
    ground_truth = np.zeros(SIZE[::-1], bool)
    ground_truth[80:200, 100:220] = True
    assert overlap(second.region, np.rot90(ground_truth)) > 0.8


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
    for module in (function, mapping):
        monkeypatch.setattr(module, "map_photos", lambda *_: found)
    with pytest.raises(InputError, match=reason):
        function.capture(tmp_path / "photographs", tmp_path / "object")


def mapped(names: range, elevation: float) -> list[View]:
    """Views of a ring around +Z."""
    up, out = np.sin(elevation), np.cos(elevation)
    azimuth = 2 * np.pi * np.arange(len(names)) / len(names)
    return [view(k, 3 * np.array([out * np.cos(a), out * np.sin(a), up])) for k, a in zip(names, azimuth, strict=True)]


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(
    "high, registered, lighting, notes",
    [
        (0, 9, "camera", "the camera is fixed,"),
        (9, 18, "turntable", "2 positions"),
        (9, 11, "turntable", "2 positions"),
    ],
)
def test_the_lighting_follows_from_the_positions_with_views(known, high, registered, lighting, notes, monkeypatch):
    photos = [view(k, np.ones(3)).photo for k in range(9 + high)]
    region = np.full(photos[0].pixels.shape[:2], 255, np.uint8)
    positions = [Position(tuple(range(9)), region), Position(tuple(range(9, 9 + high)), region)][: 1 + (high > 0)]
    views = (mapped(range(9), 0.3) + mapped(range(9, 9 + high), 0.9))[:registered]
    found = Map(tuple(views), np.zeros((0, 3)), np.zeros(0), np.zeros(0), ())
    monkeypatch.setattr(mapping, "map_photos", lambda *_: found)
    monkeypatch.setattr(turntable, "map_photos", lambda *_: found)
    report = CaptureReport(len(photos))
    assert turntable.map_on_turntable(Path("photos"), photos, positions, report, quiet, known=known) is found
    assert report.lighting == lighting and notes in report.notes[0] and len(report.notes) == 1


def test_images_between_the_positions_do_not_count_as_lost(monkeypatch):
    photos = [view(k, np.ones(3)).photo for k in range(12)]
    position = Position(tuple(range(10)), np.full(photos[0].pixels.shape[:2], 255, np.uint8))
    found = Map(tuple(mapped(range(10), 0.3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), ())
    monkeypatch.setattr(mapping, "map_photos", lambda photos, *_: found if len(photos) == 10 else None)
    report = CaptureReport(len(photos))
    assert turntable.map_on_turntable(Path("photos"), photos, [position], report, quiet, known=False) is found
    assert report.left_out == dict.fromkeys(("10", "11"), "not from a position of the camera")
    assert report.images == 10


def test_views_of_a_moving_camera_are_not_on_a_turntable(monkeypatch):
    photos = [view(k, np.ones(3)).photo for k in range(10)]
    position = Position(tuple(range(10)), np.full(photos[0].pixels.shape[:2], 255, np.uint8))
    views = mapped(range(5), 0.3) + mapped(range(5, 10), 0.9)
    found = Map(tuple(views), np.zeros((0, 3)), np.zeros(0), np.zeros(0), ())
    monkeypatch.setattr(mapping, "map_photos", lambda *_: found)
    monkeypatch.setattr(turntable, "map_photos", lambda *_: found)
    report = CaptureReport(len(photos))
    place = Path("photos"), photos, [position], report, quiet
    assert turntable.map_on_turntable(*place, known=False) is None and not report.notes
    assert turntable.map_on_turntable(*place, known=True) is found
    assert report.lighting == "turntable" and "omit --turntable" in report.notes[1]


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
