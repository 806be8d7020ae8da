"""Curves and pictures of a run for TensorBoard, where asked for: the numbers of ``log.jsonl`` and ``pictures.png``."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def writer_class() -> type:
    """``SummaryWriter`` of torch.  Raises ValueError where the package ``tensorboard`` is missing."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ValueError("--tensorboard: expected the package tensorboard, got none; pip install tensorboard") from None
    return SummaryWriter


class Board:
    """An event file in ``folder``.  step: of the run that goes on; what the folder has of later ones is replaced."""

    def __init__(self, folder: str, step: int):
        self.writer = writer_class()(folder, purge_step=step + 1)

    def numbers(self, row: Mapping[str, float]) -> None:
        """The values of a row of the log, each by its name, at the row's ``step``."""
        for name, value in row.items():
            if name != "step":
                self.writer.add_scalar(name, value, row["step"])

    def pictures(self, grid: np.ndarray, step: int) -> None:
        """``grid (H, W, 3)`` uint8 under the name ``pictures``; all so far is on the disk then."""
        self.writer.add_image("pictures", grid, step, dataformats="HWC")
        self.writer.flush()

    def close(self) -> None:
        self.writer.close()
