"""The choice among many views: distinct ones first, and the notes about near-duplicates and narrow baselines."""

import itertools
import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.views.choose import DUPLICATE_DISTANCE_RAD, choose_views, spread_notes, view_distances
from reli3d.views.folder import MAX_VIEWS, load_views
from tests.support import hostile
from tests.support.rigs import rig


def crowd() -> torch.Tensor:
    """60 views: 57 within half a degree of view 0, and three others at 17, 33 and 51."""
    rng = torch.Generator().manual_seed(2)
    at = [(20.0 + 0.3 * x, 15.0 + 0.3 * y, 2.0 + 0.002 * z) for x, y, z in torch.rand(60, 3, generator=rng).tolist()]
    at[17], at[33], at[51] = (110.0, 20.0, 2.0), (200.0, 10.0, 2.2), (290.0, 40.0, 1.9)
    return rig(*at)


def test_of_sixty_views_of_which_57_are_near_identical_the_four_distinct_are_taken():
    assert choose_views(crowd(), 4) == [0, 17, 33, 51]
    assert choose_views(crowd(), 16, min_distance=DUPLICATE_DISTANCE_RAD) == [0, 17, 33, 51]
    assert len(choose_views(crowd(), 16)) == 16  # as many as requested


def test_the_choice_covers_within_twice_the_best():
    """Gonzalez's bound, against all choices of 3 of 9 with view 0 among them."""
    rng = torch.Generator().manual_seed(4)
    cameras = rig(*[(360 * x, 80 * y - 30, 2 + z) for x, y, z in torch.rand(9, 3, generator=rng).tolist()])
    distance = view_distances(cameras)[1]
    radius = lambda taken: float(distance[list(taken)].amin(0).max())
    best = min(radius((0, *rest)) for rest in itertools.combinations(range(1, 9), 2))
    assert radius(choose_views(cameras, 3)) <= 2 * best


def test_distance_counts_in_addition_to_direction():
    cameras = rig((0, 0, 2), (4, 0, 2), (0, 0, 0.5), (0, 5, 2))
    assert choose_views(cameras, 2) == [0, 2]  # a close-up adds more than four degrees
    angle, distance = view_distances(cameras)
    # axes within 5 degrees: the prior on the point where they meet still weighs a little
    assert float(angle[0, 1]) == pytest.approx(math.radians(4), rel=0.05) and float(angle[0, 2]) < 0.01
    assert float(distance[0, 2]) == pytest.approx(0.5 * math.log(4), rel=0.05)


def test_a_move_of_the_world_changes_nothing():
    cameras = crowd().double()
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn)
    moved = cameras.clone()
    moved[:, :3, :3] = turn @ cameras[:, :3, :3]
    moved[:, :3, 3] = 7.0 * cameras[:, :3, 3] @ turn.T + torch.tensor([3.0, -90.0, 1.0], dtype=torch.float64)
    assert choose_views(moved, 4) == choose_views(cameras, 4)


def test_all_views_the_same_or_one_view():
    same = crowd()[:1].expand(5, 4, 4)
    assert choose_views(same, 3) == [0, 1, 2] and choose_views(same, 3, min_distance=DUPLICATE_DISTANCE_RAD) == [0]
    assert choose_views(same[:1], 16) == [0] and spread_notes(same[:1]) == []
    with pytest.raises(ValueError, match="count: expected"):
        choose_views(same, 0)


def test_near_duplicates_and_a_narrow_baseline_are_reported():
    assert spread_notes(rig((0, 0, 2), (90, 0, 2), (180, 0, 2))) == []
    (near,) = spread_notes(rig((0, 0, 2), (90, 0, 2), (91, 0, 2), (180, 0, 2)))
    assert near.startswith("1 of 4 views lie within 3 degrees") and near.endswith(": 2")
    (narrow,) = spread_notes(rig((0, 0, 2), (10, 0, 2), (20, 0, 2)))
    assert narrow.startswith("narrow baseline: all views lie within 20.0 degrees")


def folder(path, cameras, cut_off=()) -> None:
    """A folder of views, of which those in ``cut_off`` show the object at the border."""
    data = hostile.good(path, len(cameras))
    for k, (frame, c2w) in enumerate(zip(data["frames"], cameras, strict=True)):
        frame |= {"transform_matrix": c2w.tolist(), "file_path": f"rgba/{k:02d}.png"}
        pixels = np.roll(hostile.random_image(), hostile.SIDE // 2 if k in cut_off else 0, 1)
        Image.fromarray(pixels).save(path / frame["file_path"])
    (path / "transforms.json").write_text(json.dumps(data))


def around(count) -> torch.Tensor:
    return rig(*[(360 * k / count, 20, 2) for k in range(count)])


def test_a_folder_of_sixty_is_read_as_its_four_distinct_views(tmp_path):
    cameras = crowd()
    folder(tmp_path, cameras)
    for requested in ({}, {"views": 4}):
        views = load_views(tmp_path, **requested)
        assert views.in_folder == 60 and torch.allclose(views.c2w, cameras[[0, 17, 33, 51]], atol=1e-5)
        (note,) = views.notes
        assert note.startswith("4 of 60 views taken by farthest-point sampling: 0, 17, 33, 51")
    whole = load_views(tmp_path, every=True)
    assert len(whole) == 60 and whole.notes == views.notes and torch.equal(whole.taken().c2w, views.c2w)
    assert whole.taken().taken() is not whole and len(whole.taken().taken()) == 4
    assert len(load_views(tmp_path, views=MAX_VIEWS)) == MAX_VIEWS


def test_views_that_cut_the_object_off_are_left_out_while_eight_remain(tmp_path):
    folder(tmp_path / "twelve", around(12), (0, 3, 7))
    others = tuple(f"rgba/{k:02d}.png" for k in range(12) if k not in (0, 3, 7))
    named = "3 masks touch the image's border, where the object is cut off: 0 (rgba/00.png), 3 (rgba/03.png), 7"
    views = load_views(tmp_path / "twelve")
    assert views.names == others and views.in_folder == 12
    (note,) = (n for n in views.notes if n.startswith(named))
    assert note.endswith("; left out of the hull and of the choice of views")
    every = load_views(tmp_path / "twelve", every=True)
    assert len(every) == 12 and every.taken().names == others
    assert set(load_views(tmp_path / "twelve", views=4).names) <= set(others)
    folder(tmp_path / "ten", around(10), (0, 3, 7))  # seven others
    views = load_views(tmp_path / "ten")
    assert len(views) == 10 and any(n.startswith(named) and n.endswith("; used all the same") for n in views.notes)


def test_of_many_views_that_all_cut_the_object_off_none_is_left_out(tmp_path):
    folder(tmp_path, around(18), range(18))
    views = load_views(tmp_path)
    assert len(views) == 16 and views.names[0] == "rgba/00.png"
    assert any(n.endswith("; used all the same") for n in views.notes)
    assert set(views.names) == set(load_views(tmp_path, every=True).taken().names)


def test_of_many_views_those_that_cut_the_object_off_are_replaced(tmp_path):
    folder(tmp_path, around(24), range(0, 24, 3))
    views = load_views(tmp_path)
    assert len(views) == 16 and not any(int(name[5:7]) % 3 == 0 for name in views.names)
