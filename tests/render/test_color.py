"""Color transfer against the published values and closed forms."""

import numpy as np
import pytest
import torch

from reli3d.render.color import agx, linear_to_srgb, srgb_to_linear


def test_agx_and_srgb_equal_the_published_values(goldens, device):
    data = {k: torch.from_numpy(v).to(device) for k, v in np.load(goldens / "agx.npz").items()}
    torch.testing.assert_close(agx(data["linear"]), data["display"], rtol=0, atol=2e-6)  # float32 exp and log
    torch.testing.assert_close(linear_to_srgb(data["cs_in"]), data["linear_to_srgb"], rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(srgb_to_linear(data["cs_in"]), data["srgb_to_linear"], rtol=1e-6, atol=1e-7)


def test_srgb_round_trip_and_finite_gradients(device):
    x = torch.linspace(-0.2, 2.0, 1001, device=device, requires_grad=True)
    torch.testing.assert_close(linear_to_srgb(srgb_to_linear(x)), x, rtol=0, atol=2e-6)
    for f in (srgb_to_linear, linear_to_srgb):
        assert bool(torch.isfinite(torch.autograd.grad(f(x).sum(), x)[0]).all())
    rgb = torch.tensor([[0.0, 0.0, 0.0], [1e6, 1e6, 0.0], [0.2, 0.5, 0.1]], device=device, requires_grad=True)
    out = agx(rgb)
    assert float(out.detach().min()) >= 0.0 and float(out.detach().max()) <= 1.0
    assert bool(torch.isfinite(torch.autograd.grad(out.sum(), rgb)[0]).all())
    with pytest.raises(ValueError, match="radiance: expected shape"):
        agx(rgb[:, :2])


@pytest.mark.parametrize("f", [agx, srgb_to_linear, linear_to_srgb])
def test_gradients_equal_finite_differences(f):
    """Both sides of the knees at 0.0031 and 0.0405, where the derivative jumps; agx clamps below 0."""
    above = torch.rand(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 1.5 + 0.05
    toe = torch.linspace(1e-4 if f is agx else -0.2, 0.003, 15, dtype=torch.float64).reshape(5, 3)
    assert torch.autograd.gradcheck(f, torch.cat([above, toe]).requires_grad_(), eps=1e-6, atol=1e-5, rtol=1e-3)
