"""One-bounce interreflection: view factors in closed form, colors read from images."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh

from reli3d.fit import maps, shape
from reli3d.fit.bounce import RAYS_PER_VERTEX, gathered, reflected
from reli3d.fit.input_images import InputImages
from reli3d.fit.losses import Weights
from reli3d.fit.maps import FixedSurface
from reli3d.fit.unknowns import Start, Unknowns, material_of
from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.render.color import srgb_to_linear
from reli3d.render.points import SurfacePoints
from tests.support import small_scene
from tests.support.meshes import mesh_from

COLOR = torch.tensor([0.5, 0.2, 0.05])  # linear
COPIES = 401  # vertices at each distance: 13,000 rays


def images(eye, device):
    """One image of uniform color."""
    up = torch.tensor([0.0, 1.0, 0.1])
    camera = Camera.from_fov(look_at(torch.tensor(eye), torch.zeros(3), up)[None].to(device), 1.2, 16, 16)
    return InputImages(COLOR.to(device).expand(1, 16, 16, 3), torch.ones(1, 16, 16, device=device), camera)


def corner(height, device):
    """Points of a floor, y = 0, at five distances from a wall at z = 0 that is 200 times as wide as it is high."""
    wide = 100.0 * height
    x = torch.linspace(-0.2, 0.2, COPIES) * height
    z = torch.tensor([0.05, 0.25, 0.5, 1.0, 2.0]) * height
    points = torch.stack([*torch.meshgrid(x, torch.zeros(1), z, indexing="ij")], -1).reshape(-1, 3)
    ends = torch.tensor([[-wide, 0.0, 0.0], [wide, 0.0, 0.0], [wide, height, 0.0], [-wide, height, 0.0]])
    n = len(points)
    vertices = torch.cat([points, ends])
    faces = torch.tensor([[n, n + 1, n + 2], [n, n + 2, n + 3]], dtype=torch.int32)
    normals = torch.tensor([[0.0, 1.0, 0.0]] * n + [[0.0, 0.0, 1.0]] * 4)
    return Mesh(vertices, faces, normals).to(device), z.repeat(COPIES).to(device)


def test_a_floor_receives_the_view_factor_of_its_wall(device):
    height = 0.5
    mesh, distance = corner(height, device)
    got = gathered(mesh, images((0.0, 2.0, 4.0), device), seed=0)[: len(distance)]
    # the cosine over pi, integrated over the directions from a point of the floor to an endless wall
    factor = 0.5 * (1.0 - distance / (distance.square() + height**2).sqrt())
    for d in distance.unique():
        row = distance == d
        weight, count = factor[row][0], int(row.sum()) * RAYS_PER_VERTEX
        mean, expected = got[row].mean(0), weight * COLOR.to(device)
        error = COLOR.to(device) * math.sqrt(float(weight * (1 - weight)) / count)
        assert bool(((mean - expected).abs() < 4.0 * error + 1e-3).all())  # four standard deviations; starts are lifted


def test_a_convex_body_receives_nothing_and_a_closed_box_one_color(device):
    ball = mesh_from(trimesh.creation.icosphere(3), device)
    vertices = ball.vertices
    outside, inside = replace(ball, normals=vertices), Mesh(vertices, ball.faces.flip(1), -vertices)
    assert not gathered(outside, images((0.0, 0.0, 4.0), device), seed=0).any()
    got = gathered(inside, images((0.0, 0.0, 0.2), device), seed=0)
    torch.testing.assert_close(got, COLOR.to(device).expand(len(vertices), 3), rtol=1e-3, atol=0.0)


def test_where_no_camera_sees_anything_nothing_is_received(device):
    mesh, _ = corner(0.5, device)
    assert not gathered(mesh, images((0.0, -3.0, 0.1), device), seed=0).any()


def test_a_floor_receives_the_color_of_the_nearer_wall(device):
    """Two walls that face each other, one red and one blue in the image."""
    walls = []
    for x in (-1.0, 1.0):
        ends = [(x, 0.0, -1.0), (x, 1.0, -1.0), (x, 1.0, 1.0), (x, 0.0, 1.0)]
        walls.append(torch.tensor(ends if x < 0.0 else ends[::-1]))
    floor = torch.tensor([[-0.8, 0.0, 0.0], [0.8, 0.0, 0.0]]).repeat(COPIES, 1)
    n = len(floor)
    quad = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
    normals = torch.tensor([[0.0, 1.0, 0.0]] * n + [[1.0, 0.0, 0.0]] * 4 + [[-1.0, 0.0, 0.0]] * 4)
    mesh = Mesh(torch.cat([floor, *walls]), torch.cat([quad + n, quad + n + 4]), normals).to(device)
    inputs = images((0.0, 2.0, 4.0), device)
    color = torch.zeros(1, 16, 16, 3, device=device)
    color[:, :, :8, 0], color[:, :, 8:, 2] = 1.0, 1.0
    got = gathered(mesh, replace(inputs, color=color), seed=0)[:n]
    left, right = got[0::2].mean(0), got[1::2].mean(0)
    # endless walls would cover 40 % of the hemisphere, at 0.2 heights, and 6 %, at 1.8 heights
    assert float(left[0]) > 4.0 * float(left[2]) > 0.0
    torch.testing.assert_close(left, right.flip(0), rtol=0.1, atol=0.01)  # mirror images, 13,000 rays each


def test_a_fit_of_maps_includes_interreflection():
    """Without direct light the image is the reflected interreflection times the exposure."""
    asset, images = small_scene.ball(), small_scene.input_views(small_scene.ball(), 3, 32)
    images, mesh = InputImages.of(images), asset.mesh
    received = torch.linspace(0.1, 0.5, len(mesh.vertices))[:, None].expand(-1, 3).contiguous()
    data = FixedSurface(Start.of(asset), asset, received, images, [0, 1, 2])
    pixels = maps.traced(data, RayScene(mesh.vertices, mesh.faces), seed=0)
    base_color, _, metallic = material_of(pixels.logits)
    shown = replace(pixels, target=1.5 * base_color * (1.0 - metallic[:, None]) * pixels.received)
    dark = lambda points, *args, **options: torch.zeros_like(points.base_color)
    weights = Weights(**{**dict.fromkeys(vars(Weights()), 0.0), "image": 1.0})
    unknowns = Unknowns.zero(torch.ones(2, 2, 2), 3, 8)
    unknowns.exposure += math.log(1.5)

    def loss(weight: float, independent: bool) -> float:
        rows = replace(shown, received=weight * pixels.received)
        options = dict(direct=dark, seed=0, independent=independent)
        return float(maps.maps_loss(unknowns, data, rows, pixels.order, weights, **options))

    assert loss(1.0, False) < 1e-10 < 1e-4 < loss(0.5, False)
    assert loss(0.5, True) == loss(0.5, False)  # both estimates include it, and there is no noise


def test_a_fit_of_the_surface_includes_interreflection(monkeypatch):
    """Without direct light a uniform ball matches uniform images for the right received radiance."""
    asset, views = small_scene.ball(), small_scene.input_views(small_scene.ball(), 3, 32)
    images = InputImages.of(replace(views, images=torch.full_like(views.images, 0.5)))
    grid = shape.Grid.around(asset.mesh.vertices, 16)
    sdf, start = shape.start_sdf(asset.mesh, grid), Start.of(asset)
    base_color, _, metallic = material_of(start.material.reshape(-1, 5))
    target = srgb_to_linear(torch.tensor(0.5)) / (base_color * (1.0 - metallic[:, None]))
    target = target.reshape(*start.material.shape[:3], 3)
    monkeypatch.setattr(shape, "radiance", lambda points, *args, **options: torch.zeros_like(points.base_color))
    weights = Weights(**{**dict.fromkeys(vars(Weights()), 0.0), "shading": 1.0})
    bound, unknowns = torch.full_like(sdf, -9.0), Unknowns.zero(sdf, 3, 8)

    def loss(weight: float, independent: bool) -> float:
        data = shape.ShapeData.of(start, sdf, bound, grid, weight * target, images, [0, 1, 2])
        return float(shape.shape_loss(unknowns, data, weights, progress=0.9, seed=1, independent=independent))

    assert loss(1.0, False) < 1e-6 < 1e-2 < loss(0.5, False)  # colors read from images are rounded
    assert loss(0.5, True) == loss(0.5, False)  # both estimates include it, and there is no noise


@pytest.mark.parametrize("metallic, weight", [(0.0, 1.0), (0.25, 0.75), (1.0, 0.0)])
def test_lambertian_points_reflect_their_diffuse_albedo_times_their_irradiance(metallic, weight):
    n = torch.tensor([[0.0, 0.0, 1.0]])
    base_color = torch.tensor([[0.8, 0.5, 0.1]])
    points = SurfacePoints(0.0 * n, n, n, base_color, torch.tensor([0.5]), torch.tensor([metallic]))
    torch.testing.assert_close(reflected(points, torch.full((1, 3), 2.0)), 2.0 * weight * base_color)
