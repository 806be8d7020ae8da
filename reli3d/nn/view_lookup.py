"""Lookup of points in posed images by kernels without gradient; the callers have differentiable versions in torch."""

from torch import Tensor

from reli3d._bridge import check, launch, struct_of
from reli3d.geometry.camera import Camera, check_camera
from reli3d.kernels.view_features import Viewed, fuse_views_kernel, pool_views_kernel, view_summary_kernel

BLOCK_CHANNELS = 8  # floats of a kernels.vec8
NUMBERS = 9  # features of a view at a point; the summary over the views has the same width


def summarize_views(
    images: Tensor, camera: Camera, points: Tensor, visible: Tensor | None, normal: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Features ``(N, V, 9)`` and blend weights ``(N, V)`` of each view at ``points (N, 3)``, and a summary ``(N, 9)``.

    images: ``(V, S, S, 4)``, sRGB and signed distance to the silhouette in pixels.  camera: of these images.
    visible: ``(N, V)``, 1 where a surface point is visible, 0 where it is occluded.  normal: ``(N, 3)`` unit.  Both are
    None for points in free space.  :mod:`reli3d.kernels.view_features` lists the features.  No gradient.  Raises
    TypeError unless float32, ValueError for a wrong shape or device.
    """
    n, out, viewed = _summary(images, camera, points, visible, normal)
    numbers, weight = points.new_empty(n, len(images), NUMBERS), points.new_empty(n, len(images))
    launch(view_summary_kernel, n, [viewed, numbers, weight, out], points.device)
    return numbers, weight, out


def pool_views(
    images: Tensor,
    tokens: Tensor,
    mix: Tensor,
    camera: Camera,
    points: Tensor,
    visible: Tensor | None,
    normal: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Weighted mean over the views of a hidden layer at ``points (N, 3)``, ``(N, H)``, and the summary ``(N, 9)``.

    The layer of a view is ``silu(token + features @ mix)`` with ``tokens (V, P, P, H)`` interpolated where the point
    projects, the 9 features of :func:`summarize_views` and ``mix (9, H)``; H is a multiple of 8.  No gradient; the
    differentiable version by :func:`gather_views` and torch takes about 5 times as long.
    """
    n, out, viewed = _summary(images, camera, points, visible, normal)
    check("tokens", tokens, like=images)
    hidden = tokens.shape[-1]
    if tokens.ndim != 4 or tokens.shape[0] != len(images) or min(tokens.shape[1:3]) < 2 or hidden % BLOCK_CHANNELS:
        raise ValueError(
            f"tokens: expected ({len(images)}, P, P, H), P at least 2 and H a multiple of {BLOCK_CHANNELS}, "
            f"got {tuple(tokens.shape)}"
        )
    check("mix", mix, shape=(NUMBERS, hidden), like=images)
    pooled = points.new_empty(n, hidden)
    layer = [t.detach().contiguous().unflatten(-1, (-1, BLOCK_CHANNELS)) for t in (tokens, mix)]
    launch(pool_views_kernel, n, [viewed, *layer, pooled.unflatten(-1, (-1, BLOCK_CHANNELS)), out], points.device)
    return pooled, out


def fuse_views(
    images: Tensor, pixels: Tensor, camera: Camera, points: Tensor, visible: Tensor, normal: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Blends the views' material at ``points (N, 3)``: base color logit ``(N, 3)``, features ``(N, 10)``, unit normal.

    pixels: ``(3, V, P, P, 4)``: gain and three shifts; confidence, roughness, metallic, chroma; normal, 0.  The base
    color logit of a view is ``gain * m + chroma * (l - m) + shift`` with the logits ``l`` of the observed color and
    their mean ``m``.  The blend weight is ``w**2 * exp(confidence)``; ``w`` as in :func:`summarize_views`.  Features:
    roughness, metallic, gain, blended normal minus ``normal``, their cosine, greatest ``w``, confidence, standard
    deviation of the logit.  No gradient; :class:`reli3d.nn.local.LocalField` has the differentiable version.
    """
    check("pixels", pixels, last=4, like=images)
    if pixels.ndim != 5 or pixels.shape[:2] != (3, len(images)) or min(pixels.shape[2:4]) < 2:
        raise ValueError(f"pixels: expected (3, {len(images)}, P, P, 4), P at least 2, got {tuple(pixels.shape)}")
    n, _, viewed = _summary(images, camera, points, visible, normal)
    logit, numbers, shading = points.new_empty(n, 3), points.new_empty(n, 10), points.new_empty(n, 3)
    launch(fuse_views_kernel, n, [viewed, *pixels.detach().contiguous(), logit, numbers, shading], points.device)
    return logit, numbers, shading


def _summary(images, camera, points, visible, normal) -> tuple[int, Tensor, Viewed]:
    """Number of points, an empty summary and the kernels' common inputs, checked."""
    views, n = len(images), len(points)
    check("images", images, last=4)
    check("points", points, last=3, like=images)
    if images.ndim != 4 or images.shape[1] != images.shape[2] or images.shape[1] < 2:
        raise ValueError(f"images: expected (V, S, S, 4) with S of at least 2, got {tuple(images.shape)}")
    check_camera(camera, like=images, views=views, size=images.shape[1:3])
    if (visible is None) != (normal is None):
        raise ValueError("visible, normal: expected both or none, got one")
    if visible is None:
        visible, normal = points.new_empty(0, views), points.new_empty(0, 3)
    else:
        check("visible", visible, last=views, like=points)
        check("normal", normal, last=3, like=points)
        if len(visible) != n or len(normal) != n:
            raise ValueError(f"visible, normal: expected {n} rows, got {len(visible)} and {len(normal)}")
    arrays = {"image": images, "c2w": camera.c2w, "intrinsics": camera.intrinsics, "points": points}
    arrays |= {"normal": normal, "visible": visible}
    viewed = struct_of(Viewed, **{name: value.detach().contiguous() for name, value in arrays.items()})
    return n, points.new_empty(n, NUMBERS), viewed
