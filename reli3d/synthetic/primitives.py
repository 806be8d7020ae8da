"""Closed manifold3d solids of procedural objects, +Y up.  ``segments``: number of sides of a full circle."""

from collections.abc import Sequence

import numpy as np
from manifold3d import CrossSection, Manifold, Mesh

Y_UP = (-90.0, 0.0, 0.0)  # manifold3d extrudes and revolves along +Z: (x, y, z) -> (x, z, -y)
BEVEL_STEPS = 2  # facets of a rounded edge: enough for smooth normals at 512 pixels


def box(size: Sequence[float] | np.ndarray, bevel: float = 0.0) -> Manifold:
    """Box of full ``size`` at the origin; edges rounded with radius ``bevel``, clamped to half the shortest side."""
    half = np.asarray(size, dtype=float) / 2
    bevel = min(bevel, 0.98 * float(half.min()))
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    if bevel <= 1e-4 * half.max():
        return Manifold.hull_points(signs * half)
    steps = BEVEL_STEPS + (bevel > 0.15 * half.max())
    a, b = np.meshgrid(*[np.linspace(0, np.pi / 2, steps + 1)] * 2)
    octant = np.stack([np.cos(a) * np.cos(b), np.sin(a), np.cos(a) * np.sin(b)], -1).reshape(-1, 3)
    points = signs[:, None] * (half - bevel + bevel * octant)
    return Manifold.hull_points(np.ascontiguousarray(points.reshape(-1, 3)))


def lathe(profile: np.ndarray, segments: int = 32) -> Manifold:
    """Body of revolution about +Y of a closed polygon ``(K, 2)`` of radius and height, in either orientation."""
    ring = np.asarray(profile, dtype=float)
    x, y = ring.T
    if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) < 0:
        ring = ring[::-1]
    return CrossSection([np.ascontiguousarray(ring)]).revolve(segments).rotate(Y_UP)


def solid_of_profile(radius: np.ndarray, height: np.ndarray, segments: int = 32) -> Manifold:
    """Body of revolution with ``radius`` at each ``height``, bottom to top, closed along the axis."""
    ring = np.stack([np.maximum(radius, 0.0), height], -1)
    return lathe(np.concatenate([[[0.0, height[0]]], ring, [[0.0, height[-1]]]]), segments)


def cylinder(
    radius: float, height: float, *, top: float | None = None, bevel: float = 0.0, segments: int = 32
) -> Manifold:
    """Cylinder, or frustum with the radius ``top``, centered at the origin; rims rounded with radius ``bevel``."""
    top = radius if top is None else top
    bevel = min(bevel, 0.45 * height, 0.9 * max(min(radius, top), 1e-3))
    turn = np.linspace(0, np.pi / 2, BEVEL_STEPS + 1) if bevel > 0 else np.zeros(1)
    low = np.stack([radius - bevel + bevel * np.sin(turn), -height / 2 + bevel * (1 - np.cos(turn))], -1)
    high = np.stack([top - bevel + bevel * np.sin(turn), height / 2 - bevel * (1 - np.cos(turn))], -1)[::-1]
    ring = np.concatenate([low, high])
    return solid_of_profile(ring[:, 0], ring[:, 1], segments)


def ellipsoid(radii: Sequence[float] | np.ndarray, segments: int = 32) -> Manifold:
    """Ellipsoid with semi-axes ``radii`` centered at the origin."""
    return Manifold.sphere(1.0, segments).scale(tuple(float(r) for r in radii))


def capsule(start: Sequence[float], end: Sequence[float], radius: float, *, tip: float | None = None) -> Manifold:
    """Convex hull of two balls, of ``radius`` at ``start`` and ``tip`` (default the same) at ``end``."""
    ends = (start, radius), (end, radius if tip is None else tip)
    return Manifold.batch_hull([Manifold.sphere(r, 20).translate(tuple(map(float, p))) for p, r in ends])


def torus(ring: float, tube: float, *, segments: int = 40) -> Manifold:
    """Torus about +Y with major radius ``ring`` and minor radius ``tube``."""
    turn = np.linspace(0, 2 * np.pi, 17)[:-1]
    return lathe(np.stack([ring + tube * np.cos(turn), tube * np.sin(turn)], -1), segments)


def prism(outline: np.ndarray | Sequence[np.ndarray], height: float, *, bevel: float = 0.0) -> Manifold:
    """Extrudes a polygon ``(K, 2)`` in x, z, or contours, by ``height``, centered; ``bevel``: inset of the end rims."""
    contours = [outline] if isinstance(outline, np.ndarray) else list(outline)
    section = CrossSection([np.ascontiguousarray(c, dtype=float) for c in contours])
    body = Manifold.extrude(section, height).translate((0, 0, -height / 2))
    inner = section.offset(-bevel) if bevel > 0 else None
    if inner is not None and not inner.is_empty() and bevel < 0.4 * height:
        middle = Manifold.extrude(section, height - 2 * bevel).translate((0, 0, bevel - height / 2))
        body = middle + Manifold.extrude(inner, height).translate((0, 0, -height / 2))
    return body.rotate(Y_UP)


def wedge(size: Sequence[float], ridge: float, shift: float = 0.0) -> Manifold:
    """Box of full ``size`` whose top face is scaled along x by ``ridge`` and moved by ``shift`` half sides."""
    x, y, z = (s / 2 for s in size)
    top = np.array([[s * x * ridge + shift * x, y, t * z] for s in (-1, 1) for t in (-1, 1)])
    low = np.array([[s * x, -y, t * z] for s in (-1, 1) for t in (-1, 1)])
    return Manifold.hull_points(np.concatenate([low, top]))


def tube(
    path: np.ndarray | Sequence, radius: np.ndarray | float, *, closed: bool = False, segments: int = 12
) -> Manifold:
    """Sweeps a circle of ``radius`` along ``path (K, 3)``, with rotation-minimizing frames (Hanson and Ma 1995)."""
    path = np.asarray(path, dtype=float)
    count = len(path)
    tangent = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.empty_like(path)
    side[0] = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    side[0] /= np.linalg.norm(side[0])
    for k in range(1, count):
        side[k] = _carry(side[k - 1], tangent[k - 1], tangent[k])
    if closed:
        last = _carry(side[-1], tangent[-1], tangent[0])
        left = np.arctan2(np.dot(np.cross(last, side[0]), tangent[0]), np.dot(last, side[0]))
        angle = left * np.arange(count) / count
        side = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(tangent, side)
    other = np.cross(tangent, side)
    turn = np.linspace(0, 2 * np.pi, segments + 1)[:-1]
    outline = np.stack([np.cos(turn), np.sin(turn)], -1)
    size = np.broadcast_to(np.asarray(radius, dtype=float), (count,))[:, None, None]
    rings = path[:, None] + size * (outline[None, :, :1] * side[:, None] + outline[None, :, 1:] * other[:, None])
    m = len(outline)
    i, j = np.meshgrid(np.arange(count if closed else count - 1), np.arange(m), indexing="ij")
    a, b = (i * m + j).ravel(), (i * m + (j + 1) % m).ravel()
    c, d = ((i + 1) % count * m + j).ravel(), ((i + 1) % count * m + (j + 1) % m).ravel()
    faces = [np.stack([a, b, d], -1), np.stack([a, d, c], -1)]
    vertices = rings.reshape(-1, 3)
    if not closed:
        ids, after = np.arange(m), (np.arange(m) + 1) % m
        vertices = np.concatenate([vertices, path[[0, -1]]])
        faces.append(np.stack([np.full(m, count * m), after, ids], -1))
        faces.append(np.stack([np.full(m, count * m + 1), (count - 1) * m + ids, (count - 1) * m + after], -1))
    return from_arrays(vertices, np.concatenate(faces))


def _carry(vector: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Parallel transport: rotates ``vector`` by the smallest rotation from ``before`` to ``after``, both unit."""
    axis = np.cross(before, after)
    cosine = float(np.dot(before, after))
    turned = vector * cosine + np.cross(axis, vector) + axis * (np.dot(axis, vector) / (1.0 + max(cosine, -0.99)))
    turned -= after * np.dot(turned, after)
    return turned / np.linalg.norm(turned)


def from_arrays(vertices: np.ndarray, faces: np.ndarray) -> Manifold:
    """Solid of a closed, outward oriented triangle mesh ``(V, 3)``, ``(F, 3)``; empty if the mesh is not closed."""
    vertices = np.ascontiguousarray(vertices, dtype=np.float32)
    return Manifold(Mesh(vertices, np.ascontiguousarray(faces, dtype=np.uint32)))


def curve(points: np.ndarray | Sequence, count: int, *, closed: bool = False) -> np.ndarray:
    """``count`` points of the uniform Catmull-Rom spline through ``points`` ``(K, D)``."""
    p = np.asarray(points, dtype=float)
    ends = (p[-1:], p[:2]) if closed else (2 * p[:1] - p[1:2], 2 * p[-1:] - p[-2:-1])
    ext = np.concatenate([ends[0], p, ends[1]])
    spans = len(p) if closed else len(p) - 1
    t = np.linspace(0, spans, count, endpoint=not closed)
    k = np.minimum(t.astype(int), spans - 1)
    t = (t - k)[:, None]
    a, b, c, d = ext[k], ext[k + 1], ext[k + 2], ext[k + 3]
    return 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
