"""Open borders of a mesh: the loops they form, a report of each, and filling them.

Judged on the welded mesh (see :mod:`reli3d.geometry.mesh`); degenerate faces do not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from reli3d.geometry.mesh import Mesh, weld, welded_faces


@dataclass(frozen=True)
class Hole:
    """One border loop, as :func:`holes` finds it."""

    vertices: Tensor  # (N,) int64 of the mesh, the lowest at its position, in the direction of the faces beside them
    length: float  # of the loop, units of the positions
    area: float  # of the flattest cap: length of the loop's area vector
    clean: bool  # every edge has one face: not a cut at an edge with more faces or with two that disagree


def open_loops(faces: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Loops of open half-edges ``3 * face + corner``, and which half-edges ``(3 F,)`` lie on an edge with one face.

    faces: ``(F, 3)``, none degenerate.

    A half-edge is open unless exactly one other half-edge runs along its edge, the other way.  At a vertex a loop stays
    within one fan of faces; where fans touch in a vertex, each has its own loop.  Each half-edge has one successor and
    one predecessor, so the loops are closed and hold every open half-edge once.
    """
    tail, head = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    n = int(faces.max()) + 1 if len(faces) else 0
    key = np.minimum(tail, head) * n + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    start = np.flatnonzero(np.diff(key[order], prepend=-1))
    valence = np.diff(start, append=len(key))
    pair = start[valence == 2]
    one, other = order[pair], order[pair + 1]
    agree = tail[one] != tail[other]
    twin = np.full(len(key), -1)
    twin[one[agree]], twin[other[agree]] = other[agree], one[agree]
    single = np.zeros(len(key), bool)
    single[order[start[valence == 1]]] = True

    def after(h: np.ndarray) -> np.ndarray:
        return h // 3 * 3 + (h + 1) % 3

    following = np.full(len(key), -1)
    left = opened = np.flatnonzero(twin < 0)
    at = after(left)
    while len(left):
        done = twin[at] < 0
        following[left[done]] = at[done]
        left, at = left[~done], after(twin[at[~done]])
    loops, seen = [], np.zeros(len(key), bool)
    for h in opened.tolist():
        loop = []
        while not seen[h]:
            seen[h] = True
            loop.append(h)
            h = int(following[h])
        if loop:
            loops.append(np.array(loop))
    return loops, single


def holes(mesh: Mesh) -> list[Hole]:
    """Every border loop of the surface, longest first; empty for a closed one.

    Where an edge has more than two faces, or two that run through it alike, the surface counts as cut open there, and
    the loops along the cut are not ``clean``.
    """
    faces, sound = welded_faces(mesh)
    faces = faces[sound]
    first = weld(mesh.vertices)[0].cpu().numpy()
    positions = mesh.vertices.detach().cpu().numpy()[first].astype(np.float64)
    loops, single = open_loops(faces)
    tail = faces.reshape(-1)
    found = []
    for loop in loops:
        at = positions[tail[loop]]
        following = np.roll(at, -1, axis=0)
        area = 0.5 * np.linalg.norm(np.cross(at - at.mean(0), following - at.mean(0)).sum(0))
        vertices = torch.from_numpy(first[tail[loop]]).to(mesh.faces.device)
        found.append(
            Hole(vertices, float(np.linalg.norm(following - at, axis=1).sum()), float(area), bool(single[loop].all()))
        )
    return sorted(found, key=lambda hole: -hole.length)


def fill_holes(mesh: Mesh, *, max_edges: int | None = None) -> Mesh:
    """The welded mesh with a cap over every clean hole of at most ``max_edges`` edges (None: of any size).

    A hole of three edges gets one face, others a fan around the mean of their vertices; a strongly curved hole gives a
    cap that may cut the surface.  Positions only; gradients flow through.  Raises ValueError unless ``max_edges`` is
    at least 3.
    """
    if max_edges is not None and max_edges < 3:
        raise ValueError(f"max_edges: expected at least 3, got {max_edges}")
    first, _ = weld(mesh.vertices)
    faces, sound = welded_faces(mesh)
    faces = faces[sound]
    vertices = mesh.vertices[first]
    loops, single = open_loops(faces)
    tail, new_faces = faces.reshape(-1), [faces]
    centres: list[Tensor] = []
    for loop in loops:
        if not single[loop].all() or not 3 <= len(loop) <= (max_edges or len(loop)):
            continue
        ring = tail[loop][::-1]  # a cap runs through the border against the faces beside it
        if len(ring) == 3:
            new_faces.append(ring[None])
            continue
        hub = len(vertices) + len(centres)
        centres.append(vertices[torch.from_numpy(ring.copy()).to(vertices.device)].mean(0))
        new_faces.append(np.stack([ring, np.roll(ring, -1), np.full(len(ring), hub)], -1))
    if centres:
        vertices = torch.cat([vertices, torch.stack(centres)])
    return Mesh(vertices, torch.from_numpy(np.concatenate(new_faces).astype(np.int32)).to(mesh.faces.device))
