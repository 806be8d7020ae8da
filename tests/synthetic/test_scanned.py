"""Meshes as training objects: internal faces, holes, and faces that are seen from behind."""

import numpy as np
import torch
import trimesh

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.render.environment import Environment
from reli3d.synthetic.samples import random_faces, render_sample
from reli3d.synthetic.scanned import ScannedSurface
from reli3d.synthetic.shapes import ShapeSurface


def without_bottom(extents) -> trimesh.Trimesh:
    box = trimesh.creation.box(extents)
    box.update_faces(box.face_normals[:, 1] > -0.5)
    return box


def test_internal_faces_are_no_ground_truth(tmp_path):
    trimesh.util.concatenate([trimesh.creation.box(), trimesh.creation.icosphere(2, 0.2)]).export(tmp_path / "a.glb")
    surface = ScannedSurface(tmp_path / "a.glb", None)
    at = surface.points_at(*random_faces(surface, 2000, np.random.default_rng(0))).position
    torch.testing.assert_close(at.abs().amax(1), torch.full((2000,), 0.5), rtol=0, atol=1e-5)
    points = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.7, 0.0, 0.0]])
    torch.testing.assert_close(surface.distance(points), torch.tensor([-0.5, -0.2, 0.2]), rtol=0, atol=1e-5)


def test_a_shape_without_bottom_is_solid(tmp_path):
    without_bottom((1.0, 0.6, 0.4)).export(tmp_path / "a.glb")
    for seed in range(3):
        surface = ShapeSurface((tmp_path / "a.glb",), np.random.default_rng(seed))
        shape = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)
        assert shape.is_watertight and shape.volume > 0.0
        assert float(surface.distance(torch.zeros(1, 3))) < -0.05


def test_normals_of_a_face_that_is_seen_from_behind_point_to_the_viewer(tmp_path):
    box = without_bottom((1.0, 0.3, 0.8))
    box.apply_transform(trimesh.transformations.rotation_matrix(np.pi, (1.0, 0.0, 0.0)))  # the opening is above
    box.export(tmp_path / "a.glb")
    eyes = torch.tensor([[0.4, 2.5, 0.6], [-0.7, 2.2, 0.2]])
    c2w = look_at(eyes, torch.zeros(2, 3), torch.tensor([0.0, 0.0, 1.0]))
    camera = Camera(c2w, torch.tensor([[90.0, 90.0, 24.0, 24.0]]).repeat(2, 1), 48, 48)
    light = Environment(torch.ones(8, 16, 3))
    sample = render_sample(ScannedSurface(tmp_path / "a.glb", None), light, camera, np.random.default_rng(0))
    valid = sample["view_depth"] > 0
    facing = -(sample["view_normal"].float() / 127 * camera_rays(camera)[1]).sum(-1)[valid]
    assert float((facing > 0).float().mean()) > 0.99  # means over a pixel of two faces
    position, normal, _ = sample["surface"].float().unbind(1)
    for view in range(2):
        seen = sample["visible"][:, view] > 0
        assert float(((c2w[view, :3, 3] - position[seen]) * normal[seen]).sum(1).min()) > 0.0
    ground = (position.abs() < torch.tensor([0.45, 1.0, 0.35])).all(1) & (position[:, 1] < -0.14)
    ground &= sample["visible"].amax(1) > 0
    assert int(ground.sum()) > 1000 and float(normal[ground, 1].min()) > 0.99
