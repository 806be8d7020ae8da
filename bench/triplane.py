"""Gather from three planes beside ``torch.nn.functional.grid_sample``, at the published size."""

import torch
from torch.nn.functional import grid_sample

from reli3d.triplane import sample_triplane


def inputs(device, n, channels, size, backward):
    rng = torch.Generator().manual_seed(0)
    planes = torch.randn(1, 3, channels, size, size, generator=rng).to(device).requires_grad_(backward)
    points = (2 * torch.rand(1, n, 3, generator=rng) - 1).to(device)
    return planes, points


def gather(device, n, channels, size, backward):
    """Features of ``n`` random points, with the gradient of their sum to the planes if ``backward``."""
    planes, points = inputs(device, n, channels, size, backward)

    def step():
        features = sample_triplane(planes, points)
        return torch.autograd.grad(features.sum(), planes) if backward else features

    return step, {"points": n}


def torch_gather(device, n, channels, size, backward):
    planes, points = inputs(device, n, channels, size, backward)

    def step():
        grid = points[0, :, [[0, 1], [0, 2], [1, 2]]].transpose(0, 1)[:, None]  # (3, 1, n, 2)
        features = grid_sample(planes[0], grid, align_corners=True)
        features = features[:, :, 0].permute(2, 0, 1).reshape(1, n, 3 * channels)
        return torch.autograd.grad(features.sum(), planes) if backward else features

    return step, {"points": n}


SIZES = dict(n=200_000, channels=40, size=384)
CASES = {"gather": (gather, dict(**SIZES, backward=False)), "gather_grad": (gather, dict(**SIZES, backward=True))}
PEERS = dict.fromkeys(CASES, torch_gather)
