"""How the time of a warm reconstruction grows: ``python -m bench.studies.growth OUT.png``.

Views of one object in memory to a GLB in memory with the weights of the package: 1 to 16 views, 32 to 256 cubes a side,
textures of 256 to 4096, one changed at a time from 4 views, the preset's resolution and 512.  The object is the
bundled example, reconstructed and rendered from 16 sides.  The picture has one panel each, both axes logarithmic; the
numbers are the best of the runs and go into ``OUT.json`` as well, so that ``--only`` can measure one panel at a time.
Exponents are slopes of straight lines through the points, of all and of the last two.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from bench.end_to_end import example
from reli3d.geometry.camera import Camera, look_at
from reli3d.io.glb import glb_bytes
from reli3d.nn.weights import Network, load_model
from reli3d.pipeline import ReconstructOptions, Stopwatch, reconstruct
from reli3d.render.render import render
from reli3d.render.shading import ShadeOptions
from reli3d.render.transfer import sphere_spiral
from reli3d.views.folder import load_views
from reli3d.views.views import Views

CASES: dict = {}
PANELS = {
    "views": (1, 2, 4, 8, 16),
    "resolution": (32, 64, 128, 256),
    "texture": (256, 512, 1024, 2048, 4096),
}
PIXELS = 512  # of a view
STAGES = {"all": (0, 0, 0), "network": (31, 119, 180), "surface": (44, 160, 44), "textures": (214, 39, 40)}
WIDTH, HEIGHT, MARGIN = 420, 360, 46


@torch.no_grad()
def photographs(count: int) -> Views:
    """Views of the example's reconstruction from all sides, in its own light."""
    asset = reconstruct(load_views(example(), views=12))
    low, high = asset.mesh.vertices.aminmax(dim=0)
    middle, radius = (low + high) / 2, float((high - low).norm()) / 2
    eyes = middle + 3.5 * radius * sphere_spiral(count)
    cameras = [Camera.from_fov(look_at(eye, middle), math.radians(40.0), PIXELS, PIXELS) for eye in eyes]
    shots = [render(asset, camera, options=ShadeOptions((4, 4, 2))).picture() for camera in cameras]
    return Views(
        tuple(s[..., :3].contiguous() for s in shots),
        tuple(s[..., 3].contiguous() for s in shots),
        torch.stack([c.c2w for c in cameras]),
        torch.stack([c.intrinsics for c in cameras]),
        tuple(f"{k:02d}" for k in range(count)),
    )


def spread(views: Views, count: int) -> Views:
    """``count`` of the views, evenly along the spiral."""
    return views.select([k * len(views) // count for k in range(count)])


def seconds(views: Views, model: Network, options: ReconstructOptions) -> dict[str, float]:
    """Seconds of the stages and of all with the GLB."""
    watch, began = Stopwatch(model.device), time.perf_counter()
    glb_bytes(reconstruct(views, weights=model, options=options, watch=watch))
    return {**watch.seconds, "all": time.perf_counter() - began}


def measured(panel: str, views: Views, model: Network, runs: int) -> list[dict[str, float]]:
    """The fastest run at each size of a panel."""
    plain, found = ReconstructOptions(texture_size=512), []
    for size in PANELS[panel]:
        changed = {"views": {}, "resolution": {"resolution": size}, "texture": {"texture_size": size}}[panel]
        options = replace(plain, **changed)
        shown = spread(views, size if panel == "views" else 4)
        times = [seconds(shown, model, options) for _ in range(runs)]
        found.append(min(times, key=lambda t: t["all"]))
        sys.stdout.write(f"{panel} {size}: " + ", ".join(f"{k} {found[-1][k]:.3f}" for k in STAGES) + " s\n")
        sys.stdout.flush()
    return found


def exponents(sizes: tuple[int, ...], times: list[float]) -> tuple[float, float]:
    """Slopes of log time over log size: of all points, and of the last two."""
    x, y = np.log(sizes), np.log(times)
    return float(np.polyfit(x, y, 1)[0]), float((y[-1] - y[-2]) / (x[-1] - x[-2]))


def draw(results: dict[str, list[dict[str, float]]], path: Path) -> None:
    """The panels that have been measured, side by side."""
    sheet = Image.new("RGB", (WIDTH * len(results), HEIGHT), "white")
    pen = ImageDraw.Draw(sheet)
    times = [row[stage] for rows in results.values() for row in rows for stage in STAGES]
    low, high = math.floor(math.log10(min(times))), math.ceil(math.log10(max(times)))
    for k, (panel, rows) in enumerate(results.items()):
        sizes, left = PANELS[panel], k * WIDTH + MARGIN
        right, top, bottom = (k + 1) * WIDTH - 14, 24, HEIGHT - 112

        def place(size: float, value: float, sizes=sizes, left=left, right=right, top=top, bottom=bottom):
            across = math.log(size / sizes[0]) / math.log(sizes[-1] / sizes[0])
            up = (math.log10(value) - low) / (high - low)
            return left + across * (right - left), bottom - up * (bottom - top)

        pen.text((left, 6), f"seconds by {panel}", fill="black")
        for decade in range(low, high + 1):
            y = place(sizes[0], 10.0**decade)[1]
            pen.line([(left, y), (right, y)], fill=(210, 210, 210))
            pen.text((left - 40, y - 6), f"{10.0**decade:g}", fill="black")
        for size in sizes:
            pen.text((place(size, 10.0**low)[0] - 8, bottom + 6), str(size), fill="black")
        for line, (stage, color) in enumerate(STAGES.items()):
            values = [row[stage] for row in rows]
            points = [place(s, v) for s, v in zip(sizes, values, strict=True)]
            pen.line(points, fill=color, width=2)
            for x, y in points:
                pen.ellipse([x - 3, y - 3, x + 3, y + 3], fill=color)
            whole, end = exponents(sizes, values)
            text = f"{stage}: exponent {whole:.2f}, {end:.2f} at the end"
            pen.text((left, bottom + 30 + 16 * line), text, fill=color)
    sheet.save(path, optimize=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.studies.growth", description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", choices=tuple(PANELS), help="measure this panel; the others from OUT.json")
    parser.add_argument("--runs", type=int, default=2)
    options = parser.parse_args(argv)
    kept = options.out.with_suffix(".json")
    results = json.loads(kept.read_text()) if kept.is_file() else {}
    model, views = load_model("small"), photographs(max(PANELS["views"]))
    seconds(spread(views, 4), model, ReconstructOptions(texture_size=512))  # kernels are loaded
    for panel in [options.only] if options.only else PANELS:
        results[panel] = measured(panel, views, model, options.runs)
    results = {panel: results[panel] for panel in PANELS if panel in results}
    kept.write_text(json.dumps(results) + "\n")
    draw(results, options.out)
    for panel, rows in results.items():
        found = {stage: exponents(PANELS[panel], [row[stage] for row in rows]) for stage in STAGES}
        line = ", ".join(f"{stage} {a:.2f} ({b:.2f})" for stage, (a, b) in found.items())
        sys.stdout.write(f"{panel}: exponents {line}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
