"""Objects of thin tubes along curves: loops, springs, cages of rings, bent wire.  ``manmade.py`` defines a family.

A curve is a pair of points ``(K, 3)`` and whether it is closed.
"""

import numpy as np
from scipy.spatial import cKDTree

from reli3d.synthetic import primitives as p
from reli3d.synthetic.assembly import Assembly

Curve = tuple[np.ndarray, bool]

THICKNESS = 0.006, 0.04  # diameter over the longest side of the curves' box
TURN = np.linspace(0, 2 * np.pi, 141)[:-1]  # six tubes stay below the limit of faces
NEIGHBOR_RADII, GAP_RADII = 4.0, 2.2  # points farther apart than the first along a curve keep the second in space


def wire(a: Assembly) -> None:
    """One to six tubes along curves that meet in a point or cross each other, but not themselves."""
    rng, curves, radii = a.rng, list[Curve](), np.zeros(0)
    while not curves or any(_meets_itself(*curve, r) for curve, r in zip(curves, radii)):
        curves = (_loops, _spring, _cage, _bent)[int(rng.integers(4))](rng)
        size = np.ptp(np.concatenate([points for points, _ in curves]), axis=0).max()
        curves = [(points / size, closed) for points, closed in curves]
        thickness = THICKNESS[0] * (THICKNESS[1] / THICKNESS[0]) ** rng.random(len(curves))  # log-uniform
        radii = 0.5 * (thickness if rng.random() < 0.3 else np.full(len(curves), thickness[0]))
    parts = [a.random_part("metal", "plastic", "paint", "rubber", "accent") for _ in range(int(rng.integers(1, 3)))]
    for (points, closed), radius in zip(curves, radii):
        a.add(p.tube(points, radius, closed=closed), parts[int(rng.integers(len(parts)))])


def _meets_itself(points: np.ndarray, closed: bool, radius: float) -> bool:
    """Whether the tube of ``radius`` along a curve touches itself, also in a tight bend."""
    points = np.concatenate([points, points[:1]]) if closed else points
    arc = np.append(0.0, np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum())
    at = np.linspace(0, arc[-1], int(2 * arc[-1] / radius) + 2)
    tree = cKDTree(np.stack([np.interp(at, arc, x) for x in points.T], -1))
    along = np.abs(np.diff(at[tree.query_pairs(GAP_RADII * radius, output_type="ndarray")]))
    return bool((np.minimum(along, arc[-1] - along if closed else along) > NEIGHBOR_RADII * radius).any())


def _loops(rng: np.random.Generator) -> list[Curve]:
    """One to six random Fourier series of three harmonics, through a common point."""
    loops = []
    for _ in range(int(rng.integers(1, 7))):
        terms = [rng.normal(0, k**-1.5, 3) * np.sin(k * TURN[:, None] + rng.uniform(0, 6.28, 3)) for k in (1, 2, 3)]
        points = np.sum(terms, axis=0)
        loops.append((points - points[0], True))
    return loops


def _spring(rng: np.random.Generator) -> list[Curve]:
    """A conical or bulging helix whose ends are bent to its axis, often with a rod along it."""
    t, u = np.linspace(0, 1, 280), rng.uniform
    radius = u(0.15, 0.8) * (1 + u(-0.7, 0.7) * t + u(-0.5, 0.8) * np.sin(np.pi * t)).clip(0.2)
    radius, angle = radius * np.minimum(1, 8 * np.minimum(t, 1 - t)) ** 0.5, 2 * np.pi * u(2, 7) * t
    coil = np.stack([radius * np.cos(angle), u(0.8, 1.6) * t, radius * np.sin(angle)], -1)
    rod = coil[[0, -1]] + u(0, 0.3) * np.array([[0, -1, 0], [0, 1, 0]])
    return [(coil, False), (rod, False)] if rng.random() < 0.6 else [(coil, False)]


def _cage(rng: np.random.Generator) -> list[Curve]:
    """Rings on an ellipsoid: one to three meridians and one to three parallels."""
    cos, sin, axes = np.cos(TURN), np.sin(TURN), np.exp(rng.normal(0, 0.35, 3))
    meridians, parallels = rng.integers(1, 4, 2)
    around = np.pi * (np.arange(meridians) + rng.uniform()) / meridians
    rings = [np.stack([cos * np.cos(a), sin, cos * np.sin(a)], -1) for a in around]
    above = np.pi * (np.arange(1, parallels + 1) / (parallels + 1) - 0.5)
    rings += [np.stack([cos * np.cos(a), np.full_like(cos, np.sin(a)), sin * np.cos(a)], -1) for a in above]
    return [(ring * axes, True) for ring in rings]


def _bent(rng: np.random.Generator) -> list[Curve]:
    """One to three polylines with rounded corners from a common point, in a plane or in space."""
    flat, t, lines = np.array([1, 1, rng.integers(2)]), np.linspace(0, 1, 7)[:, None], list[Curve]()
    for _ in range(int(rng.integers(1, 4))):
        corners = np.cumsum(rng.normal(size=(int(rng.integers(3, 8)), 1, 3)) * flat, axis=0)
        cut = rng.uniform(0.15, 0.45)
        start, end = (corners + cut * (np.roll(corners, side, 0) - corners) for side in (1, -1))
        arcs = (1 - t) ** 2 * start + 2 * t * (1 - t) * corners + t**2 * end  # quadratic Bezier curves
        closed = bool(rng.random() < 0.4)
        points = (arcs if closed else np.concatenate([corners[0], *arcs[1:-1], corners[-1]])).reshape(-1, 3)
        lines.append((points - points[0], closed))
    return lines
