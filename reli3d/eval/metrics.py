"""The paper's figures, each with its definition (papers name them and seldom define them).

Geometry is compared in the frame of the truth, scaled so that the truth's longest side is 2, as a box from -1 to 1.
Pictures are compared in display values (sRGB in [0, 1]) over black, the whole picture.
"""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import conv2d

from reli3d.geometry.mesh import Mesh

POINTS = 30_000  # of each surface, drawn evenly by area
THRESHOLDS = (0.1, 0.2, 0.5)  # of the F-score
WINDOW, SIGMA = 11, 1.5  # of SSIM's Gaussian (Wang and others 2004)
K1, K2 = 0.01, 0.03
BEST = 100.0  # dB, of equal pictures


def surface_samples(mesh: Mesh, count: int = POINTS, seed: int = 0) -> np.ndarray:
    """Points ``(count, 3)`` on the faces, evenly by area."""
    corners = mesh.vertices.detach().cpu().double().numpy()[mesh.faces.cpu().numpy()]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    rng = np.random.default_rng(seed)
    face = rng.choice(len(area), count, p=area / area.sum())
    u, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = corners[face].transpose(1, 0, 2)
    return (1 - u) * a + u * (1 - v) * b + u * v * c


def geometry(got: np.ndarray, want: np.ndarray, *, icp: bool = False) -> dict[str, float]:
    """Chamfer distance and F-scores of points ``(N, 3)`` of the result and of the truth.

    cd: mean of the two mean distances (not squared) to the nearest point of the other.  fs@t: harmonic mean of the
    shares of each that lie within t of the other.  Both are divided by half the truth's longest side first.  icp: move
    the result by a rotation and a shift that bring it nearer first (Besl and McKay 1992, from where it is).
    """
    half = float(np.ptp(want, axis=0).max()) / 2.0
    got, want = got / half, want / half
    if icp:
        _, got, _ = trimesh.registration.icp(got, want, max_iterations=50, reflection=False, scale=False)
    to_want, to_got = cKDTree(want).query(got)[0], cKDTree(got).query(want)[0]
    found = {"cd": float(to_want.mean() + to_got.mean()) / 2.0}
    for t in THRESHOLDS:
        precision, recall = float((to_want <= t).mean()), float((to_got <= t).mean())
        found[f"fs@{t:g}"] = 2.0 * precision * recall / max(precision + recall, 1e-12)
    return found


def psnr(got: Tensor, want: Tensor) -> float:
    """Of pictures in [0, 1], dB, at most :data:`BEST`."""
    return min(BEST, -10.0 * float(torch.log10((got - want).square().mean().clamp(min=1e-12))))


def ssim(got: Tensor, want: Tensor) -> float:
    """Structural similarity of ``(H, W, C)`` in [0, 1], mean over channels and pixels whose window is whole.

    Wang and others 2004: a Gaussian window of 11 pixels, K1 0.01, K2 0.03.  Raises ValueError below 11 pixels.
    """
    if min(got.shape[:2]) < WINDOW:
        raise ValueError(f"got: expected at least {WINDOW} pixels a side, got {tuple(got.shape)}")
    at = torch.arange(WINDOW, dtype=torch.float64, device="cpu") - WINDOW // 2
    line = torch.exp(-at.square() / (2.0 * SIGMA**2))
    kernel = (line[:, None] * line)[None, None] / line.sum() ** 2

    def mean(x: Tensor) -> Tensor:
        return conv2d(x, kernel)

    a, b = (x.double().movedim(-1, 0)[:, None] for x in (got.cpu(), want.cpu()))
    ma, mb = mean(a), mean(b)
    va, vb, both = mean(a * a) - ma * ma, mean(b * b) - mb * mb, mean(a * b) - ma * mb
    c1, c2 = K1**2, K2**2
    index = (2 * ma * mb + c1) * (2 * both + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))
    return float(index.mean())
