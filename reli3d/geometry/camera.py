"""Pinhole cameras.

============  ==========================================================================================
world         right-handed, +Y up; any length unit, the same for vertices and camera positions
camera        camera-to-world 4 x 4, OpenGL axes: +X right, +Y up, looks along -Z
intrinsics    ``fx, fy, cx, cy`` in pixels; x to the right, y DOWN, pixel centers at +0.5, (0, 0) the corner
depth         distance along the viewing axis (-Z of the camera), not along the ray
============  ==========================================================================================

Other conventions are converted in ``reli3d.views`` and ``reli3d.io`` and nowhere else.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reli3d._bridge import Movable, check, expect, full_precision, tensor_of

DEPTH_RATIO_MIN = 0.01  # least depth of points over their largest distance, for their box: below, rounding dominates


@dataclass(frozen=True)
class Camera(Movable):
    """One pinhole camera, or a batch of cameras with the same image size.

    c2w: ``(..., 4, 4)`` float32 camera-to-world, OpenGL axes: +X right, +Y up, looks along -Z.  intrinsics: ``(...,
    4)`` float32 as ``fx, fy, cx, cy`` in pixels, y down, pixel centers at +0.5.  width, height: pixels, at least 1.
    ``c2w`` and ``intrinsics`` have the same batch axes.  Gradients pass through.  Raises TypeError for a wrong dtype,
    ValueError for a wrong shape, size or device.

    >>> camera = reli3d.Camera.from_fov(reli3d.look_at([0.0, 0.5, 3.0]), 0.7, 64, 48)  # fov_x in radians
    >>> origins, directions = reli3d.camera_rays(camera)
    """

    c2w: Tensor
    intrinsics: Tensor
    width: int
    height: int

    def __post_init__(self):
        for name in ("c2w", "intrinsics"):
            object.__setattr__(self, name, tensor_of(getattr(self, name)))
        check("c2w", self.c2w, last=4)
        check("intrinsics", self.intrinsics, last=4, like=self.c2w)
        if self.c2w.ndim < 2 or self.c2w.shape[-2] != 4 or self.c2w.shape[:-2] != self.intrinsics.shape[:-1]:
            raise ValueError(
                "c2w: expected (..., 4, 4) with the batch axes of intrinsics, "
                f"got {tuple(self.c2w.shape)} and {tuple(self.intrinsics.shape)}"
            )
        if self.width < 1 or self.height < 1:
            raise ValueError(f"width, height: expected at least 1, got {self.width}, {self.height}")

    @classmethod
    def from_fov(cls, c2w: Tensor, fov_x: float, width: int, height: int) -> "Camera":
        """Camera with square pixels and the principal point at the image center.

        c2w, width, height: those of the camera.  fov_x: full horizontal field of view in radians, in (0, pi); ``fx = fy
        = width / (2 tan(fov_x / 2))``.  Gradients reach ``c2w``.  Raises ValueError for a field of view out of range.
        """
        c2w = tensor_of(c2w)
        check("c2w", c2w, last=4)
        if not 0.0 < fov_x < torch.pi:
            raise ValueError(f"fov_x: expected radians in (0, pi), got {fov_x}")
        f = 0.5 * width / torch.tan(torch.tensor(0.5 * fov_x, dtype=torch.float64, device="cpu")).item()
        row = torch.tensor([f, f, 0.5 * width, 0.5 * height], dtype=torch.float32, device=c2w.device)
        return cls(c2w, row.expand(*c2w.shape[:-2], 4).contiguous(), width, height)

    def __getitem__(self, index) -> "Camera":
        """The cameras that ``index`` picks from the batch axes, as torch indexes."""
        return Camera(self.c2w[index], self.intrinsics[index], self.width, self.height)

    @property
    def position(self) -> Tensor:
        """Camera position, ``(..., 3)``."""
        return self.c2w[..., :3, 3]

    def resized(self, width: int, height: int) -> "Camera":
        """The same view in ``width`` x ``height`` pixels; gradients reach the intrinsics."""
        x, y = width / self.width, height / self.height
        scale = x if x == y else self.intrinsics.new_tensor([x, y, x, y])  # a number waits for no device
        return Camera(self.c2w, self.intrinsics * scale, width, height)

    def scaled(self, factor: int) -> "Camera":
        """The same view with ``factor`` times as many pixels along each side."""
        if factor < 1:
            raise ValueError(f"factor: expected at least 1, got {factor}")
        return Camera(self.c2w, self.intrinsics * factor, self.width * factor, self.height * factor)


def check_camera(camera: Camera, *, like: Tensor, views: int | None = None, size: Sequence[int] | None = None) -> None:
    """Raises TypeError or ValueError unless ``camera`` is a batch of ``views`` cameras on the device of ``like``.

    views: None: any number.  size: expected height and width in pixels; None: any.
    """
    expect("camera", camera, Camera)
    check("camera", camera.c2w, like=like)
    batch = tuple(camera.c2w.shape[:-2])
    if len(batch) != 1 or views not in (None, batch[0]):
        raise ValueError(f"camera: expected {'one axis of' if views is None else views} views, got {batch}")
    if size is not None and (camera.height, camera.width) != tuple(size):
        raise ValueError(f"camera: expected {size[0]} by {size[1]} pixels, got {camera.height} by {camera.width}")


def image_plane(camera: Camera) -> tuple[Tensor, Tensor]:
    """Right and up coordinates, both ``(..., H, W)``, of all pixel centers, in the plane at depth 1."""
    fx, fy, cx, cy = (v[..., None, None] for v in camera.intrinsics.unbind(-1))
    ys = torch.arange(camera.height, dtype=torch.float32, device=camera.c2w.device)[:, None] + 0.5
    xs = torch.arange(camera.width, dtype=torch.float32, device=camera.c2w.device)[None, :] + 0.5
    x, y = torch.broadcast_tensors((xs - cx) / fx, -(ys - cy) / fy)
    return x, y


@full_precision
def camera_rays(camera: Camera) -> tuple[Tensor, Tensor]:
    """Rays through all pixel centers: origins and unit directions, both ``(..., H, W, 3)`` float32, world frame.

    Row 0 is the top row of the image.  Origins are the camera position, expanded without a copy.  Because directions
    are unit, ``t`` of a hit is the Euclidean distance, not the depth along the viewing axis.  Gradients reach ``c2w``
    and ``intrinsics``.

    >>> origins, directions = reli3d.camera_rays(camera)  # (H, W, 3) each
    >>> hits = reli3d.RayScene(mesh).intersect(origins, directions)
    """
    x, y = image_plane(camera)
    local = normalize(torch.stack([x, y, -torch.ones_like(x)], -1), dim=-1)
    rotation = camera.c2w[..., None, None, :3, :3]
    directions = normalize((rotation @ local[..., None])[..., 0], dim=-1)
    return camera.position[..., None, None, :].expand_as(directions), directions


@full_precision
def project(points: Tensor, c2w: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel coordinates ``(..., 2)`` and depth along the viewing axis ``(...)`` of world points.

    points: ``(..., 3)``; c2w: ``(..., 4, 4)``, a rotation and a translation; intrinsics: ``(..., 4)``.  Batch axes
    broadcast (use ``c2w[:, None]`` with ``points (N, 3)`` for all pairs).  A point behind the camera has depth < 0 and
    mirrored pixel coordinates; depth 0 gives inf.  Gradients reach all three.
    """
    check("points", points, last=3)
    check("c2w", c2w, last=4, like=points)
    check("intrinsics", intrinsics, last=4, like=points)
    local = ((points - c2w[..., :3, 3])[..., None, :] @ c2w[..., :3, :3])[..., 0, :]  # row vector: the inverse rotation
    depth = -local[..., 2]
    fx, fy, cx, cy = intrinsics.unbind(-1)
    pixels = torch.stack([fx * local[..., 0] / depth + cx, -fy * local[..., 1] / depth + cy], -1)
    return pixels, depth


def box_of(points: Tensor, camera: Camera) -> tuple[int, int, int, int]:
    """Pixel box ``(x0, y0, x1, y1)``, ends exclusive, around the projection of the convex hull of ``points (N, 3)``.

    camera: a single camera.  The box is clipped to the image; it has at least one pixel, even if all points project
    outside the image, and is the whole image if a point is near or behind the camera plane.  No gradient.
    """
    points, eye = points.detach(), camera.position.detach()
    pixels, depth = project(points, camera.c2w.detach(), camera.intrinsics.detach())
    if not len(points) or not float(depth.min()) > DEPTH_RATIO_MIN * float((points - eye).norm(dim=-1).max()):
        return 0, 0, camera.width, camera.height
    (x0, y0), (x1, y1) = pixels.amin(0).tolist(), pixels.amax(0).tolist()
    left, right = _pixels_between(x0, x1, camera.width)
    top, bottom = _pixels_between(y0, y1, camera.height)
    return left, top, right, bottom


def _pixels_between(low: float, high: float, count: int) -> tuple[int, int]:
    """Begin and end of the pixels of ``count`` that overlap [low, high], extended by one on each side."""
    first = min(max(math.floor(low) - 1, 0), count - 1)
    return first, max(min(math.ceil(high) + 1, count), first + 1)


def look_at(
    eye: Tensor | Sequence[float],
    target: Tensor | Sequence[float] = (0.0, 0.0, 0.0),
    up: Tensor | Sequence[float] = (0.0, 1.0, 0.0),
) -> Tensor:
    """Camera-to-world matrix ``(..., 4, 4)`` of a camera at ``eye`` that looks at ``target``, with ``up`` upwards.

    eye, target, up: ``(..., 3)`` float32 tensors or lists of numbers; batch axes broadcast.  Lists are moved to the
    device of the first tensor.  Gradients reach all three.  Raises TypeError for a wrong dtype, ValueError for a wrong
    shape or if ``up`` is parallel to the viewing direction.

    >>> pose = reli3d.look_at([0.0, 0.5, 3.0], [0.0, 0.0, 0.0])
    >>> camera = reli3d.Camera.from_fov(pose, 0.7, 64, 48)
    """
    device = next((v.device for v in (eye, target, up) if isinstance(v, Tensor)), torch.device("cpu"))
    given = [
        v if isinstance(v, Tensor) else torch.as_tensor(v, dtype=torch.float32, device=device)
        for v in (eye, target, up)
    ]
    for name, value in zip(("eye", "target", "up"), given, strict=True):
        check(name, value, last=3, like=given[0])
    origin, aim, above = torch.broadcast_tensors(*given)
    if bool((origin == aim).all(-1).any()):
        raise ValueError("eye, target: expected different points, got equal ones")
    z = normalize(origin - aim, dim=-1)
    x = torch.linalg.cross(normalize(above, dim=-1), z)
    if origin.numel() and float(x.norm(dim=-1).min()) < 1e-6:  # sine of the angle; float32 noise is 1e-7
        raise ValueError("up: expected a direction not parallel to the view, got a parallel one")
    x = normalize(x, dim=-1)
    rows = torch.stack([x, torch.linalg.cross(z, x), z, origin], -1)
    last = rows.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*rows.shape[:-2], 1, 4)
    return torch.cat([rows, last], -2)
