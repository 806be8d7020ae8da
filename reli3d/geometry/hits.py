"""Differentiable evaluation of hits: the hit itself, vertex attributes and geometric normals.

The choice of the hit face has no gradient; everything evaluated at the hit has gradients.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from reli3d._bridge import call, check
from reli3d.kernels import hits as kernels


@dataclass(frozen=True)
class Hits:
    """First hits of rays, from :meth:`reli3d.RayScene.intersect`.

    face: ``(...)`` int32, -1 for a miss.  t: ``(...)`` ray parameter: the hit is at ``origin + t * direction``; inf for
    a miss.  bary: ``(..., 2)`` weights of the face's vertices 1 and 2 (vertex 0: ``1 - b1 - b2``); 0 for a miss.
    valid: ``face >= 0``.  Gradients of ``t`` and ``bary`` reach the rays, and the vertices passed to ``intersect``.

    >>> hits = reli3d.RayScene(mesh).intersect(origins, directions)
    >>> points = reli3d.surface_points(mesh, None, hits.face[hits.valid], hits.bary[hits.valid])
    """

    face: Tensor
    t: Tensor
    bary: Tensor

    @property
    def valid(self) -> Tensor:
        """Whether the ray hit, ``(...)`` bool."""
        return self.face >= 0


def interpolate(values: Tensor, faces: Tensor, face: Tensor, bary: Tensor) -> Tensor:
    """Vertex attribute ``values (V, C)``, C = 2, 3 or 4, interpolated at hits: ``(..., C)``, 0 for a miss.

    faces: ``(F, 3)`` int32.  face: ``(...)`` int32, -1 for a miss.  bary: ``(..., 2)``.  Gradients reach ``values`` and
    ``bary``.  Raises ValueError for an index out of range.
    """
    check("values", values)
    if values.ndim != 2 or values.shape[1] not in kernels.INTERPOLATE:
        raise ValueError(f"values: expected shape (V, C) with C = 2, 3 or 4, got {tuple(values.shape)}")
    _check_faces(values.shape[0], faces, face, values)
    check("bary", bary, shape=(*face.shape, 2), like=values)
    n = face.numel()
    ins = [values, faces, face.reshape(-1), bary.reshape(-1, 2)]
    (out,) = call(kernels.INTERPOLATE[values.shape[1]], n, ins, [(n,)], shared=(0,))
    return out.reshape(*face.shape, values.shape[1])


def hit_normals(vertices: Tensor, faces: Tensor, face: Tensor) -> Tensor:
    """Unit geometric normals ``(..., 3)`` of hit faces ``(...)``; 0 for a miss or a degenerate face.

    Gradients reach ``vertices (V, 3)``.
    """
    check("vertices", vertices, last=3)
    _check_faces(vertices.shape[0], faces, face, vertices)
    n = face.numel()
    (out,) = call(kernels.hit_normal_kernel, n, [vertices, faces, face.reshape(-1)], [(n,)], shared=(0,))
    return out.reshape(*face.shape, 3)


def evaluate_hits(vertices: Tensor, faces: Tensor, hits: Hits, origins: Tensor, directions: Tensor) -> Hits:
    """``hits`` with differentiable ``t`` and ``bary``, recomputed from their faces.

    vertices: ``(V, 3)``.  faces: ``(F, 3)`` int32.  origins, directions: ``(..., 3)``, the rays that produced ``hits``.
    Gradients reach vertices, origins and directions; visibility is constant.  Values and gradients are computed in
    float64.  Hits on faces that are nearly degenerate or seen nearly edge-on are kept unchanged, with gradient 0.  For
    the hit position, use ``origins + t directions``: its gradient with respect to the vertices is more accurate than
    the gradient of an interpolated position.  Source: Moller and Trumbore 1997.
    """
    check("vertices", vertices, last=3)
    _check_faces(vertices.shape[0], faces, hits.face, vertices)
    check("origins", origins, last=3, like=vertices)
    check("directions", directions, last=3, like=vertices)
    shape = hits.face.shape
    o, d = (v.expand(*shape, 3).reshape(-1, 3) for v in (origins, directions))
    n = o.shape[0]
    ins = [vertices, faces, hits.face.reshape(-1), o, d, hits.t.detach().reshape(-1), hits.bary.detach().reshape(-1, 2)]
    t, bary = call(kernels.reevaluate_kernel, n, ins, [(n,), (n,)], shared=(0,))
    return Hits(hits.face, t.reshape(shape), bary.reshape(*shape, 2))


def _check_faces(count: int, faces: Tensor, face: Tensor, like: Tensor) -> None:
    check("faces", faces, last=3, like=like, dtype=torch.int32)
    check("face", face, like=like, dtype=torch.int32)
    for name, value, high in (("faces", faces, count), ("face", face, faces.shape[0])):
        if value.numel():
            low, top = (int(v) for v in torch.aminmax(value))
            if low < (-1 if name == "face" else 0) or top >= high:
                raise ValueError(f"{name}: expected indices below {high}, got [{low}, {top}]")
