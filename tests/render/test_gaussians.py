"""Spherical Gaussians against quadrature over the sphere in float64.

Gradients of irradiance and shading are compared with float64 references in ``tests/bridge/test_adjoints.py``.
"""

import pytest
import torch
from torch.nn.functional import normalize

from reli3d.render.gaussians import SphericalGaussians, shade_gaussians
from tests.support import reference
from tests.support.lobes import irradiance
from tests.support.surfaces import on_ball


def lobes(device, count=5, low=0.05, high=150.0, seed=0):
    rng = torch.Generator().manual_seed(seed)
    axis = normalize(torch.randn(count, 3, generator=rng), dim=-1)
    sharpness = torch.exp(torch.linspace(0, 1, count) * torch.log(torch.tensor(high / low))) * low
    return [t.to(device) for t in (axis, sharpness, torch.rand(count, 3, generator=rng))]


def light_at(d, axis, sharpness, amplitude):
    """Mixture at directions ``d``, float64."""
    return torch.exp(sharpness * (d @ axis.T - 1.0)) @ amplitude


def leaves(tensors):
    return [t.clone().requires_grad_() for t in tensors]


def test_irradiance_and_gradients_match_quadrature(device):
    """Every sharpness from nearly constant to 150 and normals all around, behind the lobe too."""
    d, solid = reference.sphere_grid(200)  # a lobe of sharpness 150 is 5 degrees wide, 8 rows
    own, rng = leaves(lobes(device, 24)), torch.Generator().manual_seed(2)
    normals = normalize(torch.randn(48, 3, generator=rng), dim=-1).to(device).requires_grad_()
    doubles, at = leaves([t.detach().cpu().double() for t in own]), normals.detach().cpu().double().requires_grad_()
    expected = ((at @ d.T).clamp(min=0.0) * solid) @ light_at(d, *doubles)
    got = irradiance(SphericalGaussians(*own), normals)
    # the fit errs by 0.2 % of a lobe's maximum each, here with random signs over 24 lobes
    assert float((got.detach().cpu().double() - expected.detach()).abs().max()) < 3e-3 * float(expected.detach().max())
    weight = torch.rand(48, 3, generator=rng)
    grads = torch.autograd.grad((got * weight.to(device)).sum(), [*own, normals])
    expected_grads = torch.autograd.grad((expected * weight.double()).sum(), [*doubles, at])
    for g, t, v in zip(grads, expected_grads, [*own, normals], strict=True):
        g = g.cpu().double()
        if v.shape[-1] == 3 and v is not own[2]:
            unit = v.detach().cpu().double()
            g, t = (x - (x * unit).sum(-1, keepdim=True) * unit for x in (g, t))
        assert float((g - t).norm() / t.norm()) < 0.02  # gradient of the fit: a few times its error of 0.2 %


@pytest.mark.parametrize("sharpness", [0.02, 0.29, 0.49, 0.51, 1.0, 10.0, 300.0])
def test_irradiance_is_exact_along_the_axis(device, sharpness):
    s = torch.tensor([sharpness], dtype=torch.float64, requires_grad=True)
    expected = (
        2 * torch.pi * (s - 1 + torch.exp(-s)) / s**2,
        2 * torch.pi * torch.exp(-s) * (1 - torch.exp(-s) * (1 + s)) / s**2,
    )
    axis = torch.tensor([[0.0, 0, 1]], device=device)
    own = s.detach().float().to(device).requires_grad_()
    light = SphericalGaussians(axis, own, torch.ones(1, 3, device=device))
    for sign, value in zip((1.0, -1.0), expected, strict=True):
        got = irradiance(light, sign * axis)
        # float32, and at 300 the far side is 1e-131: 0
        torch.testing.assert_close(got.cpu().double(), value.expand(1, 3), rtol=2e-5, atol=1e-6)
        gradients = torch.autograd.grad(got.sum() / 3.0, own), torch.autograd.grad(value, s, retain_graph=True)
        # 1e-5 of the closed forms' cancellation and of the series' end; the derivative of the far side at 10 is 1e-5
        torch.testing.assert_close(gradients[0][0].cpu().double(), gradients[1][0], rtol=3e-5, atol=2e-8)


def reflected(wo, base, alpha, metallic, axis, sharpness):
    """Quadrature of the material times one white lobe, normal +z, float64."""
    d, solid = reference.sphere_grid(256)
    wi = d[d[:, 2] > 1e-6]
    rows = [v.expand(len(wi), *v.shape) for v in (base, alpha, metallic)]
    value = reference.eval_bsdf(wo.expand(len(wi), 3), wi, *rows, "published")
    return (value * (torch.exp(sharpness * (wi @ axis - 1.0)) * wi[:, 2])[:, None]).sum(0) * solid


CASES = [
    (r, deg, s, m)
    for r, deg in ((0.3, 0), (0.3, 45), (0.5, 0), (0.5, 45), (0.7, 20))
    for s in (2.0, 30.0, 150.0)
    for m in (0.0, 1.0)
]


def test_shading_matches_quadrature(device):
    base = torch.tensor([0.8, 0.5, 0.2], dtype=torch.float64)
    for roughness, deg, sharpness, metallic in CASES:
        angle = torch.deg2rad(torch.tensor(float(deg), dtype=torch.float64))
        wo = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()])
        axis = normalize(wo * torch.tensor([-1.0, 1.0, 1.0]) + torch.tensor([0.05, 0.1, 0.0]), dim=-1)  # by the mirror
        alpha, metal = torch.tensor([roughness**2, metallic], dtype=torch.float64)
        expected = reflected(wo, base, alpha, metal, axis, sharpness)
        rows = [t.float().to(device)[None] for t in (torch.tensor([0.0, 0, 1]), wo, base)]
        light = SphericalGaussians(
            axis.float().to(device)[None], torch.tensor([sharpness], device=device), torch.ones(1, 3, device=device)
        )
        got = shade_gaussians(*on_ball(*rows, roughness, metallic), light)[0]
        # round lobes and one Fresnel factor: the method's own error as the docstring states it
        limit = 0.065 if roughness < 0.4 else 0.12 if roughness < 0.6 else 0.18
        error = (got.cpu().double() / expected - 1.0).abs().max()
        assert float(error) < limit, (roughness, deg, sharpness, metallic)


def shading_inputs(device, n=6, seed=3):
    rng = torch.Generator().manual_seed(seed)
    normal = normalize(torch.randn(n, 3, generator=rng), dim=-1)
    wo = normalize(normal + 0.7 * normalize(torch.randn(n, 3, generator=rng), dim=-1), dim=-1)
    base, rough, metal = (torch.rand(n, k, generator=rng) for k in (3, 1, 1))
    return [t.to(device) for t in (normal, wo, base, 0.25 + 0.7 * rough[:, 0], 0.1 + 0.8 * metal[:, 0])]


def test_gradients_stay_finite_at_the_edges(device):
    """A hundred thousand points: mirrors and rough, metals, black; views along the normal, in the surface, behind it;
    lobes along the normal or the view of one of them, against it, nearly constant and as sharp as a laser."""
    n, rng = 100_000, torch.Generator().manual_seed(5)
    normal, wo, base, rough, metal = shading_inputs("cpu", n)
    kind = torch.arange(n) % 16
    rough[kind < 4], rough[kind == 4] = 0.0, 1.0
    metal[kind < 8], base[kind < 2], base[kind == 2] = (torch.arange(n)[kind < 8] % 2).float(), 0.0, 1.0
    wo[kind == 5], wo[kind == 6] = normal[kind == 5], -normal[kind == 6]
    flat = torch.linalg.cross(normal, normalize(torch.randn(n, 3, generator=rng), dim=-1))
    wo[kind == 7] = normalize(flat, dim=-1)[kind == 7]
    axis, sharpness, amplitude = lobes("cpu", 12, 1e-4, 1e6)
    axis[:6] = torch.stack([-normal[4], wo[4], -wo[5], wo[7], 2.0 * normal[0] * (normal[0] @ wo[0]) - wo[0], -wo[0]])
    sharpness[3:5], amplitude[5] = torch.tensor([0.01, 0.5]), 0.0
    inputs = leaves(t.to(device) for t in (normal, wo, base, rough, metal, axis, sharpness, amplitude))
    light = SphericalGaussians(*inputs[5:])
    for out in (shade_gaussians(*on_ball(*inputs[:5]), light), irradiance(light, inputs[0])):
        grads = torch.autograd.grad(out.sum(), inputs, allow_unused=True)
        assert bool(torch.isfinite(out).all()) and float(out.detach().min()) >= 0.0
        assert all(g is None or bool(torch.isfinite(g).all()) for g in grads)
        assert float(grads[6].abs().max()) > 0.0


def test_bad_input_and_empty_batches(device):
    axis, sharpness, amplitude = lobes(device)
    with pytest.raises(ValueError, match="sharpness: expected shape"):
        SphericalGaussians(axis, sharpness[:2], amplitude)
    light = SphericalGaussians(axis, sharpness, amplitude)
    rows = shading_inputs(device)
    assert shade_gaussians(*on_ball(*(r[:0] for r in rows)), light).shape == (0, 3)
    with pytest.raises(ValueError, match="wo: expected"):
        shade_gaussians(*on_ball(rows[0], rows[1][:2], *rows[2:]), light)
