"""Surface of a level set on a grid, with the gradient of its vertices to the level; reported without a peer."""

import torch

from reli3d.geometry.surface import extract_surface


def extract(device, resolution, backward):
    """A bumpy torus on ``resolution`` cubes a side."""
    axis = torch.linspace(-1, 1, resolution + 1, device=device)
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    ring = (x**2 + z**2).sqrt() - 0.6
    level = (ring**2 + y**2).sqrt() - 0.28 + 0.02 * torch.sin(9 * x) * torch.cos(8 * y) * torch.sin(7 * z)
    level.requires_grad_(backward)

    def step():
        mesh = extract_surface(level, radius=1.0)
        return torch.autograd.grad(mesh.vertices.square().sum(), level) if backward else mesh

    return step, {"cubes": resolution**3}


CASES = {
    "extract": (extract, dict(resolution=80, backward=False)),
    "extract_grad": (extract, dict(resolution=80, backward=True)),
}
