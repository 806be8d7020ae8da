"""Visual hull of an object from the masks of posed images, as a signed distance that is positive inside."""

import math

import torch
from torch import Tensor

from reli3d._bridge import check, launch, struct_of
from reli3d.geometry.camera import Camera, check_camera
from reli3d.kernels import hull as kernels


def mask_distance(masks: Tensor) -> Tensor:
    """Signed distance ``(V, H, W)`` [pixels] from every pixel center to the mask's contour, positive inside.

    masks: ``(V, H, W)`` float32 coverage in [0, 1].  The contour is the 0.5 isoline of the mask, bilinear between pixel
    centers, as straight segments (marching squares).  The distance is exact near the contour; far from it, the distance
    can be a fraction of a pixel too long, because only segments around the nearest crossing are evaluated.  The image
    border is not a contour: a mask that touches the border continues outside.  In a view without contour, the distance
    is plus or minus the image diagonal everywhere.  No gradient.
    """
    check("masks", masks)
    if masks.ndim != 3 or min(masks.shape[1:]) < 2 or max(masks.shape[1:]) > 8192:
        raise ValueError(f"masks: expected shape (V, H, W) with H and W in [2, 8192], got {tuple(masks.shape)}")
    masks = masks.detach().contiguous()
    views, height, width = masks.shape
    if views and not (bool((masks >= 0).all()) and bool((masks <= 1).all())):
        raise ValueError("masks: expected values in [0, 1], got others")
    distance = torch.empty_like(masks)
    crossings = *_nearest_crossing(masks), *_nearest_crossing(masks.transpose(1, 2).contiguous())
    inputs = [masks, *crossings, math.hypot(height, width), distance]
    launch(kernels.mask_distance_kernel, masks.numel(), inputs, masks.device)
    return distance


def _nearest_crossing(masks: Tensor) -> list:
    """Kernel arguments: the nearest contour crossing in each pixel's column, and the column of the nearest crossing."""
    views, height, width = masks.shape
    rows, begin = torch.empty_like(masks), torch.empty_like(masks)
    apex, nearest = (torch.empty_like(masks, dtype=torch.int32) for _ in range(2))
    launch(kernels.column_kernel, views * width, [masks, rows], masks.device)
    launch(kernels.row_kernel, views * height, [rows, apex, begin, nearest], masks.device)
    return [rows, nearest]


def hull_distance(points: Tensor, distance: Tensor, camera: Camera, *, far: float = math.inf) -> Tensor:
    """Signed distance ``(N,)`` of points to the visual hull, world units, positive inside: the minimum over the views.

    points: ``(N, 3)``.  distance: ``(V, H, W)`` from :func:`mask_distance`.  camera: a batch of these V views.  A
    view's distance is the pixel distance at the point's projection times depth / focal length, too large by a factor of
    up to 1 / cos^2 of the angle to the optical axis.  Outside the image, the border value counts: silhouettes cut off
    there are unbounded.  Points at or behind a camera's plane get -1000; without views, all get +1000.  far: world
    units, at least 0, else ValueError; points farther outside may get any value below ``-far``, which saves time.  No
    gradient.
    """
    check("points", points, shape=("N", 3))
    views = _views(points, distance, camera)
    if not far >= 0.0:
        raise ValueError(f"far: expected at least 0, got {far}")
    hull = torch.empty(len(points), device=points.device, dtype=torch.float32)
    launch(kernels.hull_distance_kernel, len(points), [points.detach().contiguous(), views, far, hull], points.device)
    return hull


def hull_grid(axis: Tensor, distance: Tensor, camera: Camera, *, far: float = math.inf) -> Tensor:
    """:func:`hull_distance` on the grid ``(axis[i], axis[j], axis[k])``, ``(n, n, n)``, for ``axis (n,)``."""
    check("axis", axis, shape=("n",))
    return hull_distance(torch.cartesian_prod(axis, axis, axis), distance, camera, far=far).view(*[len(axis)] * 3)


def mirror_residual(
    points: Tensor, known: Tensor, normal: Tensor, offset: Tensor, most: float, distance: Tensor, camera: Camera
) -> Tensor:
    """Least distance ``(P, R)`` outside the visual hull over the mirrored points of each ray, clamped to ``most``.

    points: ``(R, D, 3)``, D points along each ray.  known: ``(R, D)`` bool, the points to use; a ray without such
    points gets ``most``.  normal: ``(P, 3)`` unit, offset: ``(P,)``: P planes.  most: at least 0, world units, else
    ValueError.  The other arguments are those of :func:`hull_distance`.  No gradient.
    """
    check("points", points, last=3)
    check("normal", normal, last=3, like=points)
    check("offset", offset, like=points)
    check("known", known, like=points, dtype=torch.bool)
    if points.ndim != 3 or known.shape != points.shape[:2]:
        raise ValueError(
            f"points, known: expected (R, D, 3) and (R, D), got {tuple(points.shape)}, {tuple(known.shape)}"
        )
    if normal.ndim != 2 or tuple(offset.shape) != normal.shape[:1]:
        raise ValueError(f"normal, offset: expected (P, 3) and (P,), got {tuple(normal.shape)}, {tuple(offset.shape)}")
    if not most >= 0.0:
        raise ValueError(f"most: expected at least 0, got {most}")
    views = _views(points, distance, camera)
    residual = points.new_empty(len(normal), len(points))
    arrays = [v.detach().contiguous() for v in (points, known, normal, offset)]
    inputs = [*arrays, float(most), views, residual]
    launch(kernels.mirror_residual_kernel, residual.numel(), inputs, points.device)
    return residual


def hull_span(origins: Tensor, directions: Tensor, radius: float, distance: Tensor, camera: Camera) -> Tensor:
    """Ray parameters ``(N, 2)`` of the first entry into the visual hull and the last exit.

    origins, directions: ``(N, 3)``, directions nonzero, of any length.  radius: radius of the sphere around the world
    origin to which the hull is clipped.  The other arguments are those of :func:`hull_distance`.  For a ray that misses
    the hull, both are the parameter of the closest approach.  Parts thinner than 0.004 along the ray may be missed.  No
    gradient.  Source: sphere tracing of Hart 1996.
    """
    check("origins", origins, last=3)
    check("directions", directions, last=3, like=origins)
    if origins.ndim != 2 or origins.shape != directions.shape:
        shapes = f"{tuple(origins.shape)} and {tuple(directions.shape)}"
        raise ValueError(f"origins, directions: expected (N, 3) both, got {shapes}")
    if not 0.0 < radius < 100.0:
        raise ValueError(f"radius: expected between 0 and 100, got {radius}")
    views = _views(origins, distance, camera)
    span = torch.empty(len(origins), 2, device=origins.device, dtype=torch.float32)
    rays = [v.detach().contiguous() for v in (origins, directions)]
    launch(kernels.hull_span_kernel, len(origins), [*rays, float(radius), views, span], origins.device)
    return span


def _views(points: Tensor, distance: Tensor, camera: Camera) -> kernels.Views:
    """The views, checked."""
    check("distance", distance, like=points)
    if distance.ndim != 3 or min(distance.shape[1:]) < 2:
        raise ValueError(f"distance: expected shape (V, H, W) with H and W above 1, got {tuple(distance.shape)}")
    check_camera(camera, like=points, views=len(distance), size=distance.shape[1:])
    arrays = {"distance": distance, "c2w": camera.c2w, "intrinsics": camera.intrinsics}
    return struct_of(kernels.Views, **{name: value.detach().contiguous() for name, value in arrays.items()})
