"""sample_triplane against torch's grid_sample in float64, the published release's features, and itself."""

import numpy as np
import pytest
import torch

from reli3d.geometry.triplane import CACHED_FLOATS, sample_triplane
from tests.support.reference import fraction_within, grid_samples


def inputs(batch=2, channels=13, height=9, width=11, n=300, device="cpu", seed=0):
    rng = torch.Generator().manual_seed(seed)
    planes = torch.randn(batch, 3, channels, height, width, generator=rng)
    points = torch.rand(batch, n, 3, generator=rng) * 2.6 - 1.3  # some beyond the last texel
    weights = torch.randn(batch, n, 3 * channels, generator=rng)
    return planes.to(device), points.to(device), weights.to(device)


@pytest.mark.parametrize("channels, height, width", [(1, 1, 1), (3, 2, 5), (8, 16, 4), (40, 24, 24), (13, 300, 280)])
def test_values_and_gradients_match_grid_sample_in_float64(device, channels, height, width):
    planes, points, weights = inputs(2, channels, height, width, 300, device)
    planes, points = planes.requires_grad_(), points.requires_grad_()
    got = sample_triplane(planes, points)
    reference = [planes.detach().double().requires_grad_(), points.detach().double().requires_grad_()]
    expected = grid_samples(*reference)
    torch.testing.assert_close(got.double(), expected, rtol=0, atol=5e-6)  # float32 sums of four values of up to 5
    g_got = torch.autograd.grad((got * weights).sum(), (planes, points))
    g_expected = torch.autograd.grad((expected * weights.double()).sum(), reference)
    # of 600 points where there is 1 texel
    torch.testing.assert_close(g_got[0].double(), g_expected[0], rtol=0, atol=4e-5)
    # the gradient jumps at a texel center, which rounding may move a point across: none of these 600 points is there
    for a, b in zip((got, *g_got), (expected, *g_expected), strict=True):
        assert fraction_within(a, b) >= 0.999


def test_features_match_the_published_release(goldens, device):
    data = np.load(goldens / "object_representation_heads.npz")
    planes, points = (torch.from_numpy(data[k]).to(device) for k in ("triplane", "positions"))
    got = sample_triplane(planes, points / 0.87).cpu()
    torch.testing.assert_close(got, torch.from_numpy(data["features"]), rtol=0, atol=2e-5)  # float32 of values up to 4


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_storage_is_summed_in_float32(device, dtype):
    planes, points, weights = inputs(1, 8, 6, 7, 4000, device)
    stored = planes.to(dtype).requires_grad_()
    got = sample_triplane(stored, points)
    assert got.dtype == torch.float32
    torch.testing.assert_close(got, sample_triplane(stored.detach().float(), points), rtol=0, atol=0)
    grad = torch.autograd.grad((got * weights).sum(), stored)[0]
    full = stored.detach().float().requires_grad_()
    expected = torch.autograd.grad((sample_triplane(full, points) * weights).sum(), full)[0]
    assert grad.dtype == dtype
    assert torch.equal(grad, expected.to(dtype))  # rounded once, after the sum over 4000 points


def test_coherent_points_in_order_and_shuffled_ones_by_row_are_bitwise_equal():
    planes, _, _ = inputs(1, 8, 100, 100)
    assert planes[0, 0].numel() > CACHED_FLOATS
    t = torch.linspace(0, 300, 6000)
    walk = torch.stack([0.9 * (0.11 * t).sin(), t / 160 - 0.9, 0.9 * (0.13 * t).cos()], -1)[None]
    shuffled = torch.randperm(6000, generator=torch.Generator().manual_seed(0))
    assert torch.equal(sample_triplane(planes, walk[:, shuffled]), sample_triplane(planes, walk)[:, shuffled])


@pytest.mark.parametrize("channels, height, width", [(40, 120, 90), (13, 64, 200)])
def test_channel_first_planes_read_by_rows_are_bitwise_equal(channels, height, width):
    """Scattered points, some outside; rows of cells without any, whole bands of them, and a batch."""
    planes, points, weights = inputs(2, channels, height, width, 3000)
    points[1, :, 1] = points[1, :, 1].abs() * 0.3 + 0.4
    points[0, 5] = float("nan")
    assert planes[0, 0].numel() > CACHED_FLOATS
    channel_last = planes.movedim(2, -1).contiguous().movedim(-1, 2)
    p, q = planes.requires_grad_(), channel_last.requires_grad_()
    got, expected = sample_triplane(p, points), sample_triplane(q, points)
    assert torch.equal(got, expected)
    assert torch.equal(*(torch.autograd.grad(f, x, weights)[0] for f, x in ((got, p), (expected, q))))
    assert torch.equal(sample_triplane(planes.detach(), points), expected)


@pytest.mark.parametrize(
    "change, error",
    [
        (dict(planes=torch.zeros(2, 4, 4, 5, 6)), ValueError),
        (dict(planes=torch.zeros(3, 4, 5, 6)), ValueError),
        (dict(planes=torch.zeros(2, 3, 0, 5, 6)), ValueError),
        (dict(points=torch.zeros(2, 7, 2)), ValueError),
        (dict(points=torch.zeros(1, 7, 3)), ValueError),
        (dict(points=torch.zeros(7, 3)), ValueError),
        (dict(planes=None), TypeError),
    ],
)
def test_wrong_input_is_named(change, error):
    arguments = dict(planes=torch.zeros(2, 3, 4, 5, 6), points=torch.zeros(2, 7, 3)) | change
    with pytest.raises(error, match=f"^{next(iter(change))}: expected"):
        sample_triplane(**arguments)
