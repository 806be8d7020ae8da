"""Rays against a triangle mesh: closest hit and occlusion, on Embree (CPU) or Warp's BVH (CPU and CUDA).

Directions need not be unit; ``t`` counts in their lengths, from 0 inclusive to ``t_max`` exclusive.  A ray that
misses, that holds a NaN, an infinity or a zero direction, or whose ``t`` leaves float32 has ``face = -1``, ``t = inf``,
``bary = 0``.  Nothing here has a gradient: the hit is re-evaluated from its face by :func:`evaluate_hits`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from torch import Tensor

from reli3d._bridge import check, empty, launch, over_slices, stream
from reli3d.kernels import intersect as kernels

BACKENDS = ("auto", "embree", "warp")
LENGTHEN = 2.0**100  # exact in float32, and brings a length of 2^-149 to 2^-50 near 1
EMBREE_HIT = (("primID", wp.int32), ("tfar", wp.float32), ("u", wp.float32), ("v", wp.float32))
SLICE_RAYS = 8192  # fewest of an Embree slice, and of one whose rays are ordered: below it costs more than it gains
THREAD_SLICES = 2  # of a large call for each thread: the more rays are ordered together, the closer are neighbours


@dataclass(frozen=True)
class Hits:
    """face ``(...)`` int32, -1 for a miss; t ``(...)``, inf for a miss; bary ``(..., 2)`` weights of vertices 1 and
    2."""

    face: Tensor
    t: Tensor
    bary: Tensor


class RayScene:
    """Acceleration structure over one mesh; keeps its own copy of the geometry.

    vertices: ``(V, 3)`` float32.  faces: ``(F, 3)`` int32.  Zero-area faces are never hit; without faces every ray
    misses. backend: ``embree`` (CPU only, robust mode), ``warp``, or ``auto``: Embree on CPU, where it is some three
    times faster, Warp on CUDA.  Warp's tree is split by surface area on every device, since its other ways leak more
    rays at vertices; on CUDA it is built by one thread of the host too (80 thousand triangles: 50 ms of a 2.8 GHz Xeon,
    refit 3 ms).  Raises TypeError or ValueError for a wrong dtype or shape, an index out of range or a vertex that is
    not finite.
    """

    def __init__(self, vertices: Tensor, faces: Tensor, backend: str = "auto"):
        if backend not in BACKENDS:
            raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend}")
        check("faces", faces, last=3, dtype=torch.int32)
        if faces.ndim != 2:
            raise ValueError(f"faces: expected shape (F, 3), got {tuple(faces.shape)}")
        self.faces = faces.detach().clone().contiguous()
        self.device = faces.device
        if backend == "auto":
            backend = "embree" if self.device.type == "cpu" else "warp"
        if backend == "embree" and self.device.type != "cpu":
            raise ValueError(f"backend: expected warp on {self.device}, got embree, which runs on CPU only")
        self.backend = backend
        self._embree = self._warp = None
        self._set_vertices(vertices)
        self._build()

    def refit(self, vertices: Tensor) -> None:
        """Move the vertices, ``(V, 3)``, keeping the faces.

        Warp refits its boxes, which traverse slower after large motion; Embree builds anew.  Raises as the constructor
        does, and then leaves the scene as it was.
        """
        if vertices.shape != self.vertices.shape:
            raise ValueError(f"vertices: expected shape {tuple(self.vertices.shape)}, got {tuple(vertices.shape)}")
        if self._warp is None:
            self._set_vertices(vertices)
            self._build()
            return
        held = self.vertices
        self._set_vertices(vertices)
        held.copy_(self.vertices)
        self.vertices = held  # the memory that the structure points to
        with stream(self.device):
            self._warp.refit()

    def closest(self, origins: Tensor, directions: Tensor, *, t_max: Tensor | float = float("inf")) -> Hits:
        """First hit of every ray: origins and directions ``(..., 3)`` broadcast; ``t_max`` a number or ``(...)``."""
        shape, o, d, far = self._rays(origins, directions, t_max)
        n = o.shape[0]
        face, t, bary = (empty((n,), kind, self.device) for kind in (wp.int32, wp.float32, wp.vec2))
        outs = [(face, wp.int32), (t, wp.float32), (bary, wp.vec2)]
        if self._embree is not None:
            self._embree_closest(o, d, far, outs)
        elif self._warp is not None:
            args = [self._warp.id, (o, wp.vec3), (d, wp.vec3), (far, wp.float32), *outs]
            launch(kernels.closest_kernel, n, args, self.device)
        else:
            face.fill_(-1), t.fill_(torch.inf), bary.zero_()
        return Hits(face.reshape(shape), t.reshape(shape), bary.reshape(*shape, 2))

    def occluded(self, origins: Tensor, directions: Tensor, *, t_max: Tensor | float = float("inf")) -> Tensor:
        """Whether anything lies on each ray before ``t_max``, ``(...)`` bool; arguments as in :meth:`closest`."""
        shape, o, d, far = self._rays(origins, directions, t_max)
        out = torch.zeros(o.shape[0], dtype=torch.bool, device=self.device)
        if self._embree is not None:
            self._embree_occluded(o, d, far, out)
        elif self._warp is not None:
            args = [self._warp.id, (o, wp.vec3), (d, wp.vec3), (far, wp.float32), (out, wp.bool)]
            launch(kernels.occluded_kernel, o.shape[0], args, self.device)
        return out.reshape(shape)

    def clear(self, origins: Tensor, directions: Tensor, t_max: Tensor) -> Tensor:
        """Whether nothing lies on a ray before its ``t_max``, ``(N,)`` bool; False where ``t_max`` is below 0.

        For rays that a kernel has made, ``(N, 3)``, ``(N, 3)`` and ``(N,)`` on the device: values are not checked.
        """
        if self._embree is None:
            return (t_max >= 0.0) & ~self.occluded(origins, directions, t_max=t_max)
        out = torch.empty(len(origins), dtype=torch.bool)

        def work(_, start, count):
            part = slice(start, start + count)
            out[part] = self.embree_blocked(origins[part], directions[part], t_max[part]) < 0

        if len(origins):
            over_slices(len(origins), work)
        return out

    @property
    def mesh_id(self) -> int:
        """Handle of Warp's mesh for kernels that trace rays themselves; 0 without faces or with Embree."""
        return 0 if self._warp is None else self._warp.id

    def embree_blocked(self, origins: Tensor, directions: Tensor, limit: Tensor) -> Tensor:
        """Raw any-hit of prepared CPU rays, ``(N,)`` int32: -1 where free, 0 where blocked or ``limit`` < 0.

        For callers that slice over threads themselves: nothing is checked, it runs in the calling thread and in the
        given order (rays from a few points are near each other already: ordering them cost the shader 15 %).
        """
        found = self._embree.run(origins.numpy(), directions.numpy(), limit.numpy(), query="OCCLUDED")
        return torch.from_numpy(found)

    def _set_vertices(self, vertices: Tensor) -> None:
        """Keep a copy, once all checks have passed."""
        check("vertices", vertices, last=3, like=self.faces)
        if vertices.ndim != 2:
            raise ValueError(f"vertices: expected shape (V, 3), got {tuple(vertices.shape)}")
        cells, scale = (wp.vec3(), wp.vec3()), 0.0
        if vertices.numel():
            low, high = vertices.detach().amin(0), vertices.detach().amax(0)
            scale = float(torch.maximum(low.abs(), high.abs()).max())
            if not scale < float("inf"):
                raise ValueError("vertices: expected finite coordinates, got NaN or infinity")
            cells = wp.vec3(*low.tolist()), wp.vec3(*(4.0 / (high - low).clamp(min=1e-30)).tolist())
        if self.faces.numel():
            first, last = (int(v) for v in torch.aminmax(self.faces))
            if first < 0 or last >= len(vertices):
                raise ValueError(f"faces: expected indices in [0, {len(vertices)}), got [{first}, {last}]")
        self.vertices = vertices.detach().clone().contiguous()
        self._cells = cells  # lower corner of the mesh, and quarters of its box per unit
        self.scale = scale  # largest coordinate of the mesh: what offset_origin needs

    def _build(self) -> None:
        if self.faces.shape[0] == 0:
            return
        if self.backend == "warp":
            with stream(self.device):
                self._warp = wp.Mesh(
                    points=wp.from_torch(self.vertices, dtype=wp.vec3, requires_grad=False),
                    indices=wp.from_torch(self.faces.reshape(-1), dtype=wp.int32, requires_grad=False),
                    bvh_constructor="sah",  # Warp's own choice on CUDA is "lbvh"
                )
            return
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._embree = EmbreeScene(robust=True)
        TriangleMesh(self._embree, self.vertices.numpy(), self.faces.numpy())
        nothing = np.ones((1, 3), np.float32)
        self._embree.run(nothing, nothing)  # builds the tree; later calls from several threads only read it

    def _rays(self, origins, directions, t_max):
        check("origins", origins, last=3, like=self.faces)
        check("directions", directions, last=3, like=self.faces)
        if isinstance(t_max, Tensor):
            check("t_max", t_max, like=self.faces)
            far = t_max.detach()
        else:
            far = torch.tensor(float(t_max), device=self.device)
        shape = np.broadcast_shapes(origins.shape[:-1], directions.shape[:-1], far.shape)
        o = origins.detach().expand(*shape, 3).reshape(-1, 3).contiguous()
        d = directions.detach().expand(*shape, 3).reshape(-1, 3).contiguous()
        far = far.reshape(1) if far.numel() == 1 else far.expand(shape).reshape(-1).contiguous()
        return shape, o, d, far

    def _embree_closest(self, o, d, far, outs) -> None:
        def store(part, order, limit, short, hit):
            count = len(hit["primID"])
            ins = [(torch.empty(0, dtype=torch.int64) if order is None else torch.from_numpy(order), wp.int64),
                   (torch.empty(0) if limit is None else torch.from_numpy(limit), wp.float32)]  # fmt: skip
            ins += [(torch.from_numpy(hit[name]), kind) for name, kind in EMBREE_HIT]
            own = [(tensor[part], kind) for tensor, kind in outs]
            launch(kernels.place_hits_kernel, count, [*ins, *own], o.device, slice_min=count)
            if short is not None:
                own[1][0][short] *= LENGTHEN

        self._embree_slices(o, d, far, store, output=1)

    def _embree_occluded(self, o, d, far, out) -> None:
        def store(part, order, limit, short, found):
            blocked = found >= 0
            if limit is not None:
                blocked &= limit >= 0.0
            out[part].numpy()[slice(None) if order is None else order] = blocked

        self._embree_slices(o, d, far, store, query="OCCLUDED")

    def _embree_slices(self, o, d, far, store, **query) -> None:
        """``store(part, order, limit, short, result)`` of Embree for every slice; its rays went there in ``order``."""

        def work(_, start, count):
            part = slice(start, start + count)
            order, odd = self._order(o[part], d[part])
            rays = [o[part], d[part]]
            rays[1], limit, short = embree_rays(*rays, far if far.numel() == 1 else far[part], odd)
            rays = [v.numpy() for v in rays]
            if order is not None:  # np.take: indexing with the order takes 4 times as long
                rays = [np.take(v, order, 0, mode="clip") for v in rays]
                limit = None if limit is None else np.take(limit, order)
            store(part, order, limit, short, self._embree.run(*rays, limit, **query))

        n = o.shape[0]
        if n:
            over_slices(n, work, slice_min=max(SLICE_RAYS, n // (THREAD_SLICES * torch.get_num_threads())))

    def _order(self, o: Tensor, d: Tensor) -> tuple[np.ndarray | None, bool]:
        """Permutation that brings like rays together, None where they are few or come in such an order already; and
        whether a ray may be odd as :func:`embree_rays` means it.

        Embree traces one ray after the other; neighbours that visit the same nodes find them in the cache.
        """
        n = o.shape[0]
        if n < SLICE_RAYS:  # any NaN or infinity shows in the sums
            plain = bool(torch.isfinite(o.sum() + d.sum())) and float(d.abs().amax(-1).min()) >= float(kernels.SHORT)
            return None, not plain
        key, odd = empty((n,), wp.int16, o.device), torch.zeros(1, dtype=torch.bool)
        args = [(o, wp.vec3), (d, wp.vec3), *self._cells, (key, wp.int16), (odd, wp.bool)]
        launch(kernels.ray_key_kernel, n, args, o.device, slice_min=n)
        keys = key.numpy()
        if np.count_nonzero(keys[1:] != keys[:-1]) < 0.5 * n:
            return None, bool(odd)
        return np.argsort(keys, kind="stable"), bool(odd)  # a radix sort for 16 bits


def embree_rays(o: Tensor, d: Tensor, far: Tensor, odd: bool) -> tuple[Tensor, np.ndarray | None, Tensor | None]:
    """Directions and far limits for Embree (None: all unlimited), and which directions were lengthened (None: none).

    Embree's limit is inclusive; -1 turns an invalid ray off.  Directions shorter than ``SHORT`` go in ``LENGTHEN``
    times as long.  odd: whether there may be any of the two.
    """
    if not odd and far.numel() == 1 and float(far) == float("inf"):
        return d, None, None
    limit = torch.from_numpy(np.nextafter(far.numpy(), np.float32(-np.inf))).expand(len(o))
    reach = d.abs().amax(-1)
    short = (reach > 0.0) & (reach < float(kernels.SHORT))
    if bool(short.any()):
        d = torch.where(short[:, None], d * LENGTHEN, d)
        limit = torch.where(short, limit.clamp(max=torch.finfo(torch.float32).max) / LENGTHEN, limit)
    else:
        short = None
    valid = torch.isfinite(o).all(-1) & torch.isfinite(reach) & (reach > 0.0) & (limit >= 0.0)
    return d, torch.where(valid, limit, -1.0).numpy(), short


def offset_origin(position: Tensor, ng: Tensor, direction: Tensor, *, scale: float = 1.0) -> Tensor:
    """Origins ``(..., 3)`` for rays from a surface that cannot hit the face they start on.

    position: ``(..., 3)`` on the face.  ng: ``(..., 3)`` unit geometric normal, either side; 0, of a face without area,
    moves nothing.  direction: ``(..., 3)``, of the ray to come.  scale: largest coordinate of the mesh
    (``RayScene.scale``).  No gradient.
    """
    check("position", position, last=3)
    check("ng", ng, last=3, like=position)
    check("direction", direction, last=3, like=position)
    shape = np.broadcast_shapes(position.shape, ng.shape, direction.shape)
    ins = [(v.detach().expand(shape).reshape(-1, 3).contiguous(), wp.vec3) for v in (position, ng, direction)]
    out = empty((ins[0][0].shape[0],), wp.vec3, position.device)
    launch(kernels.offset_origin_kernel, out.shape[0], [*ins, float(scale), (out, wp.vec3)], position.device)
    return out.reshape(shape)
