"""The log of a training run, plots of it (drawn with Pillow), and TensorBoard event files."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from reli3d.errors import InputError

WIDTH, HEIGHT, MARGIN = 420, 180, 34
NO_CURVE = ("step", "seconds", "bad")  # columns of the log


def write_curves(log: Path, target: Path) -> None:
    """Plots every logged quantity over the steps, on a logarithmic axis if all its values are positive.

    Quantities without finite values are left out.  Nothing is written for fewer than two rows.
    """
    rows = [r for r in map(json.loads, log.read_text().splitlines()) if "config" not in r]
    if len(rows) < 2:
        return
    logged = {k: np.array([r.get(k, np.nan) for r in rows], float) for k in rows[-1] if k not in NO_CURVE}
    logged = {k: values for k, values in logged.items() if np.isfinite(values).any()}
    columns = 3
    sheet = Image.new("RGB", (WIDTH * columns, max(1, HEIGHT * -(-len(logged) // columns))), "white")
    draw = ImageDraw.Draw(sheet)
    steps = np.array([r["step"] for r in rows], float)
    for i, (name, values) in enumerate(logged.items()):
        x0, y0 = WIDTH * (i % columns) + MARGIN, HEIGHT * (i // columns) + 16
        w, h = WIDTH - MARGIN - 10, HEIGHT - 34
        known = np.isfinite(values)
        least, most = values[known].min(), values[known].max()
        shown = np.log10(values[known]) if least > 0 else values[known]
        low, high = shown.min(), max(shown.max(), shown.min() + 1e-9)
        xs = x0 + w * (steps[known] - steps[0]) / max(steps[-1] - steps[0], 1)
        ys = y0 + h * (1 - (shown - low) / (high - low))
        draw.rectangle([x0, y0, x0 + w, y0 + h], outline="#bbbbbb")
        draw.line(list(zip(xs, ys, strict=True)), fill="#1f5fa8")
        draw.text((x0, y0 - 13), f"{name}: {values[-1]:.4g} at step {int(steps[-1])}", fill="black")
        draw.text((2 + WIDTH * (i % columns), y0), f"{most:.2g}", fill="#777777")
        draw.text((2 + WIDTH * (i % columns), y0 + h - 10), f"{least:.2g}", fill="#777777")
    temporary = target.with_suffix(".tmp.png")
    sheet.save(temporary)
    os.replace(temporary, target)


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
