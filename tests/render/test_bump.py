"""Shading normals from bump normals."""

import numpy as np
import torch

from reli3d.render.bump import radial_bump


def test_radial_bump_matches_the_published_frame(goldens):
    data = np.load(goldens / "radial_bump.npz")
    keys = {k: torch.as_tensor(data[k]) for k in data.files}
    got = radial_bump(keys["position"], keys["geometry_normal"], keys["surface_normal"])
    torch.testing.assert_close(got, keys["shading_normal"], rtol=1e-5, atol=2e-6)  # four float32 normalizations


def test_the_kernel_of_the_radial_bump_is_its_formula_in_float64():
    """The kernel works where no gradient is required; also on the vertical axis, where there is no frame."""
    generator = torch.Generator().manual_seed(4)
    position, bump = torch.randn(2000, 3, generator=generator), torch.randn(2000, 3, generator=generator)
    position[:10, 0] = position[:10, 2] = 0.0
    normal = torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=-1)
    expected = radial_bump(position.double(), normal.double(), bump.double())
    got = radial_bump(position.view(40, 50, 3), normal.view(40, 50, 3), bump.view(40, 50, 3)).view(2000, 3)
    near = (expected.norm(dim=-1) > 0.5) & (bump.norm(dim=-1) > 0.1)  # elsewhere rounding is divided by something small
    assert float(near.double().mean()) > 0.95
    torch.testing.assert_close(got[near].double(), expected[near], rtol=0, atol=2e-5)  # five float32 normalizations
    leaf = bump.clone().requires_grad_()
    torch.testing.assert_close(radial_bump(position, normal, leaf).detach()[near], got[near], rtol=0, atol=2e-5)


def test_a_flat_bump_is_the_normal():
    generator = torch.Generator().manual_seed(3)
    position, normal = torch.randn(500, 3, generator=generator), torch.randn(500, 3, generator=generator)
    normal = torch.nn.functional.normalize(normal, dim=-1)
    flat = torch.tensor([0.0, 0.0, 1.0]).expand(500, 3)
    torch.testing.assert_close(radial_bump(position, normal, flat), normal, rtol=0, atol=1e-6)
