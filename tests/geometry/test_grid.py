"""Grids: torch in float64 is the judge of features at points and of the squared Laplacian, values and gradients."""

import pytest
import torch
from torch.nn.functional import conv3d, grid_sample

from reli3d.geometry.grid import sample_grid, squared_laplacian


def in_float64(grid, points):
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
    got, expected = sample_grid(grid, points), in_float64(grid, points)
    # float32 place between points: 2^-24 of a coordinate of up to 8 cells, times differences of up to 6
    torch.testing.assert_close(got, expected.float(), rtol=0, atol=1e-5)
    gradients = torch.autograd.grad((got * weight).sum(), (grid, points))
    exact = torch.autograd.grad((expected * weight.double()).sum(), (grid, points))
    torch.testing.assert_close(gradients[0], exact[0].float(), rtol=1e-4, atol=1e-3)  # sums of a hundred products
    inside = points.detach().abs().amax(-1) < 1
    # gradients jump where a coordinate is a grid point's: a few in 5000 are nearer to one than float32 resolves
    close = ((gradients[1] - exact[1]).abs().amax(-1) < 1e-3)[inside]
    assert float(close.double().mean()) > 0.999


def laplacian_in_float64(field, weight):
    stencil = torch.zeros(3, 3, 3, dtype=torch.float64, device=field.device)
    stencil[1, 1, [0, 2]] = stencil[1, [0, 2], 1] = stencil[[0, 2], 1, 1] = 1.0
    stencil[1, 1, 1] = -6.0
    bend = conv3d(field.double()[None, None], stencil[None, None])[0, 0]
    return (weight[1:-1, 1:-1, 1:-1] * bend.square()).sum()


@pytest.mark.parametrize("shape", [(9, 7, 8), (40, 30, 21), (3, 3, 3)])
def test_the_squared_laplacian_is_that_of_a_convolution(device, shape):
    generator = torch.Generator().manual_seed(2)
    field = torch.randn(shape, generator=generator).to(device).requires_grad_()
    weight = torch.rand(shape, generator=generator)
    weight = (weight * (torch.rand(shape, generator=generator) < 0.5)).to(device)  # borders are not 0
    got, expected = squared_laplacian(field, weight), laplacian_in_float64(field, weight)
    torch.testing.assert_close(got.double(), expected, rtol=1e-5, atol=1e-6)  # sums of 1e4 squares in float32
    gradients = [torch.autograd.grad(3.0 * value, field)[0] for value in (got, expected)]
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-3)  # of 7 products of up to 100


def test_a_grid_without_inner_points_has_none(device):
    field = torch.randn(2, 5, 5, generator=torch.Generator().manual_seed(0)).to(device).requires_grad_()
    total = squared_laplacian(field, torch.ones_like(field))
    (gradient,) = torch.autograd.grad(total, field)
    assert float(total.detach()) == 0.0 and not gradient.any()


def test_bad_input_is_named():
    grid, points = random_case("cpu", 4)
    field = torch.zeros(4, 5, 6)
    for call, message in (
        (lambda: sample_grid(grid[0], points), r"grid: expected \(X, Y, Z, C\)"),
        (lambda: sample_grid(grid[:1], points), "at least 2"),
        (lambda: sample_grid(grid, points[None]), r"points: expected shape \(N, 3\)"),
        (lambda: squared_laplacian(field, field[1:]), "field, weight: expected one shape"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    assert sample_grid(grid, points[:0]).shape == (0, 11)
