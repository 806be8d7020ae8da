"""Displacement to given normals against its solution for a wave, a noisy ball, and its limits."""

import math

import pytest
import torch
import trimesh

from reli3d.geometry.mesh import Mesh
from reli3d.geometry.normals import displace_to_normals
from tests.support.meshes import mesh_from, sheet


def noisy_ball(device, noise=0.01):
    mesh = mesh_from(trimesh.creation.icosphere(subdivisions=4), device=device)
    rng = torch.Generator().manual_seed(0)
    radius = 1 + noise * torch.randn(len(mesh.vertices), 1, generator=rng).to(device)
    return Mesh(mesh.vertices * radius, mesh.faces).with_normals(), mesh.vertices


def unlimited(mesh):
    return mesh.vertices.new_full((len(mesh.vertices),), math.inf)


def angles(a, b):
    return torch.rad2deg((a * b).sum(-1).clamp(-1, 1).arccos())


@pytest.mark.parametrize("waves", [4, 8, 16])
def test_a_wave_of_normals_on_a_plane_becomes_the_wave_of_least_energy(waves, device):
    cells = 128  # of side 1
    bumpy, _ = sheet(cells + 1)
    plane = Mesh(bumpy.vertices * torch.tensor([1.0, 1.0, 0.0]), bumpy.faces).to(device).with_normals()
    x, up = plane.vertices[:, 0], plane.normals[0]
    length, height, k = 6.0, 0.01, 2 * math.pi * waves / cells
    slope = torch.zeros_like(plane.normals)
    slope[:, 0] = height * k * torch.cos(k * x)
    target = torch.nn.functional.normalize(up - slope, dim=-1)
    got = displace_to_normals(plane, target, length=length, limit=unlimited(plane))
    # every edge is in two faces; per vertex one edge along x and one diagonal, whose slope is smaller by sqrt(2)
    p, q = 2 * math.sin(k / 2), k * math.cos(k / 2)
    gain = 3 * p * q / (3 * p * p + 1 / length**2)
    inner = ((plane.vertices - plane.vertices.mean(0)).abs() < 0.2 * cells).all(-1)
    wave = torch.sin(k * x)[inner]
    moved = ((got.vertices - plane.vertices) @ up)[inner]
    # 1%: the solver's tolerance 1e-3 and the influence of the border
    assert float(moved @ wave / (wave @ wave)) == pytest.approx(gain * height, rel=0.01)
    assert float((moved - gain * height * wave).abs().max()) < 0.03 * height


def test_noise_of_positions_is_removed_by_true_normals(device):
    mesh, true = noisy_ball(device)
    got = displace_to_normals(mesh, true.contiguous(), length=0.2, limit=unlimited(mesh))
    before, after = angles(mesh.normals, true).mean(), angles(got.normals, true).mean()
    assert float(before) > 5 and float(after) < 0.35 * float(before)
    radius = got.vertices.norm(dim=-1)
    assert float(radius.std()) < 0.5 * float(mesh.vertices.norm(dim=-1).std())
    assert float(radius.mean()) == pytest.approx(1.0, abs=1e-3)


def test_a_ball_with_its_own_normals_stays(device):
    ball = mesh_from(trimesh.creation.icosphere(subdivisions=3), device=device).with_normals()
    got = displace_to_normals(ball, ball.vertices, length=0.1, limit=unlimited(ball))
    # every chord is perpendicular to the mean of the normals at its ends
    assert torch.allclose(got.vertices, ball.vertices, atol=1e-6)


def test_displacements_are_limited_to_both_sides(device):
    mesh, true = noisy_ball(device)
    limit = torch.linspace(0, 0.01, len(mesh.vertices), device=device)
    free = displace_to_normals(mesh, true, length=0.2, limit=unlimited(mesh))
    got = displace_to_normals(mesh, true, length=0.2, limit=limit)
    height = ((free.vertices - mesh.vertices) * mesh.normals).sum(-1)
    expected = mesh.vertices + height.clamp(-limit, limit)[:, None] * mesh.normals
    assert torch.allclose(got.vertices, expected, atol=1e-6)
    assert bool((height > limit).any()) and bool((height < -limit).any())


def test_scale_and_rotation_commute_with_the_displacement():
    mesh, true = noisy_ball("cpu")
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
    turn = turn * torch.linalg.det(turn)
    moved = Mesh((mesh.vertices @ turn.T * 7).contiguous(), mesh.faces).with_normals()
    got = displace_to_normals(moved, (true @ turn.T).contiguous(), length=7 * 0.2, limit=unlimited(mesh))
    expected = displace_to_normals(mesh, true, length=0.2, limit=unlimited(mesh)).vertices @ turn.T * 7
    # 2e-3 of the radius: two runs of the solver, each to a relative residual of 1e-3
    assert float((got.vertices - expected).norm(dim=-1).max()) < 2e-3 * 7


@pytest.mark.parametrize("name, value", [("length", 0.0), ("target", torch.zeros(5, 3)), ("limit", torch.zeros(5))])
def test_wrong_arguments_are_named(name, value):
    mesh, true = noisy_ball("cpu")
    with pytest.raises(ValueError, match=f"{name}: expected"):
        displace_to_normals(mesh, **{"target": true, "length": 0.1, "limit": unlimited(mesh), name: value})
