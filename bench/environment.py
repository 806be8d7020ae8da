"""Lookup of a lat-long map against torch's grid_sample; sampling its table."""

import torch

from reli3d.render.environment import Environment


def inputs(device, n, height):
    rng = torch.Generator(device).manual_seed(0)
    radiance = torch.rand(height, 2 * height, 3, generator=rng, device=device)
    directions = torch.nn.functional.normalize(torch.randn(n, 3, generator=rng, device=device), dim=-1)
    return radiance, directions, torch.rand(n, 3, generator=rng, device=device)


def with_grad(function, radiance, weight, backward):
    radiance.requires_grad_(backward)

    def step():
        out = function(radiance)
        return torch.autograd.grad(out, radiance, weight) if backward else out

    return step, {"lookups": len(weight)}


def lookup(device, n, height, backward):
    """Radiance from ``n`` random directions, with the gradient to the texels if ``backward``."""
    radiance, directions, weight = inputs(device, n, height)
    return with_grad(lambda r: Environment(r).lookup(directions), radiance, weight, backward)


def torch_lookup(device, n, height, backward):
    """The same from grid_sample on a map with its neighboring columns appended on both sides."""
    radiance, directions, weight = inputs(device, n, height)

    def function(r):
        x = torch.atan2(directions[:, 0], -directions[:, 2]) / torch.pi * (height / (height + 1))
        y = torch.acos(directions[:, 1].clamp(-1, 1)) / torch.pi * 2 - 1
        planes = torch.cat([r[:, -1:], r, r[:, :1]], 1).permute(2, 0, 1)[None]
        got = torch.nn.functional.grid_sample(
            planes, torch.stack([x, y], -1)[None, None], padding_mode="border", align_corners=False
        )
        return got[0, :, 0].T

    return with_grad(function, radiance, weight, backward)


def sample(device, n, height):
    """Directions and densities of ``n`` uniform pairs, by importance sampling."""
    environment = Environment(inputs(device, 1, height)[0])
    u = torch.rand(n, 2, generator=torch.Generator(device).manual_seed(1), device=device)
    return lambda: environment.sample(u), {"samples": n}


_SIZE = dict(n=1 << 20, height=256)
CASES = {
    "lookup": (lookup, dict(backward=False, **_SIZE)),
    "lookup_grad": (lookup, dict(backward=True, **_SIZE)),
    "sample": (sample, _SIZE),
}
PEERS = {"lookup": ("torch", torch_lookup), "lookup_grad": ("torch", torch_lookup)}
