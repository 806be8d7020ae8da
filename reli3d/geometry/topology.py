"""Edges of a triangle mesh (half-edges, their order by edge, the face across each) and connected components.

Half-edge ``3 * face + corner`` runs from that corner to the next one of its face.  The half-edges of an edge join the
same two vertices, in either direction.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True)
class Edges:
    """Half-edges of ``F`` faces, grouped by edge."""

    tail: np.ndarray  # (3 F,) int64, first vertex of each half-edge
    head: np.ndarray  # (3 F,) int64, second vertex
    order: np.ndarray  # (3 F,) int64, half-edges sorted by edge, ascending within an edge
    start: np.ndarray  # (E,) where in ``order`` each edge begins
    valence: np.ndarray  # (E,) half-edges of each edge

    def of_valence(self, count: int) -> np.ndarray:
        """Half-edges ``(count, N)`` of the N edges with ``count`` half-edges, ascending along the first axis."""
        return self.order[self.start[self.valence == count] + np.arange(count)[:, None]]


def group(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(order, first)``: stable order that sorts ``keys`` >= 0, and the start of each run of equal keys in it."""
    n = len(keys)
    low = max(1, int(n - 1).bit_length())
    # sorting key and index as one number: 5 times faster than argsort
    if n and int(keys.max()).bit_length() + low <= 63:
        packed = np.sort((keys.astype(np.int64) << low) | np.arange(n, dtype=np.int64))
        order, ordered = packed & ((1 << low) - 1), packed >> low
    else:
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]
    return order, np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]])) if n else np.zeros(0, np.int64)


def edges_of(faces: np.ndarray) -> Edges:
    """Half-edges of ``faces (F, 3)``, grouped by edge."""
    tail, head = faces.reshape(-1).astype(np.int64), faces[:, [1, 2, 0]].reshape(-1).astype(np.int64)
    count = int(faces.max()) + 1 if len(faces) else 1
    order, start = group(np.minimum(tail, head) * count + np.maximum(tail, head))
    return Edges(tail, head, order, start, np.diff(start, append=len(order)))


def face_neighbors(faces: np.ndarray) -> np.ndarray:
    """Face across each edge, ``(F, 3)`` int32; -1 unless the edge has exactly two different faces."""
    one, other = edges_of(faces).of_valence(2)
    two = one // 3 != other // 3
    across = np.full(faces.size, -1, np.int32)
    across[one[two]], across[other[two]] = other[two] // 3, one[two] // 3
    return across.reshape(-1, 3)


def graph_components(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """Lowest node ``(count,)`` int32 of the component of every node; a, b: ``(L,)``, the nodes joined by each link."""
    graph = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    return np.unique(label, return_index=True)[1][label].astype(np.int32)


def weld_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First index of each set of equal rows in ``rows (N, K)`` float32, and the set ``(N,)`` of every row."""
    bits = np.ascontiguousarray(rows + np.float32(0.0)).view(np.uint32).astype(np.uint64)
    key = np.zeros(len(bits), np.uint64)
    for k in range(bits.shape[1]):  # 64-bit mix (splitmix64): one integer to sort instead of the columns
        key = (key ^ bits[:, k]) + np.uint64(0x9E3779B97F4A7C15)
        key = (key ^ (key >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        key = (key ^ (key >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        key ^= key >> np.uint64(31)
    spare = np.uint64(1 + max(1, len(bits).bit_length()))  # bits left for the index
    order, start = group((key >> spare).astype(np.int64))
    lowest = np.empty(len(bits), np.int64)
    lowest[order] = np.repeat(order[start], np.diff(start, append=len(order)))
    if not np.array_equal(bits[lowest], bits):  # hash collision
        _, first, label = np.unique(bits, axis=0, return_index=True, return_inverse=True)
        lowest = first[label.reshape(-1)]
    leads = lowest == np.arange(len(bits))
    return np.flatnonzero(leads), (np.cumsum(leads) - 1)[lowest]
