"""The check of cameras names the fault and never ends in a traceback, wherever the eyes are."""

import json
from dataclasses import replace

import pytest
import torch
from PIL import Image

from reli3d.views.check import draw_rig, explain_cameras
from reli3d.views.folder import load_views
from tests.support import hostile
from tests.support.rigs import sphere_views


def at(place, *, spread=0.0, count=4, parallel=False):
    """Views whose eyes stand in ``place``; they look where the eyes of a right rig do, or all the same way."""
    views = sphere_views(count=count, size=(40, 40))
    c2w = views.c2w.clone()
    c2w[:, :3, 3] = torch.tensor(place) + spread * torch.arange(3.0 * count).reshape(count, 3)
    if parallel:
        c2w[:, :3, :3] = c2w[0, :3, :3]
    return replace(views, c2w=c2w)


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.3, -0.7, 1.9), (1e5, 3e5, -2e5), (1e-30, 0.0, 2e-30)])
@pytest.mark.parametrize("spread", [0.0, 1e-12])
def test_eyes_in_one_point_are_reported(tmp_path, place, spread, parallel):
    views = at(place, spread=spread, parallel=parallel)
    lines = explain_cameras(views)
    assert len(lines) == 5 and not any("nan" in line for line in lines)
    if not parallel and max(map(abs, place)) > 0.1:  # the same way from one point: the views are one, and agree
        assert lines[-1].startswith("suspect: all cameras stand in one point")
    draw_rig(views, tmp_path / "rig.png")
    assert Image.open(tmp_path / "rig.png").size[0] > 1000


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.3, -0.7, 1.9)])
def test_one_or_two_eyes(tmp_path, place, count):
    views = at(place, count=count)
    assert len(explain_cameras(views)) == count + 1
    draw_rig(views, tmp_path / "rig.png")


@pytest.mark.parametrize("scale", [1e-30, 1e-18, 1e-6, 1e5])
def test_rigs_of_any_size(tmp_path, scale):
    views = sphere_views(count=4, size=(40, 40))
    c2w = views.c2w.clone()
    c2w[:, :3, 3] *= scale
    explain_cameras(replace(views, c2w=c2w))
    draw_rig(replace(views, c2w=c2w), tmp_path / "rig.png")


def test_lenses_of_all_widths_have_a_verdict(tmp_path):
    """Found by the campaign: most of the hull is behind the camera of the second view, so that no footprint ends."""
    data = hostile.good(tmp_path)
    for frame, fov in zip(data["frames"], (0.011823446300047972, 2.780726955605057, 0.7154630259161558), strict=True):
        frame["camera_fov"] = [fov, fov]
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    assert explain_cameras(load_views(tmp_path))[-1].startswith("suspect")
