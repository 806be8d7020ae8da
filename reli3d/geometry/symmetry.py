"""Vertical mirror plane of an object from silhouettes; with it, each view also shows the mirrored half.

If the object is mirror-symmetric, the silhouettes and their mirror images are consistent: the visual hull of both sets
still covers every silhouette.  With a wrong plane, the mirrored silhouettes carve away parts that some view shows.  The
residual is the silhouette coherence of Hernandez, Schmitt and Cipolla 2007, Silhouette Coherence for Camera Calibration
under Circular Motion, here as a function of a plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from reli3d._bridge import check, full_precision
from reli3d.geometry.camera import Camera, check_camera
from reli3d.geometry.hull import hull_distance, hull_span, mirror_residual

# Lengths are fractions of the longest side of the hull's bounding box unless noted.
RAYS, DEPTHS = 96, 16  # rays per view, and points along each, at which hulls are compared
RIM_RAYS = 128  # per view, in the fine search
RIM_PIXELS = 2.0  # width of the band inside the silhouette from which they are taken: its rays determine the plane
ANGLES, OFFSETS = 60, 7  # planes of the coarse search
MAX_OFFSET = 0.06  # of the plane from the hull's center
FINE_STEPS = 7  # angles and offsets of the fine search
FINE_HALF_WIDTHS = 1.0, 0.35  # of the successive fine searches, in coarse steps, around the mean of the best planes
LOST_RESIDUAL = 0.01  # a pixel whose ray has a larger residual is lost
MAX_LOST_FRACTION = 0.008  # of the pixels: one-sided parts would be cut off
SIMILAR_RESIDUAL = 3e-4  # planes whose mean residual is within this of the best are candidates
EQUAL_RESIDUAL = 6e-5  # planes within this are equal; the one with the most novel views is chosen
MAX_CANDIDATES = 0.03, 0.5  # fraction of the planes: per squared number of views, and overall
MAX_MEAN_DIRECTION = 0.75  # length of the mean horizontal view direction: one-sided captures are ambiguous
MAX_UNKNOWN_FRACTION = 0.05  # of rays without a point in the hull: more means inconsistent masks and cameras
REVOLUTION_FRACTION = 0.95  # of planes that are candidates, from which the object is a solid of revolution
MIN_VIEWS = 3  # two silhouettes are consistent with many planes
MAX_OBJECT_DISTANCE = 50.0  # of the object from the cameras' centroid, in their greatest distance from it
MAX_RESIDUAL = 0.1  # clamp on the residual of a ray
MAX_ROLL = 0.17  # rms roll of the cameras about their axes [rad]: more leaves the vertical undefined
MIN_AXIS_SINE = 0.2  # rms sine between the cameras' horizontal axes: less leaves the vertical undefined


@dataclass(frozen=True)
class MirrorPlane:
    """The points ``x`` with ``normal . x = offset``; ``normal (3,)`` unit, ``offset`` in the world's unit."""

    normal: Tensor
    offset: float

    @full_precision
    def mirrored(self, camera: Camera) -> Camera:
        """Mirrored cameras ``(V,)``: they image the mirrored object as ``camera`` the object, flipped left to right."""
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
    """Vertical mirror plane of the object in V views, or None if there is none or it is ambiguous.

    distance: ``(V, H, W)`` from :func:`~reli3d.geometry.hull.mask_distance`, of silhouettes that do not touch the image
    border.  camera: a batch of these views, in any frame and unit.  None for one or two views; for cameras that are
    rolled, at one position or all on one side; if no plane is consistent with the silhouettes; and if many are, unless
    nearly all are (a solid of revolution).  Asymmetry invisible in the silhouettes is not detected.  No gradient.
    Raises TypeError for a wrong dtype, ValueError for a wrong shape or device.
    """
    check("distance", distance)
    check_camera(camera, like=distance, views=len(distance), size=distance.shape[1:])
    up = upright(camera) if len(distance) >= MIN_VIEWS else None
    if up is None:
        return None
    shift = camera.position.mean(0)
    unit = (camera.position - shift).norm(dim=1).max()
    if float(unit) <= 1e-6 * float(shift.norm()):  # all cameras at one position
        return None
    c2w = camera.c2w.clone()
    c2w[:, :3, 3] = (camera.position - shift) / unit
    camera = Camera(c2w, camera.intrinsics, camera.width, camera.height)
    points, known = _hull_points(distance, camera, distance > 0.5, RAYS)
    inside, seen = points[known], known.any(1)
    if len(inside) == 0 or float(seen.float().mean()) < 1.0 - MAX_UNKNOWN_FRACTION:
        return None
    whole = points[seen], known[seen]
    low, high = inside.aminmax(dim=0)
    center, size = (low + high) / 2, float((high - low).max())
    views = functional.normalize(camera.position - center, dim=1)
    if float(functional.normalize(views - (views @ up)[:, None] * up, dim=1).mean(0).norm()) > MAX_MEAN_DIRECTION:
        return None
    first = functional.normalize(
        torch.linalg.cross(up, torch.eye(3, device=up.device, dtype=torch.float32)[int(up.abs().argmin())]), dim=0
    )
    second = torch.linalg.cross(up, first)

    def residuals(angle: Tensor, offset: Tensor, ray_points: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Mean residual and fraction of lost pixels of the planes at these angles [rad] and offsets from the center."""
        normals = torch.outer(angle.cos(), first) + torch.outer(angle.sin(), second)
        away = normals @ center + size * offset
        residual = mirror_residual(*ray_points, normals, away, MAX_RESIDUAL * size, distance, camera) / size
        return residual.mean(1), (residual > LOST_RESIDUAL).float().mean(1)

    angles = torch.arange(ANGLES, device=up.device, dtype=torch.float32) * (math.pi / ANGLES)
    offsets = torch.linspace(-MAX_OFFSET, MAX_OFFSET, OFFSETS, device=up.device, dtype=torch.float32)
    coarse = whole[0][::3, ::3], whole[1][::3, ::3]
    residual, _ = residuals(angles.repeat_interleave(OFFSETS), offsets.repeat(ANGLES), coarse)
    residual = residual.view(ANGLES, OFFSETS)
    by_angle = residual.amin(1)
    candidates_fraction = float((by_angle < by_angle.min() + SIMILAR_RESIDUAL).float().mean())
    if min(MAX_CANDIDATES[0] * len(distance) ** 2, MAX_CANDIDATES[1]) < candidates_fraction < REVOLUTION_FRACTION:
        return None
    planes = torch.tensor(
        _middles((by_angle <= by_angle.min() + EQUAL_RESIDUAL).tolist()), device=up.device, dtype=torch.int64
    )
    normals = torch.outer(angles[planes].cos(), first) + torch.outer(angles[planes].sin(), second)
    best = int(planes[_novelty(normals, views).argmax()])
    equal = residual[best] <= residual[best].min() + EQUAL_RESIDUAL
    angle, offset = angles[best], offsets[equal].mean()
    around = torch.linspace(-1.0, 1.0, FINE_STEPS, device=up.device, dtype=torch.float32)
    points, known = _hull_points(distance, camera, (distance > 0.5) & (distance < RIM_PIXELS), RIM_RAYS)
    rim = (points[known.any(1)], known[known.any(1)]) if bool(known.any()) else whole
    for width in FINE_HALF_WIDTHS:
        fine_angles = (angle + width * math.pi / ANGLES * around).repeat_interleave(FINE_STEPS)
        fine_offsets = (offset + width * 2 * MAX_OFFSET / (OFFSETS - 1) * around).repeat(FINE_STEPS)
        residual, _ = residuals(fine_angles, fine_offsets, rim)
        equal = residual <= residual.min() + EQUAL_RESIDUAL
        angle, offset = fine_angles[equal].mean(), fine_offsets[equal].mean()
    if float(residuals(angle[None], offset[None], whole)[1]) > MAX_LOST_FRACTION:
        return None
    normal = angle.cos() * first + angle.sin() * second
    return MirrorPlane(normal, float(unit * (normal @ center + size * offset) + normal @ shift))


def _middles(good: list[bool]) -> list[int]:
    """Middle index of each cyclic run of true values; all indices if all are true."""
    count = len(good)
    if all(good):
        return list(range(count))
    found = []
    for begin in (k for k in range(count) if good[k] and not good[k - 1]):
        length = next(j for j in range(1, count) if not good[(begin + j) % count])
        found.append((begin + length // 2) % count)
    return found


def _novelty(normals: Tensor, directions: Tensor) -> Tensor:
    """Mean angle [rad] from each mirrored view direction to the nearest given one ``(V, 3)``, for P planes ``(P, 3)``.

    Opposite directions are identified, because their silhouettes are nearly equal.
    """
    mirrored = directions - 2.0 * (normals @ directions.T)[..., None] * normals[:, None]
    return (mirrored @ directions.T).abs().amax(-1).clamp(max=1.0).acos().mean(-1)


@full_precision
def upright(camera: Camera) -> Tensor | None:
    """Up direction ``(3,)`` orthogonal to the X axes of cameras without roll, or None if it is not determined."""
    right = camera.c2w[:, :3, 0]
    _, spread, axes = torch.linalg.svd(right / max(len(right), 1) ** 0.5, full_matrices=True)
    if len(right) < 2 or float(spread[1]) < MIN_AXIS_SINE or (len(right) > 2 and float(spread[2]) > MAX_ROLL):
        return None
    up = axes[-1]
    return up if float(up @ camera.c2w[:, :3, 1].sum(0)) > 0 else -up


def _hull_points(distance: Tensor, camera: Camera, pixels: Tensor, max_rays: int) -> tuple[Tensor, Tensor]:
    """Points ``(R, D, 3)`` along up to ``max_rays`` rays per view, and whether each lies in the hull ``(R, D)``.

    pixels: ``(V, H, W)`` bool, from which the rays are taken at equal intervals.
    """
    places: list[Tensor] = []
    for number, inside in enumerate(pixels):
        found = inside.nonzero()
        every = torch.linspace(
            0, max(len(found) - 1, 0), min(max_rays, len(found)), device=found.device, dtype=torch.float32
        ).long()
        places.append(functional.pad(found[every], (1, 0), value=number))
    view, row, column = torch.cat(places).unbind(1)
    fx, fy, cx, cy = camera.intrinsics[view].unbind(1)
    x, y = column.to(cx.dtype) + 0.5, row.to(cy.dtype) + 0.5
    local = torch.stack([(x - cx) / fx, -(y - cy) / fy, -torch.ones_like(fx)], 1)
    direction = functional.normalize((camera.c2w[view, :3, :3] @ local[..., None])[..., 0], dim=1)
    origin = camera.position[view].contiguous()
    span = hull_span(origin, direction, MAX_OBJECT_DISTANCE, distance, camera)
    fraction = (torch.arange(DEPTHS, device=origin.device, dtype=torch.float32) + 0.5) / DEPTHS
    depth = torch.lerp(span[:, :1], span[:, 1:], fraction)
    points = origin[:, None] + direction[:, None] * depth[..., None]
    within = hull_distance(points.reshape(-1, 3), distance, camera).view(depth.shape)
    pixel = (points - origin[:, None]).norm(dim=2).mean() / camera.intrinsics[:, 0].mean()
    return points, within > -pixel
