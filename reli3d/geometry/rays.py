"""Ray casting against a triangle mesh: closest hits and occlusion, by Embree (CPU) or Warp's BVH (CPU and CUDA).

Directions may have any length, and ``t`` is measured in units of that length.  Hits have ``0 <= t < t_max``.  A ray
misses if it hits nothing, if it contains a NaN, an infinity or a zero direction, or if ``t`` exceeds the range of
float32.  A miss has ``face = -1``, ``t = inf``, ``bary = 0``.  Only :meth:`RayScene.intersect` has gradients.
"""

from functools import partial

import numpy as np
import torch
import warp as wp
from torch import Tensor

from reli3d._bridge import array_of, check, empty, expect, launch, over_slices, stream, tensor_of
from reli3d.geometry import embree
from reli3d.geometry.hits import Hits, evaluate_hits
from reli3d.geometry.mesh import Mesh, check_topology
from reli3d.kernels import embree as embree_kernels
from reli3d.kernels import rays as kernels

BACKENDS = ("auto", "embree", "warp")
SLICE_RAYS = 8192  # fewest of an Embree slice, and of one whose rays are ordered: below it costs more than it gains
THREAD_SLICES = 2  # of a large call for each thread: the more rays are ordered together, the closer are neighbors


class RayScene:
    """Acceleration structure (BVH) for rays against one triangle mesh; holds a detached copy of the geometry.

    mesh: a :class:`~reli3d.geometry.mesh.Mesh`, or its vertices ``(V, 3)`` float32 with ``faces (F, 3)`` int32.
    Degenerate faces are never hit; without faces every ray misses.  backend: ``embree`` (CPU, robust mode), ``warp``
    (CPU and CUDA), or ``auto``: Embree on the CPU, where it is about 3 times faster than Warp on incoherent rays, and
    Warp on CUDA.  :meth:`refit` updates moved vertices.  For vertex gradients, pass ``vertices`` to :meth:`intersect`.
    Raises TypeError for a wrong type or dtype; ValueError for a wrong shape, an index out of range, non-finite
    vertices, or ``embree`` on CUDA.

    >>> scene = reli3d.RayScene(mesh)
    >>> hits = scene.intersect(origins, directions, vertices=mesh.vertices)
    """

    vertices: Tensor  # (V, 3), a copy

    def __init__(self, mesh: Mesh | Tensor, faces: Tensor | None = None, *, backend: str = "auto"):
        if backend not in BACKENDS:
            raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend}")
        if isinstance(mesh, Mesh) and faces is not None:
            raise TypeError("faces: expected None with a mesh, got faces")
        if isinstance(mesh, Tensor) and faces is None:
            raise TypeError("faces: expected a tensor with vertices, got None")
        if faces is None:
            expect("mesh", mesh, Mesh)
        vertices, faces = (mesh.vertices, mesh.faces) if isinstance(mesh, Mesh) else (mesh, faces)
        vertices, faces = tensor_of(vertices), tensor_of(faces, torch.int32)
        check("faces", faces, shape=("F", 3), dtype=torch.int32)
        self.faces = faces.detach().clone().contiguous()
        self.device = faces.device
        if backend == "auto":
            backend = "embree" if self.device.type == "cpu" else "warp"
        if backend == "embree" and self.device.type != "cpu":
            raise ValueError(f"backend: expected warp on {self.device}, got embree, which runs on CPU only")
        self.backend = backend
        self._embree: embree.Tree | None = None
        self._warp: wp.Mesh | None = None
        self._set_vertices(vertices)
        self._build()

    def refit(self, vertices: Tensor) -> None:
        """Replaces the vertex positions ``(V, 3)``; the faces stay.

        Warp refits the bounding boxes, which slows down traversal after large motion; Embree rebuilds.  Raises the
        errors of the constructor; the scene is then unchanged.
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

    def intersect(
        self,
        origins: Tensor,
        directions: Tensor,
        *,
        vertices: Tensor | None = None,
        t_max: Tensor | float = float("inf"),
    ) -> Hits:
        """First hit of every ray, differentiable in the rays and in ``vertices``.

        origins, directions: ``(..., 3)`` float32, broadcast; ``t`` is in units of the length of ``directions``.
        vertices: ``(V, 3)``, receives gradients, equal to the scene's (see :meth:`refit`).  t_max: a number or
        ``(...)``, exclusive.  A miss has ``face = -1``, ``t = inf``, ``bary = 0``, gradient 0.

        The choice of the face has no gradient: silhouettes need :func:`reli3d.antialias`.  ``origins + t * directions``
        is the most accurate position.  Raises TypeError for a wrong dtype; ValueError for a wrong shape or device, or
        other ``vertices``.  Source: Moller and Trumbore 1997, in float64.

        >>> hits = scene.intersect(origins, directions, vertices=v)
        >>> points = origins[hits.valid] + hits.t[hits.valid][:, None] * directions[hits.valid]
        """
        if vertices is None:
            vertices = self.vertices
        else:
            check("vertices", vertices, shape=self.vertices.shape, like=self.faces)
            if not torch.equal(vertices.detach(), self.vertices):
                raise ValueError(
                    "vertices: expected the positions of the scene, got others; call refit(vertices) first"
                )
        hits = self.closest(origins, directions, t_max=t_max)
        origins, directions = tensor_of(origins), tensor_of(directions)
        return evaluate_hits(vertices, self.faces, hits, origins, directions)

    def closest(self, origins: Tensor, directions: Tensor, *, t_max: Tensor | float = float("inf")) -> Hits:
        """First hit of every ray ``(..., 3)``, without gradient; ``t_max`` a number or ``(...)``."""
        shape, o, d, far = self._rays(origins, directions, t_max)
        n = o.shape[0]
        face, t, bary = (empty((n,), kind, self.device) for kind in (wp.int32, wp.float32, wp.vec2))
        if self._embree is not None:
            self._trace(embree_kernels.embree_closest_kernel, "rtcIntersect1", o, d, far, [face, t, bary])
        elif self._warp is not None:
            launch(kernels.closest_kernel, n, [self._warp.id, o, d, far, face, t, bary], self.device)
        else:
            face.fill_(-1), t.fill_(torch.inf), bary.zero_()
        return Hits(face.reshape(shape), t.reshape(shape), bary.reshape(*shape, 2))

    def occluded(self, origins: Tensor, directions: Tensor, *, t_max: Tensor | float = float("inf")) -> Tensor:
        """Whether each ray hits anything before ``t_max``, ``(...)`` bool; arguments as in :meth:`closest`."""
        shape, o, d, far = self._rays(origins, directions, t_max)
        out = torch.zeros(o.shape[0], dtype=torch.bool, device=self.device)
        if self._embree is not None:
            self._trace(embree_kernels.embree_occluded_kernel, "rtcOccluded1", o, d, far, [out])
        elif self._warp is not None:
            launch(kernels.occluded_kernel, o.shape[0], [self._warp.id, o, d, far, out], self.device)
        return out.reshape(shape)

    def unoccluded(self, origins: Tensor, directions: Tensor, t_max: Tensor) -> Tensor:
        """Whether a ray hits nothing before its ``t_max``, ``(N,)`` bool; False for ``t_max`` below 0.

        Meant for rays generated by a kernel.  origins, directions: ``(N, 3)``, t_max: ``(N,)``, float32 on the scene's
        device; values are not checked.  Neighboring rays should have nearby origins.
        """
        if self._embree is None:
            return (t_max >= 0.0) & ~self.occluded(origins, directions, t_max=t_max)
        left, group = t_max.clone(memory_format=torch.contiguous_format), embree_kernels.GROUP
        args = [embree.query("rtcOccluded16"), self._embree.scene, origins.contiguous(), directions.contiguous(), left]
        kernel, count = embree_kernels.embree_unoccluded_kernel, -(-len(left) // group)
        launch(kernel, count, args, self.device, slice_min=SLICE_RAYS // group)
        return left >= 0.0

    @property
    def mesh_id(self) -> int:
        """Handle of Warp's mesh for kernels that trace rays themselves; 0 without faces or with Embree."""
        return 0 if self._warp is None else self._warp.id

    @property
    def embree_scene(self) -> int:
        """Handle of Embree's scene for kernels that trace rays themselves; 0 without faces or with Warp."""
        return 0 if self._embree is None else self._embree.scene

    def _set_vertices(self, vertices: Tensor) -> None:
        """Keep a copy, once all checks have passed."""
        check("vertices", vertices, like=self.faces)
        check_topology(vertices, self.faces)
        cells, scale = (wp.vec3(), wp.vec3()), 0.0
        if vertices.numel():
            low, high = vertices.detach().amin(0), vertices.detach().amax(0)
            scale = float(torch.maximum(low.abs(), high.abs()).max())
            if not scale < float("inf"):
                raise ValueError("vertices: expected finite coordinates, got NaN or infinity")
            cells = wp.vec3(*low.tolist()), wp.vec3(*(4.0 / (high - low).clamp(min=1e-30)).tolist())
        self.vertices = vertices.detach().clone().contiguous()
        self._cells = cells  # lower corner of the mesh, and quarters of its box per unit
        self.scale = scale  # largest coordinate of the mesh: the step off a face is a multiple of it

    def __reduce__(self):  # copies and pickles build their own structure: it holds pointers
        return partial(RayScene, backend=self.backend), (self.vertices, self.faces)

    def _build(self) -> None:
        if len(self.faces) and self.backend == "embree":
            self._embree = embree.Tree(self.vertices.numpy(), self.faces.numpy())
        elif len(self.faces):
            self._warp = warp_mesh(self.vertices, self.faces)

    def _rays(self, origins, directions, t_max):
        origins, directions = tensor_of(origins), tensor_of(directions)
        check("origins", origins, last=3, like=self.faces)
        check("directions", directions, last=3, like=self.faces)
        if isinstance(t_max, Tensor):
            check("t_max", t_max, like=self.faces)
            far = t_max.detach()
        else:
            far = torch.tensor(float(t_max), device=self.device, dtype=torch.float32)
        try:
            shape = np.broadcast_shapes(origins.shape[:-1], directions.shape[:-1], far.shape)
        except ValueError:
            got = ", ".join(str(tuple(t.shape)) for t in (origins, directions, far))
            raise ValueError(f"origins, directions, t_max: expected shapes that broadcast, got {got}") from None
        o = origins.detach().expand(*shape, 3).reshape(-1, 3).contiguous()
        d = directions.detach().expand(*shape, 3).reshape(-1, 3).contiguous()
        far = far.reshape(1) if far.numel() == 1 else far.expand(shape).reshape(-1).contiguous()
        return shape, o, d, far

    def _trace(self, kernel, query: str, o: Tensor, d: Tensor, far: Tensor, outs: list) -> None:
        """Embree's ``query`` of all rays, those of a slice in the order that brings like rays together."""
        address, n = embree.query(query), o.shape[0]

        def work(_, start, count):
            part = slice(start, start + count)
            rays, answers = [o[part], d[part], far if far.numel() == 1 else far[part]], [v[part] for v in outs]
            order, found = self._order(*rays[:2]), answers
            if order is not None:  # numpy's take and its assignment: torch's take 4 times as long
                rays = [v if len(v) == 1 else torch.from_numpy(np.take(v.numpy(), order, 0, mode="clip")) for v in rays]
                found = [torch.empty_like(v) for v in answers]
            launch(kernel, count, [address, self.embree_scene, *rays, *found], o.device, slice_min=count)
            if order is not None:
                for answer, v in zip(answers, found, strict=True):
                    _items(answer)[order] = _items(v)

        if n:
            over_slices(n, work, slice_min=max(SLICE_RAYS, n // (THREAD_SLICES * torch.get_num_threads())))

    def _order(self, o: Tensor, d: Tensor) -> np.ndarray | None:
        """Permutation that brings like rays together, for the cache; None for few rays or ones in such an order."""
        n = o.shape[0]
        if n < SLICE_RAYS:
            return None
        key = empty((n,), wp.int16, o.device)
        args = [o, d, *self._cells, key]
        launch(embree_kernels.ray_key_kernel, -(-n // embree_kernels.RUN), args, o.device, slice_min=n)
        keys = key.numpy()
        if np.count_nonzero(keys[1:] != keys[:-1]) < 0.5 * n:
            return None
        return np.argsort(keys, kind="stable")  # a radix sort for 16 bits


def warp_mesh(vertices: Tensor, faces: Tensor) -> wp.Mesh:
    """Warp's structure on the memory of contiguous ``vertices (V, 3)`` and ``faces (F, 3)``."""
    with stream(vertices.device):
        return wp.Mesh(points=array_of(vertices, wp.vec3), indices=array_of(faces.reshape(-1), wp.int32))


def _items(values: Tensor) -> np.ndarray:
    """``(N,)`` unchanged, ``(N, 2)`` float32 as ``(N,)`` of eight bytes, which numpy copies about 4 times faster."""
    return values.numpy() if values.ndim == 1 else values.view(torch.float64)[:, 0].numpy()
