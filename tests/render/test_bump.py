"""Shading normals from bump normals."""

import numpy as np
import torch

from reli3d.render.bump import radial_bump


def test_radial_bump_matches_the_published_frame(goldens):
    data = np.load(goldens / "radial_bump.npz")
    keys = {k: torch.as_tensor(data[k]) for k in data.files}
    got = radial_bump(keys["position"], keys["geometry_normal"], keys["surface_normal"])
    torch.testing.assert_close(got, keys["shading_normal"], rtol=1e-5, atol=2e-6)  # four float32 normalizations


def formula(position, normal, bump):
    """The published frame, in plain torch; 0 on the vertical axis, where there is no tangent."""
    unit = lambda v: v / v.norm(dim=-1, keepdim=True).clamp(min=1e-7)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=position.dtype).expand_as(position)
    tangent = torch.linalg.cross(normal, torch.linalg.cross(torch.linalg.cross(up, position), normal))
    tangent = unit(tangent)
    bitangent = unit(torch.linalg.cross(normal, tangent))
    return unit(tangent * bump[..., :1] + bitangent * bump[..., 1:2] + normal * bump[..., 2:])


def test_values_and_gradients_are_those_of_the_formula_in_float64(device):
    generator = torch.Generator().manual_seed(4)
    position, bump = torch.randn(2000, 3, generator=generator), torch.randn(2000, 3, generator=generator)
    position[:10, 0] = position[:10, 2] = 0.0
    normal = torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=-1)
    leaf, exact = bump.to(device).view(40, 50, 3).requires_grad_(), bump.double().requires_grad_()
    expected = formula(position.double(), normal.double(), exact)
    got = radial_bump(position.to(device).view(40, 50, 3), normal.to(device).view(40, 50, 3), leaf)
    near = (expected.norm(dim=-1) > 0.5) & (bump.norm(dim=-1) > 0.1)  # elsewhere rounding is divided by something small
    assert float(near.double().mean()) > 0.95
    # five float32 normalizations
    torch.testing.assert_close(got.view(2000, 3).cpu()[near].double(), expected[near], rtol=0, atol=2e-5)
    weight = torch.randn(2000, 3, generator=generator) * near[:, None]
    (gradient,) = torch.autograd.grad((got.view(2000, 3) * weight.to(device)).sum(), leaf)
    (true,) = torch.autograd.grad((expected * weight).sum(), exact)
    torch.testing.assert_close(gradient.view(2000, 3).cpu().double(), true, rtol=0, atol=2e-4)  # over lengths above 0.1
