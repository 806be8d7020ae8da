"""Cameras far from their origin, or at nearly one position: float64 where the poses are read, float32 about the object.

The spacing of float32 is 0.06 at 900,000: poses and vertices that went there lost their shape.
"""

import json

import numpy as np
import pytest
import torch

from reli3d.cli import infer
from reli3d.cli.export import main as export
from reli3d.errors import InputError
from reli3d.io.glb import glb_bytes, read_glb
from reli3d.pipeline import ReconstructOptions, reconstruct
from reli3d.render.asset import Asset
from reli3d.views.folder import load_views
from reli3d.views.normalize import FAR_DISTANCES, near_origin
from reli3d.views.similarity import Similarity
from tests.support import gltf, hostile
from tests.support.example import QUICK, moved_example
from tests.support.rigs import sphere_views
from tests.support.scenes import ball_mesh, textures

FARTHEST = (6e5, -4e5, 5e5)


def moved(folder, shift, scale=1.0):
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] *= scale
    matrix[:3, 3] = torch.tensor(shift, dtype=torch.float64)
    return moved_example(folder, matrix)


def poses(shift, scale=1.0, count=5):
    c2w = sphere_views(count=count).c2w.double()
    c2w[:, :3, 3] = scale * c2w[:, :3, 3] + torch.tensor(shift, dtype=torch.float64)
    return c2w


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("shift", [(9e5, 0, 0), FARTHEST])
def test_the_origin_of_a_far_rig_is_where_it_looks(shift, scale):
    at = near_origin(poses(shift, scale))
    # float32 rotations put the meeting point 1e-7 of the distance off
    torch.testing.assert_close(at, torch.tensor(shift, dtype=torch.float64), rtol=0, atol=1e-6 * scale)


NEAR = (0.9 * FAR_DISTANCES * 2.2, 0, 0)


FOLDED = [((0, 0, 0), 0.0), ((0.3, 0.7, 0.9), 0.0), (FARTHEST, 0.0)]  # cameras in one point are left to the check


@pytest.mark.parametrize(
    "shift, scale", [((0, 0, 0), 1.0), (NEAR, 1.0), ((300, -20, 5), 40.0), ((0, 0, 0), 4e5), *FOLDED]
)
def test_a_rig_that_is_not_far_stays(shift, scale):
    assert not bool(near_origin(poses(shift, scale)).any())


def test_one_view_is_far_only_where_it_looks_elsewhere():
    """The object of one view is where its ray is nearest to the origin: to move that would change the object."""
    towards, away = torch.eye(4, dtype=torch.float64)[None], torch.eye(4, dtype=torch.float64)[None].clone()
    towards[0, 2, 3], away[0, 2, 3] = 9e5, -9e5  # OpenGL cameras look along -z
    assert not bool(near_origin(towards).any())
    assert float(near_origin(away)[2]) == pytest.approx(-9e5 - 1)


@pytest.mark.parametrize("scale", [1e-7, 1e-20, 1e-44, 1e-300])
def test_a_rig_of_no_size_is_refused(tmp_path, scale):
    data = hostile.good(tmp_path)
    for frame in data["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= scale
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"expected a distance of 1e-06 or more to the object, got (2e-|0)"):
        load_views(tmp_path)


def test_a_far_folder_reads_as_a_near_one(tmp_path):
    near, far = load_views(infer.EXAMPLE), load_views(moved(tmp_path / "far", FARTHEST))
    assert near.origin == (0, 0, 0) and any("far from their origin" in note for note in far.notes)
    assert not any("far" in note for note in near.notes)
    eyes = near.c2w[:, :3, 3].double() + torch.tensor(FARTHEST, dtype=torch.float64)
    got = far.c2w[:, :3, 3].double() + torch.tensor(far.origin, dtype=torch.float64)
    # float32 about the object, and float64's own 1e-10 at 1e6; without the move 0.03
    torch.testing.assert_close(got, eyes, rtol=0, atol=5e-7)
    assert far.select(1).transformed(Similarity.identity()).origin == far.origin
    every = load_views(tmp_path / "far", every=True)
    assert load_views(tmp_path / "far", views=2).origin == every.origin == far.origin


def test_the_mesh_of_far_cameras_is_closed_and_in_its_place(tmp_path):
    folder = moved(tmp_path / "far", FARTHEST)
    arguments = [str(infer.EXAMPLE), str(folder), "--output", str(tmp_path / "out"), "--normalize", "hull"]
    assert infer.main([*arguments, *QUICK, "--up", "z"]) == 0
    boxes, records = [], []
    for name in ("example", "far"):
        document, _ = gltf.parsed((tmp_path / "out" / name / "mesh.glb").read_bytes())
        shift = np.array(document["nodes"][0].pop("translation", [0.0, 0.0, 0.0]))
        low, high = (np.array(document["accessors"][0][k]) for k in ("min", "max"))
        boxes.append((low + shift, high + shift))
        records.append(json.loads((tmp_path / "out" / name / "run_info.json").read_text()))
    record = records[1]["mesh"]
    assert record["watertight"] and record["manifold"] and record["degenerate_faces"] == 0
    x, y, z = FARTHEST
    there = x, z, -y
    # the meeting point of the axes is about 1e-7 from the cameras' own origin, and the hull's grid begins elsewhere
    for near, far in zip(*boxes):
        np.testing.assert_allclose(far - there, near, rtol=0, atol=0.02)
    # both matrices lead from the folder's frame: the same point of the object goes to the same place
    for key, rest in (("model_from_input", (0, 0, 0)), ("output_from_input", there)):
        near, far = (np.array(r[key]) for r in records)
        np.testing.assert_allclose(far @ (*FARTHEST, 1) - (*rest, 0), near @ (0, 0, 0, 1), rtol=0, atol=0.02)


def test_views_that_are_far_in_float32_are_refused_where_the_mesh_would_break():
    views = load_views(infer.EXAMPLE)
    shift = Similarity.without_rotation(torch.tensor(FARTHEST, dtype=torch.float64))
    with pytest.raises(ValueError, match="views: expected an object near the origin, got one of size"):
        reconstruct(views.transformed(shift), options=ReconstructOptions(texture_size=256, resolution=40))


def test_a_translation_goes_to_the_node_and_back_and_an_export_keeps_the_vertices(tmp_path):
    asset = Asset(ball_mesh(3, 0.6), textures(4, "cpu", (0.8, 0.1, 0.1)))
    assert b"translation" not in glb_bytes(asset)
    (tmp_path / "near.glb").write_bytes(glb_bytes(asset, translation=(8.0, -4.0, 2.0)))
    got = read_glb(tmp_path / "near.glb")[0].mesh.vertices
    # exact sums but for float32's step at 8
    torch.testing.assert_close(got, asset.mesh.vertices + torch.tensor([8.0, -4.0, 2.0]), rtol=0, atol=1e-6)
    far, origin = (4.0e6, -3.0e6, 10.0), []
    (tmp_path / "far.glb").write_bytes(glb_bytes(asset, translation=far))
    assert export([str(tmp_path / "far.glb"), "--textures", "webp", "--output", str(tmp_path / "out")]) == 0
    (again,) = read_glb(tmp_path / "out" / "far.glb", origin=origin)
    assert tuple(origin) == far and torch.equal(again.mesh.vertices, asset.mesh.vertices)
