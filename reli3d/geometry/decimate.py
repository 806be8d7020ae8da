"""Decimation of a surface by ``fast-simplification`` (MIT), an optional dependency."""

import threading

import numpy as np
import torch

from reli3d.geometry.mesh import Mesh, select_faces, weld, welded_faces

_ONE_AT_A_TIME = threading.Lock()  # fast-simplification keeps its mesh in a global


def decimate(mesh: Mesh, faces: int) -> Mesh:
    """Decimates the surface to about ``faces`` triangles by collapsing edges in order of quadric error.

    Works on the welded positions on the CPU.  The result has only positions and faces, on the device of ``mesh``, and
    no gradient; normals, UV and tangents are dropped because they belong to the original triangles.

    The result has at most ``faces`` faces unless every remaining collapse would flip a face, and it may have a few
    non-manifold edges (:func:`reli3d.geometry.mesh.report` counts them).  A surface with at most ``faces`` faces is
    only welded.  Deterministic.  Source: Garland and Heckbert 1997, Surface simplification using quadric error metrics,
    through ``fast-simplification`` (``pip install 'reli3d[mesh]'``).

    Raises ValueError unless ``faces`` is at least 4 and positions are finite, ImportError without the library.
    """
    if faces < 4:
        raise ValueError(f"faces: expected at least 4, got {faces}")
    try:
        from fast_simplification import simplify
    except ModuleNotFoundError as error:
        raise ImportError(
            "fast_simplification is not installed: pip install 'reli3d[mesh]'", name=error.name
        ) from error
    if not bool(torch.isfinite(mesh.vertices.detach()).all()):
        raise ValueError("mesh.vertices: expected finite positions, got NaN or infinity")
    first, label = weld(mesh.vertices)
    triangles, sound = welded_faces(mesh, label)
    if not sound.any():
        raise ValueError("mesh: expected faces with three different corners, got none")
    whole = _used(mesh.vertices.detach()[first].cpu().numpy(), triangles[sound])
    if len(whole.faces) <= faces:
        return whole.to(mesh.vertices.device)
    positions = whole.vertices.numpy()
    center, size = positions.mean(0, dtype=np.float64), float(np.ptp(positions, axis=0).max())
    with _ONE_AT_A_TIME:  # unit size: the library's error thresholds are absolute
        points, triangles = simplify((positions - center) / size, whole.faces.numpy(), target_count=int(faces))
    return _used(points * size + center, triangles).to(mesh.vertices.device)


def _used(positions: np.ndarray, faces: np.ndarray) -> Mesh:
    """Mesh of ``faces`` and the vertices that they use, on the CPU."""
    whole = Mesh(torch.from_numpy(np.array(positions, np.float32, order="C")), torch.from_numpy(faces.astype(np.int32)))
    return select_faces(whole, torch.ones(len(faces), dtype=torch.bool))
