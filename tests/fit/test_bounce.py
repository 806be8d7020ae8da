"""Light that an object throws on itself: view factors in closed form, colours of photographs."""

import math

import pytest
import torch
import trimesh

from reli3d.fit.bounce import gathered, thrown_back
from reli3d.fit.photographs import Photographs
from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.render.points import SurfacePoints

COLOR = torch.tensor([0.5, 0.2, 0.05])  # linear


def photographs(eye, device, count=1):
    """Of one colour everywhere."""
    up = torch.tensor([0.0, 1.0, 0.1])
    c2w = torch.stack([look_at(torch.tensor(eye), torch.zeros(3), up)] * count).to(device)
    camera = Camera.from_fov(c2w, 1.2, 16, 16)
    return Photographs(COLOR.to(device).expand(count, 16, 16, 3), torch.ones(count, 16, 16, device=device), camera)


def corner(height, device):
    """A floor of many vertices, y = 0, before a wall at z = 0; both a hundred times as wide as the wall is high."""
    wide = 100.0 * height
    x = torch.linspace(-0.2, 0.2, 21) * height
    z = torch.tensor([0.05, 0.25, 0.5, 1.0, 2.0]) * height
    points = torch.stack([*torch.meshgrid(x, torch.zeros(1), z, indexing="ij")], -1).reshape(-1, 3)
    ends = torch.tensor([[-wide, 0.0, 0.0], [wide, 0.0, 0.0], [wide, height, 0.0], [-wide, height, 0.0]])
    n = len(points)
    vertices = torch.cat([points, ends])
    faces = torch.tensor([[n, n + 1, n + 2], [n, n + 2, n + 3]], dtype=torch.int32)
    normals = torch.tensor([[0.0, 1.0, 0.0]] * n + [[0.0, 0.0, 1.0]] * 4)
    return Mesh(vertices, faces, normals).to(device), z.repeat(21).to(device)


def received(mesh, seen):
    return gathered(mesh, RayScene(mesh.vertices, mesh.faces), seen, list(range(len(seen))), seed=0)


def test_a_floor_receives_the_view_factor_of_its_wall(device):
    height = 0.5
    mesh, distance = corner(height, device)
    got = received(mesh, photographs((0.0, 2.0, 4.0), device))[: len(distance)]
    # the cosine over pi, integrated over the directions from a point of the floor to an endless wall
    factor = 0.5 * (1.0 - distance / (distance.square() + height**2).sqrt())
    for d in distance.unique():
        row = distance == d
        share, count = factor[row][0], int(row.sum()) * 32
        mean, want = got[row].mean(0), share * COLOR.to(device)
        error = COLOR.to(device) * math.sqrt(float(share * (1 - share)) / count)
        assert bool(((mean - want).abs() < 4.0 * error + 1e-3).all())  # four standard deviations; starts are lifted


def test_a_convex_body_receives_nothing_and_a_closed_room_one_colour(device):
    ball = trimesh.creation.icosphere(3)
    vertices, faces = torch.tensor(ball.vertices).float(), torch.tensor(ball.faces).int()
    outside, inside = Mesh(vertices, faces, vertices).to(device), Mesh(vertices, faces.flip(1), -vertices).to(device)
    seen = photographs((0.0, 0.0, 0.2), device)
    assert not received(outside, photographs((0.0, 0.0, 4.0), device)).any()
    torch.testing.assert_close(received(inside, seen), COLOR.to(device).expand(len(vertices), 3), rtol=1e-3, atol=0.0)


def test_where_no_camera_sees_anything_nothing_is_received(device):
    mesh, _ = corner(0.5, device)
    assert not received(mesh, photographs((0.0, -3.0, 0.1), device)).any()


def test_colours_of_views_that_may_not_be_used_are_not(device):
    mesh, _ = corner(0.5, device)
    both = photographs((0.0, 2.0, 4.0), device, count=2)
    changed = both.color.clone()
    changed[1] = 0.0
    other = Photographs(changed, both.mask, both.camera)
    scene = RayScene(mesh.vertices, mesh.faces)
    assert torch.equal(gathered(mesh, scene, both, [0], seed=0), gathered(mesh, scene, other, [0], seed=0))
    assert not torch.equal(gathered(mesh, scene, both, [0, 1], seed=0), gathered(mesh, scene, other, [0, 1], seed=0))


@pytest.mark.parametrize("metallic, share", [(0.0, 1.0), (0.25, 0.75), (1.0, 0.0)])
def test_matt_points_return_their_paint_times_what_they_receive(metallic, share):
    n = torch.tensor([[0.0, 0.0, 1.0]])
    paint = torch.tensor([[0.8, 0.5, 0.1]])
    points = SurfacePoints(0.0 * n, n, n, paint, torch.tensor([0.5]), torch.tensor([metallic]))
    torch.testing.assert_close(thrown_back(points, torch.full((1, 3), 2.0)), 2.0 * share * paint)
