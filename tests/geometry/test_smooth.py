"""Smoothing: noise and volume, copies of vertices, nothing to do; values are in ``tests/bridge/test_adjoints.py``."""

import pytest
import torch
import trimesh

from reli3d.geometry.mesh import Mesh
from reli3d.geometry.smooth import taubin_smooth
from tests.support.meshes import mesh_from, volume


def ball(device="cpu", subdivisions=3, noise=0.0):
    mesh = mesh_from(trimesh.creation.icosphere(subdivisions=subdivisions), device=device)
    rng = torch.Generator().manual_seed(0)
    return Mesh(mesh.vertices * (1 + noise * torch.randn(len(mesh.vertices), 1, generator=rng).to(device)), mesh.faces)


def test_noise_is_removed_and_the_volume_kept(device):
    clean, noisy = ball(device), ball(device, noise=0.03)
    got = taubin_smooth(noisy, iterations=20)

    def spread(mesh):
        return float(mesh.vertices.norm(dim=-1).std())

    assert spread(got) < 0.4 * spread(noisy)
    # the pass band lifts a frequency by at most 0.975 * 1.0263 - 1 = 6.6e-4 a pair, which is 4 % of volume after 20
    assert abs(volume(got) / volume(clean) - 1) < 0.04


def test_copies_of_a_vertex_move_together_and_uv_stay():
    whole = ball(noise=0.02)
    split = Mesh(
        whole.vertices[whole.faces.long().view(-1)],
        torch.arange(whole.faces.numel(), dtype=torch.int32).view(-1, 3),
        uv=torch.rand(whole.faces.numel(), 2),
    )
    got, expected = taubin_smooth(split), taubin_smooth(whole)
    assert got.uv is split.uv and got.normals is None
    # a mean over copies rounds once more than the vertex alone
    torch.testing.assert_close(got.vertices, expected.vertices[whole.faces.long().view(-1)], rtol=0, atol=2e-6)


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match="^iterations: expected"):
        taubin_smooth(ball(subdivisions=1), iterations=-1)


def test_nothing_to_do_changes_nothing():
    mesh = ball(subdivisions=1)
    assert torch.equal(taubin_smooth(mesh, iterations=0).vertices, mesh.vertices)
    alone = Mesh(torch.rand(3, 3).requires_grad_(), torch.tensor([[0, 1, 2]], dtype=torch.int32))  # all of it border
    got = taubin_smooth(alone).vertices
    assert torch.equal(got, alone.vertices)
    assert torch.equal(torch.autograd.grad(got.sum(), alone.vertices)[0], torch.ones(3, 3))
