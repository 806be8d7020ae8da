"""Heads in one kernel on a CPU, against the same layers in torch in float64."""

import pytest
import torch
from torch import nn

from reli3d.geometry.triplane import sample_triplane
from reli3d.nn.heads import HEADS, Heads, activate

NAMES = tuple(HEADS)
SHAPES = [(40, 64, 1000), (7, 16, 49), (12, 100, 5), (8, 130, 97)]  # channels, width, points: padded, parts of a tile


def asked(channels, width, count, batch=2):
    """Heads whose outputs spread, a triplane, and points in it, outside it, and one that is no point."""
    torch.manual_seed(0)
    heads = Heads(3 * channels, width).eval()
    for layer in heads.modules():
        if isinstance(layer, nn.Linear):
            nn.init.normal_(layer.weight, std=1.5 / layer.in_features**0.5)
            nn.init.normal_(layer.bias, std=0.5)
    points = torch.rand(batch, count, 3) * 2.4 - 1.2
    points[0, 1] = float("nan")
    return heads.requires_grad_(False), torch.randn(batch, 3, channels, 24, 32), points


def rounded(x):
    return x.float().bfloat16().double()


def in_bfloat16(layers, features):
    """Float64, but numbers between the layers, and the weights of hidden ones, have eight significant bits."""
    *hidden, last = (m for m in layers if isinstance(m, nn.Linear))
    x = rounded(features)
    for layer in hidden:
        x = rounded(nn.functional.silu(nn.functional.linear(x, rounded(layer.weight), layer.bias.double())))
    return nn.functional.linear(x, last.weight.double(), last.bias.double())


@pytest.mark.parametrize("channels, width, count", SHAPES)
def test_every_head_is_its_layers_in_float64(channels, width, count):
    heads, triplane, points = asked(channels, width, count)
    with torch.no_grad():
        got = heads.at(triplane, points, NAMES)
        features = sample_triplane(triplane, points).double()
        for name in NAMES:
            want = activate(name, heads[name].double()(features))
            heads[name].float()
            # float32 sums of up to 130 products of size 1, three layers deep; normals are divided by their length
            torch.testing.assert_close(got[name].double(), want, rtol=1e-5, atol=2e-5 if name == "normal" else 5e-6)


@pytest.mark.parametrize("channels, width, count", SHAPES)
def test_bfloat16_rounds_what_lies_between_the_layers_and_nothing_else(channels, width, count):
    heads, triplane, points = asked(channels, width, count)
    with torch.no_grad():
        got = heads.at(triplane, points, NAMES, torch.bfloat16)
        features = sample_triplane(triplane, points)
        for name in NAMES:
            error = (got[name].double() - activate(name, in_bfloat16(heads[name], features))).abs()
            # sums in float32 seldom fall on the other side of a rounding: then one activation moves by 1/256
            assert float((error < 1e-5).double().mean()) > 0.9 and float(error.max()) < 0.02, name


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_point_has_the_same_bits_wherever_it_stands_and_for_any_number_of_threads(dtype):
    heads, triplane, points = asked(40, 64, 3000, batch=1)
    packed, threads = heads.packed(NAMES, dtype), torch.get_num_threads()
    whole, part = packed.at(triplane[0], points[0]), packed.at(triplane[0], points[0, 17:1200])
    torch.set_num_threads(1)
    try:
        alone = packed.at(triplane[0], points[0])
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(whole[:, 17:1200], part) and torch.equal(whole, alone)


def test_gradients_go_the_way_of_the_layers_and_give_the_same_values():
    heads, triplane, points = asked(40, 64, 200)
    heads.requires_grad_(True)
    slow = heads.at(triplane, points, NAMES)
    assert all(value.requires_grad for value in slow.values())
    with torch.no_grad():
        fast = heads.at(triplane, points, NAMES)
    for name in NAMES:
        torch.testing.assert_close(fast[name], slow[name].detach(), rtol=1e-5, atol=2e-5)  # sums in another order


def test_no_points_give_no_values():
    heads, triplane, _ = asked(8, 16, 2)
    with torch.no_grad():
        got = heads.at(triplane, torch.zeros(2, 0, 3), ("normal",))
    assert got["normal"].shape == (2, 0, 3)


def test_what_the_kernel_cannot_take_is_refused():
    heads, triplane, points = asked(8, 16, 2)
    with torch.no_grad():
        with pytest.raises(ValueError, match="heads: expected some of .*, got colour"):
            heads.at(triplane, points, ("colour",))
        with pytest.raises(
            ValueError, match="dtype: expected float32 or bfloat16 for heads on a CPU, got torch.float16"
        ):
            heads.at(triplane, points, ("normal",), torch.float16)
        with pytest.raises(TypeError, match="points: expected torch.float32"):
            heads.at(triplane, points.double(), ("normal",))
        with pytest.raises(ValueError, match="features: expected a triplane of 8 channels for these heads, got 7"):
            heads.at(triplane[:, :, :7], points, ("normal",))
