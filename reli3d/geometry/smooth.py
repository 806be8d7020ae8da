"""Mesh smoothing with the umbrella operator, which moves every vertex towards the mean of its neighbors.

Neighbors are taken from the welded mesh, so that surfaces do not tear at UV seams or split vertices.  UV coordinates
are kept; normals and tangents are dropped because they no longer match the positions.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from reli3d.geometry.mesh import Mesh, weld, welded_faces
from reli3d.geometry.topology import edges_of

STEP, PASS_BAND = 0.5, 0.1  # of Taubin smoothing, in units of the umbrella operator's eigenvalues


@dataclass(frozen=True)
class _Umbrella:
    """The sparse operator ``mean of the neighbors - position`` on the welded mesh."""

    label: Tensor  # (V,) welded vertex of every vertex
    weight: Tensor  # (V, 1) 1 / copies of a vertex
    neighbors: Tensor  # (E,) of every moving welded vertex, concatenated
    start: Tensor  # (W,) first entry of a vertex in ``neighbors``
    inverse: Tensor  # (W, 1) 1 / number of neighbors, 0 for fixed vertices

    def welded(self, values: Tensor) -> Tensor:
        out = values.new_zeros(len(self.inverse), values.shape[1])
        return out.index_add(0, self.label, values * self.weight)

    def __call__(self, positions: Tensor) -> Tensor:
        total = torch.nn.functional.embedding_bag(self.neighbors, positions, self.start, mode="sum")
        return total * self.inverse - positions * (self.inverse > 0)


def _umbrella(mesh: Mesh) -> _Umbrella:
    first, label = weld(mesh.vertices)
    n = len(first)
    faces, sound = welded_faces(mesh, label)
    edges = edges_of(faces[sound])
    lead = edges.order[edges.start]
    ends = np.stack([edges.tail[lead], edges.head[lead]])
    at_border = np.zeros(n, bool)
    at_border[ends[:, edges.valence == 1]] = True
    directed = np.sort(np.concatenate([ends[0] * n + ends[1], ends[1] * n + ends[0]]))  # every edge from both its ends
    key = torch.from_numpy(directed[~at_border[directed // n]]).to(label.device)
    moved = key // n
    degree = torch.bincount(moved, minlength=n)
    start = torch.cumsum(degree, 0) - degree
    inverse = torch.where(degree > 0, 1.0 / degree.clamp(min=1), 0.0)[:, None].to(mesh.vertices.dtype)
    weight = 1.0 / torch.bincount(label, minlength=n)[label][:, None].to(mesh.vertices.dtype)
    return _Umbrella(label, weight, key - moved * n, start, inverse)


def taubin_smooth(mesh: Mesh, *, iterations: int = 10) -> Mesh:
    """Taubin smoothing: ``iterations`` pairs of a shrinking and an inflating step, which preserve the volume.

    The steps are ``STEP`` and ``mu`` with ``1 / STEP + 1 / mu = PASS_BAND``; frequencies of the umbrella operator below
    ``PASS_BAND`` are kept or slightly amplified.  Vertices of open borders are fixed.  Gradients reach the vertices.
    On the CPU, neighbors are summed in a fixed order.  Raises ValueError for negative ``iterations``.  Source: Taubin
    1995, A signal processing approach to fair surface design.
    """
    if iterations < 0:
        raise ValueError(f"iterations: expected at least 0, got {iterations}")
    if not iterations or not len(mesh.faces):
        return replace(mesh, normals=None, tangents=None)
    operator = _umbrella(mesh)
    start = positions = operator.welded(mesh.vertices)
    for step in [STEP, 1.0 / (PASS_BAND - 1.0 / STEP)] * iterations:
        positions = positions + step * operator(positions)
    vertices = mesh.vertices + (positions - start).index_select(0, operator.label)
    return replace(mesh, vertices=vertices, normals=None, tangents=None)
