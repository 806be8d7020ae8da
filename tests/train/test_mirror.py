"""Training reads mirror images of the views of a symmetric object, as inference does."""

import numpy as np
import pytest
import torch
import trimesh

from reli3d.geometry.camera import project
from reli3d.nn.weights import load_model
from reli3d.train import batches
from reli3d.train.batches import load_sample
from reli3d.train.losses import losses
from reli3d.train.mirror import mirrored_visibility, surface_mirror
from tests.support.stages import rendered_sample, write_maps

ANGLE, OFFSET = 0.7, 0.13  # of the plane


def points_of(parts):
    """Uniform samples ``(8192, 3)`` of the surface of boxes ``(extents, center)``, turned about +Y and shifted."""
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in parts]
    mesh = trimesh.util.concatenate(boxes)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-ANGLE, (0, 1, 0)))
    mesh.apply_translation(OFFSET * np.array([np.cos(ANGLE), 0.0, np.sin(ANGLE)]))
    return trimesh.sample.sample_surface(mesh, 8192, seed=0)[0]


CHAIR = [((0.8, 0.1, 0.5), (0, 0, 0)), ((0.8, 0.6, 0.1), (0, 0.3, -0.3)), ((0.3, 0.2, 0.1), (0, 0.1, 0.4))]


def test_the_plane_of_a_symmetric_surface():
    normal, offset = surface_mirror(points_of(CHAIR))
    expected = np.array([np.cos(ANGLE), 0.0, np.sin(ANGLE)])
    # the finest search step is 0.9 degrees; the mean of the samples is off by 0.25 / sqrt(8192) = 0.003
    assert abs(normal @ expected) > np.cos(np.radians(1.0))
    assert abs(offset * np.sign(normal @ expected) - OFFSET) < 0.012


def test_a_part_on_one_side_leaves_no_plane():
    assert surface_mirror(points_of([*CHAIR, ((0.2, 0.3, 0.2), (0.4, 0.3, 0.1))])) is None


def test_a_mirror_image_shows_what_the_mirrored_camera_sees():
    """On a ball, a camera sees the points within an angle of its direction; the mirror images, their reflections."""
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(8192, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    eyes = np.array([[0.8, 0.0, 0.6], [0.0, 0.6, 0.8]])
    visible = (ball @ eyes.T > 0.3).astype(np.uint8)
    points = ball[rng.permutation(8192)[:1000]]
    expected = points * [-1.0, 1.0, 1.0] @ eyes.T
    got = mirrored_visibility(ball, visible, points, (np.array([1.0, 0.0, 0.0]), 0.0))
    sure = np.abs(expected - 0.3) > 0.05  # distances between neighbors: 0.02
    assert (got == (expected > 0.3))[sure].all()


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """Two views of a box."""
    root = tmp_path_factory.mktemp("box")
    trimesh.creation.box((1.0, 0.7, 0.4)).export(root / "box.glb")
    return rendered_sample(root / "out", write_maps(root), views=2, size=64, meshes=(root / "box.glb",))


def test_mirror_images_show_the_points_that_they_are_said_to_show(box, monkeypatch):
    monkeypatch.setattr(batches, "MIRROR_PROBABILITY", 1.0)
    for seed in range(6):  # turned, mirrored or not
        s = load_sample(box, 2, 4096, np.random.default_rng(seed))
        assert s.visible.shape == (2048, 4) and float((s.visible[:, :2].amax(1) * s.visible[:, 2:].amax(1)).max()) == 0
        for v in range(2):
            shown = s.visible[:, 2 + v] > 0
            xy, _ = project(s.surface[shown, 0].contiguous(), s.mirrored_c2w[v], s.mirrored_intrinsics[v])
            x, y = xy.long().clamp(0, 63).unbind(-1)
            # a mirrored point is matched to the nearest of 8192, and the contour is known to a pixel
            assert float((s.masks[v].flip(1)[y, x] > 0).float().mean()) > 0.98
        assert bool((s.visible[:, 2:] > 0).any())


def test_mirror_images_reach_the_losses_and_leave_the_maps_of_the_views_as_they_are(box, monkeypatch):
    model, found = load_model("small").train().requires_grad_(True), []
    for probability in (0.0, 1.0):
        monkeypatch.setattr(batches, "MIRROR_PROBABILITY", probability)
        sample = load_sample(box, 2, 512, np.random.default_rng(3))
        torch.manual_seed(0)
        terms = losses(model, sample)
        model.zero_grad()
        sum(terms.values()).backward()
        found.append((sample, terms, float(model.volume.out.weight.grad.norm())))
    (plain, terms, gradient), (mirrored, other_terms, other) = found
    assert terms.keys() == other_terms.keys() and 0.0 < gradient != other > 0.0
    assert terms["occupancy"].item() != other_terms["occupancy"].item()
    assert len(mirrored.mirrored_c2w) == 2 and len(plain.mirrored_c2w) == 0
    for name in ("images", "masks", "view_material", "view_normal", "view_depth", "surface"):
        assert torch.equal(getattr(plain, name), getattr(mirrored, name)), name
