"""The upright mirror plane of an object, found from its silhouettes: each view then shows the other half, too.

If an object is its own mirror image, its silhouettes and their mirror images are silhouettes of one thing, and their
common visual hull still fills every one of them.  Under a wrong plane the mirrored silhouettes cut away what some view
shows.  The amount is the silhouette coherence of Hernandez, Schmitt and Cipolla 2007, Silhouette Coherence for Camera
Calibration under Circular Motion, here a function of a plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from reli3d._bridge import check, full_precision
from reli3d.geometry.camera import Camera, check_camera
from reli3d.geometry.hull import hull_distance, hull_span, mirror_miss

RAYS, DEPTHS = 96, 16  # rays of a view, and points along each, at which hulls are compared
ANGLES, OFFSETS = 60, 7  # planes of the first search
OFFSET_MAX = 0.06  # greatest offset of the plane from the hull's centre, of the hull's longest side
FINER = 9  # angles and offsets of the second search, within one step of the first
LOST = 0.01  # of the longest side: a pixel whose ray misses the common hull by more is lost
MOST_LOST = 0.008  # share of the pixels that may be lost: a part that is on one side alone would be cut off
AS_GOOD = 3e-4  # mean miss, of the longest side, by which another plane may be worse and still be as good
EQUAL = 6e-5  # mean miss by which planes count as equal: of them the one that shows most is taken
AMBIGUOUS = 0.03, 0.5  # share of the planes that may be as good: times the square of the number of views; at most
ONE_SIDED = 0.75  # length of the mean of the level view directions: from one side many things look symmetric
UNKNOWN = 0.05  # share of the rays that may have no point in the hull: else masks and cameras do not agree
ROUND = 0.95  # share of the planes from which on the object is one of revolution
FEWEST = 3  # views: two silhouettes agree with many planes
FARTHEST = 50.0  # from the middle of the cameras, in their greatest distance from it: farther off there is no object
FAR = 0.1  # of the longest side: rays that miss by more count as much
ROLL = 0.17  # root mean square [rad] by which cameras may be rolled about their axes: else there is no upright
APART = 0.2  # rms sine between the cameras' horizontal axes, below which nothing tells what is upright


@dataclass(frozen=True)
class MirrorPlane:
    """The points ``x`` with ``normal . x = offset``; ``normal (3,)`` unit, ``offset`` in the world's unit."""

    normal: Tensor
    offset: float

    @full_precision
    def mirrored(self, camera: Camera) -> Camera:
        """Cameras ``(V,)`` whose pictures of the object are those of ``camera (V,)`` with the columns reversed."""
        flip = torch.eye(4, device=camera.c2w.device, dtype=torch.float32)
        flip[:3, :3] -= 2.0 * torch.outer(self.normal, self.normal)
        flip[:3, 3] = 2.0 * self.offset * self.normal
        c2w = flip @ camera.c2w
        c2w = torch.cat([-c2w[..., :1], c2w[..., 1:]], -1)  # right-handed again
        fx, fy, cx, cy = camera.intrinsics.unbind(-1)
        return Camera(c2w, torch.stack([fx, fy, camera.width - cx, cy], -1), camera.width, camera.height)


@torch.no_grad()
@full_precision
def mirror_plane(distance: Tensor, camera: Camera) -> MirrorPlane | None:
    """The upright plane in which the object of V views is its own mirror image, or None where none is sure.

    distance: ``(V, H, W)`` from :func:`~reli3d.geometry.hull.mask_distance`, of whole silhouettes.  camera: of these
    views; any frame and unit.  None for one or two views, for cameras that are rolled, in one place or on one side,
    where no plane lets the common hull fill the silhouettes, and where many do, so that the views do not tell which.
    Where nearly all do, the object is one of revolution.  An object that is not symmetric where no silhouette shows it
    may get a plane.  No gradient.  Raises TypeError or ValueError where shapes or devices disagree.
    """
    check("distance", distance)
    check_camera(camera, like=distance, views=len(distance), size=distance.shape[1:])
    up = upright(camera) if len(distance) >= FEWEST else None
    if up is None:
        return None
    shift = camera.position.mean(0)
    unit = (camera.position - shift).norm(dim=1).max()
    if float(unit) <= 1e-6 * float(shift.norm()):  # all cameras are in one place
        return None
    c2w = camera.c2w.clone()
    c2w[:, :3, 3] = (camera.position - shift) / unit
    camera = Camera(c2w, camera.intrinsics, camera.width, camera.height)
    points, known = _hull_points(distance, camera)
    inside, seen = points[known], known.any(1)
    if len(inside) == 0 or float(seen.float().mean()) < 1.0 - UNKNOWN:
        return None
    points, known = points[seen], known[seen]
    low, high = inside.aminmax(dim=0)
    centre, size = (low + high) / 2, float((high - low).max())
    views = functional.normalize(camera.position - centre, dim=1)
    if float(functional.normalize(views - (views @ up)[:, None] * up, dim=1).mean(0).norm()) > ONE_SIDED:
        return None
    first = functional.normalize(
        torch.linalg.cross(up, torch.eye(3, device=up.device, dtype=torch.float32)[int(up.abs().argmin())]), dim=0
    )
    second = torch.linalg.cross(up, first)

    def misses(angle: Tensor, offset: Tensor, every: int = 1) -> tuple[Tensor, Tensor]:
        """Planes at these angles [rad] and offsets [sizes] from the centre: mean miss and share of lost pixels."""
        normals = torch.outer(angle.cos(), first) + torch.outer(angle.sin(), second)
        away = normals @ centre + size * offset
        some, within = points[::every, ::every], known[::every, ::every]
        miss = mirror_miss(some, within, normals, away, FAR * size, distance, camera) / size
        return miss.mean(1), (miss > LOST).float().mean(1)

    angles = torch.arange(ANGLES, device=up.device, dtype=torch.float32) * (math.pi / ANGLES)
    offsets = torch.linspace(-OFFSET_MAX, OFFSET_MAX, OFFSETS, device=up.device, dtype=torch.float32)
    miss, _ = misses(angles.repeat_interleave(OFFSETS), offsets.repeat(ANGLES), every=3)
    miss = miss.view(ANGLES, OFFSETS)
    by_angle = miss.amin(1)
    as_good = float((by_angle < by_angle.min() + AS_GOOD).float().mean())
    if min(AMBIGUOUS[0] * len(distance) ** 2, AMBIGUOUS[1]) < as_good < ROUND:
        return None
    planes = torch.tensor(_middles((by_angle <= by_angle.min() + EQUAL).tolist()), device=up.device, dtype=torch.int64)
    normals = torch.outer(angles[planes].cos(), first) + torch.outer(angles[planes].sin(), second)
    best = int(planes[_novelty(normals, views).argmax()])
    equal = miss[best] <= miss[best].min() + EQUAL
    around = torch.linspace(-1.0, 1.0, FINER, device=up.device, dtype=torch.float32)
    angle = (angles[best] + around * (math.pi / ANGLES)).repeat_interleave(FINER)
    offset = (offsets[equal].mean() + around * (2 * OFFSET_MAX / (OFFSETS - 1))).repeat(FINER)
    miss, _ = misses(angle, offset)
    alike = (miss <= miss.min() + EQUAL).nonzero()[:, 0]
    equally = torch.stack([angle[alike], offset[alike]], 1)
    middle = int(alike[(equally - equally.mean(0)).norm(dim=1).argmin()])
    angle, offset = angle[middle], offset[middle]
    if float(misses(angle[None], offset[None])[1]) > MOST_LOST:
        return None
    normal = angle.cos() * first + angle.sin() * second
    return MirrorPlane(normal, float(unit * (normal @ centre + size * offset) + normal @ shift))


def _middles(good: list[bool]) -> list[int]:
    """The middle index of each run of true values on a circle; every index where all are true."""
    count = len(good)
    if all(good):
        return list(range(count))
    found = []
    for begin in (k for k in range(count) if good[k] and not good[k - 1]):
        length = next(j for j in range(1, count) if not good[(begin + j) % count])
        found.append((begin + length // 2) % count)
    return found


def _novelty(normals: Tensor, directions: Tensor) -> Tensor:
    """Mean angle [rad] between the mirrored view directions and the nearest of the given ones ``(V, 3)``, for P planes
    ``(P, 3)``.  Views from opposite sides have nearly the same silhouette, so a direction counts as its opposite.
    """
    mirrored = directions - 2.0 * (normals @ directions.T)[..., None] * normals[:, None]
    return (mirrored @ directions.T).abs().amax(-1).clamp(max=1.0).acos().mean(-1)


@full_precision
def upright(camera: Camera) -> Tensor | None:
    """The direction ``(3,)`` that is up for cameras that are not rolled, or None: right angles to all their X axes."""
    right = camera.c2w[:, :3, 0]
    _, spread, axes = torch.linalg.svd(right / max(len(right), 1) ** 0.5, full_matrices=True)
    if len(right) < 2 or float(spread[1]) < APART or (len(right) > 2 and float(spread[2]) > ROLL):
        return None
    up = axes[-1]
    return up if float(up @ camera.c2w[:, :3, 1].sum(0)) > 0 else -up


def _hull_points(distance: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Points ``(R, D, 3)`` along rays of pixels inside the silhouettes, and which lie in the hull ``(R, D)``."""
    places: list[Tensor] = []
    for number, inside in enumerate(distance > 0.5):
        found = inside.nonzero()
        every = torch.linspace(
            0, max(len(found) - 1, 0), min(RAYS, len(found)), device=found.device, dtype=torch.float32
        ).long()
        places.append(functional.pad(found[every], (1, 0), value=number))
    view, row, column = torch.cat(places).unbind(1)
    fx, fy, cx, cy = camera.intrinsics[view].unbind(1)
    x, y = column.to(cx.dtype) + 0.5, row.to(cy.dtype) + 0.5
    local = torch.stack([(x - cx) / fx, -(y - cy) / fy, -torch.ones_like(fx)], 1)
    direction = functional.normalize((camera.c2w[view, :3, :3] @ local[..., None])[..., 0], dim=1)
    origin = camera.position[view].contiguous()
    span = hull_span(origin, direction, FARTHEST, distance, camera)
    share = (torch.arange(DEPTHS, device=origin.device, dtype=torch.float32) + 0.5) / DEPTHS
    depth = torch.lerp(span[:, :1], span[:, 1:], share)
    points = origin[:, None] + direction[:, None] * depth[..., None]
    within = hull_distance(points.reshape(-1, 3), distance, camera).view(depth.shape)
    pixel = (points - origin[:, None]).norm(dim=2).mean() / camera.intrinsics[:, 0].mean()
    return points, within > -pixel
