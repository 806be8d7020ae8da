"""Calibration of the occupancy logit, by silhouettes in held-out views.

An uncertain network predicts occupancies below 0.5 at the true surface, which makes shapes too thin.  A constant added
to the logit compensates.  Uncertainty depends on the number of views, so one and four views have separate constants.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from reli3d.errors import InputError
from reli3d.geometry.camera import Camera, camera_rays
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.nn.presets import LocalPreset
from reli3d.pipeline import Network, NoSurface, encode, extract, prepare
from reli3d.train.batches import stored_views
from reli3d.views.similarity import Similarity

OFFSETS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0)  # candidates; the last gives about the visual hull
FEW_VIEWS, MANY_VIEWS = 1, 4  # numbers of views that are tried
SILHOUETTE_SIZE = 96  # pixels of the silhouettes that are compared
MIN_RATIO_DIFFERENCE = 1e-3  # of 1 / recall - precision: a few pixels in a silhouette of several thousand
MAX_MISMATCH = math.log(20.0)  # that of a recall of 1/20


@torch.no_grad()
def calibrate(
    model: Network,
    samples: Path,
    *,
    objects: int = 32,
    seed: int = 1,
    progress: Callable[[str], None] = lambda line: None,
) -> dict[int, dict[float, float]]:
    """Sets the surface offsets of the preset by :func:`mismatch` over random ``samples``.

    Of the candidates OFFSETS it takes the smallest that :func:`one_standard_error_choice` cannot distinguish from the
    best.  Returns the mean silhouette IoU of every offset, for each number of views.

    samples: folder of samples with more than MANY_VIEWS views, of held-out objects: on objects of its training set the
    network is too certain.  objects: how many are used.  progress: called with one line per object.  Raises InputError
    if the folder has no samples.
    """
    files = sorted(samples.glob("*.safetensors"))
    if not files:
        raise InputError(samples, "expected *.safetensors files, got none; make samples with reli3d-data render")
    chosen = np.random.default_rng(seed).permutation(len(files))[:objects]
    preset = model.preset
    if not isinstance(preset, LocalPreset):
        raise ValueError(f"model: expected a network of convolutions, got the preset {preset.name}")
    scores: dict[int, list[list[tuple[float, float]]]] = {FEW_VIEWS: [], MANY_VIEWS: []}
    for k in chosen:
        sample = load_file(files[k])
        for count, rows in scores.items():
            field = encode(model, prepare(model, stored_views(sample, count), Similarity.identity()))
            rows.append([])
            for offset in OFFSETS:
                model.preset = replace(preset, offset_one_view=offset, offset_many_views=offset)
                try:
                    mesh = extract(field, preset.resolution)
                    rows[-1].append(silhouette_scores(mesh, sample, range(count, len(sample["images"]))))
                except NoSurface:
                    rows[-1].append((0.0, MAX_MISMATCH))
        progress(f"{files[k].stem}: IoU {max(scores[FEW_VIEWS][-1])[0]:.3f}, {max(scores[MANY_VIEWS][-1])[0]:.3f}")
    found = {count: np.array(rows) for count, rows in scores.items()}  # (objects, offsets, 2)
    tried = {count: dict(zip(OFFSETS, rows[..., 0].mean(0).tolist(), strict=True)) for count, rows in found.items()}
    one, many = (OFFSETS[one_standard_error_choice(found[count][..., 1])] for count in (FEW_VIEWS, MANY_VIEWS))
    model.preset = replace(preset, offset_one_view=one, offset_many_views=many + (many - one) / (MANY_VIEWS - 1))
    return tried


def one_standard_error_choice(errors: np.ndarray) -> int:
    """First column of ``errors (objects, choices)`` whose mean exceeds the minimum by at most one standard error of the
    difference (the one-standard-error rule, Breiman et al. 1984).
    """
    more = errors - errors[:, [errors.mean(0).argmin()]]
    noise = more.std(0, ddof=1) / len(more) ** 0.5 if len(more) > 1 else 0.0
    return int(np.flatnonzero(more.mean(0) <= noise)[0])


def silhouette_scores(mesh: Mesh, sample: dict[str, Tensor], views: range) -> tuple[float, float]:
    """Mean IoU and mean :func:`mismatch` between silhouettes of ``mesh`` and the masks of ``sample`` in ``views``."""
    scene, size = RayScene(mesh.vertices, mesh.faces), sample["images"].shape[1]
    step = size // SILHOUETTE_SIZE
    rows = []
    for v in views:
        intrinsics = sample["intrinsics"][v] / step
        origins, directions = camera_rays(Camera(sample["c2w"][v], intrinsics, size // step, size // step))
        filled = scene.closest(origins, directions).face >= 0
        alpha = sample["images"][v, ..., 3].float()[None, None]
        masked = torch.nn.functional.avg_pool2d(alpha, step)[0, 0] > 127.5
        both = int((filled & masked).sum())
        rows.append((both / max(int((filled | masked).sum()), 1), mismatch(both, int(filled.sum()), int(masked.sum()))))
    return tuple(np.mean(rows, 0).tolist())


def mismatch(both: int, filled: int, masked: int) -> float:
    """``log(1 / recall - precision)`` of silhouettes of ``filled`` and ``masked`` pixels with ``both`` in common.

    Equals the logarithm of the squared error per common pixel of an image of constant color at its optimal brightness.
    Unlike IoU it penalizes missing area more than excess area.  At most MAX_MISMATCH.
    """
    if both == 0:
        return MAX_MISMATCH
    return min(MAX_MISMATCH, math.log(max(masked / both - both / filled, MIN_RATIO_DIFFERENCE)))
