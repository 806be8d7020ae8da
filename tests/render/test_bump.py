"""Shading normals from bump normals."""

import numpy as np
import torch

from reli3d.render.bump import radial_bump, world_bump


def test_radial_bump_matches_the_published_frame(goldens):
    data = np.load(goldens / "radial_bump.npz")
    keys = {k: torch.as_tensor(data[k]) for k in data.files}
    got = radial_bump(keys["position"], keys["geometry_normal"], keys["surface_normal"])
    torch.testing.assert_close(got, keys["shading_normal"], rtol=1e-5, atol=2e-6)  # four float32 normalisations


def test_the_kernel_of_the_radial_bump_is_its_formula_in_float64():
    """The kernel works where no gradient is asked for; also on the vertical axis, where there is no frame."""
    generator = torch.Generator().manual_seed(4)
    position, bump = torch.randn(2000, 3, generator=generator), torch.randn(2000, 3, generator=generator)
    position[:10, 0] = position[:10, 2] = 0.0
    normal = torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=-1)
    want = radial_bump(position.double(), normal.double(), bump.double())
    got = radial_bump(position.view(40, 50, 3), normal.view(40, 50, 3), bump.view(40, 50, 3)).view(2000, 3)
    near = (want.norm(dim=-1) > 0.5) & (bump.norm(dim=-1) > 0.1)  # elsewhere rounding is divided by something small
    assert float(near.double().mean()) > 0.95
    torch.testing.assert_close(got[near].double(), want[near], rtol=0, atol=2e-5)  # five float32 normalisations
    asked = bump.clone().requires_grad_()
    torch.testing.assert_close(radial_bump(position, normal, asked).detach()[near], got[near], rtol=0, atol=2e-5)


def test_a_flat_bump_is_the_normal():
    generator = torch.Generator().manual_seed(3)
    position, normal = torch.randn(500, 3, generator=generator), torch.randn(500, 3, generator=generator)
    normal = torch.nn.functional.normalize(normal, dim=-1)
    flat = torch.tensor([0.0, 0.0, 1.0]).expand(500, 3)
    torch.testing.assert_close(radial_bump(position, normal, flat), normal, rtol=0, atol=1e-6)


def unit_normals(n, dtype=torch.float32):
    g = torch.Generator().manual_seed(5)
    normal = torch.nn.functional.normalize(torch.randn(n, 3, generator=g, dtype=torch.float64), dim=-1)
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    return torch.cat([axes, normal]).to(dtype)


def test_world_bump_is_a_right_handed_frame_from_the_worlds_axes():
    """Against numpy in float64, formula by formula, on the axes and at random."""
    normal = unit_normals(500)
    frame = torch.stack([world_bump(normal, torch.eye(3)[k].expand_as(normal)) for k in range(3)], 1)
    for n, got in zip(normal.double().numpy(), frame.double().numpy(), strict=True):
        c = np.array([n[2], 0.0, -n[0]]) if abs(n[0]) > abs(n[1]) else np.array([0.0, n[2], -n[1]])
        c /= np.linalg.norm(c)
        np.testing.assert_allclose(got, [np.cross(c, n), c, n], atol=5e-7)  # three float32 normalisations
        np.testing.assert_allclose(np.linalg.det(got), 1.0, atol=1e-6)
    # upright walls: the bump's second axis is the world's
    np.testing.assert_allclose(frame[2, :2].numpy(), [[1, 0, 0], [0, 1, 0]], atol=1e-7)  # normal +z
    bump = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, 0.9]), dim=0).expand_as(normal)
    want = (bump[:, :, None] * frame).sum(1)
    torch.testing.assert_close(world_bump(normal, bump), want, rtol=0, atol=1e-6)


def test_gradients_of_world_bump_reach_normal_and_bump():
    normal = unit_normals(60, torch.float64)[6:]
    normal = normal[(normal[:, 0].abs() - normal[:, 1].abs()).abs() > 1e-3].requires_grad_()  # off the seam
    bump = torch.randn(normal.shape, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    assert torch.autograd.gradcheck(world_bump, (normal, bump.requires_grad_()), eps=1e-6, atol=1e-5, rtol=1e-3)
