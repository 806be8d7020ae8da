"""The RENI++ decoder with its published weights, against maps that the published code made and against its symmetry."""

import math

import numpy as np
import pytest
import torch

from reli3d.nn.reni import reni_frame
from reli3d.render.latlong import lat_long_directions, quarter_turn
from tests.support.networks import published_decoder

# Float32 through six norms, then exp; measured 6e-6 of the value.  The bound is the required one.
MAP = dict(rtol=1e-4, atol=1e-6)


@pytest.fixture
def decoder(goldens):
    return published_decoder(goldens)


@pytest.fixture
def golden(goldens):
    def read(name):
        with np.load(goldens / f"{name}.npz") as file:
            return {k: torch.from_numpy(file[k]) for k in file.files}

    return read


@torch.no_grad()
def test_maps_match_published(decoder, golden):
    g = golden("reni_decoder")
    out = decoder(g["latent"], g["rotation"], g["strength"])
    torch.testing.assert_close(out, quarter_turn(g["env_map"], -1), **MAP)


@torch.no_grad()
def test_intermediate_features_match_published(decoder, golden):
    g = golden("reni_decoder")
    # the published angles are float32
    torch.testing.assert_close(decoder.sample_directions, g["sample_directions"], rtol=0, atol=5e-7)
    turned = g["latent"] @ g["rotation"].mT
    torch.testing.assert_close(decoder.field.conditioning(turned), g["conditioning"], rtol=1e-5, atol=1e-6)
    features = decoder.field.directional(turned, g["sample_directions"][None, ::512])
    torch.testing.assert_close(features, g["directional_first16"], rtol=1e-5, atol=2e-6)


@torch.no_grad()
def test_map_turned_about_the_vertical_matches_published(decoder, golden):
    g = golden("reni_decoder_zrot")
    c, s = (f(-2.0 * float(g["z_rotation_rads"])) for f in (math.cos, math.sin))  # as published, by twice the angle
    directions = reni_frame(lat_long_directions(decoder.height)).reshape(1, -1, 3)
    turned = directions @ torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    out = decoder.radiance(g["latent"], g["rotation"], g["strength"], turned).unflatten(1, (decoder.height, -1))
    torch.testing.assert_close(quarter_turn(out, 1), g["env_map"], **MAP)


def test_gradients_are_finite_at_a_zero_latent_and_match_differences(decoder):
    decoder.double()
    latent = torch.zeros(1, 49, 3, dtype=torch.float64)
    latent[0, 20:] = torch.randn(29, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    latent.requires_grad_()
    directions = reni_frame(lat_long_directions(4)).reshape(1, -1, 3).double()

    def total(latent):
        return decoder.field(latent, directions).square().sum()

    (gradient,) = torch.autograd.grad(total(latent), latent)
    assert gradient.isfinite().all()
    step = torch.randn(1, 49, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    step[0, :20] = 0.0  # the published ReLU has a kink at zero
    with torch.no_grad():
        difference = (total(latent + 1e-6 * step) - total(latent - 1e-6 * step)) / 2e-6
    torch.testing.assert_close((gradient * step).sum(), difference, rtol=1e-6, atol=1e-6)  # float64 central difference
