"""Roughness and metallic as distributions: against SciPy's binomial, torch's cross-entropy and the shipped network."""

import numpy as np
import pytest
import torch
from scipy.stats import binom
from torch.nn.functional import cross_entropy

from reli3d.errors import InputError
from reli3d.geometry.camera import Camera, look_at
from reli3d.nn.local import METALLIC_LOGIT, PixelMaps, binned
from reli3d.nn.value_bins import L1_WEIGHT, bin_loss, two_bins, with_bins
from reli3d.nn.weights import load, load_model, save


@pytest.mark.parametrize("bins", [2, 8])
def test_multiples_of_a_logit_are_the_binomial_distribution(bins):
    logit = torch.tensor([-3.0, -0.4, 0.0, 1.7])
    raw = (logit[:, None] * torch.arange(bins))[:, None].expand(-1, 2, -1)
    log_bins, expected = binned(raw)
    for k, zero in enumerate((0.0, METALLIC_LOGIT)):
        p = (logit + zero).sigmoid().numpy()
        exact = binom.logpmf(np.arange(bins), bins - 1, p[:, None])
        # float32 logits of up to 35
        np.testing.assert_allclose(log_bins[:, k].numpy(), exact, atol=2e-5)
        np.testing.assert_allclose(expected[:, k].sigmoid().numpy(), p, atol=1e-6)


def test_the_loss_is_the_excess_cross_entropy_and_zero_at_the_value():
    generator = torch.Generator().manual_seed(0)
    value = torch.rand(64, generator=generator, dtype=torch.float64)
    value[:3] = torch.tensor([0.0, 1.0, 3.0 / 7.0])
    target = two_bins(value, 8)
    steps = torch.linspace(0, 1, 8, dtype=torch.float64)
    torch.testing.assert_close(target @ steps, value)
    torch.testing.assert_close(target.sum(-1), torch.ones_like(value))
    assert int((target > 0).sum(-1).max()) == 2
    logits = torch.randn(64, 8, generator=generator, dtype=torch.float64)
    least = cross_entropy((target + 1e-300).log(), target)
    error = (logits.softmax(-1) @ steps - value).abs().mean()
    expected = (cross_entropy(logits, target) - least) / np.log(8) + L1_WEIGHT * error
    torch.testing.assert_close(bin_loss(logits.log_softmax(-1), value), expected)
    assert float(bin_loss((target + 1e-300).log(), value)) == pytest.approx(0.0, abs=1e-12)


def test_a_converted_network_predicts_the_same(tmp_path):
    """Also from its file, and for mirror images; a network is not converted twice."""
    unlit = load_model("small", "cpu")
    made = with_bins(unlit, 8)
    made, _ = load(save(tmp_path / "bins.safetensors", made, license="test", dtype=torch.float32).path)
    assert made.preset.pyramid.material_bins == 8
    eyes = [look_at((0.0, 0.0, 2.4)), look_at((2.0, 0.4, 1.2))]
    c2w = torch.stack([*eyes, *eyes])
    camera = Camera.from_fov(c2w, 0.6, 64, 64)
    images = torch.rand(4, 64, 64, 3, generator=torch.Generator().manual_seed(0))
    x, y = torch.meshgrid(torch.linspace(-1, 1, 64), torch.linspace(-1, 1, 64), indexing="ij")
    masks = (x.square() + y.square() < 0.5).float().expand(4, -1, -1).contiguous()
    detail = torch.cat([images, 20.0 * (0.7 - (x.square() + y.square()).sqrt())[..., None].expand(4, -1, -1, 1)], -1)
    with torch.no_grad():
        views = images, masks, c2w, camera.intrinsics, detail.contiguous(), camera.intrinsics
        (_, expected, _), (_, got, _) = (m.read_pixels(*views, mirrored=2) for m in (unlit, made))
    assert got.bins.shape == (4, 32, 32, 2, 8)
    assert float(expected.roughness.std()) > 0.1 and float(expected.normal[2:].std()) > 0.1
    for name in ("gain", "shift", "confidence", "roughness", "metallic", "chroma", "normal", "depth"):
        # weights of bin 7 are 7 times those of the logit: 7 times float32's error
        torch.testing.assert_close(getattr(got, name), getattr(expected, name), rtol=1e-4, atol=1e-4, msg=name)
    with pytest.raises(InputError, match="expected 8, as the weights have, got 4"):
        with_bins(made, 4)


def test_gradients_of_the_bins_match_differences():
    raw = torch.randn(3, 2, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: binned(x), (raw,))


def test_pixel_maps_without_bins_have_none():
    camera = Camera.from_fov(look_at((0.0, 0.0, 2.4))[None], 0.6, 8, 8)
    maps = PixelMaps.of(torch.zeros(1, 8, 8, 12), torch.zeros(1, 4, 4, 2), camera, torch.tensor(0.0))
    assert maps.bins.shape == (1, 8, 8, 2, 1)
    assert float(maps.metallic.min()) == METALLIC_LOGIT and float(maps.roughness.abs().max()) == 0.0
