"""UV atlas of a bumpy closed mesh of 20 thousand faces, against xatlas with its defaults."""

import numpy as np
import torch
import trimesh
import xatlas

from reli3d.geometry.mesh import Mesh, vertex_normals
from reli3d.geometry.uv import unwrap


def inputs(subdivisions):
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    v = sphere.vertices
    bumps = 1 + 0.15 * np.sin(7 * v[:, :1]) * np.cos(6 * v[:, 1:2]) * np.sin(5 * v[:, 2:] + 1)
    return (v * bumps).astype(np.float32), sphere.faces.astype(np.int32)


def atlas(device, subdivisions, texture_size):
    """Charts, packing and the mesh split at their borders."""
    vertices, faces = (torch.from_numpy(a).to(device) for a in inputs(subdivisions))
    mesh = Mesh(vertices, faces, vertex_normals(vertices, faces), None, None)
    return lambda: unwrap(mesh, texture_size=texture_size), {"faces": len(faces)}


def xatlas_atlas(device, subdivisions, texture_size):
    vertices, faces = inputs(subdivisions)
    return lambda: xatlas.parametrize(vertices, faces), {"faces": len(faces)}


CASES = {"atlas": (atlas, dict(subdivisions=5, texture_size=1024))}
PEERS = {"atlas": ("xatlas", xatlas_atlas)}
