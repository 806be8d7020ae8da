"""New triangles for a surface: fewer, even ones, or a watertight solid.

Each function works on the welded positions on the CPU and returns a mesh of positions and faces on the device of the
input, without gradient.  Normals, UV and tangents are left out, since they belong to the old triangles.

Decimation (``fast-simplification``, MIT) and even remeshing (``pyacvd``, MIT, on VTK, BSD, and pykdtree, LGPL) are
optional installs.  ``manifold3d`` can simplify too, but takes a tolerance instead of a count and solids only.
PyMeshLab is GPL, gpytoolbox has GPL parts, and the wheel of ``geogram`` has no remeshing.
"""

from __future__ import annotations

import importlib
import threading

import numpy as np
import torch

from reli3d.geometry.holes import open_loops
from reli3d.geometry.mesh import Mesh, weld, welded_faces

_ONE_AT_A_TIME = threading.Lock()  # fast-simplification keeps its mesh in a global


def _library(name: str, install: str):
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise ImportError(f"{name} is not installed: pip install '{install}'", name=name) from error


def _arrays(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Welded positions ``(W, 3)`` float32 and the faces ``(F, 3)`` int32 that are not degenerate, used ones only."""
    if not bool(torch.isfinite(mesh.vertices.detach()).all()):
        raise ValueError("mesh.vertices: expected finite positions, got NaN or infinity")
    faces, sound = welded_faces(mesh)
    faces = faces[sound]
    if not len(faces):
        raise ValueError("mesh: expected faces with three different corners, got none")
    positions = mesh.vertices.detach().cpu().numpy()[weld(mesh.vertices)[0].cpu().numpy()]
    return _used(positions, faces)


def _used(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, faces = np.unique(faces, return_inverse=True)
    return positions[used], faces.reshape(-1, 3).astype(np.int32)


def _mesh(positions: np.ndarray, faces: np.ndarray, like: Mesh) -> Mesh:
    device = like.vertices.device
    return Mesh(
        torch.from_numpy(np.array(positions, np.float32, order="C")).to(device),
        torch.from_numpy(np.array(faces, np.int32, order="C")).to(device),
    )


def decimate(mesh: Mesh, faces: int, *, keep_border: bool = False) -> Mesh:
    """The surface with about ``faces`` triangles, by collapsing edges in the order of their quadric error.

    Garland and Heckbert 1997, Surface simplification using quadric error metrics, through ``fast-simplification``
    (``pip install 'reli3d[mesh]'``).  The result has at most ``faces`` faces unless no collapse is left that turns no
    face over, and it may have a few non-manifold edges (:func:`reli3d.geometry.mesh.report` counts them).  keep_border:
    collapse nothing at open borders.  Deterministic.  A surface that has no more than ``faces`` comes back welded.

    Raises ValueError unless ``faces`` is at least 4 and positions are finite, ImportError without the library.
    """
    if faces < 4:
        raise ValueError(f"faces: expected at least 4, got {faces}")
    library = _library("fast_simplification", "reli3d[mesh]")
    positions, triangles = _arrays(mesh)
    if len(triangles) <= faces:
        return _mesh(positions, triangles, mesh)
    centre, size = positions.mean(0, dtype=np.float64), float(np.ptp(positions, axis=0).max())
    options = {"preserve_border": True} if keep_border else {}
    with _ONE_AT_A_TIME:  # unit size: the library's error thresholds are absolute
        points, triangles = library.simplify((positions - centre) / size, triangles, target_count=int(faces), **options)
    return _mesh(*_used(points * size + centre, triangles), mesh)


def remesh(mesh: Mesh, vertices: int, *, subdivide: int = 10) -> Mesh:
    """The surface with about ``vertices`` evenly spread vertices and nearly equilateral faces.

    Clusters of equal area, their dual triangulated: Valette and Chassery 2004, Approximated centroidal Voronoi diagrams
    for uniform polygonal mesh coarsening, through ``pyacvd`` (``pip install 'reli3d[remesh]'``).  Faces are split in
    four until there are at least ``subdivide`` vertices for each cluster.  Sharp edges are rounded to the clusters'
    size; parts thinner than a cluster may come out non-manifold.

    Raises ValueError unless ``vertices`` is at least 8 and ``subdivide`` at least 1, ImportError without the library.
    """
    if vertices < 8:
        raise ValueError(f"vertices: expected at least 8, got {vertices}")
    if subdivide < 1:
        raise ValueError(f"subdivide: expected at least 1, got {subdivide}")
    acvd, vista = _library("pyacvd", "reli3d[remesh]"), _library("pyvista", "reli3d[remesh]")
    positions, triangles = _arrays(mesh)
    padded = np.concatenate([np.full((len(triangles), 1), 3, np.int64), triangles], 1)
    clustering = acvd.Clustering(vista.PolyData(positions.astype(np.float64), padded.reshape(-1)))
    levels, count = 0, len(positions)
    while count < subdivide * vertices:
        levels, count = levels + 1, count * 4
    if levels:
        clustering.subdivide(levels)
    clustering.cluster(int(vertices))
    made = clustering.create_mesh()
    return _mesh(*_used(np.asarray(made.points), np.asarray(made.faces).reshape(-1, 4)[:, 1:]), mesh)


def repair(mesh: Mesh) -> Mesh:
    """The watertight, manifold solid that the surface bounds, as ``manifold3d`` takes it; faces look outward.

    Vertices at one position are welded and repeated faces dropped.  If the surface is not closed then, it is cut at
    edges with more than two faces, or with two that disagree, and every border loop gets a cap (a fan around its
    mean).  Pieces that are inside out are turned; inside the bounds of another piece they are cavities and stay.
    Overlapping pieces are united.  A single sheet has no inside: its cap makes a flat or empty solid.  Where the solid
    touches itself in an edge or a vertex, positions repeat.

    Raises ValueError where no solid with a volume comes out.
    """
    from manifold3d import Error, Manifold, OpType
    from manifold3d import Mesh as Solid

    def solid(positions: np.ndarray, triangles: np.ndarray) -> Manifold:
        return Manifold(Solid(np.array(positions, np.float32, order="C"), np.array(triangles, np.uint32, order="C")))

    positions, triangles = _arrays(mesh)
    _, first = np.unique(np.sort(triangles, 1), axis=0, return_index=True)
    triangles = triangles[np.sort(first)]
    whole = solid(positions, triangles)
    if whole.status() != Error.NoError:
        positions, triangles = _capped(*_cut(positions, triangles))
        whole = solid(positions, triangles)
    if whole.status() != Error.NoError:
        raise ValueError(f"mesh: expected a surface that manifold3d can close, got {whole.status().name}")
    outer: list[Manifold] = []
    inner: list[Manifold] = []
    for piece in whole.decompose():
        (outer if piece.volume() > 0.0 else inner).append(piece)
    turned = []
    for piece in inner:
        data = piece.to_mesh()
        turned.append(solid(data.vert_properties[:, :3], data.tri_verts[:, ::-1]))
    cavities = [piece for piece in turned if any(_within(piece.bounding_box(), o.bounding_box()) for o in outer)]
    outer += [piece for piece in turned if not any(piece is c for c in cavities)]
    result = Manifold.batch_boolean(outer, OpType.Add) if len(outer) > 1 else outer[0] if outer else Manifold()
    if cavities:
        result = result - Manifold.batch_boolean(cavities, OpType.Add)
    if result.is_empty() or not result.volume() > 0.0:
        raise ValueError("mesh: expected a surface around a volume, got one that bounds none")
    data = result.to_mesh()
    return _mesh(data.vert_properties[:, :3], data.tri_verts, mesh)


def _within(box, other) -> bool:
    return all(a >= b for a, b in zip(box[:3], other[:3])) and all(a <= b for a, b in zip(box[3:], other[3:]))


def _cut(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same faces with a vertex for every fan, so that every edge has one face or two that agree."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    tail, head = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    n = int(faces.max()) + 1
    key = np.minimum(tail, head).astype(np.int64) * n + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    start = np.flatnonzero(np.diff(key[order], prepend=-1))
    pair = start[np.diff(start, append=len(key)) == 2]
    one, other = order[pair], order[pair + 1]
    agree = tail[one] != tail[other]
    one, other = one[agree], other[agree]

    def after(h: np.ndarray) -> np.ndarray:
        return h // 3 * 3 + (h + 1) % 3

    a, b = np.concatenate([one, after(one)]), np.concatenate([after(other), other])
    links = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(len(tail), len(tail)))
    _, fan = connected_components(links, directed=False)  # a corner is the half-edge that leaves it
    _, first, fan = np.unique(fan, return_index=True, return_inverse=True)
    return positions[tail[first]], fan.reshape(-1, 3)


def _capped(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every border loop closed by a fan around the mean of its vertices."""
    tail, caps = faces.reshape(-1), [faces]
    centres: list[np.ndarray] = []
    for loop in open_loops(faces)[0]:
        ring = tail[loop][::-1]
        hub = np.full(len(ring), len(positions) + len(centres))
        centres.append(positions[ring].mean(0))
        caps.append(np.stack([ring, np.roll(ring, -1), hub], -1))
    return np.concatenate([positions, np.array(centres, np.float32).reshape(-1, 3)]), np.concatenate(caps)
