from dataclasses import replace

import numpy as np
import pytest
import torch

from reli3d.views.folder import load_views
from reli3d.views.normalize import meeting_point, normalize, visual_hull
from reli3d.views.similarity import Similarity
from tests.support.rigs import eyes_around, sphere_views

BALL = ((0.0, 0.0, 0.0, 0.5),)


def turn(seed: int) -> torch.Tensor:
    q = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))[0]
    return q * torch.sign(torch.linalg.det(q))


def some_turn(seed: int, scale: float) -> Similarity:
    return Similarity(scale, turn(seed), torch.tensor([5.0, -9.0, 2.0], dtype=torch.float64))


def unturned(scale: float, *shift: float) -> Similarity:
    return Similarity.without_rotation(torch.tensor(shift, dtype=torch.float64), scale)


ROD = tuple((0.0, 0.05 * k, 0.0, 0.1) for k in range(-8, 9))  # 1.0 long, 0.2 thick


def one_sided(spheres):
    """Five eyes within 60 degrees about +Z."""
    angles = torch.tensor([[0, 0], [28, 5], [-28, 0], [5, 28], [0, -28]], dtype=torch.float64).deg2rad()
    a, e = angles.unbind(-1)
    eyes = 3.0 * torch.stack([e.cos() * a.sin(), e.sin(), e.cos() * a.cos()], -1)
    return sphere_views(spheres, eyes=eyes, fov=0.6, size=(160, 160))


@pytest.mark.parametrize("k", range(2))
def test_the_scale_of_a_one_sided_capture_does_not_depend_on_the_frame(k):
    """A rod across the views is 1 long; one along them is as deep as its silhouettes leave open, or 1.3 widths."""
    across, along = one_sided(ROD), one_sided(tuple((x, z, y, r) for x, y, z, r in ROD))
    sizes = []
    for views in (across, along):
        there = normalize(views.transformed(some_turn(k, 7.0)), "hull")
        sizes.append(1.0 / (7.0 * there.scale))
        assert float(there.apply(some_turn(k, 7.0).translation).norm()) < 0.25  # the middle, but for the open depth
    assert sizes[0] == pytest.approx(1.0, abs=0.06)  # a cell and two pixels
    assert sizes[1] == pytest.approx(1.3 * visual_hull(along).extent, rel=0.06)
    assert sizes[1] == pytest.approx(1.0 / normalize(along, "hull").scale, rel=0.06)


def test_similarities_are_a_group():
    a, b = some_turn(1, 1.3), some_turn(2, 2.3)
    points = torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    homogeneous = torch.cat([points, torch.ones(20, 1)], -1)
    exact = dict(rtol=0, atol=1e-12)  # float64, a few operations on values below 50
    torch.testing.assert_close(a.apply(points), (homogeneous @ a.matrix().T)[:, :3], **exact)
    torch.testing.assert_close(a.compose(b).matrix(), a.matrix() @ b.matrix(), **exact)
    torch.testing.assert_close(a.compose(b).apply(points), a.apply(b.apply(points)), **exact)
    torch.testing.assert_close(a.inverse().matrix() @ a.matrix(), torch.eye(4, dtype=torch.float64), **exact)
    assert Similarity.identity().is_identity()
    assert not a.is_identity()
    assert a.apply(points.float()).dtype == torch.float32


@pytest.mark.parametrize(
    "spheres, low, high",
    [
        (BALL, (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)),
        (((0.3, 0.0, 0.0, 0.1), (-0.3, 0.1, 0.2, 0.2)), (-0.5, -0.1, -0.1), (0.4, 0.3, 0.4)),
    ],
)
def test_the_hull_of_many_views_is_the_object(spheres, low, high):
    axes = 4.0 * torch.cat([torch.eye(3), -torch.eye(3)])
    hull = visual_hull(sphere_views(spheres, eyes=torch.cat([axes, eyes_around(8, 4.0)]), fov=0.4, size=(200, 200)))
    got = torch.stack(hull.box())
    # a cell and two pixels (4 * 0.4 / 200 each); the hull of a ball of radius 1/2 from distance 4 exceeds it by 0.004
    limit = 1.0 * hull.cell + 2 * 4 * 0.4 / 200 + 0.004
    torch.testing.assert_close(got, torch.tensor([low, high], dtype=torch.float64), rtol=0, atol=limit)
    assert limit < 0.1


FAR, NEAR = (300, -20, 5), (0.02, 0.1, 0)


@pytest.mark.parametrize(
    "count, scale, center", [(1, 40.0, (0, 0, 0)), (2, 40.0, FAR), (3, 0.01, NEAR), (8, 40.0, FAR)]
)
def test_an_object_anywhere_is_centered_and_scaled(count, scale, center):
    """A ball of diameter 1.  One view finds its middle if it is the point of the ray nearest to the origin."""
    similarity = normalize(sphere_views(BALL, count).transformed(unturned(scale, *center)), "hull")
    middle = similarity.apply(torch.tensor(center, dtype=torch.float64))
    radius = similarity.scale * 0.5 * scale
    # the hull of a few views of a ball exceeds it by up to 30 % (the limiting ball), mostly by its grid
    assert 0.5 / 1.35 < radius < 0.53
    assert float(middle.norm()) < 0.12
    assert torch.equal(similarity.rotation, torch.eye(3, dtype=torch.float64))


def test_normalization_does_not_depend_on_the_frame():
    """Scaling and shifting the rig changes the answer by that much and nothing else."""
    views = sphere_views(count=5)
    move = unturned(7.0, 3.0, 1.0, -2.0)
    there = normalize(views.transformed(move), "hull").compose(move)
    # c2w is float32: the grid shifts by 1e-6 and a cell at the edge may change sides
    torch.testing.assert_close(there.matrix(), normalize(views, "hull").matrix(), rtol=0, atol=0.04)


def test_auto_leaves_a_good_frame_alone_and_changes_a_bad_one():
    assert normalize(sphere_views(BALL, 4)).is_identity()
    assert normalize(sphere_views(BALL, 1)).is_identity()
    for scale, shift in ((0.3, 0.0), (0.6, 0.0), (1.4, 0.0), (2.5, 0.0), (1.0, 0.2), (1.0, 0.5)):
        move = unturned(scale, shift, 0.0, 0.0)
        moved = sphere_views(BALL, 4).transformed(move)
        similarity = normalize(moved)
        assert not similarity.is_identity()
        assert normalize(moved.transformed(similarity)).is_identity()  # once is enough
    assert normalize(sphere_views(BALL, 4).transformed(move), "none").is_identity()


def test_thin_parts_count():
    """A rod of spheres 1 pixel wide is far below a grid cell."""
    rod = tuple((0.0, 0.02 * k, 0.0, 0.012) for k in range(-25, 26))
    low, high = visual_hull(sphere_views(rod, 4, size=(150, 150))).box()
    assert float((high - low)[1]) == pytest.approx(1.02, abs=0.12)


def test_an_object_cut_by_the_border_is_not_lost():
    views = sphere_views(((0.0, 0.0, 0.0, 0.9),), 4, distance=2.2, fov=0.5)  # larger than the image
    hull = visual_hull(views)
    assert len(hull.points) > 1000
    assert float(hull.points.norm(dim=-1).max()) < 2.2


def test_views_that_cut_the_object_off_do_not_carve_the_hull():
    """One of nine masks, shifted to the border, would leave a part of the hull; with seven others it still counts."""
    views = sphere_views(count=9)
    wrong = torch.zeros_like(views.masks[4])
    wrong[:, :60] = views.masks[4][:, 60:]
    wrong[40:44, 0] = 1.0
    cut = replace(views, masks=(*views.masks[:4], wrong, *views.masks[5:]))
    rest = [i for i in range(9) if i != 4]
    assert torch.equal(visual_hull(cut).points, visual_hull(views.select(rest)).points)
    fewer = rest[:7]
    assert len(visual_hull(cut.select([*fewer, 4])).points) != len(visual_hull(cut.select(fewer)).points)


def test_rays_meet():
    eyes = torch.tensor([[2.0, 0.0, 1.0], [0.0, 2.0, 1.0]], dtype=torch.float64)
    point, spread = meeting_point(eyes, torch.tensor([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(point, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    assert spread == pytest.approx(0.5)  # sin^2 of the z axis is 1, of x and y 1/2
    ray = torch.tensor([[-1.0, 0.0, 0.0]], dtype=torch.float64)
    point, spread = meeting_point(eyes[:1], ray)
    torch.testing.assert_close(point, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))  # nearest to the origin
    assert spread == pytest.approx(0.0, abs=1e-12)
    away, _ = meeting_point(eyes[:1], -ray)
    torch.testing.assert_close(away, torch.tensor([3.0, 0.0, 1.0], dtype=torch.float64))


def test_cameras_that_agree_on_nothing_are_an_error():
    views = sphere_views(count=3)
    wrong = replace(views, c2w=views.c2w @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    with pytest.raises(ValueError, match="reli3d check"):
        normalize(wrong)
    assert normalize(wrong, "none").is_identity()
    with pytest.raises(ValueError, match="mode"):
        normalize(views, "center")


@pytest.mark.parametrize("name", ["Camera_01", "Lantern_01", "UCO3D_217-72983-41010", "UCO3D_639-13622-90739"])
def test_real_captures_are_left_alone_until_they_are_moved(shared_data, name):
    views = load_views(shared_data / "captures" / name)
    if name == "UCO3D_217-72983-41010":  # the hull of these four views reaches 0.64 to one side
        assert 0.9 < normalize(views).scale < 1.1 and float(normalize(views).translation.norm()) < 0.2
    else:
        assert normalize(views).is_identity()
    scales = [12.0 * normalize(views.transformed(some_turn(k, 12.0)), "hull").scale for k in range(4)]
    if name.startswith("UCO3D"):  # one-sided: the frame changes nothing but where the grid's cells lie, 3 % of a side
        np.testing.assert_allclose(scales, normalize(views, "hull").scale, rtol=0.06)
    move = some_turn(3, 12.0)
    similarity = normalize(views.transformed(move))
    size = 12.0 * similarity.scale  # of the capture in the network's frame; its longest side was 0.87 to 1.07
    assert 0.7 < size < 1.5  # the box of a turned object is another box, up to sqrt(2) smaller for a rod
    assert float((similarity.apply(move.translation)).norm()) < 0.3


def test_a_rod_as_long_as_the_unit_sphere_is_scaled_into_the_feature_volume():
    """Frames that put the object into the unit sphere, as NeuS does, exceed what the network was trained on."""
    rod = sphere_views(tuple((0.0, 0.05 * k, 0.0, 0.05) for k in range(-18, 19)), 16, distance=4.0)
    moved = normalize(rod).apply(visual_hull(rod).points)
    assert 0.45 < float(moved.abs().max()) < 0.62
