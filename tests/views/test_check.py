"""The check names the fault of cameras, wherever the eyes are, and draws the rig."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

import reli3d
from reli3d.views.check import draw_rig, explain_cameras, up_axis, verdict
from reli3d.views.folder import load_views
from tests.support import hostile
from tests.support.rigs import rig as cameras
from tests.support.rigs import sphere_views

EXAMPLE = Path(reli3d.__file__).parent / "assets" / "example"
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
ROLL = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
QUARTER = torch.tensor([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def transposed(c2w):
    result = c2w.clone()
    result[:, :3, :3] = c2w[:, :3, :3].transpose(1, 2)
    return result


MISTAKES = {
    "flipped": (lambda c: c @ FLIP, "camera axes look flipped"),
    "world_to_camera": (torch.linalg.inv, "look like world-to-camera;"),
    "colmap": (lambda c: torch.linalg.inv(c @ FLIP), "world-to-camera in OpenCV axes"),
    "transposed": (transposed, "rotations look transposed (world"),
    "transposed_flipped": (lambda c: transposed(c @ FLIP), "rotations look transposed and in OpenCV"),
    "upside_down": (lambda c: c @ ROLL, "upside down"),
    "quarter": (lambda c: c @ QUARTER, "turned by 90 degrees"),
}


def rig(count=4):
    views = sphere_views(count=count, size=(120, 120))
    return replace(views, intrinsics=views.intrinsics - torch.tensor([0.0, 0.0, 3.0, -2.0]))  # a turn keeps the center


@pytest.mark.parametrize("count", [2, 6])
def test_right_cameras_agree(count):
    views = replace(rig(count), names=("a\nb\x1b[31m.png", *map(str, range(1, count))))
    lines = explain_cameras(views)
    assert len(lines) == count + 1 and all(line.isprintable() for line in lines)
    assert lines[-1] == verdict(views) and lines[-1].startswith("cameras agree") and "left as it is" in lines[-1]


@pytest.mark.parametrize("name", MISTAKES)
def test_the_mistake_is_named(name):
    change, words = MISTAKES[name]
    views = rig(6)
    line = explain_cameras(replace(views, c2w=change(views.c2w).contiguous()))[-1]
    assert line.startswith("suspect: ")
    assert words in line


def test_inverted_masks_one_wrong_view_and_unrelated_cameras_are_named():
    views = rig(5)
    inverted = replace(views, masks=tuple(1 - m for m in views.masks))
    assert explain_cameras(inverted)[-1].startswith("suspect: the masks look inverted")
    one, unrelated = views.c2w.clone(), views.c2w.clone()
    one[3] = one[3] @ FLIP
    assert "view 3 (3.png) does not agree" in explain_cameras(replace(views, c2w=one))[-1]
    unrelated[:, :3, 3] += torch.randn(5, 3, generator=torch.Generator().manual_seed(1)) * 2
    assert explain_cameras(replace(views, c2w=unrelated))[-1].startswith("suspect: ")


def test_one_view_reports_its_ambiguities():
    views = rig(1)
    assert explain_cameras(views)[-1].startswith("one view: nothing to compare")
    assert "looks away from the origin" in explain_cameras(replace(views, c2w=views.c2w @ FLIP))[-1]


@pytest.mark.parametrize("change", [lambda c: c, lambda c: c @ FLIP, lambda c: torch.linalg.inv(c)])
def test_the_image_is_drawn_for_right_and_wrong_cameras(tmp_path, change):
    views = sphere_views(count=9)
    draw_rig(replace(views, c2w=change(views.c2w)), tmp_path / "rig.png")
    bitmap = Image.open(tmp_path / "rig.png")
    assert bitmap.width > 1000
    colors = {c for _, c in bitmap.getcolors(1 << 20)}
    assert {(214, 39, 40), (0, 200, 0)} <= colors  # the last frustum and the outline of a mask
    assert [p.name for p in tmp_path.iterdir()] == ["rig.png"]


@pytest.mark.parametrize("name", ["Camera_01", "Lantern_01", "UCO3D_217-72983-41010", "UCO3D_639-13622-90739"])
def test_real_captures(shared_data, name):
    views = load_views(shared_data / "captures" / name)
    for count in (2, 4):
        assert explain_cameras(views.select(count))[-1].startswith("cameras agree")
    for mistake in ("flipped", "world_to_camera", "colmap", "transposed"):
        change, words = MISTAKES[mistake]
        assert words in explain_cameras(replace(views, c2w=change(views.c2w)))[-1]


TURNS = {  # rotations of the world that carry +Y to the named axis
    "y": torch.eye(3),
    "-y": torch.diag(torch.tensor([1.0, -1.0, -1.0])),
    "x": torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "-x": torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "z": torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-z": torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}


def turned(c2w, rotation):
    result = c2w.clone()
    result[:, :3] = rotation @ c2w[:, :3]
    return result


@pytest.mark.parametrize("axis", TURNS)
def test_the_up_axis_is_estimated_from_upright_cameras(axis):
    """Around at many heights, one of them nearly from above, all held upright but for a few degrees."""
    c2w = cameras((0, 20, 2), (80, 70, 2), (170, -10, 2.5), (260, 35, 2), (310, 50, 3))
    lean = torch.tensor(0.06)
    c2w[2, :3, :2] = c2w[2, :3, :2] @ torch.stack([lean.cos(), -lean.sin(), lean.sin(), lean.cos()]).view(2, 2)
    assert up_axis(turned(c2w, TURNS[axis])) == axis
    halfway = torch.matrix_exp(torch.linalg.cross(torch.eye(3), torch.tensor([0.5, 0.3, 0.4]).expand(3, 3)))
    assert up_axis(turned(c2w, halfway @ TURNS[axis])) is None  # 40 degrees from every axis


def test_cameras_without_a_common_up_axis_suggest_nothing():
    assert up_axis(cameras((0, 20, 2))) is None  # one
    assert up_axis(cameras((0, 20, 2), (4, 20, 2), (8, 25, 2))) is None  # from one side: up or towards us
    rolls = torch.randn(24, 3, 3, generator=torch.Generator().manual_seed(1))
    c2w = torch.eye(4).repeat(24, 1, 1)
    c2w[:, :3, :3] = torch.linalg.qr(rolls)[0]
    assert up_axis(c2w) is None


STORED, OPENCV = (torch.eye(4), "world-to-camera; store"), (FLIP, "in OpenCV axes")


@pytest.mark.parametrize("axes, words, offset", [(*STORED, 0.0), (*OPENCV, 0.25), (*STORED, 3.0), (*OPENCV, 3.0)])
def test_world_to_camera_matrices_of_a_folder_are_named(tmp_path, axes, words, offset):
    """Read as poses, those of a rig about the origin put all eyes in one point, and others move the origin."""
    folder = tmp_path / "object"
    shutil.copytree(EXAMPLE, folder)
    data = json.loads((folder / "transforms.json").read_text())
    for frame in data["frames"]:
        pose = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        pose[0, 3] += offset
        frame["transform_matrix"] = torch.linalg.inv(pose @ axes.double()).tolist()
    (folder / "transforms.json").write_text(json.dumps(data))
    line = verdict(load_views(folder))
    assert line.startswith("suspect: the matrices look like world-to-camera") and words in line


def drawn(folder, views) -> list[str]:
    lines = explain_cameras(views)
    draw_rig(views, folder / "rig.png")
    assert len(lines) == len(views) + 1 and not any("nan" in line for line in lines)
    assert Image.open(folder / "rig.png").size[0] > 1000
    return lines


PLACES = [(0.0, 0.0, 0.0), (0.3, -0.7, 1.9), (1e5, 3e5, -2e5), (1e-30, 0.0, 2e-30)]


@pytest.mark.parametrize(
    "place, spread, count, parallel",
    [
        *((place, 1e-12, 4, False) for place in PLACES),
        *((place, 0.0, 4, True) for place in PLACES[:2]),
        *((place, 0.0, count, False) for place, count in zip(PLACES, (1, 2))),
    ],
)
def test_eyes_in_one_point_are_reported(tmp_path, place, spread, count, parallel):
    """They look where the eyes of a right rig do, or all the same way."""
    views = sphere_views(count=count, size=(40, 40))
    c2w = views.c2w.clone()
    c2w[:, :3, 3] = torch.tensor(place) + spread * torch.arange(3.0 * count).reshape(count, 3)
    if parallel:
        c2w[:, :3, :3] = c2w[0, :3, :3]
    lines = drawn(tmp_path, replace(views, c2w=c2w))
    if not parallel and max(map(abs, place)) > 0.1 and count > 2:  # otherwise the views are one, and agree
        assert lines[-1].startswith("suspect: all cameras stand in one point")


def test_rigs_of_any_size_and_images_of_any_shape(tmp_path):
    for scale in (1e-30, 1e-18, 1e5):
        views = sphere_views(count=4, size=(40, 40))
        c2w = views.c2w.clone()
        c2w[:, :3, 3] *= scale
        drawn(tmp_path, replace(views, c2w=c2w))
    drawn(tmp_path, sphere_views(count=1, size=(300, 40), fov=1.5))
    drawn(tmp_path, sphere_views(count=1, size=(24, 200), fov=0.2))


def test_lenses_of_all_widths_have_a_verdict(tmp_path):
    """Found by the campaign: most of the hull is behind the camera of the second view, so that no footprint ends."""
    data = hostile.good(tmp_path)
    for frame, fov in zip(data["frames"], (0.011823446300047972, 2.780726955605057, 0.7154630259161558), strict=True):
        frame["camera_fov"] = [fov, fov]
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    assert explain_cameras(load_views(tmp_path))[-1].startswith("suspect")
