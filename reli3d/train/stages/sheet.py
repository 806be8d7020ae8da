"""Pictures of a stage: photographs that were not input beside what the stage shows there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from reli3d.io.images import write_png
from reli3d.nn.model import Reconstructor
from reli3d.train.stages.config import Stage
from reli3d.train.stages.step import encode, pictures
from reli3d.train.stages.views import Draw

SIDE = 96  # pixels of a tile, at least


@torch.no_grad()
def write_sheet(path: Path, model: Reconstructor, draws: Sequence[Draw], stage: Stage) -> np.ndarray:
    """A row for each object: hero, photograph, render, base colour, roughness and metallic, normal, light.

    What is written comes back, ``(H, W, 3)`` uint8.
    """
    rows = []
    for one in draws:
        code = encode(model, one)
        shown, _ = pictures(model, code, one, stage)
        target = one.targets
        tiles = [one.inputs.images[0] * one.inputs.masks[0][..., None], target.images[0] * target.masks[0][..., None]]
        if shown:
            picture = shown[0]
            cover = (picture.cover * picture.known)[..., None]
            finish = torch.cat([picture.material[..., 3:], torch.zeros_like(cover)], -1) * cover
            tiles += [picture.color, picture.material[..., :3] * cover, finish, 0.5 * (picture.normal + 1.0) * cover]
        else:
            tiles += [torch.zeros_like(tiles[1])] * 4
        light = model.decode_environment(code)[0]
        tiles.append((light / light.mean().clamp(min=1e-6) * 0.3).clamp(0, 1) ** (1 / 2.2))
        rows.append(np.concatenate([_tile(t.clamp(0, 1).cpu().numpy()) for t in tiles], 1))
    grid = np.concatenate(rows)
    write_png(path, grid)
    return grid


def _tile(values: np.ndarray) -> np.ndarray:
    """Repeated pixels, ``SIDE`` high."""
    at = (np.arange(SIDE) * values.shape[0]) // SIDE
    across = (np.arange(SIDE) * values.shape[1]) // SIDE
    return (values[at][:, across] * 255 + 0.5).astype(np.uint8)
