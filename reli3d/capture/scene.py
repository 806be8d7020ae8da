"""What a map shows: the plane that supports the object, the object's own points, and its upright frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from reli3d.capture.mapping import Map
from reli3d.views.normalize import meeting_point

MOST_ERROR = 2.0  # pixels of a point that is used
FEWEST_TRACKS = 3
HYPOTHESES = 3000  # planes through three points each
PLANE_TOLERANCE = 0.006  # of the cameras' median distance: half the thickness of the plane's inliers
AREA_CELL = 0.02  # of that distance: side of the cells by which the covered area is counted
LEAST_INLIERS = 0.02  # fraction of the points: fewer are no plane
MOST_BELOW = 0.012  # fraction of the points that may lie below the plane
LEAST_ABOVE = 0.95  # fraction of the cameras that must lie above it
REACH = 0.9  # of that distance: farther points are background
CLUSTER_REACH = 0.035  # of that distance: points of one cluster are linked by steps of at most this
CLUSTER_WIDTH = 0.25  # of that distance: scale of a cluster's weight around the point at which the cameras look
CLUSTER_KEPT = 0.08  # of the best cluster's weight: smaller clusters are not the object


@dataclass(frozen=True)
class Plane:
    """Points ``x`` with ``normal . x + offset = 0``; the cameras are on the positive side."""

    normal: np.ndarray  # (3,) unit
    offset: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """Signed distances ``(...)`` of ``points (..., 3)``, positive above."""
        return points @ self.normal + self.offset

    @property
    def axes(self) -> np.ndarray:
        """Rows: two unit directions in the plane, and its normal."""
        u = np.cross(self.normal, np.eye(3)[np.abs(self.normal).argmin()])
        u /= np.linalg.norm(u)
        return np.stack([u, np.cross(self.normal, u), self.normal])

    def foot(self, points: np.ndarray) -> np.ndarray:
        """The nearest points of the plane to ``points (..., 3)``."""
        return points - self.height(points)[..., None] * self.normal


@dataclass(frozen=True)
class Scene:
    """Center and scale of a map, its support plane where one is found, and which points are the object's."""

    center: np.ndarray  # (3,) at which the cameras look
    distance: float  # median distance of the cameras from there
    plane: Plane | None
    object: np.ndarray  # (P,) bool
    support: np.ndarray  # (P,) bool, points of the plane


def find_scene(found: Map, *, supported: bool = True) -> Scene:
    """The object of a map: the points above the support plane where the cameras look, in clusters.  Without a plane, or
    where none is looked for (``supported`` False), it is the points around there.
    """
    eyes = np.stack([v.eye for v in found.views])
    axes = np.stack([v.rotation[2] for v in found.views])
    center = meeting_point(torch.from_numpy(eyes), torch.from_numpy(axes))[0].numpy()
    distance = float(np.median(np.linalg.norm(eyes - center, axis=1)))
    good = (found.error < MOST_ERROR) & (found.tracks >= FEWEST_TRACKS)
    near = good & (np.linalg.norm(found.points - center, axis=1) < REACH * distance)
    plane = find_plane(found.points[near], eyes, distance) if supported else None
    height = plane.height(found.points) if plane else np.full(len(found.points), np.inf)
    tolerance = PLANE_TOLERANCE * distance
    chosen = _object(found.points, near & (height > 1.5 * tolerance), center, distance)
    return Scene(center, distance, plane, chosen, near & (np.abs(height) < tolerance))


def find_plane(points: np.ndarray, eyes: np.ndarray, distance: float) -> Plane | None:
    """The plane of largest covered area among those that have hardly a point below and the cameras above; or None.

    Area and not number of points: a textured object has more points than the table it stands on.
    """
    if len(points) < 12:
        return None
    rng = np.random.default_rng(0)
    tolerance = PLANE_TOLERANCE * distance
    corners = points[rng.integers(len(points), size=(HYPOTHESES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals, corners = normals[length > 1e-9] / length[length > 1e-9, None], corners[length > 1e-9, 0]
    offsets = -(normals * corners).sum(1)
    side = np.sign((eyes @ normals.T + offsets).mean(0))
    normals, offsets = normals * side[:, None], offsets * side
    allowed = ((eyes @ normals.T + offsets) > 0).mean(0) >= LEAST_ABOVE
    best, area = None, 0
    for normal, offset in zip(normals[allowed], offsets[allowed], strict=True):
        plane = Plane(normal, float(offset))
        if (np.abs(plane.height(points)) < tolerance).mean() < LEAST_INLIERS:
            continue
        covered = plane_area(plane, points, distance)
        if covered > area and _below(plane, points, tolerance) <= MOST_BELOW:
            best, area = plane, covered
    for _ in range(3):
        if best is None:
            break
        inside = points[np.abs(best.height(points)) < tolerance]
        middle = inside.mean(0)
        normal = np.linalg.svd(inside - middle, full_matrices=False)[2][2]
        refined = Plane(normal, -float(normal @ middle))
        if refined.height(eyes).mean() < 0:
            refined = Plane(-normal, float(normal @ middle))
        if _below(refined, points, tolerance) > 2 * MOST_BELOW:
            break
        best = refined
    return best


def plane_area(plane: Plane, points: np.ndarray, distance: float) -> int:
    """Cells of the plane, AREA_CELL wide, that hold inliers."""
    inside = points[np.abs(plane.height(points)) < PLANE_TOLERANCE * distance]
    flat = inside @ plane.axes[:2].T / (AREA_CELL * distance)
    return len(np.unique(np.floor(flat).astype(np.int64), axis=0))


def _below(plane: Plane, points: np.ndarray, tolerance: float) -> float:
    return float((plane.height(points) < -2.0 * tolerance).mean())


def _object(points: np.ndarray, candidates: np.ndarray, center: np.ndarray, distance: float) -> np.ndarray:
    """Mask ``(P,)`` of the clusters of ``candidates`` around ``center``."""
    index = candidates.nonzero()[0]
    chosen = np.zeros(len(points), bool)
    if len(index) == 0:
        return chosen
    pairs = cKDTree(points[index]).query_pairs(CLUSTER_REACH * distance, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(index), len(index)))
    count, label = connected_components(graph, directed=False)
    away = np.linalg.norm(points[index] - center, axis=1) / (CLUSTER_WIDTH * distance)
    weight = np.bincount(label, np.exp(-(away**2)), minlength=count)
    kept = weight >= CLUSTER_KEPT * weight.max()
    chosen[index[kept[label]]] = True
    return chosen
