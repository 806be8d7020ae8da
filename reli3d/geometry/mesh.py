"""Triangle meshes: the mesh type, normals, components and the topology report.

Faces are counter-clockwise seen from outside.  Topology (components, report) refers to the *welded* mesh, in which
vertices at bit-identical positions are merged, because atlases and exporters split the vertices of a connected surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from reli3d._bridge import Movable, check, tensor_of
from reli3d.geometry.tangents import vertex_tangents
from reli3d.geometry.topology import edges_of, graph_components, weld_rows

NORMAL_MIN = 1.0e-20  # squared length of an area-weighted normal sum below which it counts as zero (ReLi3D release)
RELATIVE_NORMAL_MIN = 1.0e-12  # the same relative to the largest sum, which is the limit for small meshes


@dataclass(frozen=True)
class Mesh(Movable):
    """Triangle mesh on one device, with optional vertex attributes.

    vertices: ``(V, 3)`` float32.  faces: ``(F, 3)`` int32, counter-clockwise seen from outside.  normals: ``(V, 3)``
    unit.  uv: ``(V, 2)``, u right, v down, as glTF.  tangents: ``(V, 4)`` unit, w = +-1, bitangent = w cross(normal,
    tangent).  colors: ``(V, 3)`` linear factors of the base color.  NumPy arrays and other integer types are converted;
    float64, as in trimesh, must be rounded to float32 before.  Methods: ``.with_normals()``, ``.with_tangents()``.
    Gradients pass through.  Raises TypeError for a wrong dtype, ValueError for a wrong shape or device, or a face index
    out of range.

    >>> triangle = reli3d.Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
    >>> scene = reli3d.RayScene(triangle)
    """

    vertices: Tensor  # (V, 3) float32
    faces: Tensor  # (F, 3) int32, counter-clockwise seen from outside
    normals: Tensor | None = None  # (V, 3) unit
    uv: Tensor | None = None  # (V, 2) glTF: u right, v down
    tangents: Tensor | None = None  # (V, 4) unit, w = +-1: bitangent = w * cross(normal, tangent)
    colors: Tensor | None = None  # (V, 3) linear factors of the base color

    def __post_init__(self) -> None:
        for f in fields(self):
            kind = torch.int32 if f.name == "faces" else torch.float32
            object.__setattr__(self, f.name, tensor_of(getattr(self, f.name), kind))
        check_topology(self.vertices, self.faces)
        for name, last in (("normals", 3), ("uv", 2), ("tangents", 4), ("colors", 3)):
            value = getattr(self, name)
            if value is not None:
                check(name, value, shape=(len(self.vertices), last), like=self.vertices)

    def with_normals(self) -> "Mesh":
        """The same mesh with :func:`~reli3d.geometry.mesh.vertex_normals`."""
        return replace(self, normals=vertex_normals(self.vertices, self.faces))

    def with_tangents(self) -> "Mesh":
        """The same mesh with :func:`~reli3d.geometry.tangents.vertex_tangents`.  ValueError without normals or UV."""
        if self.normals is None:
            raise ValueError("mesh.normals: expected a tensor, got None (see Mesh.with_normals)")
        if self.uv is None:
            raise ValueError("mesh.uv: expected a tensor, got None (see unwrap)")
        return replace(self, tangents=vertex_tangents(self.vertices, self.faces, self.normals, self.uv))


@dataclass(frozen=True)
class MeshReport:
    """Result of :func:`report`.  Counts refer to the welded mesh; ``vertices`` and ``faces`` are as stored."""

    vertices: int
    faces: int
    degenerate_faces: int  # with two corners at one position; excluded from every other count
    welded_vertices: int = 0  # distinct positions used by a face
    components: int = 0  # connected through shared vertices
    euler: int = 0  # welded vertices - edges + faces
    boundary_edges: int = 0  # with one face
    nonmanifold_edges: int = 0  # with three or more faces
    flipped_edges: int = 0  # with two faces that traverse it in the same direction
    nonmanifold_vertices: int = 0  # whose faces form several fans
    watertight: bool = False  # has faces, and every edge has an even number of faces
    manifold: bool = True  # no non-manifold edge or vertex and no flipped edge; a border is allowed


def check_topology(vertices: Tensor, faces: Tensor) -> None:
    """Raises TypeError or ValueError for a wrong dtype, shape or device, or a face index out of range."""
    check("vertices", vertices, shape=("V", 3))
    check("faces", faces, shape=("F", 3), like=vertices, dtype=torch.int32)
    if faces.numel():
        low, high = (int(v) for v in torch.aminmax(faces))
        if low < 0 or high >= len(vertices):
            raise ValueError(f"faces: expected indices in [0, {len(vertices)}), got [{low}, {high}]")


def face_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Outward face normals ``(F, 3)`` of length twice the area (cross product of two sides).  Differentiable."""
    check_topology(vertices, faces)
    a, b, c = (vertices.index_select(0, faces[:, k]) for k in range(3))
    return torch.linalg.cross(b - a, c - a)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Area-weighted unit normals of the vertices, ``(V, 3)``; (0, 0, 1) without gradient where the sum vanishes.

    vertices: ``(V, 3)``.  faces: ``(F, 3)`` int32.  Gradients reach ``vertices``.  On the CPU, faces are summed in a
    fixed order.
    """
    per_face = face_normals(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in faces.long().T.contiguous():  # index_add is about 10 times slower with int32
        total = total.index_add(0, corner, per_face)
    square = (total * total).sum(-1, keepdim=True)
    largest = square.detach().nan_to_num(0.0).amax(0) if len(square) else square.new_zeros(1)
    least = (RELATIVE_NORMAL_MIN * largest).clamp(max=NORMAL_MIN)
    valid = square > least
    unit = total * torch.rsqrt(torch.where(valid, square, 1.0))
    return torch.where(valid, unit, unit.new_tensor([0.0, 0.0, 1.0]))


def weld(vertices: Tensor) -> tuple[Tensor, Tensor]:
    """``(first (W,), label (V,))`` int64: vertices at bitwise identical positions share a label.

    ``first`` is the lowest vertex index of each label; labels are numbered in the order of ``first``.  -0 equals +0.
    """
    check("vertices", vertices, last=3)
    first, label = weld_rows(vertices.detach().cpu().numpy())
    return torch.from_numpy(first).to(vertices.device), torch.from_numpy(label).to(vertices.device)


def welded_faces(mesh: Mesh, label: Tensor | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Faces over welded labels, and which of them are not degenerate.  label: of :func:`weld`, if known."""
    label = weld(mesh.vertices)[1] if label is None else label
    faces = label.cpu().numpy()[mesh.faces.cpu().numpy()].reshape(-1, 3)
    a, b, c = faces.T
    return faces, (a != b) & (b != c) & (c != a)


def face_components(mesh: Mesh) -> Tensor:
    """Component of every face, ``(F,)`` int64, numbered by lowest face; faces with a common position are connected."""
    faces, _ = welded_faces(mesh)
    if not len(faces):
        return torch.zeros(0, dtype=torch.int64, device=mesh.faces.device)
    n = int(faces.max()) + 1
    rows, cols = faces[:, [0, 1]].reshape(-1), faces[:, [1, 2]].reshape(-1)
    label = graph_components(rows, cols, n)
    _, first, inverse = np.unique(label[faces[:, 0]], return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return torch.from_numpy(rank[inverse].astype(np.int64)).to(mesh.faces.device)


def select_faces(mesh: Mesh, keep: Tensor) -> Mesh:
    """The faces where the boolean ``keep (F,)`` is True and their vertices, in their original order, with attributes.

    Gradients pass through the vertex attributes.
    """
    check("keep", keep, shape=(len(mesh.faces),), like=mesh.faces, dtype=torch.bool)
    faces = mesh.faces[keep]
    used = torch.zeros(len(mesh.vertices), dtype=torch.bool, device=faces.device)
    used[faces.reshape(-1).long()] = True
    new_index = torch.cumsum(used, 0, dtype=torch.int32) - 1
    rest = (None if v is None else v[used] for v in (mesh.normals, mesh.uv, mesh.tangents, mesh.colors))
    return Mesh(mesh.vertices[used], new_index[faces.long()].reshape(-1, 3), *rest)


def without_degenerate_faces(mesh: Mesh) -> Mesh:
    """``mesh`` without the faces that have two corners at one position; these corners become one vertex.

    For meshes without UV.  A closed mesh remains closed.  Gradients pass through the vertices.
    """
    first, label = weld(mesh.vertices)
    valid = torch.from_numpy(welded_faces(mesh, label)[1]).to(mesh.faces.device)
    if bool(valid.all()):
        return mesh
    merged = torch.arange(len(mesh.vertices), device=mesh.faces.device)
    corners = mesh.faces[~valid].reshape(-1).long()
    merged[corners] = first[label[corners]]
    return select_faces(replace(mesh, faces=merged[mesh.faces.long()].int()), valid)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """The concatenation of at least one mesh, with positions and faces only; face indices continue."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes])
    faces = [m.faces + int(s) for m, s in zip(meshes, starts)]
    return Mesh(torch.cat([m.vertices for m in meshes]), torch.cat(faces))


def largest_components(mesh: Mesh, min_fraction: float = 0.02) -> Mesh:
    """The components with at least ``min_fraction`` of all faces, and always the largest one.

    min_fraction in [0, 1].  A mesh without faces is returned unchanged.
    """
    if not 0.0 <= min_fraction <= 1.0:
        raise ValueError(f"min_fraction: expected a value in [0, 1], got {min_fraction}")
    if not len(mesh.faces):
        return mesh
    label = face_components(mesh)
    count = torch.bincount(label)
    keep = count >= min_fraction * len(label)
    keep[count.argmax()] = True
    return mesh if bool(keep.all()) else select_faces(mesh, keep[label])


def report(mesh: Mesh) -> MeshReport:
    """Topology of the welded mesh: borders, non-manifold edges and vertices, components and the Euler number."""
    faces, sound = welded_faces(mesh)
    degenerate = int((~sound).sum())
    faces = faces[sound]
    size = len(mesh.vertices), len(mesh.faces), degenerate
    if not len(faces):
        return MeshReport(*size)
    n = int(faces.max()) + 1
    edges = edges_of(faces)
    tail, head, valence = edges.tail, edges.head, edges.valence
    forward = np.add.reduceat((tail < head)[edges.order].astype(np.int64), edges.start)
    one, other = edges.of_valence(2)

    # corners around one vertex are one fan if they connect through edges with two faces
    after = np.arange(len(tail)) // 3 * 3 + (np.arange(len(tail)) + 1) % 3
    same = tail[one] == tail[other]
    join_a = np.concatenate([one, after[one]])
    join_b = np.concatenate([np.where(same, other, after[other]), np.where(same, after[other], other)])
    fan = graph_components(join_a, join_b, len(tail))
    fan_vertex = np.unique(fan.astype(np.int64) * n + tail) % n  # one entry for every fan
    fans = np.bincount(fan_vertex, minlength=n)
    used = fans > 0

    label = graph_components(tail, head, n)
    counts = {
        "welded_vertices": int(used.sum()),
        "components": len(np.unique(label[used])),
        "euler": int(used.sum()) - len(valence) + len(faces),
        "boundary_edges": int((valence == 1).sum()),
        "nonmanifold_edges": int((valence > 2).sum()),
        "flipped_edges": int(((valence == 2) & (forward != 1)).sum()),
        "nonmanifold_vertices": int((fans > 1).sum()),
    }
    manifold = not (counts["nonmanifold_edges"] or counts["flipped_edges"] or counts["nonmanifold_vertices"])
    return MeshReport(*size, **counts, watertight=bool((valence % 2 == 0).all()), manifold=manifold)


def watertight(mesh: Mesh) -> bool:
    """Whether the mesh has faces and every edge has an even number of them; only this field of :func:`report`."""
    faces, sound = welded_faces(mesh)
    return bool(sound.any() and (edges_of(faces[sound]).valence % 2 == 0).all())
