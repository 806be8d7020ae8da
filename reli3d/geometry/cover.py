"""Silhouette coverage: lowers a signed field along rays inside the silhouettes that miss the surface."""

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, max_pool3d

from reli3d._bridge import check, launch
from reli3d.geometry.camera import Camera, check_camera
from reli3d.kernels import cover as kernels

STRIDE = 4  # pixels between rays
DEPTH = 0.05  # field value reached below 0 along a lowered ray: creates a surface without thickening correct parts
FIELD_MAX = 3.0  # rays whose minimum is above this stay empty: inconsistent masks, or a rod thinner than a cell


def cover_silhouettes(sdf: Tensor, bound: Tensor, distance: Tensor, camera: Camera, *, radius: float) -> Tensor:
    """Lowers ``sdf (X, Y, Z)`` so that every ray inside the views' silhouettes hits the surface; no gradient.

    sdf: negative inside, on a grid over [-radius, radius]^3, in occupancy logits or distances divided by the softness.
    bound: ``(X, Y, Z)``, lower bound on ``sdf`` and on the result.  distance, camera: as in
    :func:`reli3d.geometry.hull.hull_distance`, at least ``2 STRIDE`` pixels per side.  Without views: a copy of
    ``sdf``.

    Predicted fields often stay slightly above 0 in thin parts.  Every ``STRIDE``-th pixel of each axis has a ray; if
    the minimum m along it is in (-DEPTH, FIELD_MAX), m + DEPTH is subtracted along the ray.  Source: own.  Raises
    TypeError for a wrong dtype, ValueError for a wrong shape, device or radius.
    """
    check("sdf", sdf)
    if sdf.ndim != 3 or min(sdf.shape) < 2:
        raise ValueError(f"sdf: expected shape (X, Y, Z) of at least 2 points a side, got {tuple(sdf.shape)}")
    check("bound", bound, like=sdf, shape=sdf.shape)
    check("distance", distance, like=sdf)
    if distance.ndim != 3 or min(distance.shape[1:]) < 2 * STRIDE:
        expected = f"(V, H, W) with H and W of at least {2 * STRIDE}"
        raise ValueError(f"distance: expected shape {expected}, got {tuple(distance.shape)}")
    views, height, width = distance.shape
    check_camera(camera, like=sdf, views=views, size=(height, width))
    if not 0.0 < radius < float("inf"):
        raise ValueError(f"radius: expected a positive number, got {radius}")
    if views == 0:
        return sdf.detach().clone()
    sdf, bound, distance = (v.detach().contiguous() for v in (sdf, bound, distance))
    block = kernels.BLOCK_CELLS  # minima of blocks, border points included
    lowest = -max_pool3d(-sdf[None, None], block + 1, block, ceil_mode=True)[0, 0]
    residual = sdf.new_empty(views, height // STRIDE, width // STRIDE)
    cameras = [v.detach().contiguous() for v in (camera.c2w, camera.intrinsics)]
    inputs = [sdf[..., None], lowest, distance, *cameras, radius, DEPTH, FIELD_MAX, STRIDE, residual]
    launch(kernels.residual_kernel, residual.numel(), inputs, sdf.device)
    residual = max_pool2d(residual, 3, 1, 1)  # dilated by a ray, so that interpolation reaches the silhouette's edge
    lowered = torch.empty_like(sdf)
    inputs = [sdf, bound, residual, *cameras, radius, FIELD_MAX, STRIDE, lowered]
    launch(kernels.lower_kernel, sdf.numel(), inputs, sdf.device)
    return lowered
