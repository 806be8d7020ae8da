"""Triplane sampling at the published size, 3 x 40 x 384^2 and 200,000 points, beside torch's grid_sample."""

import torch

from reli3d.triplane import sample_triplane


def grid_sample(planes, points):
    """The same features from torch."""
    out = []
    for k, axes in enumerate(([0, 1], [0, 2], [1, 2])):
        got = torch.nn.functional.grid_sample(planes[:, k], points[..., axes].unsqueeze(1), align_corners=False)
        out.append(got.squeeze(2).transpose(1, 2))
    return torch.cat(out, -1)


def triplane(device, sample, n, size, channel_last, backward):
    """Features of ``n`` random points, with the gradient to the planes if ``backward``."""
    rng = torch.Generator(device).manual_seed(0)
    planes = torch.randn(1, 3, 40, size, size, generator=rng, device=device)
    if channel_last:
        planes = planes.movedim(2, -1).contiguous().movedim(-1, 2)
    planes.requires_grad_(backward)
    points = torch.rand(1, n, 3, generator=rng, device=device) * 2 - 1
    weights = torch.randn(1, n, 120, generator=rng, device=device)

    def step():
        features = sample(planes, points)
        return torch.autograd.grad(features, planes, weights) if backward else features

    return step, {"points": n}


_SIZE = dict(n=200_000, size=384)
CASES = {
    "sample": (triplane, dict(sample=sample_triplane, channel_last=False, backward=False, **_SIZE)),
    "sample_channel_last": (triplane, dict(sample=sample_triplane, channel_last=True, backward=False, **_SIZE)),
    "sample_grad": (triplane, dict(sample=sample_triplane, channel_last=False, backward=True, **_SIZE)),
    "sample_grad_channel_last": (triplane, dict(sample=sample_triplane, channel_last=True, backward=True, **_SIZE)),
    "torch_grid_sample": (triplane, dict(sample=grid_sample, channel_last=False, backward=False, **_SIZE)),
    "torch_grid_sample_grad": (triplane, dict(sample=grid_sample, channel_last=False, backward=True, **_SIZE)),
}
