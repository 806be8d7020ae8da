"""Silhouettes of several views agree: motions found by them, and masks that lack parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from reli3d.capture.consistency import aligned, completed_masks, masked_views
from reli3d.capture.mapping import View
from reli3d.capture.rigidity import Group, Similarity
from tests.support.mapped import SIZE, view
from tests.support.rigs import SPHERES

BOX = np.array([[-0.3, -0.35, -0.35], [0.5, 0.5, 0.5]])


def ring(count: int, start: float = 0.0) -> list[View]:
    angle = start + 2 * np.pi * np.arange(count) / count
    height = np.where(np.arange(count) % 2, 0.5, 1.4)
    eyes = np.stack([1.8 * np.cos(angle), 1.8 * np.sin(angle), height], -1)
    return [view(k, eye) for k, eye in enumerate(eyes)]


def silhouettes(views: list[View], spheres=SPHERES) -> dict[str, np.ndarray]:
    """Masks of the spheres in closed form, by the names of the views."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    masks = {}
    for v in views:
        rays = v.rays(np.stack([x.ravel(), y.ravel()], -1))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        hit = np.zeros(len(rays), bool)
        for *middle, radius in spheres:
            away = np.array(middle) - v.eye
            hit |= away @ away - (rays @ away) ** 2 <= radius**2
        masks[v.photo.name] = 255 * hit.reshape(SIZE[::-1]).astype(np.uint8)
    return masks


def renamed(views: list[View], mark: str) -> list[View]:
    return [replace(v, photo=replace(v.photo, name=mark + v.photo.name)) for v in views]


def pair_of_groups(spheres=SPHERES):
    fixed, others = renamed(ring(10), "a"), renamed(ring(10, 0.3), "b")
    return fixed, others, silhouettes(fixed + others, spheres)


def test_the_motion_between_two_groups_of_views_is_found_by_their_silhouettes():
    fixed, others, masks = pair_of_groups()
    turn = Rotation.from_rotvec(np.radians([1.0, -1.5, 1.0])).as_matrix()
    wrong = Similarity(0.98, turn, np.array([0.02, -0.03, 0.025]))  # of an object whose longest side is 0.8
    moved = [Group(wrong.scale, wrong.rotation, wrong.translation, ()).moved(v) for v in others]
    found = aligned(masked_views(fixed, masks), masked_views(moved, masks))
    corners = np.array(np.meshgrid(*BOX.T)).reshape(3, -1).T
    before = np.linalg.norm(wrong.apply(corners) - corners, axis=1)
    after = np.linalg.norm(found.apply(wrong.apply(corners)) - corners, axis=1)
    assert before.mean() > 0.03
    assert after.max() < 0.006  # a pixel is 0.0037 to 0.0046, and the corners lie outside the silhouettes


def test_a_turn_that_no_silhouette_shows_stays_as_it_is():
    fixed, others, masks = pair_of_groups(((0.0, 0.0, 0.1, 0.35),))
    shift = np.array([0.02, 0.0, -0.02])
    moved = [Group(1.0, np.eye(3), shift, ()).moved(v) for v in others]
    found = aligned(masked_views(fixed, masks), masked_views(moved, masks))
    assert np.degrees(Rotation.from_matrix(found.rotation).magnitude()) < 0.5
    middle = np.array([0.0, 0.0, 0.1])
    np.testing.assert_allclose(found.apply(middle + shift), middle, atol=0.004)


def test_groups_whose_masks_have_no_common_point_stay_where_they_are():
    fixed, others, masks = pair_of_groups()
    masks |= silhouettes(others[::2], ((-0.25, -0.3, 0.45, 0.05),))
    found = aligned(masked_views(fixed, masks), masked_views(others, masks))
    assert found.scale == 1.0 and np.array_equal(found.rotation, np.eye(3)) and not found.translation.any()


def test_parts_that_a_few_masks_lack_are_added_and_nothing_else():
    views = ring(16)
    truth, without = silhouettes(views), silhouettes(views, SPHERES[:2] + SPHERES[3:])
    blob = silhouettes(views, ((-0.3, -0.3, 0.2, 0.1),))
    masks = dict(truth)
    for name in ("2", "7", "12"):
        masks[name] = without[name]
    masks["5"] = np.maximum(truth["5"], blob["5"])  # a wrong part that one mask alone shows
    completed = completed_masks(views, masks, BOX)
    for name, mask in completed.items():
        wanted, found = np.maximum(truth[name], masks[name]) > 127, mask > 127
        assert found[masks[name] > 127].all()  # nothing is removed
        assert (found & ~wanted).sum() < 0.01 * wanted.sum(), name
    for name in ("2", "7", "12"):
        lacking = truth[name] > without[name]
        assert (completed[name][lacking] > 127).mean() > 0.8, name  # all but a pixel along the outline
    empty = np.zeros_like(truth["9"])
    completed = completed_masks(views, masks | {"9": empty}, BOX)
    assert not completed["9"].any() and (completed["12"][lacking] > 127).mean() > 0.8


def test_masks_that_agree_stay_as_they_are():
    views = ring(12)
    masks = silhouettes(views)
    completed = completed_masks(views, masks, BOX)
    assert all((completed[n] != m).mean() < 0.002 for n, m in masks.items())  # of the image: pixels on the outline


def test_masks_without_a_common_point_stay_as_they_are():
    views = ring(8)
    masks = silhouettes(views) | silhouettes(views[::2], ((-0.25, -0.3, 0.45, 0.05),))
    completed = completed_masks(views, masks, BOX)
    assert all(np.array_equal(completed[n], m) for n, m in masks.items())
