"""The log of a training run, and TensorBoard event files."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from reli3d.errors import InputError


class Log:
    """``log.jsonl``: one JSON object per line; a run begins with its configuration.

    On resuming, rows after ``step`` and a half-written last row are removed.
    """

    def __init__(self, path: Path, step: int, configuration: Mapping[str, Any]):
        kept = []
        for line in path.read_text().splitlines() if path.exists() else ():
            try:
                row = json.loads(line)
            except ValueError:  # the line that was being written
                break
            if row["step"] > step:
                break
            kept.append(line)
        path.write_text("".join(f"{line}\n" for line in kept))
        self._file = open(path, "a", buffering=1)  # noqa: SIM115 - open for the whole run
        self.write({"step": step, "config": configuration})

    def write(self, row: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(row) + "\n")

    def close(self) -> None:
        self._file.close()


def summary_writer() -> type:
    """``SummaryWriter`` of torch.  Raises InputError where the package ``tensorboard`` is missing."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise InputError(
            "--tensorboard", "expected the package tensorboard, got none; pip install tensorboard"
        ) from None
    return SummaryWriter


class Board:
    """A TensorBoard event file in ``folder``.  step: at which the run resumes; events of later steps are purged."""

    def __init__(self, folder: str, step: int):
        self._writer = summary_writer()(folder, purge_step=step + 1)

    def numbers(self, row: Mapping[str, float]) -> None:
        """The values of a row of the log, each by its name, at the row's ``step``."""
        for name, value in row.items():
            if name != "step":
                self._writer.add_scalar(name, value, row["step"])

    def image(self, image: np.ndarray, step: int) -> None:
        """``image (H, W, 3)`` uint8 under the name ``validation``; flushes the file."""
        self._writer.add_image("validation", image, step, dataformats="HWC")
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()
