"""FlexiCubes of a bumpy sphere with all weights against plain torch; components, the visual hull."""

import math

import torch

from bench.peers.flexicubes_torch import cube_list, flexicubes
from reli3d.geometry.camera import Camera
from reli3d.geometry.hull import hull_distance, mask_distance
from reli3d.geometry.mesh import largest_components
from reli3d.geometry.surface import CubeWeights, extract_surface


def offset(p):
    """SDF ``(...)`` of a bumpy sphere at ``(..., 3)`` in the cube [-1, 1]."""
    return p.norm(dim=-1) - 0.62 + 0.05 * torch.sin(9 * p).sum(-1)


def field(n, device):
    """SDF on ``(n + 1)^3`` vertices; at n = 80 its surface has about 25,000 faces."""
    axis = torch.linspace(-1, 1, n + 1, device=device)
    return offset(torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1))


def fields(device, n, backward):
    """SDF, the weights that gradients reach, and gamma."""
    rng = torch.Generator(device).manual_seed(0)
    sdf = field(n, device).requires_grad_(backward)
    weights = dict(
        deformation=(torch.rand(*sdf.shape, 3, generator=rng, device=device) - 0.5) * 0.9 / n,
        alpha=torch.rand(n**3, 8, generator=rng, device=device) + 0.5,
        beta=torch.rand(n**3, 12, generator=rng, device=device) + 0.5,
    )
    gamma = torch.rand(n**3, generator=rng, device=device) * 0.5 + 0.25
    return sdf, {name: v.requires_grad_(backward) for name, v in weights.items()}, gamma


def extraction(device, n, backward):
    """Mesh of a field at resolution ``n``, with gradients to sdf, deformation, alpha and beta if ``backward``."""
    sdf, weights, gamma = fields(device, n, backward)
    leaves = [sdf, *weights.values()]

    def step():
        mesh = extract_surface(sdf, radius=0.87, weights=CubeWeights(gamma=gamma, **weights))
        return torch.autograd.grad(mesh.vertices.square().sum(), leaves) if backward else mesh

    return step, {"faces": len(extract_surface(sdf.detach(), radius=0.87).faces)}


def torch_extraction(device, n, backward):
    """The same from plain torch, its list of cubes made before."""
    if device.type != "cpu":
        return None
    sdf, weights, gamma = fields(device, n, backward)
    cubes, leaves = cube_list(sdf.shape), [sdf, *weights.values()]

    def step():
        vertices, faces = flexicubes(sdf, *weights.values(), gamma, cubes, 1.74)
        return torch.autograd.grad(vertices.square().sum(), leaves) if backward else faces

    return step, {}


def components(device, n):
    """Component filter on the mesh of the field."""
    mesh = extract_surface(field(n, device), radius=0.87)
    return (lambda: largest_components(mesh)), {"faces": len(mesh.faces)}


def hull(device, size, n):
    """Distances to the masks of four views, and of the vertices of a grid to their hull."""
    axis = torch.arange(size, device=device) + 0.5 - size / 2
    radius = 0.3 * size * (1 + 0.1 * torch.sin(7 * torch.atan2(axis[:, None], axis)))
    masks = (radius - torch.hypot(axis[:, None], axis) + 0.5).clamp(0, 1).expand(4, size, size)
    c2w = torch.eye(4, device=device).repeat(4, 1, 1)
    for k in range(4):
        c, s = math.cos(k * math.pi / 2), math.sin(k * math.pi / 2)
        c2w[k, :3] = torch.tensor([[c, 0, s, 3 * s], [0, 1, 0, 0], [-s, 0, c, 3 * c]])
    intrinsics = torch.tensor([1.2 * size, 1.2 * size, size / 2, size / 2], device=device).expand(4, 4)
    camera = Camera(c2w, intrinsics, size, size)
    axis = torch.linspace(-0.87, 0.87, n + 1, device=device)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).view(-1, 3)
    return (lambda: hull_distance(points, mask_distance(masks), camera)), {"points": len(points)}


CASES = {f"extract_{n}": (extraction, dict(n=n, backward=False)) for n in (32, 80, 128, 256)}
CASES |= {f"extract_grad_{n}": (extraction, dict(n=n, backward=True)) for n in (32, 80, 128, 256)}
CASES |= {"components_80": (components, dict(n=80)), "hull_80": (hull, dict(size=512, n=80))}
PEERS = {"extract_80": ("torch", torch_extraction), "extract_grad_80": ("torch", torch_extraction)}
