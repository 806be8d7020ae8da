"""Gradients of FlexiCubes: against the float64 formulation, finite differences, in the padding and for odd inputs."""

import pytest
import torch
from scipy.spatial import cKDTree

from reli3d.geometry.mesh import report
from reli3d.geometry.regularize import vertex_deviation
from reli3d.geometry.smooth import taubin_smooth
from reli3d.geometry.surface import extract_surface
from reli3d.geometry.uv import unwrap
from tests.support import reference_surface
from tests.support.reference_surface import grid, random_weights, sphere, torus

F = torch.nn.functional


def test_gradients_match_the_float64_formulation(device):
    rng = torch.Generator().manual_seed(3)
    sdf = torch.randn(7, 6, 8, generator=rng)
    sdf = F.pad(sdf, (1,) * 6, value=0.7)  # the plain formulation has no padding; away from the box both agree
    weights = random_weights(sdf.shape, 5, spread=0.5)
    gamma = weights.pop("gamma")
    leaves = {"sdf": sdf, **weights}
    ours = {k: v.to(device).requires_grad_() for k, v in leaves.items()}
    mesh = extract_surface(ours["sdf"], radius=0.8, gamma=gamma.to(device), **{k: ours[k] for k in weights})
    double = {k: v.double().requires_grad_() for k, v in leaves.items()}
    expected, _ = reference_surface.flexicubes_vertices(
        double["sdf"], double["deformation"], double["alpha"], double["beta"], 1.6
    )
    tree = cKDTree(mesh.vertices.detach().cpu().numpy())
    distance, match = tree.query(expected.detach().numpy())
    assert len(expected) == len(mesh.vertices) == len(set(match.tolist()))
    assert distance.max() < 1e-6  # float32 quotients of coordinates below 1
    cotangent = torch.randn(len(expected), 3, generator=rng)
    placed = torch.empty_like(cotangent)
    placed[torch.from_numpy(match)] = cotangent
    got = torch.autograd.grad((mesh.vertices * placed.to(device)).sum(), list(ours.values()))
    true = torch.autograd.grad((expected * cotangent.double()).sum(), list(double.values()))
    for name, a, b in zip(ours, got, true, strict=True):
        # float64 inside, so what is left is float32 sums over eight cubes
        torch.testing.assert_close(a.cpu().double(), b, rtol=1e-5, atol=1e-7 * float(b.abs().max()), msg=name)


def test_layout_of_the_inputs_does_not_matter_and_gradients_stop_where_none_is_required(device):
    sdf = torus(10, device)
    weights = random_weights(sdf.shape, 4, device)
    weights["alpha"] = weights["alpha"][:1].expand(1000, 8)
    expected = extract_surface(sdf, radius=1.0, **weights)
    strided = {name: torch.stack([value, value], -1)[..., 1] for name, value in weights.items()}
    beta = strided["beta"] = strided["beta"].requires_grad_()
    turned = sdf.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not turned.is_contiguous() and not beta.is_contiguous()
    got = extract_surface(turned, radius=1.0, **strided)
    assert torch.equal(got.vertices.detach(), expected.vertices) and torch.equal(got.faces, expected.faces)
    loss = got.vertices.square().sum()
    (first,) = torch.autograd.grad(loss, beta, retain_graph=True)
    assert torch.equal(first, torch.autograd.grad(loss, beta, retain_graph=True)[0]) and first.shape == beta.shape
    (twice,) = torch.autograd.grad(loss, beta, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        twice.sum().backward()
    leaf = sdf.clone().requires_grad_()
    held = leaf * 1.0
    mesh = extract_surface(held, radius=1.0)
    held.mul_(2.0)
    with pytest.raises(RuntimeError, match="inplace"):
        mesh.vertices.sum().backward()


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


def test_gradients_match_finite_differences_of_the_kernel(device):
    sdf = sphere(6, device=device) + 0.05
    rng = torch.Generator().manual_seed(0)
    weights = random_weights(sdf.shape, 1, device, spread=0.4)
    direction = torch.randn(sdf.shape, generator=rng).to(device)
    cotangent = None
    values = []
    leaf = sdf.clone().requires_grad_()
    for step in (-1e-2, 1e-2, 0.0):
        mesh = extract_surface(leaf + step * direction * sdf.abs(), radius=1.0, center=True, **weights)
        if cotangent is None:
            cotangent = torch.randn(mesh.vertices.shape, generator=rng).to(device)
        values.append((mesh.vertices * cotangent).sum())
    (got,) = torch.autograd.grad(values[2], leaf)
    derivative = float(((values[1] - values[0]) / 2e-2).detach())  # steps that scale with the sdf keep its signs
    assert abs(float((got * direction * sdf.abs()).sum()) - derivative) < 2e-3 * max(
        1.0, abs(derivative)
    )  # float32, step**2


def test_gradients_in_the_padding_reach_what_they_stand_at(device):
    sdf = grid(5, device=device)[..., 0] + 0.1
    leaf = sdf.clone().requires_grad_()
    shift = torch.zeros(6, 6, 6, 3, device=device).requires_grad_()
    mesh = extract_surface(leaf, radius=1.0, deformation=shift)
    g_sdf, g_shift = torch.autograd.grad(mesh.vertices.square().sum(), (leaf, shift))
    assert bool(torch.isfinite(g_sdf).all()) and bool(torch.isfinite(g_shift).all())
    # the total weight of a vertex is one: moving the whole grid moves every vertex
    (whole,) = torch.autograd.grad(extract_surface(leaf, radius=1.0, deformation=shift).vertices.sum(), shift)
    torch.testing.assert_close(whole.sum((0, 1, 2)), torch.full((3,), 2.0 * len(mesh.vertices), device=device))


def test_center_vertices_split_quads_in_four_with_gradient_to_gamma(device):
    sdf = torus(12, device)
    weights = random_weights(sdf.shape, 2, device)
    gamma = weights["gamma"].requires_grad_()
    two = extract_surface(sdf, radius=1.0, **weights)
    four = extract_surface(sdf, radius=1.0, center=True, **weights)
    quads = len(two.faces) // 2
    assert len(four.faces) == 4 * quads and len(four.vertices) == len(two.vertices) + quads
    found = report(four.detach())
    assert found.watertight and found.manifold and found.euler == 0
    assert torch.equal(four.vertices[: len(two.vertices)], two.vertices)
    assert two.vertices.requires_grad is False
    cotangent = torch.randn(four.vertices.shape, generator=torch.Generator().manual_seed(0)).to(device)
    (got,) = torch.autograd.grad((four.vertices * cotangent).sum(), gamma)
    direction = torch.rand(gamma.shape, generator=torch.Generator().manual_seed(1)).to(device) * gamma.detach()
    ends = []
    for step in (-1e-3, 1e-3):
        weights["gamma"] = gamma.detach() + step * direction
        moved = extract_surface(sdf, radius=1.0, center=True, **weights).vertices
        ends.append((moved.double() * cotangent.double()).sum())
    derivative = float((ends[1] - ends[0]) / 2e-3)
    assert abs(float((got * direction).sum()) - derivative) < 2e-2 * max(
        1.0, abs(derivative)
    )  # float32 over a step of 1e-3
