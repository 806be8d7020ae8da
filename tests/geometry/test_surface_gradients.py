"""Gradients of FlexiCubes in the padding, for odd inputs and any number of threads; center vertices."""

import pytest
import torch

from reli3d.geometry.mesh import report
from reli3d.geometry.regularize import vertex_deviation
from reli3d.geometry.smooth import taubin_smooth
from reli3d.geometry.surface import extract_surface
from reli3d.geometry.uv import unwrap
from tests.support.reference_surface import grid, random_weights, torus


@pytest.mark.parametrize("seed", range(4))
def test_fields_and_weights_of_any_size_give_finite_vertices_and_gradients(device, seed):
    rng = torch.Generator().manual_seed(seed)
    shape = (12, 11, 10)
    sdf = torch.randn(shape, generator=rng) * 10.0 ** torch.randint(-6, 7, shape, generator=rng)
    sdf[torch.rand(shape, generator=rng) < 0.1] = 0.0
    sdf[torch.rand(shape, generator=rng) < 0.1] = -0.0
    cubes = 11 * 10 * 9
    alpha, beta = (10.0 ** torch.randint(-3, 4, (cubes, n), generator=rng) for n in (8, 12))
    leaves = [v.to(device).requires_grad_() for v in (sdf, alpha, beta)]
    mesh = extract_surface(leaves[0], radius=1.0, alpha=leaves[1], beta=leaves[2])
    found = report(mesh.detach())
    assert found.boundary_edges == 0 and float(mesh.vertices.detach().abs().max()) <= 1.0 + 1e-6  # rounding of a mean
    grads = torch.autograd.grad(mesh.vertices.sum(), leaves)
    assert all(bool(torch.isfinite(g).all()) for g in grads) and all(float(g.abs().max()) > 0 for g in grads)


def test_gradients_behind_the_mesh_are_bitwise_identical_for_any_number_of_threads(threads):
    """Center vertices, deviation, normals, smoothing, atlas: torch's own scatters add up in any order."""
    sdf = torus(40) + 0.01 * torch.randn(41, 41, 41, generator=torch.Generator().manual_seed(0))
    weights = {"sdf": sdf, **random_weights(sdf.shape, 0, spread=0.5)}
    results = []
    for count in (1, 2, 5, 5):
        threads(count)
        leaves = {k: v.clone().requires_grad_() for k, v in weights.items()}
        given = {k: v for k, v in leaves.items() if k not in ("sdf", "gamma")}
        mesh = extract_surface(leaves["sdf"], radius=1.0, center=True, gamma=leaves["gamma"], **given)
        shown = unwrap(taubin_smooth(mesh.with_normals(), iterations=2), texture_size=64)
        spread = vertex_deviation(leaves["sdf"], radius=1.0, **given)
        seen = [mesh.vertices, shown.vertices, shown.normals, spread]
        rng = torch.Generator().manual_seed(1)
        cotangent = [torch.randn(v.shape, generator=rng) for v in seen]
        results.append([*seen, *torch.autograd.grad(seen, list(leaves.values()), cotangent)])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_gradients_in_the_padding_reach_their_vertices(device):
    sdf = grid(5, device=device)[..., 0] + 0.1
    leaf = sdf.clone().requires_grad_()
    shift = torch.zeros(6, 6, 6, 3, device=device).requires_grad_()
    mesh = extract_surface(leaf, radius=1.0, deformation=shift)
    g_sdf, g_shift = torch.autograd.grad(mesh.vertices.square().sum(), (leaf, shift))
    assert bool(torch.isfinite(g_sdf).all()) and bool(torch.isfinite(g_shift).all())
    # the total weight of a vertex is one: moving the whole grid moves every vertex
    (whole,) = torch.autograd.grad(extract_surface(leaf, radius=1.0, deformation=shift).vertices.sum(), shift)
    torch.testing.assert_close(whole.sum((0, 1, 2)), torch.full((3,), 2.0 * len(mesh.vertices), device=device))


def test_center_vertices_split_quads_in_four(device):
    sdf = torus(12, device)
    weights = random_weights(sdf.shape, 2, device)
    weights["gamma"].requires_grad_()
    two = extract_surface(sdf, radius=1.0, **weights)
    four = extract_surface(sdf, radius=1.0, center=True, **weights)
    quads = len(two.faces) // 2
    assert len(four.faces) == 4 * quads and len(four.vertices) == len(two.vertices) + quads
    found = report(four.detach())
    assert found.watertight and found.manifold and found.euler == 0
    assert torch.equal(four.vertices[: len(two.vertices)], two.vertices)
    assert two.vertices.requires_grad is False
    assert four.vertices.requires_grad
