"""Constructive solid geometry of procedural objects: solids with part numbers, their union, cuts and deformations."""

from collections.abc import Callable, Sequence

import numpy as np
from manifold3d import Manifold, Mesh, OpType

ON_BACK = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # the top to -z
ON_SIDE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # the top to -x
MIN_PIECE_FRACTION = 2e-3  # of the volume; smaller disconnected pieces are removed


class Assembly:
    """The union of added solids minus the cuts; every part has a role, from which its material is drawn.

    Roles: ``wood metal plastic paint fabric leather ceramic stone skin rubber accent any``.
    """

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self.roles: list[str] = []
        self._solids: list[Manifold] = []
        self._part_of: dict[int, int] = {}

    def part(self, role: str) -> int:
        """Number of a new part."""
        self.roles.append(role)
        return len(self.roles) - 1

    def random_part(self, *roles: str, p: Sequence[float] | None = None) -> int:
        """Number of a new part of one of ``roles``, with the probabilities ``p`` (default: equal)."""
        return self.part(str(self.rng.choice(roles, p=p)))

    def add(self, solid: Manifold, part: int, at: Sequence[float] | np.ndarray | None = None) -> None:
        self._solids.append(self._tagged(solid, part, at))

    def add_labeled(self, vertices: np.ndarray, faces: np.ndarray, part: np.ndarray) -> None:
        """Adds a closed mesh ``(V, 3)``, ``(F, 3)`` with the part ``(F,)`` of each face."""
        order = np.argsort(part, kind="stable")
        numbers, starts = np.unique(part[order], return_index=True)
        first = Manifold.reserve_ids(len(numbers))
        self._part_of.update({first + k: int(n) for k, n in enumerate(numbers)})
        mesh = Mesh(
            np.array(vertices, dtype=np.float32, order="C"),
            np.array(faces[order], dtype=np.uint32, order="C"),
            run_index=np.append(starts, len(faces)).astype(np.uint32) * 3,
            run_original_id=np.arange(first, first + len(numbers), dtype=np.uint32),
        )
        self._solids.append(Manifold(mesh))

    def cut(self, solid: Manifold, part: int, at: Sequence[float] | np.ndarray | None = None) -> None:
        """Subtracts ``solid`` from all that has been added so far; the cut faces belong to ``part``."""
        self._solids = [self.joined() - self._tagged(solid, part, at)]

    def keep_inside(self, solid: Manifold, part: int) -> None:
        """Intersects all that has been added so far with ``solid``; the cut faces belong to ``part``."""
        self._solids = [self.joined() ^ self._tagged(solid, part, None)]

    def transform(self, matrix: np.ndarray) -> None:
        """Applies the linear map ``(3, 3)`` to all that has been added so far."""
        affine = np.concatenate([np.asarray(matrix, dtype=float), np.zeros((3, 1))], 1)
        self._solids = [s.transform(affine) for s in self._solids]

    def warp(self, move: Callable[[np.ndarray], np.ndarray], edge: float) -> None:
        """Maps the vertices ``(N, 3)`` of the union by ``move`` after splitting edges longer than ``edge``."""
        self._solids = [self.joined().refine_to_length(edge).warp_batch(move)]

    def add_corners(self, solid: Manifold, part: int, x: float, y: float, z: float) -> None:
        """Adds ``solid`` at the four points ``(x, y, z)``, ``x`` and ``z`` with either sign."""
        for at in ((-x, y, -z), (-x, y, z), (x, y, -z), (x, y, z)):
            self.add(solid, part, at)

    def copy_turned(self, solid: Manifold, part: int, count: int) -> None:
        """Adds ``count`` copies of ``solid``, rotated by multiples of ``360 / count`` degrees about +Y."""
        for k in range(count):
            self.add(solid.rotate((0.0, 360.0 * k / count, 0.0)), part)

    def joined(self) -> Manifold:
        if not self._solids:
            raise ValueError("assembly: expected at least one solid, got none")
        solid = self._solids[0] if len(self._solids) == 1 else Manifold.batch_boolean(self._solids, OpType.Add)
        self._solids = [solid]
        return solid

    def solid_fraction(self) -> float:
        """Volume divided by the cube of the longest side; 0 for an empty solid."""
        solid = self.joined()
        return 0.0 if solid.num_tri() == 0 else solid.volume() / _longest_side(solid) ** 3

    def finish(self, max_faces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices ``(V, 3)`` float64, faces ``(F, 3)`` and part ``(F,)`` of each face of the union.

        Without small disconnected pieces, simplified to at most ``max_faces``.  Raises ValueError if nothing remains.
        """
        solid = self.joined()
        pieces = solid.decompose()
        if len(pieces) > 1:
            volume = np.array([p.volume() for p in pieces])
            solid = Manifold.compose([p for p, v in zip(pieces, volume) if v > MIN_PIECE_FRACTION * volume.sum()])
        if solid.num_tri() == 0 or solid.volume() <= 0:
            raise ValueError("assembly: expected a solid, got nothing after the cuts")
        tolerance = 2e-4 * _longest_side(solid)
        while solid.num_tri() > max_faces:
            solid = solid.simplify(tolerance)
            tolerance *= 1.6
        mesh = solid.to_mesh64()
        part = np.empty(len(mesh.tri_verts), dtype=np.int32)
        starts = np.asarray(mesh.run_index) // 3
        for k, original in enumerate(mesh.run_original_id):
            part[starts[k] : starts[k + 1]] = self._part_of[int(original)]
        vertices = np.asarray(mesh.vert_properties)[:, :3]
        return vertices, np.asarray(mesh.tri_verts).astype(np.int32), part

    def _tagged(self, solid: Manifold, part: int, at: Sequence[float] | np.ndarray | None) -> Manifold:
        solid = (solid if at is None else solid.translate(tuple(map(float, at)))).as_original()
        self._part_of[solid.original_id()] = part
        return solid


def _longest_side(solid: Manifold) -> float:
    box = np.array(solid.bounding_box()).reshape(2, 3)
    return float((box[1] - box[0]).max())
