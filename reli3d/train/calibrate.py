"""An uncertain network predicts occupancy below 0.5 at the surface.  A constant added to the logit corrects it.

Without it shapes come out thin.  The constant is chosen by the silhouettes of whole objects in views that were not
input.  The uncertainty depends on the number of views, so one view and four have their own constant.
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

from reli3d.geometry.camera import Camera, camera_rays
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.nn.presets import LocalPreset
from reli3d.pipeline import Network, NoSurface, encode, extract, prepare
from reli3d.train.batches import stored_views
from reli3d.views.similarity import Similarity

OFFSETS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0)  # of the logit; the last: the hull
FEW, MANY = 1, 4  # numbers of views that are tried
SIDE = 96  # pixels of the silhouettes that are compared
ALIKE = 1e-3  # of 1 / recall - precision: a few pixels of a silhouette of some thousand; less is chance
LOST = math.log(20.0)  # a twentieth of the object is all that is found


@torch.no_grad()
def calibrate(
    model: Network,
    samples: Path,
    *,
    objects: int = 32,
    seed: int = 1,
    progress: Callable[[str], None] = lambda line: None,
) -> dict[int, dict[float, float]]:
    """Set the preset's surface offsets to the least that do as well as any by :func:`mismatch` over random ``samples``.

    samples: a folder of samples with more than ``MANY`` views, best of objects that no training saw: of those it knows
    a network is surer.  Gives the mean IoU of every offset for each number of views; ``progress`` gets a line an
    object.  Raises ValueError where the folder holds no samples.
    """
    files = sorted(samples.glob("*.safetensors"))
    if not files:
        raise ValueError(f"samples: expected *.safetensors files, got none in {samples}")
    chosen = np.random.default_rng(seed).permutation(len(files))[:objects]
    plain = model.preset
    if not isinstance(plain, LocalPreset):
        raise ValueError(f"model: expected a network of convolutions, got the preset {plain.name}")
    scores: dict[int, list[list[tuple[float, float]]]] = {FEW: [], MANY: []}
    for k in chosen:
        sample = load_file(files[k])
        for count, rows in scores.items():
            field = encode(model, prepare(model, stored_views(sample, count), Similarity.identity()))
            rows.append([])
            for offset in OFFSETS:
                model.preset = replace(plain, offset_one_view=offset, offset_many_views=offset)
                try:
                    mesh = extract(field, plain.resolution)
                    rows[-1].append(agreement(mesh, sample, range(count, len(sample["images"]))))
                except NoSurface:  # nothing is left of the object
                    rows[-1].append((0.0, LOST))
        progress(f"{files[k].stem}: IoU {max(scores[FEW][-1])[0]:.3f}, {max(scores[MANY][-1])[0]:.3f}")
    found = {count: np.array(rows) for count, rows in scores.items()}  # (objects, offsets, 2)
    tried = {count: dict(zip(OFFSETS, rows[..., 0].mean(0).tolist(), strict=True)) for count, rows in found.items()}
    one, many = (OFFSETS[first_of_the_best(found[count][..., 1])] for count in (FEW, MANY))
    model.preset = replace(plain, offset_one_view=one, offset_many_views=many + (many - one) / (MANY - 1))
    return tried


def first_of_the_best(errors: np.ndarray) -> int:
    """First column of ``errors (objects, choices)`` whose mean is above the least by no more than the standard error of
    that difference (the rule of one standard error, Breiman et al. 1984): what objects do not tell apart stays as the
    network has it.
    """
    more = errors - errors[:, [errors.mean(0).argmin()]]
    noise = more.std(0, ddof=1) / len(more) ** 0.5 if len(more) > 1 else 0.0
    return int(np.flatnonzero(more.mean(0) <= noise)[0])


def agreement(mesh: Mesh, sample: dict[str, Tensor], views: range) -> tuple[float, float]:
    """Mean IoU and :func:`mismatch` of silhouettes of ``mesh`` and masks of ``sample`` in ``views``, ``SIDE`` pixels
    wide.
    """
    scene, size = RayScene(mesh.vertices, mesh.faces), sample["images"].shape[1]
    step = size // SIDE
    rows = []
    for v in views:
        intrinsics = sample["intrinsics"][v] / step
        origins, directions = camera_rays(Camera(sample["c2w"][v], intrinsics, size // step, size // step))
        got = scene.closest(origins, directions).face >= 0
        alpha = sample["images"][v, ..., 3].float()[None, None]
        want = torch.nn.functional.avg_pool2d(alpha, step)[0, 0] > 127.5
        both = int((got & want).sum())
        rows.append((both / max(int((got | want).sum()), 1), mismatch(both, int(got.sum()), int(want.sum()))))
    return tuple(np.mean(rows, 0).tolist())


def mismatch(both: int, got: int, want: int) -> float:
    """Logarithm of ``1 / recall - precision`` of ``both`` pixels in common of ``got`` and ``want``, at most ``LOST``.

    The square error of a picture in one color at its best brightness, for each pixel in common.  Unlike IoU it weighs
    how much of the object is missing more than what is too much, the more so the less is right: a shape that is guessed
    from one view had better be full.
    """
    if both == 0:
        return LOST
    return min(LOST, math.log(max(want / both - both / got, ALIKE)))
