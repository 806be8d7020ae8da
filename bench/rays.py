"""Incoherent rays from within a closed mesh of 82 thousand triangles, and a camera's, against one call of embreex.

``python -m bench.rays`` prints how the time of a ray grows with rays and triangles, and where it goes.
"""

import math
import sys
import time

import numpy as np
import torch
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from bench.timing import time_steps
from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.geometry.rays import RayScene


def inputs(n, subdivisions=6):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    rng = np.random.default_rng(0)
    origins = rng.uniform(-0.4, 0.4, (n, 3)).astype(np.float32)
    directions = rng.normal(size=(n, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), origins, directions


def cast(device, n, query, subdivisions=6, rays=inputs):
    """``n`` rays through :class:`RayScene`, closest hit or occlusion."""
    vertices, faces, origins, directions = (torch.from_numpy(a).to(device) for a in rays(n, subdivisions))
    scene = RayScene(vertices, faces)
    call = scene.closest if query == "closest" else scene.occluded
    return lambda: call(origins, directions), {"rays": n}


def embree_cast(device, n, query, subdivisions=6, rays=inputs):
    """The same with embreex alone, one call on one thread; CPU only."""
    if device.type != "cpu":
        return None
    vertices, faces, origins, directions = rays(n, subdivisions)
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, vertices, faces)
    if query == "closest":
        return lambda: scene.run(origins, directions, query="INTERSECT", output=True), {"rays": n}
    return lambda: scene.run(origins, directions, query="OCCLUDED"), {"rays": n}


def camera_inputs(n, subdivisions):
    """``n`` rays of a camera in order of its rows, before the same mesh, which covers half of the square image."""
    size = math.isqrt(n)
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    pose = look_at(torch.tensor([0.0, 0.5, 2.2]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    origins, directions = (v.reshape(-1, 3).numpy() for v in camera_rays(Camera.from_fov(pose, 1.1, size, size)))
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), origins.copy(), directions.copy()


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


def study() -> None:
    """Print growth with rays and triangles against embreex, and the parts of a ray's time; CPU."""
    device, write = torch.device("cpu"), sys.stdout.write
    for query in ("closest", "occluded"):
        for n, subdivisions in [(1 << k, 6) for k in (10, 14, 17, 20, 22)] + [(1 << 18, k) for k in (2, 4, 6, 8)]:
            steps = [f(device, n, query, subdivisions)[0] for f in (cast, embree_cast)]
            ours, theirs = time_steps(steps, device, seconds=0.7)
            write(
                f"{query}, {n} rays, {20 * 4**subdivisions} triangles: {1e9 * ours.median / n:.0f} ns a ray, embreex "
                f"{1e9 * theirs.median / n:.0f}, {theirs.median / ours.median:.2f} times\n"
            )
    n, torch_threads = 1 << 18, torch.get_num_threads()
    torch.set_num_threads(1)
    vertices, faces, origins, directions = inputs(n)
    scene, peer = RayScene(torch.from_numpy(vertices), torch.from_numpy(faces)), EmbreeScene(robust=True)
    TriangleMesh(peer, vertices, faces)
    o, d = torch.from_numpy(origins), torch.from_numpy(directions)
    order = scene._order(o, d)
    in_order = [torch.from_numpy(np.take(v, order, 0)) for v in (origins, directions)]
    parts = {
        "one call of embreex": lambda: peer.run(origins, directions, output=1),
        "ours, one thread": lambda: scene.closest(o, d),
        "ours, rays that come in order": lambda: scene.closest(*in_order),
        "of it the order": lambda: scene._order(o, d),
        "of it rays into that order": lambda: (np.take(origins, order, 0), np.take(directions, order, 0)),
    }
    for name, step in parts.items():
        best = min(_cpu_seconds(step) for _ in range(6))
        write(f"{name}: {1e9 * best / n:.0f} ns a ray\n")
    torch.set_num_threads(torch_threads)


def _cpu_seconds(step) -> float:
    begin = time.thread_time()
    step()
    return time.thread_time() - begin


if __name__ == "__main__":
    study()
