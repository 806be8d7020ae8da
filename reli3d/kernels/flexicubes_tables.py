"""Tables of dual marching cubes, generated from the topology of the cube.

Corner k stands at (k & 1, k >> 1 & 1, k >> 2 & 1) in (x, y, z).  A case is the sum of ``1 << k`` over the inside
corners.  A face joins its crossed edges in pairs; they form closed loops, and each loop is one dual vertex (Nielson
2004, Dual Marching Cubes).

A face with four crossed edges is ambiguous: its inside corners are kept apart.  Where four quads would meet in one dual
edge, both cubes keep the outside corners apart (cases C16 and C19 of Wenger 2013, Isosurfaces; Shen et al. 2023).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

# ends of the edges, in the order of the weights beta; the first end decides the order of the quads
EDGES = ((0, 1), (1, 5), (4, 5), (0, 4), (2, 3), (3, 7), (6, 7), (2, 6), (2, 0), (3, 1), (7, 5), (6, 4))


class Tables(NamedTuple):
    """Everything the kernels look up, int32."""

    count: np.ndarray  # (256,) dual vertices of a case
    group: np.ndarray  # (256, 12) dual vertex of an edge, -1 where the edge is not crossed
    neighbour: np.ndarray  # (256,) face (axis * 2 + side) at which one loop has both pairs, or -1
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


def groups(case: int) -> list[int]:
    """Loop of every edge, -1 if not crossed.

    Loops are numbered by their first edge when edges are sorted by their higher, then their lower corner, which is
    the order of the published tables.
    """
    inside = [case >> k & 1 for k in range(8)]
    crossed = [inside[a] != inside[b] for a, b in EDGES]
    label = [e if crossed[e] else -1 for e in range(12)]
    for _, edges in faces():
        on = [e for e in edges if crossed[e]]
        for e in on:
            for f in on:
                shared = set(EDGES[e]) & set(EDGES[f])
                if e != f and (len(on) == 2 or (shared and inside[min(shared)])):
                    label = [label[e] if v == label[f] else v for v in label]
    order = []
    for e in sorted(range(12), key=lambda e: sorted(EDGES[e], reverse=True)):
        if crossed[e] and label[e] not in order:
            order.append(label[e])
    return [order.index(v) if v >= 0 else -1 for v in label]


def _around(axis: int) -> list[int]:
    """Edge of its four cubes that an edge along ``axis`` is: the first cube lies below it in both other axes."""
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
    group = np.array([groups(case) for case in range(256)], np.int32)
    neighbour = np.full(256, -1, np.int32)
    for case in range(256):
        for face, edges in faces():
            on = group[case, list(edges)]
            if (on >= 0).all() and len(set(on)) == 1:  # ambiguous, and the only ambiguous face of such a case
                neighbour[case] = face
    around = np.array([_around(axis) for axis in range(3)], np.int32)
    return Tables(group.max(1) + 1, group, neighbour, np.array(EDGES, np.int32), around)
