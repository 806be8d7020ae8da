"""Values of posed images at points in space."""

from torch import Tensor

from reli3d._bridge import call, check
from reli3d.geometry.camera import Camera, check_camera
from reli3d.kernels.projection import gather_views_kernel


def gather_views(maps: Tensor, points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Bilinear values ``(N, V, C)`` of ``maps`` where ``points`` project, and pixel x, y and depth ``(N, V, 3)``.

    maps: ``(V, H, W, C)``, at least 2 by 2 pixels.  points: ``(N, 3)`` world.  camera: a batch of V views; the maps
    show the whole image at any resolution, and x and y are in pixels of the maps.  Outside a map, the border value is
    used.  Gradients reach ``maps`` and ``points``; pixel coordinates and depth are differentiable in ``points`` too.
    Raises TypeError unless float32, ValueError for a wrong shape or device.
    """
    check("maps", maps)
    check("points", points, last=3, like=maps)
    if maps.ndim != 4 or maps.shape[1] < 2 or maps.shape[2] < 2:
        raise ValueError(f"maps: expected (V, H, W, C) of at least 2 by 2 pixels, got {tuple(maps.shape)}")
    views, n = maps.shape[0], len(points)
    if points.ndim != 2:
        raise ValueError(f"points: expected (N, 3), got {tuple(points.shape)}")
    check_camera(camera, like=maps, views=views)
    camera = camera.detach().resized(maps.shape[2], maps.shape[1])
    ins = [maps, points, camera.c2w, camera.intrinsics]
    return call(gather_views_kernel, n * views, ins, [(n, views, maps.shape[3]), (n, views)], shared=(0, 1))
