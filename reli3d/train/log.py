"""The log of a training run, and TensorBoard's writer."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reli3d.errors import InputError


class Log:
    """``log.jsonl``: one JSON object per line, the configuration first; on resuming, later rows are removed."""

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
        self.close = self._file.close
        self.write({"step": step, "config": configuration})

    def write(self, row: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(row) + "\n")


def summary_writer() -> type:
    """``SummaryWriter`` of torch.  Raises InputError where the package ``tensorboard`` is missing."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        problem = "expected the package tensorboard, got none; pip install tensorboard"
        raise InputError("--tensorboard", problem) from None
    return SummaryWriter
