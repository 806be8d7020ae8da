"""The two numbers that training leaves open: at which density the surface is drawn, from one view and from many.

Trained on a soft occupancy, a network that is not sure says a little less than one half where it means a surface, and
the shape comes out thin.  A constant on the density, chosen by the silhouettes of whole objects in views that were not
input, takes that back.  How sure it is depends on the number of views, so one view and four have their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from reli3d.data.normalize import Similarity
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.nn.model import Reconstructor
from reli3d.pipeline import encode, extract, prepare
from reli3d.render.camera import Camera, camera_rays
from reli3d.train.pictures import sample_views

OFFSETS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0)  # of the logit; the last: the hull
FEW, MANY = 1, 4  # numbers of views that are tried
SIDE = 96  # pixels of the silhouettes that are compared


@torch.no_grad()
def calibrate(model: Reconstructor, samples: Path, *, objects: int = 16, seed: int = 1,
              progress: Callable[[str], None] = lambda line: None) -> dict[int, dict[float, float]]:  # fmt: skip
    """Set the preset's surface offsets to those with the best mean silhouette IoU over random ``samples``.

    samples: a folder of training samples with more than ``MANY`` views.  Gives the mean IoU of every offset for each
    number of views; ``progress`` gets a line an object.  Raises ValueError where the folder holds no samples.
    """
    files = sorted(samples.glob("*.safetensors"))
    if not files:
        raise ValueError(f"samples: expected *.safetensors files, got none in {samples}")
    chosen = np.random.default_rng(seed).permutation(len(files))[:objects]
    plain, scores = model.preset, {FEW: [], MANY: []}
    for k in chosen:
        sample = load_file(files[k])
        for count, rows in scores.items():
            code, maps = encode(model, prepare(model, sample_views(sample, count), Similarity.identity()))
            rows.append([])
            for offset in OFFSETS:
                model.preset = replace(plain, offset_one_view=offset, offset_many_views=offset)
                try:
                    mesh = extract(model, code, maps, plain.resolution)
                    rows[-1].append(silhouette_iou(mesh, sample, range(count, len(sample["images"]))))
                except ValueError:  # nothing is left of the object
                    rows[-1].append(0.0)
        progress(f"{files[k].stem}: {max(scores[FEW][-1]):.3f}, {max(scores[MANY][-1]):.3f}")
    tried = {count: dict(zip(OFFSETS, np.mean(rows, 0).tolist(), strict=True)) for count, rows in scores.items()}
    one, many = (max(tried[count], key=tried[count].get) for count in (FEW, MANY))
    model.preset = replace(plain, offset_one_view=one, offset_many_views=many + (many - one) / (MANY - 1))
    return tried


def silhouette_iou(mesh: Mesh, sample: dict[str, Tensor], views: range) -> float:
    """Mean IoU of the silhouettes of ``mesh`` and the masks of ``sample`` in ``views``, at ``SIDE`` pixels."""
    scene, size = RayScene(mesh.vertices, mesh.faces), sample["images"].shape[1]
    step = size // SIDE
    ious = []
    for v in views:
        intrinsics = sample["intrinsics"][v] / step
        origins, directions = camera_rays(Camera(sample["c2w"][v], intrinsics, size // step, size // step))
        got = scene.closest(origins, directions).face >= 0
        alpha = sample["images"][v, ..., 3].float()[None, None]
        want = torch.nn.functional.avg_pool2d(alpha, step)[0, 0] > 127.5
        ious.append(float((got & want).sum() / (got | want).sum().clamp(min=1)))
    return float(np.mean(ious))
