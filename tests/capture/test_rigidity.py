"""Objects and surroundings that move between views: epipolar fit of matches, groups of views with one rigid motion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from reli3d.capture import capture as function
from reli3d.capture import mapping, moving
from reli3d.capture.mapping import Map, View
from reli3d.capture.report import CaptureReport
from reli3d.capture.rigidity import Group, completed_groups, epipolar_fit, rigid_groups
from reli3d.capture.scene import Scene
from reli3d.errors import InputError
from tests.support.mapped import SIZE, view


def ring(count: int = 12) -> list[View]:
    azimuth = 2 * np.pi * np.arange(count) / count
    return [view(k, 3.0 * np.array([np.cos(a), np.sin(a), 0.5 + 0.2 * (k % 2)])) for k, a in enumerate(azimuth)]


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [0.2, 0.1, 0]


def hull_mask(pixels: np.ndarray) -> np.ndarray:
    mask = np.zeros(SIZE[::-1], np.uint8)
    cv2.fillConvexPoly(mask, np.rint(cv2.convexHull(pixels.astype(np.float32))).astype(np.int32), 255)
    return cv2.dilate(mask, np.ones((5, 5), np.uint8))


def map_of(views, matches=(), points=()) -> Map:
    points = np.reshape(points, (-1, 3))
    return Map(tuple(views), points, np.zeros(len(points)), np.full(len(points), 3), tuple(matches))


def all_pairs(pixels: list[np.ndarray]) -> list[tuple]:
    return [(a, b, pixels[a], pixels[b]) for b in range(len(pixels)) for a in range(b)]


def object_map(moved: bool) -> tuple[Map, dict[str, np.ndarray]]:
    """A map of an object that is moved after six of twelve views, or not, and of its surroundings; and its masks."""
    rng = np.random.default_rng(0)
    views, points = ring(), rng.uniform(-0.3, 0.3, (60, 3))
    surroundings = rng.uniform(-0.9, 0.9, (60, 3)) * (1, 1, 0.02) - (0, 0, 0.5)
    pixels, masks = [], {}
    for k, v in enumerate(views):
        shown = v.project(turned(points, 30) if moved and k >= 6 else points)[0]
        masks[v.photo.name] = hull_mask(shown)
        both = np.concatenate([shown, v.project(surroundings)[0]])
        pixels.append(both + rng.normal(0, 0.1, both.shape))
    return map_of(views, all_pairs(pixels)), masks


@pytest.mark.parametrize("moved", [False, True])
def test_matches_on_a_moved_object_do_not_fit_the_cameras(moved):
    found, masks = object_map(moved)
    fit = epipolar_fit(found, masks)
    assert fit < 0.75 if moved else fit > 0.97  # 36 of 66 pairs are across the motion
    assert epipolar_fit(found, masks, inside=False) > 0.97
    passes = [Group(1.0, np.eye(3), np.zeros(3), tuple(str(k) for k in part)) for part in (range(6), range(6, 12))]
    between = epipolar_fit(found, masks, between=passes)
    assert between < 0.5 if moved else between > 0.97


def test_views_join_the_group_whose_motion_their_matches_fit():
    """The object is moved after six of twelve views and lies elsewhere in the last; three views are in each group."""
    found, masks = object_map(True)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (60, 3))
    elsewhere = found.views[11].project(turned(points, -50))[0]
    masks["11"] = hull_mask(elsewhere)
    matches = [(a, b, x, np.concatenate([elsewhere, y[60:]]) if b == 11 else y) for a, b, x, y in found.matches]
    turn = (turned(np.eye(3), 30) - [0.2, 0.1, 0]).T
    groups = [
        Group(1.0, np.eye(3), np.zeros(3), ("0", "1", "2")),
        Group(1.0, turn.T, -turn.T @ [0.2, 0.1, 0], ("6", "7", "8")),
    ]
    got = completed_groups(replace(found, matches=tuple(matches)), groups, masks)
    assert [set(g.names) for g in got] == [{str(k) for k in part} for part in (range(6), range(6, 11))]
    assert [(g.scale, g.rotation.tolist()) for g in got] == [(g.scale, g.rotation.tolist()) for g in groups]


def test_wrong_matches_alone_are_no_motion():
    rng, masks = np.random.default_rng(0), {str(k): np.full(SIZE[::-1], 255, np.uint8) for k in range(3)}
    matches = [(a, b, *rng.uniform(0, SIZE, (2, 40, 2))) for b in range(3) for a in range(b)]
    assert epipolar_fit(map_of(ring(3), matches), masks) == 1.0


@pytest.mark.parametrize(
    "moved, cut_off, fix", [(False, 12, "step back"), (True, 12, "something else moves"), (False, 1, "sharper images")]
)
def test_the_advice_is_on_the_reason_why_most_views_are_left_out(moved, cut_off, fix, monkeypatch, tmp_path):
    """Not that the object is cut off where it moves, or where the masks of six of twelve views are wrong."""
    found, masks = object_map(moved)
    for folder in ("photographs", "masks"):
        (tmp_path / folder).mkdir()
        for v, mask in zip(found.views, masks.values(), strict=True):
            if int(v.photo.name) < cut_off:
                mask[0] = 255  # touches the border
            elif cut_off == 1 and int(v.photo.name) < 7:
                mask = np.roll(mask, (-1) ** int(v.photo.name) * 80, int(v.photo.name) % 3 % 2)
            pixels = mask if folder == "masks" else v.photo.pixels
            cv2.imwrite(str(tmp_path / folder / f"{v.photo.name}.png"), pixels)
    maps = iter([found])

    def mapped(*_):
        if first := next(maps, None):
            return first
        raise InputError("photographs", "expected images that overlap")

    for module in (function, mapping):
        monkeypatch.setattr(module, "map_photos", mapped)
    options = function.CaptureOptions(masks=tmp_path / "masks", turntable=False)
    with pytest.raises(InputError, match=fix):
        function.capture(tmp_path / "photographs", tmp_path / "object", options)


def test_what_moves_around_the_object_is_left_out_of_a_second_map(monkeypatch):
    """80 points move with the camera, 40 are on the object and 40 on its support."""
    rng = np.random.default_rng(0)
    views, points = ring(), rng.uniform(-0.3, 0.3, (80, 3))
    points[40:] = points[40:] * (2, 2, 0.02) - (0, 0, 0.4)
    corner, shown, masks = rng.uniform(5, 85, (80, 2)), [], {}
    for v in views:
        still = v.project(points)[0]
        masks[v.photo.name] = hull_mask(still[:40])
        shown.append(np.concatenate([still, corner]))
    first, second = (map_of(views, all_pairs([pixels[:n] for pixels in shown]), points) for n in (160, 80))
    on_object = np.arange(80) < 40
    scene = Scene(np.zeros(3), 3.0, None, on_object, ~on_object)
    regions: list[np.ndarray] = []

    def mapped(photos, progress, masks, lenses):
        regions.extend(masks)
        if len(regions) > len(views):
            raise InputError("photographs", "expected images that overlap")
        return second

    monkeypatch.setattr(mapping, "map_photos", mapped)
    fit = epipolar_fit(first, masks, inside=False)
    assert fit < 0.8 and epipolar_fit(first, masks) > 0.97
    for expected, surroundings, failed in ((second, fit, 0), (first, fit, 1), (first, 0.9, 0)):
        report = CaptureReport(12, surroundings_fit=surroundings)
        segmented = moving.Segmented(first, masks)
        result, _ = moving.without_moving(segmented, scene, masks, report, lambda *_: None)
        assert result.found is expected and len(report.failed) == failed and len(report.notes) == 1 - failed
    for region, pixels in zip(regions, shown, strict=False):
        found = region[tuple(pixels.astype(int).T[::-1])] > 0
        assert found[:80].all() and not found[80:].any()


def test_groups_of_views_have_the_motions_of_the_object():
    """The second map is the first, seen from the object: one similarity before the object was moved, and another."""
    first = ring()
    rng, turns = np.random.default_rng(1), []
    for _ in range(2):
        q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turns.append(q * np.sign(np.linalg.det(q)))
    shifts, second = ([1.0, -2.0, 0.5], [0.3, 0.2, 4.0]), []
    for k, v in enumerate(first):
        turn, shift = turns[k >= 7], np.array(shifts[k >= 7])
        rotation = v.rotation @ turn.T
        second.append(replace(v, rotation=rotation, translation=-rotation @ (2.5 * turn @ v.eye + shift)))
    groups = rigid_groups(map_of(first), map_of(second))
    assert [len(g.names) for g in groups] == [7, 5]
    for group, turn, shift in zip(groups, turns, shifts, strict=True):
        assert group.scale == pytest.approx(2.5)
        assert np.allclose(group.rotation, turn) and np.allclose(group.translation, shift)
        for name in group.names:
            pose, expected = group.moved(first[int(name)]), second[int(name)]
            assert np.allclose(pose.rotation, expected.rotation) and np.allclose(pose.eye, expected.eye)
    noisy = [replace(v, translation=v.translation + rng.normal(0, 1.0, 3)) for v in second]
    assert not [g for g in rigid_groups(map_of(first), map_of(noisy)) if len(g.names) > 4]


def test_normalized_coordinates_undo_the_lens():
    """Against OpenCV's model of the lens."""
    v = view(0, np.array([3.0, 0.4, 1.0]), radial=-0.12)
    points = np.random.default_rng(2).uniform(-0.6, 0.6, (50, 3))
    matrix = np.array([[v.focal, 0, v.principal[0]], [0, v.focal, v.principal[1]], [0, 0, 1]])
    lens = np.array([v.radial, 0.0, 0.0, 0.0])
    pixels = cv2.projectPoints(points, cv2.Rodrigues(v.rotation)[0], v.translation, matrix, lens)[0][:, 0]
    assert np.allclose(v.project(points)[0], pixels)
    local = points @ v.rotation.T + v.translation
    assert np.allclose(v.normalized(pixels), local[:, :2] / local[:, 2:], atol=1e-6)  # fixed-point iteration
    rays = v.rays(pixels)
    assert np.allclose(np.cross(rays, points - v.eye), 0, atol=1e-5)
