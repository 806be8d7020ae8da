"""The tables of the ReLi3D paper for textured GLB files, which are rendered, reconstructed and compared.

An object is centered and scaled to a longest side of 1.  The input views are lit by one environment.  Held-out views
compare renderings under the input lighting, relighting by another environment, and the material maps.
"""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reli3d.eval.metrics import geometry, psnr, ssim, surface_samples
from reli3d.geometry.camera import Camera
from reli3d.geometry.mesh import joined
from reli3d.io.glb import read_glb
from reli3d.pipeline import Network, NoSurface, ReconstructOptions, reconstruct
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.image import render_asset
from reli3d.render.shading import ShadeOptions
from reli3d.synthetic.procedural import sample_cameras
from reli3d.views.views import Views

HELD_OUT_VIEWS = 4  # views that are compared
SAMPLES = (16, 16, 4)
EXPOSURE_TARGET = 0.6  # linear value of the 90th percentile of the object in the first view
MAPS = ("base_color", "roughness", "metallic")
COLUMNS = {  # the paper's groups
    "3D": ("cd", "fs@0.1", "fs@0.2", "fs@0.5"),
    "image": ("image_psnr", "image_ssim"),
    "relit": ("relit_psnr", "relit_ssim"),
    **{name: (f"{name}_psnr", f"{name}_ssim") for name in MAPS},
}


@dataclass(frozen=True)
class ReferenceObject:
    """The original object with its lighting and cameras."""

    name: str
    parts: list[Asset]
    light: Environment  # of the input views
    other: Environment  # for relighting
    cameras: list[Camera]  # the inputs, then ``HELD_OUT_VIEWS`` others


def load_reference(
    path: Path, light: Environment, other: Environment, *, inputs: int, size: int, seed: int
) -> ReferenceObject:
    """Reads a GLB, normalizes it and places cameras by the paper's protocol."""
    parts = read_glb(path)
    points = torch.cat([p.mesh.vertices for p in parts])
    low, high = points.amin(0), points.amax(0)
    scale = 1.0 / float((high - low).max())
    move = lambda mesh: replace(mesh, vertices=((mesh.vertices - (low + high) / 2) * scale).contiguous())
    moved = [replace(part, mesh=move(part.mesh)) for part in parts]
    drawn = sample_cameras(np.random.default_rng((seed, 5)), inputs + HELD_OUT_VIEWS)
    poses = zip(torch.as_tensor(drawn[0], device="cpu"), drawn[1].tolist(), strict=True)
    cameras = [Camera.from_fov(c2w, fov, size, size) for c2w, fov in poses]
    return ReferenceObject(path.stem, moved, light, other, cameras)


def layers(
    asset: Asset | Sequence[Asset],
    camera: Camera,
    light: Environment,
    other: Environment,
    exposures: tuple[float, float],
) -> dict[str, Tensor]:
    """Images ``(H, W, 3)`` in [0, 1] over black: under both environments, and the maps; and ``alpha (H, W)``."""
    first = render_asset(asset, camera, light, options=ShadeOptions(samples=SAMPLES, seed=1))
    lit = render_asset(asset, camera, other, options=ShadeOptions(samples=SAMPLES, seed=2))
    shown = {"alpha": first.alpha}
    for name, rendering, exposure in (("image", first, exposures[0]), ("relit", lit, exposures[1])):
        shown[name] = linear_to_srgb((rendering.radiance * exposure).clamp(0.0, 1.0))
    cover = first.alpha[..., None]
    shown["base_color"] = linear_to_srgb(first.base_color.clamp(0.0, 1.0)) * cover
    for name in ("roughness", "metallic"):
        shown[name] = getattr(first, name)[..., None].expand(*first.alpha.shape, 3) * cover
    return shown


def exposure_of(target: ReferenceObject, light: Environment) -> float:
    """Factor that scales the 90th percentile of the object's radiance in the first view to EXPOSURE_TARGET."""
    rendering = render_asset(target.parts, target.cameras[0], light, options=ShadeOptions(samples=SAMPLES, seed=0))
    shown = rendering.radiance[rendering.alpha > 0.99].mean(-1)
    return EXPOSURE_TARGET / max(float(shown.quantile(0.9)) if len(shown) else 1.0, 1e-3)


def input_views(target: ReferenceObject, count: int, hero: int, exposure: float) -> Views:
    """Rendered input views: the first ``count`` cameras, the reference view ``hero`` first."""
    order = [hero, *(k for k in range(count) if k != hero)]
    cameras, options = [target.cameras[k] for k in order], ShadeOptions(samples=SAMPLES, seed=3)
    renderings = [
        render_asset(target.parts, camera, target.light, options=options, background="environment", supersampling=2)
        for camera in cameras
    ]
    images = tuple(linear_to_srgb((r.radiance * exposure).clamp(0.0, 1.0)) for r in renderings)
    c2w, intrinsics = torch.stack([c.c2w for c in cameras]), torch.stack([c.intrinsics for c in cameras])
    return Views(images, tuple(r.alpha for r in renderings), c2w, intrinsics, tuple(f"{k:04d}" for k in order))


@torch.no_grad()
def evaluate(
    model: Network, target: ReferenceObject, count: int, *, seed: int = 0
) -> tuple[dict[str, float], list[Tensor]]:
    """Metrics of one object from ``count`` views, ``empty`` 1 without a surface, and a row for :func:`sheet`."""
    exposures = exposure_of(target, target.light), exposure_of(target, target.other)
    front = int(np.random.default_rng((seed, count)).integers(count))
    views = input_views(target, count, front, exposures[0])
    unseen = target.cameras[-HELD_OUT_VIEWS:]
    reference = [layers(target.parts, c, target.light, target.other, exposures) for c in unseen]
    found = {"empty": 0.0}
    try:
        options = ReconstructOptions(texture_size=512, normalization="none")
        asset = reconstruct(views, weights=model, options=options)
    except NoSurface:
        found, result = {"empty": 1.0}, [{k: torch.zeros_like(v) for k, v in w.items()} for w in reference]
    else:
        result = [layers(asset, c, asset.light, target.other, (1.0, exposures[1])) for c in unseen]
        mesh = joined([p.mesh for p in target.parts])
        found |= geometry(surface_samples(asset.mesh), surface_samples(mesh, seed=1))
    for name in ("image", "relit", *MAPS):
        for metric in (psnr, ssim):
            values = [metric(g[name], w[name]) for g, w in zip(result, reference, strict=True)]
            found[f"{name}_{metric.__name__}"] = float(np.mean(values))
    names = ("image", "relit", "base_color")
    return found, [views.images[0], *(x[n] for n in names for x in (reference[0], result[0]))]


def summary(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Means over the objects that have the metric, and the number of objects."""
    names = dict.fromkeys(name for row in rows for name in row)
    means = {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}
    return {"objects": float(len(rows)), **means}


def markdown(tables: dict[str, dict[str, float]]) -> str:
    """Markdown table in the paper's layout: a row per number of views, ``-`` for missing values."""
    names = [c for columns in COLUMNS.values() for c in columns]
    lines = ["| views | objects | " + " | ".join(names) + " |", "|---" * (len(names) + 2) + "|"]
    for label, row in tables.items():
        cells = [f"{row[n]:.3f}" if n in row else "-" for n in names]
        lines.append(f"| {label} | {row['objects']:.0f} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def as_csv(rows: Sequence[dict]) -> str:
    """CSV table with one object and number of views per line."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    out = io.StringIO()
    writer = csv.DictWriter(out, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def sheet(rows: Sequence[Sequence[Tensor]]) -> Tensor:
    """Image sheet, uint8.  Columns: reference view, then reference and result of image, relit and base color."""
    return (torch.cat([torch.cat([t.clamp(0, 1).cpu() for t in row], 1) for row in rows]) * 255 + 0.5).to(torch.uint8)


def table(
    model: Network,
    files: Sequence[Path],
    lights: Sequence[Environment],
    counts: Sequence[int],
    *,
    size: int = 128,
    seed: int = 0,
    progress: Callable[[str], None] = lambda line: None,
) -> tuple[dict, list[dict], Tensor]:
    """Means for each number of views, the metrics of every object, and the image sheet of the last number of views.

    lights: assigned to the objects in turn; the next one relights.  size: pixels per side.  seed: of the first object.
    """
    rows, rows_of_images = list[dict](), []
    for k, path in enumerate(files):
        light, other = lights[k % len(lights)], lights[(k + 1) % len(lights)]
        target = load_reference(path, light, other, inputs=max(counts), size=size, seed=seed + k)
        for count in counts:
            found, shown = evaluate(model, target, count, seed=seed + k)
            rows.append({"object": target.name, "views": count, **found})
            progress(f"{target.name}, {count} views: " + ", ".join(f"{n} {v:.3f}" for n, v in found.items()))
        rows_of_images.append(shown)
    scores = [({n: v for n, v in row.items() if n not in ("object", "views")}, row["views"]) for row in rows]
    means = {str(c): summary([score for score, views in scores if views == c]) for c in counts}
    return means, rows, sheet(rows_of_images)
