"""Meshes: names of real ones, how they are read, and a sheet with a border."""

import numpy as np
import torch
import trimesh

from reli3d.geometry.mesh import Mesh

QUICK = ["avocado", "suzanne", "scifi_crate", "plastic_monobloc_chair_01", "abalone_shell"]
SLOW = ["boombox", "coffee_grinder", "dutch_ship_medium", "exploding_barrel", "french_horn", "horse_statue_01"]
SLOW += ["numeric_keypad", "painted_wooden_cabinet_02", "painted_wooden_stool", "rune_sword", "shader_ball"]
SLOW += ["sheen_chair", "sofa_03", "wicker_sphere", "wooden_table_02"]


def mesh_of(vertices, faces, device="cpu") -> Mesh:
    """On ``device``, whatever torch's default is."""
    parts = (vertices, torch.float32), (faces, torch.int32)
    return Mesh(*(torch.as_tensor(np.asarray(v), dtype=dtype, device=device).contiguous() for v, dtype in parts))


def mesh_from(shape: trimesh.Trimesh, device="cpu") -> Mesh:
    return mesh_of(shape.vertices, shape.faces, device)


def loaded(path) -> Mesh:
    """The whole file as one mesh, without texture coordinates."""
    shape = trimesh.load(path, force="mesh", process=False)
    return mesh_from(shape)


def volume(mesh: Mesh) -> float:
    """Signed volume of a closed mesh, positive for outward faces."""
    a, b, c = mesh.vertices.detach().double()[mesh.faces.long()].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum()) / 6.0


def coverage(mesh: Mesh, size: int) -> torch.Tensor:
    """Number of faces whose interior contains each center of ``size x size`` texels; float64."""
    q = mesh.uv.double().numpy()[mesh.faces.numpy()] * size
    low = np.ceil(q.min(1) - 0.5).astype(int).clip(0, size)
    counts = (np.floor(q.max(1) - 0.5).astype(int).clip(-1, size - 1) - low + 1).clip(0)
    face = np.repeat(np.arange(len(q)), counts.prod(1))
    k = np.arange(len(face)) - np.repeat(np.cumsum(counts.prod(1)) - counts.prod(1), counts.prod(1))
    x, y = low[face, 0] + k % counts[face, 0], low[face, 1] + k // counts[face, 0]
    d = q[face] - np.stack([x, y], -1)[:, None] - 0.5
    sides = np.stack([d[:, j, 0] * d[:, j - 1, 1] - d[:, j, 1] * d[:, j - 1, 0] for j in range(3)])
    inside = (sides.min(0) > 1e-9) | (sides.max(0) < -1e-9)
    return torch.from_numpy(np.bincount((y * size + x)[inside], minlength=size * size).reshape(size, size))


def sheet(n=9):
    """A bumpy sheet of ``n x n`` vertices, and which of them lie on its border."""
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    vertices = np.stack([x, y, np.random.default_rng(0).normal(size=x.shape)], -1).reshape(-1, 3)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    first, second = (corner, corner + n, corner + n + 1), (corner, corner + n + 1, corner + 1)
    faces = np.concatenate([np.stack(first, -1), np.stack(second, -1)])
    border = ((x == 0) | (y == 0) | (x == n - 1) | (y == n - 1)).reshape(-1)
    return Mesh(torch.tensor(vertices, dtype=torch.float32), torch.tensor(faces, dtype=torch.int32)), border
