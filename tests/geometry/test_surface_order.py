"""FlexiCubes on surfaces known in closed form: distance, volume of second order, genus, at three resolutions."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from reli3d.geometry.mesh import face_normals, report
from reli3d.geometry.surface import extract_surface
from tests.support.meshes import volume
from tests.support.reference_surface import grid, sphere, torus

F = torch.nn.functional
RESOLUTIONS = (16, 32, 64)
CENTER = torch.tensor([0.5, 0.0, 0.0])
EULER = {"sphere": 2, "torus": 0, "two spheres": 4}
VOLUME = {"sphere": 4 / 3 * 0.6**3, "torus": 2 * np.pi * 0.6 * 0.22**2, "two spheres": 8 / 3 * 0.35**3}  # over pi


def two_spheres(n, device="cpu"):
    p, center = grid(n, device=device), CENTER.to(device)
    return torch.minimum((p - center).norm(dim=-1), (p + center).norm(dim=-1)) - 0.35


FIELDS = {"sphere": lambda n, device: sphere(n, device=device), "torus": torus, "two spheres": two_spheres}


def gyroid(p):
    """Value and gradient of the gyroid, in its own units."""
    s, c = p.sin(), p.cos()
    sdf = s[..., 0] * c[..., 1] + s[..., 1] * c[..., 2] + s[..., 2] * c[..., 0]
    return sdf, c * c.roll(-1, -1) - s * s.roll(1, -1)


def fraction_below(offset, n):
    """Volume fraction in which the gyroid is below ``offset``, float64: exact along x, ``n * n`` midpoints in y, z.

    Along x the gyroid is ``hypot(cos y, sin z)`` times a sine, plus ``sin y cos z``.
    """
    t = (torch.arange(n, dtype=torch.float64) + 0.5) * (2 * np.pi / n)
    y, z = t[:, None], t[None]
    reached = (offset - y.sin() * z.cos()) / torch.hypot(y.cos(), z.sin())
    return float((0.5 + reached.clamp(-1, 1).asin() / np.pi).mean())


def orders(errors):
    return [np.log(a / b) / np.log(2) for a, b in zip(errors[:-1], errors[1:])]


def samples_of(mesh):
    """Corners and centers of the faces: no point of a face is further from one than half a cube."""
    corners = mesh.vertices[mesh.faces.long()].cpu()
    return torch.cat([corners.reshape(-1, 3), corners.mean(1)]).numpy()


@pytest.mark.parametrize("shape", VOLUME)
def test_volume_converges_with_second_order_and_the_genus_is_right(device, shape):
    errors = []
    for n in RESOLUTIONS:
        mesh = extract_surface(FIELDS[shape](n, device), radius=1.0)
        found = report(mesh)
        assert found.watertight and found.manifold
        assert (found.euler, found.components) == (EULER[shape], 1 + (shape == "two spheres"))
        errors.append(abs(volume(mesh) - np.pi * VOLUME[shape]))
        if shape == "sphere":
            outward = (face_normals(mesh.vertices, mesh.faces) * mesh.vertices[mesh.faces[:, 0].long()]).sum(-1)
            assert bool((outward > 0).all())
    assert min(orders(errors)) >= 1.8, errors


@pytest.mark.parametrize("offset", [0.0, -0.5, 0.5])
def test_volume_of_the_gyroid_converges_with_second_order(device, offset):
    """One period of ``gyroid < offset`` cut flat by the box; it has the same volume wherever the period begins, so that
    the chance by which the grid meets its edges is averaged out.  Without offset inversion swaps inside and outside:
    exactly half.
    """
    exact = [8 * fraction_below(offset, n) for n in (1000, 2000)]
    assert abs(exact[1] - exact[0]) < (1e-12 if offset == 0 else 1e-5)  # a hundredth of the least error below
    begins = torch.rand(6, 3, generator=torch.Generator().manual_seed(0)) * 2 * np.pi
    errors = []
    for n in RESOLUTIONS:
        fields = [gyroid(np.pi * grid(n, device=device) + at.to(device))[0] - offset for at in begins]
        off = [volume(extract_surface(sdf, radius=1.0)) - exact[1] for sdf in fields]
        errors.append(float(np.sqrt(np.mean(np.square(off)))))
    assert errors[-1] > 1e-3 and min(orders(errors)) >= 1.8, errors


@pytest.mark.parametrize("cells", RESOLUTIONS)
def test_a_cubic_cell_of_the_gyroid_has_genus_five(device, cells):
    """Euler number 2 - 2 * 5 of the surface that repeats (Schoen 1970, NASA TN D-5541: genus 3 in the primitive cell,
    half of the cubic one): vertices, edges and faces whose middle lies in one period.
    """
    sdf = gyroid(1.25 * np.pi * grid(cells * 5 // 4, device=device) + 0.1234)[0]
    mesh = extract_surface(sdf, radius=1.25, closed=False)
    vertices, faces = mesh.vertices.cpu().double(), mesh.faces.cpu().long()
    edges = torch.stack([faces, faces.roll(-1, 1)], -1).reshape(-1, 2).sort(1).values.unique(dim=0)
    begin = torch.tensor([0.0123, 0.0077, 0.0191], dtype=torch.float64) - 1.0

    def inside(middles):
        at = middles - begin
        assert float(torch.minimum(at.abs(), (at - 2.0).abs()).min()) > 2e-6  # float32 would decide
        return int(((at >= 0.0) & (at < 2.0)).all(1).sum())

    assert inside(vertices) - inside(vertices[edges].mean(1)) + inside(vertices[faces].mean(1)) == -8


def test_gyroid_is_within_a_cube_both_ways_and_of_one_genus_at_any_resolution(device):
    scale, euler = 4.0, []
    for n in RESOLUTIONS:
        mesh = extract_surface(gyroid(scale * grid(n, device=device))[0], radius=1.0)
        found = report(mesh)
        assert found.watertight and found.manifold
        euler.append(found.euler)
        cube = 2 / n
        inner = mesh.vertices[mesh.vertices.abs().amax(-1) < 1 - cube].cpu().double()  # not the caps at the box
        sdf, gradient = gyroid(scale * inner)
        assert (
            float((sdf.abs() / (scale * gradient.norm(dim=-1))).max()) < cube
        )  # to first order, and 0.1 cubes in fact
        points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 1.6 - 0.8
        for _ in range(20):  # Newton: onto the surface
            sdf, gradient = gyroid(scale * points)
            points = points - gradient * (sdf / (scale * gradient.square().sum(-1).clamp(min=0.1)))[:, None]
        points = points[(points.abs().amax(-1) < 0.9) & (gyroid(scale * points)[0].abs() < 1e-9)]
        assert len(points) > 3000
        assert cKDTree(samples_of(mesh)).query(points.numpy())[0].max() < cube
    assert len(set(euler)) == 1 and euler[0] < 0, euler


@pytest.mark.parametrize("n", RESOLUTIONS)
@pytest.mark.parametrize("shape", VOLUME)
def test_the_distance_to_the_analytic_surface_is_below_a_cube_both_ways(device, shape, n):
    u, v = (torch.rand(4000, generator=torch.Generator().manual_seed(k)) * 2 * np.pi for k in (0, 1))
    direction = F.normalize(torch.randn(4000, 3, generator=torch.Generator().manual_seed(2)), dim=1)
    samples = samples_of(extract_surface(FIELDS[shape](n, device), radius=1.0))
    at, cube = torch.from_numpy(samples), 2 / n
    if shape == "torus":
        points = torch.stack([*((0.6 + 0.22 * v.cos()) * torch.stack([u.cos(), u.sin()])), 0.22 * v.sin()], -1)
        away = torch.hypot(torch.hypot(*at.T[:2]) - 0.6, at[:, 2]) - 0.22
    elif shape == "sphere":
        points, away = 0.6 * direction, at.norm(dim=-1) - 0.6
    else:
        points = 0.35 * direction + torch.where(u[:, None] > 3, CENTER, -CENTER)
        away = torch.minimum((at - CENTER).norm(dim=-1), (at + CENTER).norm(dim=-1)) - 0.35
    assert float(away.abs().max()) < cube
    assert cKDTree(samples).query(points.numpy())[0].max() < cube
