"""Outlines: coverage and its gradient against exact convex polygons and against densely sampled images."""

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import ConvexHull

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.geometry.rays import RayScene
from reli3d.render.silhouette import antialias, mesh_edges
from tests.support.meshes import mesh_from

SIZE = 48
TURN = trimesh.transformations.euler_matrix(0.4, 0.7, 0.2)[:3, :3]


def camera_of(device, size=SIZE, distance=3.0):
    at = torch.tensor([0.3, 0.4, 1.0], device=device)
    at = at / at.norm() * distance
    pose = look_at(at, torch.zeros(3, device=device), torch.tensor([0.0, 1.0, 0.0], device=device))
    return Camera.from_fov(pose, 0.7, size, size)


def shape(name, device):
    if name == "cube":
        mesh = trimesh.creation.box((1.0, 0.8, 0.9))
        mesh.vertices = mesh.vertices @ TURN.T
    else:  # 20 thousand faces on 28 pixels across: at the outline they are far smaller than a pixel
        mesh = trimesh.creation.icosphere(subdivisions=5 if name == "fine sphere" else 2, radius=0.6)
    mesh = mesh_from(mesh, device)
    return mesh.vertices, mesh.faces


def layer_of_hits(scene, camera, value=None):
    """Mask, or ``value (F, C)`` of the hit faces, ``(H, W, C)``."""
    origins, directions = camera_rays(camera)
    face = scene.closest(origins, directions).face
    if value is None:
        return (face >= 0).float()[..., None]
    padded = torch.cat([value, value.new_zeros(1, value.shape[1])])
    return padded[face.long()]


def mask_of(vertices, faces, camera):
    scene = RayScene(vertices.detach(), faces)
    return antialias(layer_of_hits(scene, camera), vertices, faces, camera, scene)[..., 0]


def outline(points, camera):
    """Projected convex outline, counter-clockwise ``(K, 2)`` pixels, float64; its area is the coverage."""
    c2w = camera.c2w.cpu().double().numpy()
    fx, fy, cx, cy = camera.intrinsics.cpu().double().numpy()
    q = (points - c2w[:3, 3]) @ c2w[:3, :3]
    p = np.stack([fx * q[:, 0] / -q[:, 2] + cx, -fy * q[:, 1] / -q[:, 2] + cy], 1)
    hull = ConvexHull(p)
    return p[hull.vertices], hull.volume


def coverage(points, camera, factor=12):
    """Fraction of every pixel inside the convex outline, from ``factor`` x ``factor`` subpixels, float64."""
    polygon, _ = outline(points, camera)
    k = (np.arange(camera.width * factor) + 0.5) / factor
    x, y = np.meshgrid(k, k)
    inside = np.ones_like(x, bool)
    for a, b in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        inside &= (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) >= 0
    return inside.reshape(camera.height, factor, camera.width, factor).mean((1, 3))


def moves(points):
    """Shifts along the axes and growth, ``(V, 3)`` float64."""
    return [*np.broadcast_to(np.eye(3)[:, None], (3, *points.shape)), points]


@pytest.mark.parametrize("name", ["sphere", "fine sphere", "cube"])
def test_area_and_its_gradient_are_those_of_the_projected_outline(device, name):
    vertices, faces = shape(name, device)
    camera = camera_of(device)
    vertices.requires_grad_()
    mask = mask_of(vertices, faces, camera)
    points = vertices.detach().cpu().double().numpy()
    _, area = outline(points, camera)
    assert abs(float(mask.detach().sum()) / area - 1.0) < 0.002  # midpoint rule; corners err by part of a pixel
    (g,) = torch.autograd.grad(mask.sum(), vertices)
    h = 1e-4
    for d in moves(points):
        expected = (outline(points + h * d, camera)[1] - outline(points - h * d, camera)[1]) / (2 * h)
        got = float((g.cpu().double().numpy() * d).sum())
        # edges near 45 degrees take turns in rows and columns, which adds or drops part of a pixel of the 90 at each
        limit = 0.01 if name == "fine sphere" else 0.025
        assert abs(got - expected) < limit * float((g * vertices.detach()).sum())


@pytest.mark.parametrize("name", ["sphere", "cube"])
def test_mask_loss_gradient_matches_differences_of_sampled_coverage(device, name):
    vertices, faces = shape(name, device)
    camera = camera_of(device)
    points = vertices.cpu().double().numpy()
    target = coverage(points * 1.15 + np.array([0.12, -0.05, 0.0]), camera)
    vertices.requires_grad_()
    mask = mask_of(vertices, faces, camera)
    assert float((mask.detach().cpu() - torch.tensor(coverage(points, camera))).abs().mean()) < 2e-3  # of 0 to 1
    aim = torch.tensor(target, dtype=torch.float32, device=device)
    (g,) = torch.autograd.grad((mask - aim).square().sum(), vertices)
    largest, h = 0.0, 0.02  # half a pixel: the sampled coverage is smooth over that
    for k, d in enumerate(moves(points)):
        up, down = (((coverage(points + s * h * d, camera) - target) ** 2).sum() for s in (1, -1))
        got, expected = float((g.cpu().double().numpy() * d).sum()), (up - down) / (2 * h)
        largest = max(largest, abs(expected))
        # an oblique edge changes two pixels of a row, its crossing one, so squares of pixels weigh more: 8 to 14 %
        assert abs(got - expected) < 0.15 * largest, k


def test_hidden_outlines_do_not_move_and_colors_blend_between_neighbors(device):
    """A red square before a larger green one before nothing: against images of 8 x 8 rays a pixel."""
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], device=device)
    c, s = math.cos(0.3), math.sin(0.3)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], device=device)
    near = square * 0.4 @ turn + torch.tensor([0.1, 0.05, 0.4], device=device)
    far = square * 0.6 @ turn.T + torch.tensor([-0.2, 0.0, 0.0], device=device)
    hidden = square * 0.1 + torch.tensor([0.1, 0.05, 0.2], device=device)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32, device=device)
    faces = torch.cat([faces, faces + 4, faces + 8])
    colors = torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.8, 0.2], [0.0, 0.0, 5.0]], device=device).repeat_interleave(2, 0)
    size = 96
    camera = camera_of(device, size)
    weight = torch.rand(size, size, 3, generator=torch.Generator().manual_seed(0)).to(device)
    weight = torch.nn.functional.avg_pool2d(weight.permute(2, 0, 1), 9, 1, 4).permute(1, 2, 0)  # smooth over pixels

    def sampled(vertices):
        fine = layer_of_hits(RayScene(vertices, faces), camera.scaled(8), colors)
        return fine.reshape(size, 8, size, 8, 3).mean((1, 3))

    vertices = torch.cat([near, far, hidden]).requires_grad_()
    scene = RayScene(vertices, faces)
    image = antialias(layer_of_hits(scene, camera, colors), vertices, faces, camera, scene)
    shown = image.detach()
    assert float(shown.min()) >= 0.0 and float(shown[..., 2].max()) < 0.21
    assert float((shown - sampled(vertices.detach())).abs().mean()) < 2e-3  # without blending: 9e-3
    (g,) = torch.autograd.grad((image * weight).sum(), vertices)
    assert float(g[8:].abs().max()) == 0.0
    for k in (slice(0, 4), slice(4, 8)):
        for axis in (0, 1):
            step = torch.zeros_like(vertices)
            step[k, axis] = 0.03
            with torch.no_grad():
                expected = float(((sampled(vertices + step) - sampled(vertices - step)) * weight).sum()) / 0.06
            # of 730; a row at the end of an edge is 20
            assert abs(float(g[k, axis].sum()) - expected) < 30.0, (k, axis)


def test_edges_of_split_vertices_and_open_borders(device):
    v = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], device=device)
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]], dtype=torch.int32, device=device)
    edges = mesh_edges(v[[0, 1, 2, 0, 2, 3]], faces)
    assert len(edges) == 5 and int((edges[:, 3] >= 0).sum()) == 1
    assert edges[edges[:, 3] >= 0].tolist() == [[0, 2, 1, 5]]
    assert mesh_edges(v, faces[:0]).shape == (0, 4)
    with pytest.raises(ValueError, match="faces: expected indices"):
        mesh_edges(v, faces)


def test_odd_scenes_give_finite_gradients(device):
    """Faces without area, slivers, vertices behind the eye or on it, an eye within the plane of a face; 256 pixels a
    scene, a hundred thousand in all."""
    rng = torch.Generator().manual_seed(3)
    for k in range(400):
        vertices = (torch.rand(12, 3, generator=rng) * 6 - 3).to(device)
        camera = camera_of(device, 16, 1.0)
        vertices[0] = vertices[1]
        vertices[2] = camera.position
        vertices[3] = camera.position - 1e-7 * camera.c2w[:3, 2]
        vertices[4:6] = camera.position * 0.5
        if k % 2:
            vertices[:, 2] = camera.position[2]
        faces = torch.randint(0, 12, (30, 3), generator=rng).int().to(device)
        scene, v = RayScene(vertices, faces), vertices.clone().requires_grad_()
        image = layer_of_hits(scene, camera).requires_grad_()
        out = antialias(image, v, faces, camera, scene)
        grads = torch.autograd.grad(out.square().sum(), (v, image))
        assert bool(torch.isfinite(out).all()) and all(bool(torch.isfinite(g).all()) for g in grads)
        assert float(out.detach().min()) >= -1e-6 and float(out.detach().max()) <= 1.0 + 1e-6


def test_bad_input_is_named(device):
    vertices, faces = shape("cube", device)
    camera, image = camera_of(device), torch.zeros(SIZE, SIZE, 1, device=device)
    with pytest.raises(ValueError, match="image: expected"):
        antialias(image[1:], vertices, faces, camera)
    with pytest.raises(ValueError, match="edges: expected"):
        antialias(image, vertices[:4], faces, camera, RayScene(vertices, faces), edges=mesh_edges(vertices, faces))
