"""Incoherent rays from within a closed mesh of 82 thousand triangles, beside one call of embreex."""

import numpy as np
import torch
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from reli3d.geometry.rays import RayScene


def inputs(n):
    mesh = trimesh.creation.icosphere(subdivisions=6)
    rng = np.random.default_rng(0)
    origins = rng.uniform(-0.4, 0.4, (n, 3)).astype(np.float32)
    directions = rng.normal(size=(n, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), origins, directions


def cast(device, n, query):
    """``n`` rays through :class:`RayScene`, closest hit or occlusion."""
    vertices, faces, origins, directions = (torch.from_numpy(a).to(device) for a in inputs(n))
    scene = RayScene(vertices, faces)
    call = scene.closest if query == "closest" else scene.occluded
    return lambda: call(origins, directions), {"rays": n}


def embree_cast(device, n, query):
    """The same with embreex alone, one call on one thread; CPU only."""
    if device.type != "cpu":
        return None
    vertices, faces, origins, directions = inputs(n)
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, vertices, faces)
    if query == "closest":
        return lambda: scene.run(origins, directions, query="INTERSECT", output=True), {"rays": n}
    return lambda: scene.run(origins, directions, query="OCCLUDED"), {"rays": n}


CASES = {"closest": (cast, dict(n=1 << 20, query="closest")), "occluded": (cast, dict(n=1 << 20, query="occluded"))}
PEERS = dict.fromkeys(CASES, embree_cast)
