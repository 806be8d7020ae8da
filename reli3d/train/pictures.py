"""Curves of a training run, drawn with Pillow."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

WIDTH, HEIGHT, MARGIN = 420, 180, 34


def write_curves(log: Path, target: Path) -> None:
    """One panel a logged quantity over the steps, logarithmic where it is positive; nothing is written without two
    points.
    """
    rows = [r for r in map(json.loads, log.read_text().splitlines()) if "config" not in r]
    if len(rows) < 2:
        return
    names = [k for k in rows[-1] if k not in ("step", "seconds", "bad")]
    columns = 3
    sheet = Image.new("RGB", (WIDTH * columns, HEIGHT * -(-len(names) // columns)), "white")
    draw = ImageDraw.Draw(sheet)
    steps = np.array([r["step"] for r in rows], float)
    for i, name in enumerate(names):
        x0, y0 = WIDTH * (i % columns) + MARGIN, HEIGHT * (i // columns) + 16
        w, h = WIDTH - MARGIN - 10, HEIGHT - 34
        values = np.array([r.get(name, np.nan) for r in rows], float)
        shown = np.log10(values) if np.nanmin(values) > 0 else values
        low, high = np.nanmin(shown), max(np.nanmax(shown), np.nanmin(shown) + 1e-9)
        xs = x0 + w * (steps - steps[0]) / max(steps[-1] - steps[0], 1)
        ys = y0 + h * (1 - (shown - low) / (high - low))
        draw.rectangle([x0, y0, x0 + w, y0 + h], outline="#bbbbbb")
        draw.line([(x, y) for x, y in zip(xs, ys, strict=True) if np.isfinite(y)], fill="#1f5fa8")
        draw.text((x0, y0 - 13), f"{name}: {values[-1]:.4g} at step {int(steps[-1])}", fill="black")
        draw.text((2 + WIDTH * (i % columns), y0), f"{np.nanmax(values):.2g}", fill="#777777")
        draw.text((2 + WIDTH * (i % columns), y0 + h - 10), f"{np.nanmin(values):.2g}", fill="#777777")
    temporary = target.with_suffix(".tmp.png")
    sheet.save(temporary)
    os.replace(temporary, target)
