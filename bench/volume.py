"""Ray marching of a ball in a cube, and compositing with gradients against a padded product in torch."""

import torch

from reli3d.render.volume import OccupancyGrid, composite, march_rays


def scene(device, n, resolution):
    rng = torch.Generator(device).manual_seed(0)
    origins = torch.nn.functional.normalize(torch.randn(n, 3, generator=rng, device=device), dim=-1) * 2.0
    aim = (torch.rand(n, 3, generator=rng, device=device) - 0.5) * 1.6
    directions = torch.nn.functional.normalize(aim - origins, dim=-1)
    k = (torch.arange(resolution, device=device) + 0.5) / resolution * 2 - 1
    cells = torch.stack(torch.meshgrid(k, k, k, indexing="ij"), -1).norm(dim=-1) < 0.6
    return origins, directions, OccupancyGrid(cells, 0.87)


def march(device, n, resolution, step):
    """Samples of ``n`` rays in the occupied cells."""
    origins, directions, grid = scene(device, n, resolution)
    total = len(march_rays(origins, directions, grid, step).t)
    return lambda: march_rays(origins, directions, grid, step), {"rays": n, "samples": total}


def fields(device, n, resolution, step):
    origins, directions, grid = scene(device, n, resolution)
    samples = march_rays(origins, directions, grid, step)
    rng = torch.Generator(device).manual_seed(1)
    total = len(samples.t)
    density = (torch.rand(total, generator=rng, device=device) * 5).requires_grad_()
    color = torch.rand(total, 3, generator=rng, device=device).requires_grad_()
    return samples, density, color, torch.rand(n, 3, generator=rng, device=device)


def blend(device, n, resolution, step):
    """Colors of ``n`` rays and the gradient to densities and colors."""
    samples, density, color, weight = fields(device, n, resolution, step)

    def run():
        return torch.autograd.grad(composite(density, color, samples).color, (density, color), weight)

    return run, {"samples": len(density)}


def torch_blend(device, n, resolution, step):
    """The same with rays padded to the longest, sums along them and autograd."""
    samples, density, color, weight = fields(device, n, resolution, step)
    first, ray = samples.first.long(), samples.ray.long()
    slot = torch.arange(len(ray), device=device) - first[ray]
    longest = int(first.diff().max())

    def run():
        own = density.new_zeros(n, longest).index_put((ray, slot), density * step)
        padded = color.new_zeros(n, longest, 3).index_put((ray, slot), color)
        weights = torch.exp(-(own.cumsum(1) - own)) * (1.0 - torch.exp(-own))
        return torch.autograd.grad((weights[..., None] * padded).sum(1), (density, color), weight)

    return run, {"samples": len(density)}


_SIZE = dict(n=16384, resolution=128, step=0.01)
CASES = {"march": (march, _SIZE), "composite_grad": (blend, _SIZE)}
PEERS = {"composite_grad": ("torch", torch_blend)}
