"""How well the network reconstructs procedural objects that no training has seen, under light that no training has
seen.

For every validation sample: silhouette IoU and base color PSNR from cameras that were not input, beside what the
best single color scores there, and the error of the environment beside that of the mean environment of the training
maps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from reli3d.geometry.camera import Camera, camera_rays
from reli3d.geometry.rays import RayScene
from reli3d.pipeline import Network, NoSurface, ReconstructOptions, reconstruct
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import surface_points
from reli3d.render.latlong import quarter_turn
from reli3d.synthetic.procedural import make_object
from reli3d.synthetic.samples import ObjectSurface
from reli3d.train.batches import stored_views
from reli3d.train.light_prior import scale_free

UNSEEN = 8  # the last views are looked at, the first are input
BLACK = 0.01  # added to radiance before the logarithm


def truth_colors(seed: int, cameras: list[Camera]) -> list[tuple[Tensor, Tensor]]:
    """Coverage ``(H, W)`` bool and base color ``(H, W, 3)``, sRGB-encoded, of the object of ``seed`` in each
    camera.
    """
    surface = ObjectSurface(make_object(seed))
    out = []
    for camera in cameras:
        origins, directions = (r.reshape(-1, 3) for r in camera_rays(camera))
        hits = surface.scene.closest(origins, directions)
        seen = (hits.face >= 0).nonzero()[:, 0]
        color = torch.zeros(len(origins), 3, dtype=torch.float32, device="cpu")
        color[seen] = linear_to_srgb(surface.points_at(hits.face[seen].long(), hits.bary[seen]).base_color.clamp(0, 1))
        shape = (camera.height, camera.width)
        out.append(((hits.face >= 0).reshape(shape), color.reshape(*shape, 3)))
    return out


def asset_colors(asset, scene: RayScene, camera: Camera) -> tuple[Tensor, Tensor]:
    """The same of a reconstruction."""
    origins, directions = (r.reshape(-1, 3) for r in camera_rays(camera))
    hits = scene.closest(origins, directions)
    seen = (hits.face >= 0).nonzero()[:, 0]
    color = torch.zeros(len(origins), 3, dtype=torch.float32, device="cpu")
    color[seen] = linear_to_srgb(
        surface_points(asset.mesh, asset.textures, hits.face[seen], hits.bary[seen]).base_color
    )
    shape = (camera.height, camera.width)
    return (hits.face >= 0).reshape(shape), color.reshape(*shape, 3)


def square_error(color: Tensor, truth: Tensor) -> float:
    """Mean square difference of sRGB values ``(N, 3)`` in [0, 1]."""
    return float((color - truth).square().mean().clamp(min=1e-10))


def scaled_square_error(color: Tensor, truth: Tensor) -> float:
    """The same after the best factor for each channel in linear light: no image determines how bright an albedo is,
    since a longer exposure looks the same.
    """
    p, t = srgb_to_linear(color), srgb_to_linear(truth)
    factor = (p * t).sum(0) / (p * p).sum(0).clamp(min=1e-9)
    return square_error(linear_to_srgb((p * factor).clamp(0, 1)), truth)


def light_error(predicted: Tensor, target: Tensor) -> float:
    """Mean absolute difference of log radiance over the sphere of two maps ``(H, 2H, 3)``, up to one exposure."""
    weight = torch.sin((torch.arange(len(target), dtype=torch.float32, device="cpu") + 0.5) * torch.pi / len(target))[
        :, None, None
    ].expand_as(target)
    difference = torch.log(predicted + BLACK) - torch.log(target + BLACK)
    difference = difference - (difference * weight).sum() / weight.sum()
    return float((difference.abs() * weight).sum() / weight.sum())


def evaluate(
    model: Network, sample: dict[str, Tensor], seed: int, count: int, mean_light: Tensor, *, symmetry: str = "auto"
) -> dict[str, float]:
    """Figures of one object reconstructed from the first ``count`` views, at most all but ``UNSEEN``; colors are
    compared where truth and result are seen.  symmetry: of :class:`~reli3d.pipeline.ReconstructOptions`.
    Raises ValueError for more views.

    ``*_mse`` are square errors of the base color, ``single_*`` those of the best single color of this very object.
    ``empty`` is 1 where the field has no surface: IoU 0 and nothing else to compare.  Without a pixel that both cover
    there are no colors.
    """
    last = len(sample["c2w"])
    if not 1 <= count <= last - UNSEEN:
        raise ValueError(f"count: expected 1 to {last - UNSEEN} of {last} views, got {count}")
    try:
        options = ReconstructOptions(texture_size=512, symmetry=symmetry)
        asset = reconstruct(stored_views(sample, count), weights=model, options=options)
    except NoSurface:
        return {"empty": 1.0, "iou": 0.0}
    scene, size = RayScene(asset.mesh.vertices, asset.mesh.faces), sample["images"].shape[1]
    chosen = range(last - UNSEEN, last)
    cameras = [Camera(sample["c2w"][i], sample["intrinsics"][i], size, size) for i in chosen]
    ious, got_all, want_all = [], [], []
    for camera, (mask, want) in zip(cameras, truth_colors(seed, cameras), strict=True):
        got_mask, got = asset_colors(asset, scene, camera)
        ious.append(float((mask & got_mask).sum() / (mask | got_mask).sum().clamp(min=1)))
        both = mask & got_mask
        got_all.append(got[both])
        want_all.append(want[both])
    got, want = torch.cat(got_all), torch.cat(want_all)
    target = quarter_turn(sample["environment"].float(), -1)  # stored with -Z in the center column
    predicted = asset.light.resized(len(target)).radiance
    exposure = target.mean() / mean_light.mean()
    found = {
        "empty": 0.0,
        "iou": float(np.mean(ious)),
        "light_error": light_error(predicted, target),
        "mean_light_error": light_error(mean_light * exposure, target),
    }
    if len(got):
        found |= {
            "base_color_mse": square_error(got, want),
            "base_color_scaled_mse": scaled_square_error(got, want),
            "single_color_mse": square_error(want.mean(0), want),
            "single_color_scaled_mse": scaled_square_error(torch.ones_like(want), want),
        }
    return found


def summary(rows: list[dict[str, float]]) -> dict[str, float]:
    """Means over the objects that have the figure.  A square error becomes two PSNRs [dB]: the mean over objects
    (``_psnr``), which objects of nearly one color rule, and that of the mean error (``_psnr_pooled``), which the
    colorful ones rule.
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
    """The geometric mean ``(32, 64, 3)`` of maps ``(n, H, 2H, 3)`` over all turns about the vertical: what a guess
    can know.
    """
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
    """:func:`summary` of the samples in ``folder`` for each number of views; ``progress`` gets a line an object.  The
    rest as in :func:`evaluate`.  Raises ValueError where the folder holds no samples.
    """
    files = sorted(folder.glob("*.safetensors"))
    if not files:
        raise ValueError(f"samples: expected *.safetensors files, got none in {folder}")
    out = {}
    for count in counts:
        rows = []
        for path in files:
            rows.append(evaluate(model, load_file(path), int(path.stem), count, mean_light, symmetry=symmetry))
            progress(f"{count} views, {path.stem}: " + ", ".join(f"{k} {v:.4f}" for k, v in rows[-1].items()))
        out[count] = summary(rows)
    return out
