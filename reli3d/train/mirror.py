"""Mirror plane of a sampled surface: half of all scans have one, and inference adds mirror images of such objects."""

import numpy as np
from scipy.spatial import cKDTree

ANGLES, FINE = 48, 9  # planes of the coarse search, and angles of the fine one within a coarse step
OFFSETS = np.linspace(-0.01, 0.01, 5)  # of the fine search, from the centroid [model's unit]
SEARCH_POINTS, CHECK_POINTS = 400, 2048
MAX_MEAN, MAX_QUANTILE, QUANTILE = 1.4, 2.0, 0.99  # distances after mirroring, in the distances between the points


Plane = tuple[np.ndarray, float]  # normal (3,), unit, and offset


def surface_mirror(position: np.ndarray) -> Plane | None:
    """Normal ``(3,)`` and offset of the vertical plane (+Y up) at which a surface is mirror-symmetric, or None.

    position: ``(N, 3)`` points, uniform over the surface, so that the plane passes near their mean.
    """
    tree, center = cKDTree(position), position.mean(0)

    def distances(angle: float, offset: float, count: int) -> np.ndarray:
        return tree.query(reflected(position[:count], *plane(angle, offset)))[0]

    def plane(angle: float, offset: float) -> Plane:
        normal = np.array([np.cos(angle), 0.0, np.sin(angle)])
        return normal, float(normal @ center + offset)

    step = np.pi / ANGLES
    coarse = min(np.arange(ANGLES) * step, key=lambda a: distances(a, 0.0, SEARCH_POINTS).mean())
    fine = [(float(a), float(o)) for a in coarse + np.linspace(-step, step, FINE) for o in OFFSETS]
    angle, shift = min(fine, key=lambda p: distances(p[0], p[1], SEARCH_POINTS).mean())
    found = distances(angle, shift, CHECK_POINTS)
    spacing = tree.query(position[:CHECK_POINTS], k=2)[0][:, 1]
    if found.mean() > MAX_MEAN * spacing.mean():
        return None
    if np.quantile(found, QUANTILE) > MAX_QUANTILE * np.quantile(spacing, QUANTILE):
        return None
    return plane(angle, shift)


def reflected(points: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """``points (N, 3)`` mirrored at the plane ``normal . x = offset``."""
    return points - 2.0 * (points @ normal - offset)[:, None] * normal


def mirrored_visibility(position: np.ndarray, visible: np.ndarray, points: np.ndarray, plane: Plane) -> np.ndarray:
    """``(M, V)``: visibility of ``points (M, 3)`` in mirror images, read at the nearest mirrored surface point.

    position, visible: ``(N, 3)`` and ``(N, V)``, all points of the sample and their visibility in the input views.
    """
    return visible[cKDTree(position).query(reflected(points, *plane))[1]]
