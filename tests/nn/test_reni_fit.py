"""RENI++ latents fitted to a map."""

import math

import pytest
import torch

from reli3d.nn.presets import OFFICIAL
from reli3d.nn.reni import EnvironmentDecoder
from reli3d.nn.reni_fit import fit_latent
from tests.support.networks import published_decoder


@pytest.fixture(params=["random", "published"])
def decoder(request, device):
    if request.param == "random":
        torch.manual_seed(0)
        return EnvironmentDecoder(OFFICIAL.reni).to(device).eval()
    return published_decoder(request.getfixturevalue("goldens")).to(device)


@pytest.mark.parametrize("height", [20, pytest.param(32, marks=pytest.mark.slow)])
def test_a_decoded_map_is_found_again(decoder, height):
    device = decoder.sample_directions.device
    latent = torch.randn(49, 3, generator=torch.Generator().manual_seed(7)).to(device)
    with torch.no_grad():
        eye, strength = torch.eye(3, device=device)[None], torch.full((1,), 2.0, device=device)
        radiance = decoder(latent[None], eye, strength, height)
    before = [p.clone() for p in decoder.parameters()]
    found, level, error = fit_latent(decoder, radiance[0], steps=120)
    spread = float((radiance.log() - radiance.log().mean()).abs().mean())
    assert error < 0.3 * spread  # 120 steps of the 500
    with torch.no_grad():
        again = decoder(found[None], eye, level[None], height)
    rows = torch.sin((torch.arange(height, device=device) + 0.5) * math.pi / height)[:, None, None]
    measured = float(((again.log() - radiance.log()).abs() * rows).mean() / rows.mean())
    assert measured < 1.3 * error  # the reported error, up to the floor of the logarithm
    _, level, _ = fit_latent(decoder, radiance[0], steps=20)
    _, twice, _ = fit_latent(decoder, 2.0 * radiance[0], steps=20)
    # on CUDA sums take any order, which steps amplify: 1.5e-3 measured after 120
    most = 1e-3 if device.type == "cpu" else 3e-3
    torch.testing.assert_close(twice - level, torch.tensor(math.log(2.0), device=device), rtol=0, atol=most)
    assert all(torch.equal(a, b) and b.grad is None for a, b in zip(before, decoder.parameters(), strict=True))


def test_maps_that_cannot_be_fitted_are_named():
    torch.manual_seed(0)
    decoder = EnvironmentDecoder(OFFICIAL.reni).eval()
    for radiance, message in [
        (torch.ones(8, 15, 3), r"expected \(H, 2H, 3\) with H at least 8, got \(8, 15, 3\)"),
        (torch.ones(4, 8, 3), "H at least 8"),
        (torch.zeros(8, 16, 3), "got NaN, infinity, negative or black"),
        (torch.full((8, 16, 3), math.nan), "got NaN, infinity, negative or black"),
        (-torch.ones(8, 16, 3), "got NaN, infinity, negative or black"),
    ]:
        with pytest.raises(ValueError, match="radiance: .*" + message):
            fit_latent(decoder, radiance)
    with pytest.raises(TypeError, match="radiance: expected torch.float32"):
        fit_latent(decoder, torch.ones(8, 16, 3, dtype=torch.float64))
