"""Metrics on held-out procedural objects: silhouettes, base color in held-out views and lighting, with baselines."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from reli3d.errors import InputError
from reli3d.geometry.camera import Camera
from reli3d.geometry.rays import RayScene
from reli3d.pipeline import Network, NoSurface, ReconstructOptions, reconstruct
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import primary_hits, surface_points
from reli3d.render.latlong import quarter_turn
from reli3d.render.points import SurfacePoints
from reli3d.synthetic.procedural import make_object
from reli3d.synthetic.samples import ObjectSurface
from reli3d.train.batches import stored_views
from reli3d.train.light_prior import scale_free

HELD_OUT_VIEWS = 8  # the last views of a sample, which are compared; the first are input
MAX_MASK_DIFFERENCE = 0.02  # fraction of the pixels of a view; samples of the same object differ in at most 0.0003
BLACK = 0.01  # added to radiance before the logarithm


def seen_colors(
    scene: RayScene, camera: Camera, points_at: Callable[[Tensor, Tensor], SurfacePoints]
) -> tuple[Tensor, Tensor]:
    """Coverage ``(H, W)`` bool and base color ``(H, W, 3)``, sRGB, of the surface points that ``points_at`` gives."""
    hits, _, _ = primary_hits(scene, camera)
    seen = hits.face >= 0
    color = torch.zeros(*seen.shape, 3, dtype=torch.float32, device="cpu")
    color[seen] = linear_to_srgb(points_at(hits.face[seen], hits.bary[seen]).base_color.clamp(0, 1))
    return seen, color


def square_error(color: Tensor, reference: Tensor) -> float:
    """Mean squared error of sRGB values ``(N, 3)`` in [0, 1], at least 1e-10."""
    return float((color - reference).square().mean().clamp(min=1e-10))


def scaled_square_error(color: Tensor, reference: Tensor) -> float:
    """:func:`square_error` after the best factor per channel in linear light: exposure makes the albedo ambiguous."""
    p, t = srgb_to_linear(color), srgb_to_linear(reference)
    factor = (p * t).sum(0) / (p * p).sum(0).clamp(min=1e-9)
    return square_error(linear_to_srgb((p * factor).clamp(0, 1)), reference)


def light_error(predicted: Tensor, target: Tensor) -> float:
    """Mean absolute difference of log radiance over the sphere of two maps ``(H, 2H, 3)``, up to one exposure."""
    rows = torch.arange(len(target), dtype=torch.float32, device="cpu") + 0.5
    weight = torch.sin(rows * torch.pi / len(target))[:, None, None].expand_as(target)
    difference = torch.log(predicted + BLACK) - torch.log(target + BLACK)
    difference = difference - (difference * weight).sum() / weight.sum()
    return float((difference.abs() * weight).sum() / weight.sum())


def evaluate(
    model: Network, sample: dict[str, Tensor], seed: int, count: int, mean_light: Tensor, *, symmetry: str = "auto"
) -> dict[str, float]:
    """Metrics of one object reconstructed from the first ``count`` views, compared in the last HELD_OUT_VIEWS.

    ``*_mse``: mean squared errors of the base color over the pixels that both silhouettes cover, absent if there are
    none; ``single_*``: of the best constant color of the object.  ``empty``: 1 if the field has no surface; the IoU is
    then 0 and the other metrics are absent.  symmetry: as in :class:`~reli3d.pipeline.ReconstructOptions`.  Raises
    ValueError if the sample has too few views.
    """
    last = len(sample["c2w"])
    if not 1 <= count <= last - HELD_OUT_VIEWS:
        raise ValueError(f"count: expected 1 to {last - HELD_OUT_VIEWS} of {last} views, got {count}")
    options = ReconstructOptions(texture_size=512, symmetry=symmetry)
    try:
        asset = reconstruct(stored_views(sample, count), weights=model, options=options)
    except NoSurface:
        return {"empty": 1.0, "iou": 0.0}
    scene, size = RayScene(asset.mesh.vertices, asset.mesh.faces), sample["images"].shape[1]
    original = ObjectSurface(make_object(seed))
    ious, pairs = [], []
    for i in range(last - HELD_OUT_VIEWS, last):
        camera = Camera(sample["c2w"][i], sample["intrinsics"][i], size, size)
        mask, reference = seen_colors(original.scene, camera, lambda face, bary: original.points_at(face.long(), bary))
        if float((mask ^ (sample["images"][i, ..., 3] > 127)).float().mean()) > MAX_MASK_DIFFERENCE:
            raise InputError("samples", f"expected procedural objects, got another object in the sample of seed {seed}")
        result_mask, result = seen_colors(scene, camera, partial(surface_points, asset.mesh, asset.textures))
        both = mask & result_mask
        ious.append(float(both.sum() / (mask | result_mask).sum().clamp(min=1)))
        pairs.append((result[both], reference[both]))
    result, reference = map(torch.cat, zip(*pairs, strict=True))
    target = quarter_turn(sample["environment"].float(), -1)  # stored with -Z at the horizontal center
    predicted = asset.light.resized(len(target)).radiance
    exposure = target.mean() / mean_light.mean()
    found = {
        "empty": 0.0,
        "iou": float(np.mean(ious)),
        "light_error": light_error(predicted, target),
        "mean_light_error": light_error(mean_light * exposure, target),
    }
    if len(result):
        found |= {
            "base_color_mse": square_error(result, reference),
            "base_color_scaled_mse": scaled_square_error(result, reference),
            "single_color_mse": square_error(reference.mean(0), reference),
            "single_color_scaled_mse": scaled_square_error(torch.ones_like(reference), reference),
        }
    return found


def summary(rows: list[dict[str, float]]) -> dict[str, float]:
    """Means over the objects that have the metric.

    A mean squared error gives ``_psnr`` [dB], the mean over objects, and ``_psnr_pooled``, that of the mean error.
    """
    out: dict[str, float] = {"objects": len(rows)}
    for key in dict.fromkeys(key for row in rows for key in row):
        values = np.array([row[key] for row in rows if key in row])
        if key.endswith("_mse"):
            name = key.removesuffix("_mse")
            out[f"{name}_psnr"] = round(float(np.mean(-10 * np.log10(values))), 4)
            out[f"{name}_psnr_pooled"] = round(float(-10 * np.log10(np.mean(values))), 4)
        else:
            out[key] = round(float(np.mean(values)), 4)
    return out


def mean_environment(maps: Tensor) -> Tensor:
    """Geometric mean ``(32, 64, 3)`` of maps ``(n, H, 2H, 3)`` over all rotations about the vertical axis."""
    rows = scale_free(maps).log().mean((0, 2))
    wide = rows.exp()[:, None].expand(-1, 2 * len(rows), -1)
    return Environment(wide.contiguous()).resized(32).radiance


def table(
    model: Network,
    folder: Path,
    mean_light: Tensor,
    counts: Sequence[int],
    progress: Callable[[str], None],
    *,
    symmetry: str = "auto",
) -> dict[int, dict]:
    """:func:`summary` of the samples in ``folder`` for each number of views.  progress: called for each object."""
    files, out = sorted(folder.glob("*.safetensors")), {}
    for count in counts:
        rows = []
        for path in files:
            rows.append(evaluate(model, load_file(path), int(path.stem), count, mean_light, symmetry=symmetry))
            progress(f"{count} views, {path.stem}: " + ", ".join(f"{k} {v:.4f}" for k, v in rows[-1].items()))
        out[count] = summary(rows)
    return out
