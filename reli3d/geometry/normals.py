"""Displacement of a mesh along its normals so that its surface has given normals.

The displacements h minimize the sum over the edges of all faces of ``(t . (d + change of h n))^2 / |d|^2`` plus the sum
over the vertices of ``(h / length)^2``, where d is an edge, n the normal at its ends and t the mean target there.
Source: Nehab et al. 2005, Efficiently combining positions and normals for precise 3D geometry.
"""

from dataclasses import replace

import numpy as np
import torch
from scipy.sparse import coo_matrix, diags, spmatrix
from torch import Tensor

from reli3d._bridge import check, present
from reli3d.geometry.mesh import Mesh, vertex_normals

TOLERANCE, MAX_ITERATIONS = 1e-3, 200  # of conjugate gradients: preconditioned residual relative to the first, steps


def displace_to_normals(mesh: Mesh, target: Tensor, *, length: float, limit: Tensor) -> Mesh:
    """``mesh`` with vertices displaced along their normals so that the surface's normals approach ``target (V, 3)``.

    mesh: with normals.  target: unit normals at the vertices.  length: world units; features smaller than about
    ``length`` follow the target, larger ones keep their positions.  limit: ``(V,)``, greatest displacement to either
    side, at least 0.  Returns the mesh with new normals, without tangents.  No gradient; computed on the CPU.  Raises
    TypeError for a wrong dtype, ValueError for a wrong shape or a length that is not positive.  Source: Nehab et al.
    2005.
    """
    normals = present("mesh.normals", mesh.normals)
    check("target", target, shape=mesh.vertices.shape, like=mesh.vertices)
    check("limit", limit, shape=mesh.vertices.shape[:1], like=mesh.vertices)
    if not 0.0 < length < float("inf"):
        raise ValueError(f"length: expected a positive number, got {length}")
    x, n, t = (v.detach().double().cpu().numpy() for v in (mesh.vertices, normals, target))
    faces = mesh.faces.cpu().numpy()
    i, j = np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]]).T
    toward = t[i] + t[j]
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-6)
    edge = x[j] - x[i]
    weight = 1.0 / np.maximum(np.linalg.norm(edge, axis=1), 1e-6 * length)
    wanted = -weight * (toward * edge).sum(1)
    rows = np.tile(np.arange(len(edge)), 2)
    values = np.concatenate([weight * (toward * n[j]).sum(1), -weight * (toward * n[i]).sum(1)])
    slopes = coo_matrix((values, (rows, np.concatenate([j, i]))), shape=(len(edge), len(x))).tocsr()
    matrix = slopes.T @ slopes + diags(np.full(len(x), length**-2))
    displacement = torch.from_numpy(_solved(matrix, slopes.T @ wanted)).to(mesh.vertices).clamp(-limit, limit)
    vertices = mesh.vertices + displacement[:, None] * normals
    return replace(mesh, vertices=vertices, normals=vertex_normals(vertices, mesh.faces), tangents=None)


def _solved(matrix: spmatrix, right: np.ndarray) -> np.ndarray:
    """Solution of ``matrix x = right`` by conjugate gradients, preconditioned with the diagonal.

    The result does not depend on the number of threads; that of SciPy's solver does, through sums in BLAS.
    """
    inverse = 1.0 / matrix.diagonal()
    found, residual = np.zeros_like(right), right
    direction = scaled = inverse * residual
    error = first = (residual * scaled).sum()
    for _ in range(MAX_ITERATIONS):
        if error <= TOLERANCE**2 * first:
            break
        moved = matrix @ direction
        step = error / (direction * moved).sum()
        found, residual = found + step * direction, residual - step * moved
        scaled = inverse * residual
        before, error = error, (residual * scaled).sum()
        direction = scaled + (error / before) * direction
    return found
