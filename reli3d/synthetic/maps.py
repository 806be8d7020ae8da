"""Environment maps: which ones training may see."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

ROWS = 64
HELD_BACK = 6  # every sixth map is left out of the fit and of all training


def load_maps(path: Path) -> tuple[Tensor, list[str]]:
    """Maps ``(n, 64, 128, 3)`` linear, row 0 up, area-averaged, and their names, from an .npz of ``env`` and
    ``names``.
    """
    data = np.load(path)
    maps = torch.as_tensor(data["env"].astype(np.float32)).permute(0, 3, 1, 2)
    maps = torch.nn.functional.interpolate(maps, (ROWS, 2 * ROWS), mode="area").permute(0, 2, 3, 1)
    return maps.contiguous(), [str(n) for n in data["names"]]


def held_back(names: list[str]) -> list[bool]:
    """Which maps no training may see: every sixth by alphabetical order."""
    rank = {n: i for i, n in enumerate(sorted(names))}
    return [rank[n] % HELD_BACK == HELD_BACK - 1 for n in names]
