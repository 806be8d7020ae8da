"""Tables of dual marching cubes, generated from the topology of the cube.

Corner k is at (k & 1, k >> 1 & 1, k >> 2 & 1) in (x, y, z).  A case is the sum of ``1 << k`` over the inside
corners.  A face joins its crossed edges in pairs; they form closed loops, and each loop is one dual vertex (Nielson
2004, Dual Marching Cubes).

A face with four crossed edges is ambiguous: its inside corners are separated.  Where four quads would meet in one dual
edge, both cubes separate the outside corners (cases C16 and C19 of Wenger 2013, Isosurfaces; Shen et al. 2023).
"""

from functools import lru_cache
from itertools import permutations
from typing import NamedTuple

import numpy as np

# ends of the edges, in the order of the weights beta; the first end decides the order of the quads
EDGES = ((0, 1), (1, 5), (4, 5), (0, 4), (2, 3), (3, 7), (6, 7), (2, 6), (2, 0), (3, 1), (7, 5), (6, 4))


class Tables(NamedTuple):
    """Lookup tables of the kernels, int32."""

    count: np.ndarray  # (256,) dual vertices of a case
    group: np.ndarray  # (256, 12) dual vertex of an edge, -1 where the edge is not crossed
    neighbor: np.ndarray  # (256,) face (axis * 2 + side) at which one loop has both pairs, or -1
    ends: np.ndarray  # (12, 2) EDGES
    around: np.ndarray  # (3, 4) axis of a grid edge -> which edge it is of its four cubes, by rising cube index


def faces() -> list[tuple[int, tuple[int, ...]]]:
    """``(axis * 2 + side, edges)`` of the six faces."""
    found = []
    for axis in range(3):
        for side in range(2):
            corners = {k for k in range(8) if (k >> axis & 1) == side}
            found.append((axis * 2 + side, tuple(e for e, ends in enumerate(EDGES) if corners.issuperset(ends))))
    return found


def groups() -> np.ndarray:
    """``(256, 12)``: loop of every edge in every case, -1 if not crossed.

    Loops are numbered by their first edge when edges are sorted by their higher, then their lower corner, which is
    the order of the published tables.
    """
    inside = (np.arange(256)[:, None] >> np.arange(8) & 1).astype(bool)
    low, high = np.array(EDGES).T
    crossed = inside[:, low] != inside[:, high]
    label = np.where(crossed, np.arange(12), -1)
    for _, edges in faces():
        alone = crossed[:, edges].sum(1) == 2
        for e, f in permutations(edges, 2):
            shared = set(EDGES[e]) & set(EDGES[f])
            pair = alone | inside[:, min(shared)] if shared else alone
            joined = crossed[:, e] & crossed[:, f] & pair
            label = np.where(joined[:, None] & (label == label[:, [f]]), label[:, [e]], label)
    loop, count = np.full((256, 12), -1, np.int32), np.zeros(256, np.int32)
    for e in sorted(range(12), key=lambda e: sorted(EDGES[e], reverse=True)):
        first = crossed[:, e] & (loop[:, e] < 0)
        loop = np.where(first[:, None] & (label == label[:, [e]]), count[:, None], loop)
        count += first
    return loop


def _around(axis: int) -> list[int]:
    """Index of a grid edge along ``axis`` in each of its four cubes; the first cube is below it in both other axes."""
    first, second = (a for a in range(3) if a != axis)
    found = []
    for below_first in (1, 0):
        for below_second in (1, 0):
            low = below_first << first | below_second << second
            found.append(next(e for e, ends in enumerate(EDGES) if set(ends) == {low, low | 1 << axis}))
    return found


@lru_cache(1)
def tables() -> Tables:
    """The tables of all 256 cases."""
    group = groups()
    neighbor = np.full(256, -1, np.int32)
    for face, edges in faces():
        on = group[:, edges]
        same = (on[:, 0] >= 0) & (on == on[:, :1]).all(1)
        neighbor[same] = face  # ambiguous, and the only ambiguous face of such a case
    around = np.array([_around(axis) for axis in range(3)], np.int32)
    return Tables(group.max(1) + 1, group, neighbor, np.array(EDGES, np.int32), around)
