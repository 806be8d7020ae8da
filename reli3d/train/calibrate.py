"""Calibration of the occupancy logit, by normal maps in held-out views.

An uncertain network predicts occupancies below 0.5 at the true surface, which makes shapes too thin.  A constant added
to the logit compensates; it is linear in 1 / V through the best values of one and four views, up to OFFSET_VIEWS views.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from reli3d._bridge import present
from reli3d.errors import InputError
from reli3d.geometry.camera import Camera, camera_rays
from reli3d.geometry.hits import interpolate
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.nn.presets import CALIBRATED_VIEWS, LocalPreset
from reli3d.pipeline import Network, NoSurface, encode, extract, prepare
from reli3d.train.batches import stored_views
from reli3d.views.similarity import Similarity

# candidates; the last gives about the visual hull
OFFSETS = (0.0, 0.125, 0.25, 0.375, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0)
FEW_VIEWS, MANY_VIEWS = 1, CALIBRATED_VIEWS  # numbers of views that are tried
COMPARED_SIZE = 96  # pixels of the normal maps that are compared
MIN_ERROR, MAX_ERROR = 1e-3, math.log(20.0)  # of a normal map: 2 degrees everywhere; a mesh of 20 times the area


@torch.no_grad()
def calibrate(
    model: Network,
    samples: Path,
    *,
    objects: int = 32,
    seed: int = 1,
    progress: Callable[[str], None] = lambda line: None,
) -> dict[int, dict[float, float]]:
    """Sets the surface offsets of the preset by :func:`normal_map_error` over random ``samples``.

    Takes the smallest of OFFSETS that :func:`one_standard_error_choice` cannot distinguish from the best.  Returns the
    mean silhouette IoU of every offset, for each number of views.

    samples: folder of samples with more than MANY_VIEWS views, of held-out objects: on training objects the network is
    too certain.  objects: how many are used.  progress: called with one line per object.
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
                    rows[-1].append(view_scores(mesh, sample, range(count, len(sample["images"]))))
                except NoSurface:
                    rows[-1].append((0.0, MAX_ERROR))
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


def view_scores(mesh: Mesh, sample: dict[str, Tensor], views: range) -> tuple[float, float]:
    """Mean silhouette IoU and mean :func:`normal_map_error` of ``mesh`` in ``views`` of ``sample``."""
    scene, size = RayScene(mesh.vertices, mesh.faces), sample["images"].shape[1]
    normals = present("mesh.normals", mesh.normals)
    step = max(1, size // COMPARED_SIZE)
    rows = []
    for v in views:
        intrinsics = sample["intrinsics"][v] / step
        origins, directions = camera_rays(Camera(sample["c2w"][v], intrinsics, size // step, size // step))
        hits = scene.closest(origins.reshape(-1, 3), directions.reshape(-1, 3))
        filled, masked = hits.face >= 0, _reduced(sample["images"][v, ..., 3:], step)[:, 0] > 127.5
        got = interpolate(normals, mesh.faces, hits.face, hits.bary)
        wanted = _reduced(sample["view_normal"][v], step)
        unknown = masked & (wanted == 0.0).all(-1)  # at the outline: only whether the mesh is there counts
        wanted[unknown] = torch.where(filled[unknown, None], got[unknown], torch.tensor([0.0, 0.0, 1.0]))
        both, either = int((filled & masked).sum()), int((filled | masked).sum())
        rows.append((both / max(either, 1), normal_map_error(got, filled, wanted, masked)))
    return tuple(np.mean(rows, 0).tolist())


def _reduced(values: Tensor, step: int) -> Tensor:
    """Means ``(P, C)`` over squares of ``step`` pixels of ``values (H, W, C)``."""
    return functional.avg_pool2d(values.float().permute(2, 0, 1), step).flatten(1).T


def normal_map_error(got: Tensor, filled: Tensor, wanted: Tensor, masked: Tensor) -> float:
    """Squared error of a normal map over the area of the object, as a logarithm; at most MAX_ERROR.

    got, wanted: normals ``(P, 3)`` of any length.  filled, masked: ``(P,)`` bool, the pixels of mesh and object.
    """
    got, wanted = functional.normalize(got, dim=-1), functional.normalize(wanted, dim=-1)
    difference = (got * filled[:, None] - wanted * masked[:, None]).square().sum()
    return min(MAX_ERROR, math.log(max(float(difference) / max(int(masked.sum()), 1), MIN_ERROR)))
