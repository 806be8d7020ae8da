"""Incoherent rays from within a closed mesh of 82 thousand triangles, and a camera's, against one call of embreex."""

import math

import numpy as np
import torch
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.geometry.rays import RayScene


def inputs(n):
    mesh = trimesh.creation.icosphere(subdivisions=6)
    rng = np.random.default_rng(0)
    origins = rng.uniform(-0.4, 0.4, (n, 3)).astype(np.float32)
    directions = rng.normal(size=(n, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), origins, directions


def cast(device, n, query, rays=inputs):
    """``n`` rays through :class:`RayScene`, closest hit or occlusion."""
    vertices, faces, origins, directions = (torch.from_numpy(a).to(device) for a in rays(n))
    scene = RayScene(vertices, faces)
    call = scene.closest if query == "closest" else scene.occluded
    return lambda: call(origins, directions), {"rays": n}


def embree_cast(device, n, query, rays=inputs):
    """The same with embreex alone, one call on one thread; CPU only."""
    if device.type != "cpu":
        return None
    vertices, faces, origins, directions = rays(n)
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, vertices, faces)
    if query == "closest":
        return lambda: scene.run(origins, directions, query="INTERSECT", output=True), {"rays": n}
    return lambda: scene.run(origins, directions, query="OCCLUDED"), {"rays": n}


def camera_inputs(n):
    """``n`` rays of a camera in order of its rows, before the same mesh, which covers half of the square image."""
    size = math.isqrt(n)
    vertices, faces, _, _ = inputs(1)
    pose = look_at(torch.tensor([0.0, 0.5, 2.2]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    origins, directions = (v.reshape(-1, 3).numpy() for v in camera_rays(Camera.from_fov(pose, 1.1, size, size)))
    return vertices, faces, origins.copy(), directions.copy()


def primary(device, size):
    """Closest hits of a camera's rays through :class:`RayScene`: coherent, as embreex likes them."""
    return cast(device, size * size, "closest", rays=camera_inputs)


def embree_primary(device, size):
    """The same with embreex alone, one call on one thread; CPU only."""
    return embree_cast(device, size * size, "closest", rays=camera_inputs)


def invalid(device, n, value):
    """Closest hits where every second ray holds ``value``; Embree's verification allows 2.5 times the valid ones'."""
    vertices, faces, origins, directions = (torch.from_numpy(a).to(device) for a in inputs(n))
    directions[::2, 1] = value
    scene = RayScene(vertices, faces)
    return lambda: scene.closest(origins, directions), {"rays": n}


def valid(device, n, value):
    """The same rays before ``value`` was written into them."""
    return cast(device, n, "closest")


_N = 1 << 20
CASES = {
    "closest": (cast, dict(n=_N, query="closest")),
    "occluded": (cast, dict(n=_N, query="occluded")),
    "primary": (primary, dict(size=1024)),
    "nan": (invalid, dict(n=_N, value=float("nan"))),
    "infinity": (invalid, dict(n=_N, value=float("inf"))),
}
PEERS = {
    "closest": ("embreex", embree_cast),
    "occluded": ("embreex", embree_cast),
    "primary": ("embreex", embree_primary),
    "nan": ("reli3d", valid),
    "infinity": ("reli3d", valid),
}
