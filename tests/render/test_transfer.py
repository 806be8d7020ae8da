"""Transfer in harmonics: their orthonormality, closed forms of open and half hidden places, our own Monte Carlo."""

import math

import numpy as np
import pytest
import torch
import trimesh

from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions
from reli3d.render.transfer import blocked_transfer, light_harmonics, spherical_harmonics
from tests.support.meshes import mesh_from

COSINE = torch.tensor([math.pi] + [2 * math.pi / 3] * 3 + [math.pi / 4] * 5 + [0.0] * 7).double()  # an open plane's


def quadrature(rows=64):
    """Directions ``(N, 3)`` and weights of a product rule that is exact for polynomials, float64."""
    height, weight = np.polynomial.legendre.leggauss(rows)
    phi = (np.arange(2 * rows) + 0.5) * (math.pi / rows)
    across = np.sqrt(1 - height**2)[:, None]
    d = np.stack([across * np.cos(phi), np.broadcast_to(height[:, None], (rows, 2 * rows)), across * np.sin(phi)], -1)
    weight = np.broadcast_to(weight[:, None] * (math.pi / rows), (rows, 2 * rows))
    return torch.from_numpy(d.reshape(-1, 3)), torch.from_numpy(weight.reshape(-1).copy())


def test_harmonics_are_orthonormal_and_begin_with_the_axes():
    d, weight = quadrature()
    y = spherical_harmonics(d)
    torch.testing.assert_close(y.T @ (weight[:, None] * y), torch.eye(16).double(), rtol=0, atol=1e-12)
    torch.testing.assert_close(y[:, 1:4], math.sqrt(3 / (4 * math.pi)) * d, rtol=0, atol=1e-12)


def smooth_light(degree, height=32):
    """A positive light of random harmonics up to ``degree``, and their coefficients ``((degree + 1)^2, 3)``."""
    coefficients = torch.randn((degree + 1) ** 2, 3, generator=torch.Generator().manual_seed(1)) * 0.2
    coefficients[0] = 3.0
    d = lat_long_directions(height)
    return Environment(spherical_harmonics(d)[..., : len(coefficients)] @ coefficients), coefficients, d


def test_a_light_gives_an_open_plane_the_irradiance_of_its_map():
    """The factors pi, 2 pi / 3, pi / 4, 0 of a clamped cosine, beyond which this light has nothing."""
    light, coefficients, d = smooth_light(3)
    found = light_harmonics(light)
    torch.testing.assert_close(found, coefficients, rtol=0, atol=4e-3)  # texels of 0.1 rad
    got = spherical_harmonics(d.double()) @ (COSINE[:, None] * found.double())
    torch.testing.assert_close(got.float(), light.irradiance().radiance, rtol=4e-3, atol=0)


def test_a_convex_surface_hides_nothing_from_itself(device):
    for shape in (trimesh.creation.icosphere(subdivisions=4), trimesh.creation.box()):
        assert blocked_transfer(mesh_from(shape, device).with_normals()).abs().max() == 0.0


def test_a_wall_occludes_half_of_the_hemisphere_of_a_floor(device):
    """Of a small floor at the foot of a tall wall, in the wall's middle: the integral over a quarter of the sphere."""
    small, large = 0.01, 1000.0
    floor = [[-small, 0.0, small], [small, 0.0, small], [0.0, 0.0, 2 * small]]  # in front of the wall at z = 0
    wall = [[-large, -1.0, 0.0], [large, -1.0, 0.0], [0.0, large, 0.0]]
    vertices = torch.tensor(floor + wall, device=device)
    faces = torch.tensor([[0, 2, 1], [3, 4, 5]], dtype=torch.int32, device=device)
    mesh = Mesh(vertices, faces, torch.tensor([[0.0, 1.0, 0.0]] * 3 + [[0.0, 0.0, 1.0]] * 3, device=device))
    found = blocked_transfer(mesh, directions=20000)[:3].cpu().double()
    d, weight = quadrature(256)
    hidden = weight * d[:, 1].clamp(min=0.0) * (d[:, 2] < 0.0)
    expected = hidden @ spherical_harmonics(d)
    assert abs(float(expected[0]) - math.pi / 2 * math.sqrt(1 / (4 * math.pi))) < 1e-4  # closed form
    torch.testing.assert_close(found, expected.expand(3, -1), rtol=0, atol=6e-3)  # rim of the wall, 20,000 directions


def test_missing_irradiance_is_that_of_a_monte_carlo_estimate(device):
    """In a dish and on a ball above it, at vertices chosen at random; a light of degree 3 makes the product exact."""
    dish = trimesh.creation.icosphere(subdivisions=4)
    dish.update_faces(dish.triangles_center[:, 1] < 0.2)
    dish.invert()  # its inside
    dish.remove_unreferenced_vertices()
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.35)
    mesh = mesh_from(trimesh.util.concatenate([dish, ball]), device).with_normals()
    light = smooth_light(3)[0].to(device)
    rng = torch.Generator().manual_seed(5)
    chosen = torch.randperm(len(mesh.vertices), generator=rng)[:40].to(device)
    scene, rays = RayScene(mesh.vertices, mesh.faces), 1 << 16
    d = torch.nn.functional.normalize(torch.randn(rays, 3, generator=rng), dim=-1).to(device)
    cosine = (mesh.normals[chosen] @ d.T).clamp(min=0.0) * (4 * math.pi / rays)
    hidden = scene.occluded((mesh.vertices[chosen] + 2e-3 * mesh.normals[chosen])[:, None], d[None])
    radiance = light.lookup(d)
    expected, whole = (cosine * hidden) @ radiance, cosine @ radiance
    assert float((expected / whole).min()) < 0.1 and float((expected / whole).max()) > 0.9
    for directions, mean, most in ((64, 0.04, 0.2), (4096, 0.006, 0.03)):
        got = blocked_transfer(mesh, directions=directions)[chosen] @ light_harmonics(light)
        error = ((got - expected) / whole).abs()
        assert error.mean() < mean and error.max() < most, (directions, error.mean(), error.max())


def test_invalid_inputs_are_refused():
    box = mesh_from(trimesh.creation.box()).with_normals()
    with pytest.raises(ValueError, match="directions: expected at least 1, got 0"):
        blocked_transfer(box, directions=0)
    with pytest.raises(ValueError, match="normals: expected a value, got None"):
        blocked_transfer(Mesh(box.vertices, box.faces))
    empty = Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32), torch.zeros(0, 3))
    assert blocked_transfer(empty).shape == (0, 16)
