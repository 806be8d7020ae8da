"""Connected components of a graph on the host."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from reli3d._bridge import launch
from reli3d.kernels import components as kernels


def graph_components(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """Lowest node ``(count,)`` int32 of the component of every node.

    a, b: ``(L,)`` integers in [0, count), the nodes that each link joins.  Raises ValueError for other numbers.
    """
    if a.shape != b.shape or a.ndim != 1:
        raise ValueError(f"b: expected shape (L,) as a, got {a.shape} and {b.shape}")
    if len(a) and not (min(a.min(), b.min()) >= 0 and max(a.max(), b.max()) < count):
        raise ValueError(f"a, b: expected nodes in [0, {count}), got others")
    parent = torch.arange(count, dtype=torch.int32)
    ends = [(torch.from_numpy(np.ascontiguousarray(v, dtype=np.int32)), wp.int32) for v in (a, b)]
    launch(kernels.components_kernel, 1, [*ends, (parent, wp.int32)], parent.device)
    return parent.numpy()
