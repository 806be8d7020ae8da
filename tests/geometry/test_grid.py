"""Features from a grid: torch's own trilinear sampling in float64 is the judge, values and gradients."""

import pytest
import torch
from torch.nn.functional import grid_sample

from reli3d.geometry.grid import sample_grid


def twin(grid, points):
    at = points.double()[None, None, None, :, [2, 1, 0]]
    value = grid_sample(grid.double().permute(3, 0, 1, 2)[None], at, align_corners=True, padding_mode="border")
    return value[0, :, 0, 0].T


def random_case(device, n=5000):
    generator = torch.Generator().manual_seed(0)
    grid = torch.randn(7, 9, 5, 11, generator=generator).to(device)
    return grid, (torch.rand(n, 3, generator=generator) * 2.4 - 1.2).to(device)  # a sixth of each axis lies outside


def test_values_and_gradients(device):
    grid, points = random_case(device)
    grid.requires_grad_(), points.requires_grad_()
    weight = torch.randn(5000, 11, generator=torch.Generator().manual_seed(1)).to(device)
    got, want = sample_grid(grid, points), twin(grid, points)
    # float32 place between points: 2^-24 of a coordinate of up to 8 cells, times differences of up to 6
    torch.testing.assert_close(got, want.float(), rtol=0, atol=1e-5)
    slopes = torch.autograd.grad((got * weight).sum(), (grid, points))
    wanted = torch.autograd.grad((want * weight.double()).sum(), (grid, points))
    torch.testing.assert_close(slopes[0], wanted[0].float(), rtol=1e-4, atol=1e-3)  # sums of a hundred products
    inside = points.detach().abs().amax(-1) < 1
    # slopes jump where a coordinate is a grid point's: a few in 5000 are nearer to one than float32 can tell
    close = ((slopes[1] - wanted[1]).abs().amax(-1) < 1e-3)[inside]
    assert float(close.double().mean()) > 0.999


def test_grid_points_give_their_own_values(device):
    grid, _ = random_case(device, 1)
    axes = [torch.linspace(-1, 1, n, device=device) for n in grid.shape[:3]]
    points = torch.cartesian_prod(*axes)
    torch.testing.assert_close(sample_grid(grid, points), grid.reshape(-1, 11), rtol=0, atol=2e-5)


def test_bad_input_is_named():
    grid, points = random_case("cpu", 4)
    for change, message in (
        ({"grid": grid[0]}, r"grid: expected \(X, Y, Z, C\)"),
        ({"grid": grid[:1]}, "at least 2"),
        ({"points": points[None]}, r"points: expected \(N, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            sample_grid(**{"grid": grid, "points": points, **change})
    with pytest.raises(TypeError, match="points: expected torch.float32"):
        sample_grid(grid, points.double())
    assert sample_grid(grid, points[:0]).shape == (0, 11)
