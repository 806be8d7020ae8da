"""Rays, the meshes that they are traced through, and samples along them."""

import numpy as np
import pytest
import torch
import trimesh
import warp as wp

from reli3d._bridge import launch
from reli3d.geometry.rays import RayScene
from reli3d.kernels import rays as kernels
from reli3d.render.volume import RaySamples

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BACKENDS = ["embree", "warp"]
# stretch and shift of meshes and rays: plain, tiny, long, flat, far
PLACES = [((1.0, 1.0, 1.0), 0.0), ((1e-4, 1e-4, 1e-4), 0.0), ((1.0, 1.0, 1e3), 0.0), ((1.0, 1e-3, 1.0), 0.0)]
PLACES += [((1.0, 1.0, 1.0), 1e3), ((1.0, 1.0, 1.0), 1e5)]


def make(vertices, faces, backend, device):
    """The scene, or a visible skip where the backend has no such device."""
    if backend == "embree" and device.type != "cpu":
        pytest.skip("Embree runs on CPU only")
    v = torch.as_tensor(np.asarray(vertices), dtype=torch.float32, device=device)
    return RayScene(v, torch.as_tensor(np.asarray(faces), dtype=torch.int32, device=device), backend=backend)


def soup(seed, count=60):
    """Vertices and faces of triangles at random places, none joined."""
    rng = np.random.default_rng(seed)
    center = rng.uniform(-1, 1, (count, 1, 3))
    vertices = (center + rng.normal(0, 0.3, (count, 3, 3))).reshape(-1, 3).astype(np.float32)
    return vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def bumpy(seed, subdivisions=2, height=0.25):
    """Closed, star-shaped about the origin: every radius of a sphere changed at random."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    radius = 1.0 + height * np.random.default_rng(seed).uniform(-1, 1, (len(mesh.vertices), 1))
    return (mesh.vertices * radius).astype(np.float32), np.asarray(mesh.faces, np.int32)


def rays(n, seed=0, reach=2.0):
    """Random origins within ``reach`` and directions of random length."""
    rng = np.random.default_rng(seed)
    o, d = rng.uniform(-reach, reach, (n, 3)), rng.normal(size=(n, 3))
    return torch.tensor(o, dtype=torch.float32), torch.tensor(d, dtype=torch.float32)


def placed(vertices, o, d, stretch, shift):
    """Rounded to float32 as the scene gets them: at 1e5 coordinates are a grid of 0.008, for the oracle too."""
    by = torch.tensor(stretch)
    return (vertices * stretch + shift).astype(np.float32), (o * by + shift).float(), (d * by).float()


def packed(counts, device, step=0.05, seed=2):
    """Samples of rays with these counts, random densities (some negative) and colors."""
    rng = torch.Generator().manual_seed(seed)
    first = torch.nn.functional.pad(torch.tensor(counts).cumsum(0), (1, 0)).int()
    ray = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)).int()
    t = torch.cat([torch.arange(c) * step + 0.3 for c in counts] + [torch.zeros(0)])
    total = int(first[-1])
    density, color = torch.rand(total, generator=rng) * 30 - 3, torch.rand(total, 3, generator=rng)
    return RaySamples(ray.to(device), t.to(device), first.to(device), step), density.to(device), color.to(device)


@wp.kernel
def offset_origin_kernel(
    start: int,
    position: wp.array[wp.vec3],
    ng: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    scale: float,
    origin: wp.array[wp.vec3],  # out
):
    i = start + wp.tid()
    origin[i] = kernels.offset_origin(position[i], ng[i], direction[i], scale)


def offset_origin(position, ng, direction, scale):
    """Origins ``(N, 3)`` as the kernels of the package move them off their own face."""
    out = torch.empty_like(position)
    ins = [v.contiguous() for v in (position, ng, direction)]
    launch(offset_origin_kernel, len(out), [*ins, float(scale), out], out.device)
    return out
