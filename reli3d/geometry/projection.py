"""Values of posed images at points in space."""

from __future__ import annotations

import warp as wp
from torch import Tensor

from reli3d._bridge import call, check, launch
from reli3d.kernels.projection import gather_views_kernel
from reli3d.kernels.view_features import view_summary_kernel

OWN = 9  # numbers that a view says of a point, and as many that sum up all views


def gather_views(maps: Tensor, points: Tensor, c2w: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Bilinear values ``(N, V, C)`` of ``maps`` where ``points`` project, and pixel x, y and depth ``(N, V, 3)``.

    maps: ``(V, H, W, C)``, at least 2 by 2 pixels.  points: ``(N, 3)`` world.  c2w: ``(V, 4, 4)`` OpenGL.
    intrinsics: ``(V, 4)`` fx, fy, cx, cy in pixels of ``maps``.  Outside a map its border value is taken.  Gradients
    reach ``maps`` and ``points``; the pixels carry the gradient of the points too.  Raises TypeError unless float32,
    ValueError on wrong shapes or mixed devices.
    """
    check("maps", maps), check("points", points, last=3, like=maps)
    check("c2w", c2w, last=4, like=maps), check("intrinsics", intrinsics, last=4, like=maps)
    if maps.ndim != 4 or maps.shape[1] < 2 or maps.shape[2] < 2:
        raise ValueError(f"maps: expected (V, H, W, C) of at least 2 by 2 pixels, got {tuple(maps.shape)}")
    views, n = maps.shape[0], len(points)
    if points.ndim != 2:
        raise ValueError(f"points: expected (N, 3), got {tuple(points.shape)}")
    if c2w.shape != (views, 4, 4) or intrinsics.shape != (views, 4):
        raise ValueError(
            f"c2w, intrinsics: expected {views} cameras, got {tuple(c2w.shape)} and {tuple(intrinsics.shape)}"
        )
    ins = [(maps, wp.float32), (points, wp.vec3), (c2w.detach(), wp.mat44), (intrinsics.detach(), wp.vec4)]
    outs = [((n, views, maps.shape[3]), wp.float32), ((n, views), wp.vec3)]
    return call(gather_views_kernel, n * views, ins, outs, device=maps.device, shared=(0, 1))


def summarize_views(
    images: Tensor, c2w: Tensor, intrinsics: Tensor, points: Tensor, visible: Tensor | None, normal: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """What the images show of ``points (N, 3)``: ``(N, V, 9)`` a view, its weight ``(N, V)``, ``(N, 9)`` in sum.

    images: ``(V, S, S, 4)``, sRGB and signed distance to the silhouette in pixels.  c2w: ``(V, 4, 4)`` OpenGL.
    intrinsics: ``(V, 4)`` in pixels.  visible: ``(N, V)``, 1 where a view sees the point of a surface, 0 where it is
    hidden, and normal: ``(N, 3)`` unit; both None for points in space.  :mod:`reli3d.kernels.view_features` has the
    numbers.  No gradient.  Raises TypeError unless float32, ValueError on wrong shapes or mixed devices.
    """
    views, n = len(images), len(points)
    check("images", images, last=4), check("points", points, last=3, like=images)
    if images.ndim != 4 or images.shape[1] != images.shape[2] or images.shape[1] < 2:
        raise ValueError(f"images: expected (V, S, S, 4) with S of at least 2, got {tuple(images.shape)}")
    if (visible is None) != (normal is None):
        raise ValueError("visible, normal: expected both or none, got one")
    if visible is None:
        visible, normal, surface = points.new_empty(0, views), points.new_empty(0, 3), 0
    else:
        check("visible", visible, last=views, like=points), check("normal", normal, last=3, like=points)
        surface = 1
        if len(visible) != n or len(normal) != n:
            raise ValueError(f"visible, normal: expected {n} rows, got {len(visible)} and {len(normal)}")
    out = [points.new_empty(n, views, OWN), points.new_empty(n, views), points.new_empty(n, OWN)]
    inputs = (images, c2w, intrinsics, points, normal, visible)
    images, c2w, intrinsics, points, normal, visible = (t.detach().contiguous() for t in inputs)
    launch(
        view_summary_kernel,
        n,
        [(images, wp.vec4), (c2w, wp.mat44), (intrinsics, wp.vec4), (points, wp.vec3), surface, (normal, wp.vec3),
         (visible, wp.float32), *((t, wp.float32) for t in out)],
        points.device,
    )  # fmt: skip
    return out[0], out[1], out[2]
