"""Curves and validation pictures of a training run, drawn with Pillow."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from safetensors.torch import load_file

from reli3d.io.images import write_png
from reli3d.output.preview import preview
from reli3d.pipeline import Network, NoSurface, ReconstructOptions, reconstruct
from reli3d.views.views import Views

WIDTH, HEIGHT, MARGIN = 420, 180, 34
BESIDE = ("step", "seconds", "bad")  # of a row of the log: no curves


def write_curves(log: Path, target: Path) -> None:
    """One panel a logged quantity over the steps, logarithmic where it is positive; one that is nowhere finite has
    none.  Nothing is written without two points.
    """
    rows = [r for r in map(json.loads, log.read_text().splitlines()) if "config" not in r]
    if len(rows) < 2:
        return
    logged = {k: np.array([r.get(k, np.nan) for r in rows], float) for k in rows[-1] if k not in BESIDE}
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


def sample_views(sample: dict, count: int) -> Views:
    """The first ``count`` views of a training sample, as the pipeline takes them."""
    images = sample["images"][:count].float() / 255
    return Views(
        tuple(images[..., :3].contiguous()),
        tuple(images[..., 3].contiguous()),
        sample["c2w"][:count],
        sample["intrinsics"][:count],
        tuple(f"{i:04d}" for i in range(count)),
    )


def write_validation(model: Network, samples: list[Path], folder: Path) -> None:
    """``validation.png``: previews of the samples reconstructed from one and from four views; an empty field leaves
    a gap.
    """
    rows = []
    for path in samples:
        sample = load_file(path)
        row = []
        for count in (1, 4):
            views = sample_views(sample, count)
            try:
                asset = reconstruct(views, weights=model, options=ReconstructOptions(texture_size=256))
                row.append(preview(asset, sample_views(sample, 4))())
            except NoSurface:  # early in training
                continue
        if row:
            rows.append(np.concatenate(row, 1))
    if rows:
        width = max(r.shape[1] for r in rows)
        padded = [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
        write_png(folder / "validation.png", np.concatenate(padded, 0))
