"""The metrics of the ReLi3D paper: geometry in the frame of the reference, images as sRGB in [0, 1] over black."""

from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import conv2d

from reli3d.geometry.mesh import Mesh

SURFACE_SAMPLES = 30_000  # of each surface, uniform by area
THRESHOLDS = (0.1, 0.2, 0.5)  # of the F-score
WINDOW, SIGMA = 11, 1.5  # of SSIM's Gaussian (Wang et al. 2004)
K1, K2 = 0.01, 0.03
MAX_PSNR = 100.0  # dB, of equal images


def surface_samples(mesh: Mesh, count: int = SURFACE_SAMPLES, seed: int = 0) -> np.ndarray:
    """Points ``(count, 3)`` on the surface, uniform by area."""
    corners = mesh.vertices.detach().cpu().double().numpy()[mesh.faces.cpu().numpy()]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    rng = np.random.default_rng(seed)
    face = rng.choice(len(area), count, p=area / area.sum())
    u, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = corners[face].transpose(1, 0, 2)
    return (1 - u) * a + u * (1 - v) * b + u * v * c


def geometry(result: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Chamfer distance and F-scores of points ``(N, 3)`` of a result and of the reference.

    cd: mean of the two mean distances (not squared) to the nearest point of the other set.  fs@t: harmonic mean of the
    fractions of points within t of the other set.  Lengths are in units of half the reference's longest side.
    """
    half = float(np.ptp(reference, axis=0).max()) / 2.0
    result, reference = result / half, reference / half
    to_reference, to_result = cKDTree(reference).query(result)[0], cKDTree(result).query(reference)[0]
    found = {"cd": float(to_reference.mean() + to_result.mean()) / 2.0}
    for t in THRESHOLDS:
        precision, recall = float((to_reference <= t).mean()), float((to_result <= t).mean())
        found[f"fs@{t:g}"] = 2.0 * precision * recall / max(precision + recall, 1e-12)
    return found


def psnr(result: Tensor, reference: Tensor) -> float:
    """Peak signal-to-noise ratio of images in [0, 1], dB, at most MAX_PSNR."""
    return min(MAX_PSNR, -10.0 * float(torch.log10((result - reference).square().mean().clamp(min=1e-12))))


def ssim(result: Tensor, reference: Tensor) -> float:
    """Structural similarity (Wang et al. 2004) of ``(H, W, C)`` in [0, 1], mean over channels and windows inside."""
    if min(result.shape[:2]) < WINDOW:
        raise ValueError(f"result: expected at least {WINDOW} pixels per side, got {tuple(result.shape)}")
    at = torch.arange(WINDOW, dtype=torch.float64, device="cpu") - WINDOW // 2
    line = torch.exp(-at.square() / (2.0 * SIGMA**2))
    kernel = (line[:, None] * line)[None, None] / line.sum() ** 2

    mean = partial(conv2d, weight=kernel)
    a, b = (x.double().movedim(-1, 0)[:, None] for x in (result.cpu(), reference.cpu()))
    ma, mb = mean(a), mean(b)
    va, vb, both = mean(a * a) - ma * ma, mean(b * b) - mb * mb, mean(a * b) - ma * mb
    c1, c2 = K1**2, K2**2
    index = (2 * ma * mb + c1) * (2 * both + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))
    return float(index.mean())
