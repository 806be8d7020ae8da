"""Untextured GLB files as training objects: smoothed, stretched and combined, with procedural materials."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from scipy.sparse import coo_matrix

from reli3d.errors import InputError
from reli3d.geometry.mesh import joined
from reli3d.io.glb import read_glb
from reli3d.synthetic.finishes import draw_materials
from reli3d.synthetic.procedural import CREASE_DEG, ProceduralObject, corner_normals, part_bounds, unit_size, yaw_matrix
from reli3d.synthetic.samples import ObjectSurface
from reli3d.synthetic.scanned import outside_distance

ROLES = ("any", "any", "any", "wood", "metal", "plastic", "paint", "fabric", "leather", "ceramic", "stone", "accent")
STRETCH_SIGMA = 0.22  # standard deviation of the logarithm of the scale along each axis
COMBINED_PROBABILITY = 0.3  # of combining two or three shapes
ROUNDED_PROBABILITY = 0.65  # of subdividing and smoothing a coarse shape
COARSE_FACES = 3000  # meshes with more faces are scans and not smoothed
MAX_FACES = 60_000


class ShapeSurface(ObjectSurface):
    """One or more shapes with procedural materials; holes are closed."""

    distance = outside_distance

    def __init__(self, paths: Sequence[Path], rng: np.random.Generator):
        count = int(rng.integers(2, 4)) if rng.random() < COMBINED_PROBABILITY else 1
        super().__init__(combine([paths[int(rng.integers(len(paths)))] for _ in range(count)], rng))


@lru_cache(64)
def _read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Welded vertices, faces and the primitive of each face; longest side 1, centered."""
    meshes = [asset.mesh for asset in read_glb(path)]
    whole = joined(meshes)
    f, part = whole.faces.numpy(), np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    v = unit_size(whole.vertices.numpy().astype(np.float64))
    _, first, index = np.unique(np.round(v * 1e5).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    f = index.reshape(-1)[f]
    keep = (f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])
    return capped(v[first], f[keep], part[keep])


def capped(v: np.ndarray, f: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mesh with a fan of faces over each hole: shapes often lack their bottom, but are meant to be solid."""
    of = {(int(a), int(b)): int(p) for tri, p in zip(f, part) for a, b in zip(tri, np.roll(tri, -1))}
    follow = {b: (a, p) for (a, b), p in of.items() if (b, a) not in of}
    points, caps, parts = [v], [], []
    while follow:
        loop, at = [], next(iter(follow))
        while at in follow:
            loop.append((at, *follow.pop(at)))
            at = loop[-1][1]
        if len(loop) > 2 and at == loop[0][0]:  # not where holes touch
            center = len(v) + len(points) - 1
            points.append(v[[a for a, _, _ in loop]].mean(0, keepdims=True))
            caps += [(a, b, center) for a, b, _ in loop]
            parts += [p for _, _, p in loop]
    if not caps:
        return v, f, part
    return np.concatenate(points), np.concatenate([f, np.array(caps, f.dtype)]), np.concatenate([part, parts])


def combine(paths: Sequence[Path], rng: np.random.Generator) -> ProceduralObject:
    """One object of the meshes of ``paths``, the others next to, on or in the first.  InputError above MAX_FACES."""
    vertices: list[np.ndarray] = []
    faces, owners, start, parts = [], [], 0, 0
    for k, path in enumerate(paths):
        v, f, p = _read(path)
        if len(f) < COARSE_FACES and rng.random() < ROUNDED_PROBABILITY:
            v, f, p = rounded(v, f, p, int(rng.integers(1, 3)), float(rng.uniform(0.2, 1.0)))
        v = v * np.exp(rng.normal(0, STRETCH_SIGMA, 3))
        turn = yaw_matrix(rng.uniform(0, 2 * np.pi) if rng.random() < 0.5 else np.pi / 2 * rng.integers(4))
        if rng.random() < 0.12:
            turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            turn[:, 0] *= np.sign(np.linalg.det(turn))
        v = v @ turn.T
        if k:
            v = v * rng.uniform(0.35, 0.9)
            low, high = np.concatenate(vertices).min(0), np.concatenate(vertices).max(0)
            at = rng.uniform(low, high)
            side = int(rng.integers(3))
            at[side] = (high if rng.random() < 0.7 else low)[side]
            v = v - (v.min(0) + v.max(0)) / 2 + at
            if rng.random() < 0.5:
                v[:, 1] += low[1] - v[:, 1].min()  # on the same ground plane
        vertices.append(v)
        faces.append(f + start)
        owners.append(p + parts)
        start, parts = start + len(v), parts + int(p.max()) + 1
    v, f, part = np.concatenate(vertices), np.concatenate(faces), np.concatenate(owners)
    if len(f) > MAX_FACES:
        names = ", ".join(str(path) for path in paths)
        raise InputError("--shapes", f"expected at most {MAX_FACES} faces of {names}, got {len(f)}; decimate them")
    v = unit_size(v).astype(np.float32)
    used, part = np.unique(part, return_inverse=True)
    part = part.reshape(-1).astype(np.int32)
    roles = [str(rng.choice(ROLES)) for _ in used]
    materials = draw_materials(rng, roles, part_bounds(v, f, part))
    normals = corner_normals(v, f, CREASE_DEG if rng.random() < 0.7 else float(rng.choice([10.0, 60.0])))
    return ProceduralObject(v, f.astype(np.int32), normals, part, materials, "shape")


def rounded(v: np.ndarray, f: np.ndarray, part: np.ndarray, times: int, strength: float):
    """Subdivides ``times``, each followed by Laplacian smoothing of weight ``strength``."""
    for _ in range(times):
        if len(f) * 4 > COARSE_FACES * 8:
            break
        v, f, index = trimesh.remesh.subdivide(v, f, return_index=True)
        old, part = part, np.empty(len(f), part.dtype)
        for source, new in index.items():
            part[new] = old[source]
        edge = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
        edge = np.concatenate([edge, edge[:, ::-1]])
        graph = coo_matrix((np.ones(len(edge)), (edge[:, 0], edge[:, 1])), shape=(len(v),) * 2).tocsr()
        degree = np.maximum(np.asarray(graph.sum(1)).reshape(-1, 1), 1)
        for _ in range(2):
            v = v + 0.5 * strength * (graph @ v / degree - v)
    return v, f, part
