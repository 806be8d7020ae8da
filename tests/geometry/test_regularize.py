"""FlexiCubes regularizers against float64 formulations and closed forms; fields in batches."""

import pytest
import torch

from reli3d.geometry.mesh import report
from reli3d.geometry.regularize import sign_entropy, vertex_deviation
from reli3d.geometry.surface import CubeWeights, extract_surface, surface_cubes
from tests.support.reference_surface import random_weights, sphere

F = torch.nn.functional


def test_deviation_of_a_flat_cut_vanishes_and_pulls_a_skewed_one_back():
    x = torch.linspace(-1, 1, 5)
    plane = (x[:, None, None] - 0.1).expand(5, 5, 5).contiguous()
    spread = vertex_deviation(plane, radius=1.0, closed=False)
    assert float(spread.max()) < 1e-6  # the vertex is as far from all four crossings
    beta = torch.rand(64, 12, generator=torch.Generator().manual_seed(1)) + 0.5
    losses = []
    for _ in range(40):
        beta = beta.detach().requires_grad_()
        loss = vertex_deviation(plane, radius=1.0, closed=False, weights=CubeWeights(beta=beta)).mean()
        losses.append(float(loss.detach()))
        beta = beta - 20.0 * torch.autograd.grad(loss, beta)[0]
    assert losses[-1] < 0.3 * losses[0]


def test_deviation_follows_the_vertices_of_a_closed_field_at_the_box(device):
    sdf = sphere(6, radius=1.1, device=device).requires_grad_()
    cubes = surface_cubes(sdf)
    weights = {
        name: value[cubes.cpu()].to(device)
        for name, value in random_weights((7,) * 3, 2).items()
        if name in ("alpha", "beta")
    }
    spread = vertex_deviation(sdf, radius=1.0, weights=CubeWeights(cubes=cubes, **weights))
    assert len(spread) == len(extract_surface(sdf, radius=1.0, weights=CubeWeights(cubes=cubes, **weights)).vertices)
    (g,) = torch.autograd.grad(spread.mean(), sdf)
    assert bool(torch.isfinite(spread).all() & torch.isfinite(g).all()) and float(g.abs().max()) > 0


def test_entropy_matches_cross_entropy_in_float64(device):
    sdf = torch.randn(2, 4, 5, 6, generator=torch.Generator().manual_seed(0)) * 3
    ours, double = sdf.to(device).requires_grad_(), sdf.double().requires_grad_()
    terms = []
    for axis in (1, 2, 3):
        n = sdf.shape[axis]
        a, b = double.narrow(axis, 0, n - 1), double.narrow(axis, 1, n - 1)
        change = (a < 0) != (b < 0)
        a, b = a[change], b[change]
        terms.append(
            F.binary_cross_entropy_with_logits(a, (b > 0).double(), reduction="none")
            + F.binary_cross_entropy_with_logits(b, (a > 0).double(), reduction="none")
        )
    expected, got = torch.cat(terms).mean(), sign_entropy(ours)
    torch.testing.assert_close(got.cpu().double(), expected, rtol=1e-6, atol=0)  # a float32 sum of 300 like terms
    torch.testing.assert_close(
        torch.autograd.grad(got, ours)[0].cpu().double(), torch.autograd.grad(expected, double)[0], rtol=1e-5, atol=1e-9
    )


def test_entropy_removes_a_floater_that_nothing_holds():
    sdf = sphere(8, radius=0.5)
    sdf[1, 1, 1] = -0.05
    assert report(extract_surface(sdf, radius=1.0)).components == 2
    for _ in range(5):
        sdf = sdf.detach().requires_grad_()
        sdf = sdf - 3.0 * torch.autograd.grad(sign_entropy(sdf), sdf)[0]
    assert float(sdf[1, 1, 1].detach()) > 0.0


def deviation(weights):
    return vertex_deviation(sphere(4), radius=1.0, weights=weights)


@pytest.mark.parametrize(
    "call, name",
    [
        (lambda: sign_entropy(torch.ones(3, 3)), "sdf"),
        (lambda: sign_entropy(torch.ones(3, 3, 1)), "sdf"),
        (lambda: sign_entropy(torch.full((3, 3, 3), float("nan"))), "sdf"),
        (lambda: vertex_deviation(torch.ones(3, 3), radius=1.0), "sdf"),
        (lambda: vertex_deviation(sphere(4), radius=-1.0), "radius"),
        (lambda: deviation(CubeWeights(beta=torch.zeros(64, 12))), "beta"),
        (lambda: deviation(CubeWeights(alpha=torch.ones(9, 8))), "alpha"),
    ],
)
def test_wrong_input_is_named(call, name):
    with pytest.raises(ValueError, match=name):
        call()
