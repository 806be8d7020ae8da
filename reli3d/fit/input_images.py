"""Posed input images of a fit: linear colors, masks and cameras."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d, normalize

from reli3d._bridge import check
from reli3d.geometry.camera import Camera
from reli3d.render.color import srgb_to_linear

SATURATED_LINEAR = 0.97  # a brighter pixel may be clipped: its value is a lower bound
LIGHT_FRAMES = "object", "camera", "turntable"
MIN_HORIZONTAL_LENGTH = 0.1  # of a unit direction; below, its azimuth is uncertain
INSIDE_COVERAGE = 0.99  # minimum of a pixel and its neighbors that contain only the object


class PosedImages(Protocol):
    """Batch of posed images, such as :meth:`reli3d.views.views.Views.resampled` returns.

    images: ``(V, S, S, 3)`` sRGB in [0, 1].  masks: ``(V, S, S)`` in [0, 1].  c2w: ``(V, 4, 4)``.  intrinsics: ``(V,
    4)``.  It may also have ``silhouettes (V, S, S)``: the masks, continued beyond the border of the photographs.
    """

    @property
    def images(self) -> Tensor: ...
    @property
    def masks(self) -> Tensor: ...
    @property
    def c2w(self) -> Tensor: ...
    @property
    def intrinsics(self) -> Tensor: ...


@dataclass(frozen=True)
class InputImages:
    """``V`` input images of one size on one device.

    color: ``(V, S, S, 3)`` linear.  mask: ``(V, S, S)`` coverage in [0, 1].  camera: batch of V cameras.  light_group:
    index of the lighting per view, by default 0.  light_frame: what the lighting is fixed to, of LIGHT_FRAMES.
    silhouette: ``(V, S, S)``, the mask continued beyond the border of the photograph, by default ``mask``.
    """

    color: Tensor
    mask: Tensor
    camera: Camera
    light_group: tuple[int, ...] = ()
    light_frame: str = "object"
    silhouette: Tensor = None  # type: ignore[assignment] # set after construction

    def __post_init__(self):
        if self.silhouette is None:
            object.__setattr__(self, "silhouette", self.mask)
        if not self.light_group:
            object.__setattr__(self, "light_group", (0,) * len(self.color))

    @classmethod
    def of(cls, views: PosedImages, light: str | Sequence[Hashable] = "object") -> InputImages:
        """Converts sRGB images to linear.

        light: what it is fixed to: ``object``; ``camera``, such as a flash; ``turntable``, the room in which the object
        turns about +Y in front of a camera that is not moved sideways; or a label per view: views with equal labels
        share their lighting.  Raises TypeError or ValueError if shapes or devices do not match, or for an invalid
        ``light``.
        """
        images, masks = views.images, views.masks
        silhouettes = getattr(views, "silhouettes", None)
        silhouettes = masks if silhouettes is None else silhouettes
        check("images", images, shape=("V", "S", "S", 3))
        count, size = images.shape[:2]
        if not count or images.shape[2] != size:
            raise ValueError(f"images: expected (V, S, S, 3) with at least one view, got {tuple(images.shape)}")
        for name, value in (("masks", masks), ("silhouettes", silhouettes)):
            check(name, value, shape=(count, size, size), like=images)
        check("c2w", views.c2w, shape=(count, 4, 4), like=images)
        check("intrinsics", views.intrinsics, shape=(count, 4), like=images)
        camera = Camera(views.c2w, views.intrinsics, size, size).detach()
        group: tuple[int, ...] = ()
        frame = light if isinstance(light, str) else "object"
        if not isinstance(light, str):
            numbers = {g: k for k, g in enumerate(dict.fromkeys(light))}
            group = tuple(numbers[g] for g in light)
            if len(group) != count:
                raise ValueError(f"light: expected the lighting of {count} views, got {len(group)}")
        elif light not in LIGHT_FRAMES:
            raise ValueError(f"light: expected {', '.join(LIGHT_FRAMES)} or a name for each view, got {light!r}")
        linear = torch.empty_like(images)
        for k, image in enumerate(images.detach()):  # one at a time: less memory
            linear[k] = srgb_to_linear(image)
        return cls(linear, masks.detach(), camera, group, frame, silhouettes.detach())

    def __len__(self) -> int:
        return len(self.color)

    @property
    def size(self) -> int:
        """Pixels per side."""
        return self.color.shape[1]

    def select(self, views: list[int]) -> InputImages:
        """The images with these indices, in this order."""
        group = tuple(self.light_group[v] for v in views)
        camera, silhouette = self.camera[views], self.silhouette[views]
        return InputImages(self.color[views], self.mask[views], camera, group, self.light_frame, silhouette)

    @property
    def light_rotations(self) -> Tensor | None:
        """Rotations ``(V, 3, 3)`` from the axes of the lighting to the object's; None if they are the same.

        ``turntable``: by the azimuth of the direction of view; elevation and roll of the cameras do not count.  For a
        vertical one, by the azimuth of the images' upward direction.
        """
        rotations = self.camera.c2w[:, :3, :3]
        if self.light_frame != "turntable":
            return rotations if self.light_frame == "camera" else None
        backward, upward = rotations[:, :, 2], rotations[:, :, 1]
        vertical = (backward[:, [0, 2]].norm(dim=-1) < MIN_HORIZONTAL_LENGTH)[:, None]
        toward = torch.where(vertical, -backward[:, 1:2].sign() * upward[:, [0, 2]], backward[:, [0, 2]])
        sin, cos = normalize(toward, dim=-1).unbind(-1)
        zero, one = torch.zeros_like(sin), torch.ones_like(sin)
        return torch.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos], -1).unflatten(-1, (3, 3))

    def resized(self, size: int) -> InputImages:
        """The images resampled to ``size`` pixels per side; colors are averaged with the masks as weights."""
        if size == self.size:
            return self
        planes = self.color.new_empty(len(self), 5, size, size)
        for k, (color, mask) in enumerate(zip(self.color, self.mask, strict=True)):  # one at a time: less memory
            masks = torch.stack([mask, self.silhouette[k]], -1)
            of_view = torch.cat([color * mask[..., None], masks], -1).permute(2, 0, 1)[None]
            planes[k] = interpolate(of_view, (size, size), mode="bilinear", align_corners=False, antialias=True)[0]
        cover = planes[:, 3]
        color = planes[:, :3].permute(0, 2, 3, 1) / cover.clamp(min=1e-4)[..., None]
        camera = self.camera.resized(size, size)
        mask, silhouette = cover.clamp(0.0, 1.0), planes[:, 4].clamp(0.0, 1.0)
        return replace(self, color=color.contiguous(), mask=mask, camera=camera, silhouette=silhouette)

    def moved(self, shift: Tensor, scale: float) -> InputImages:
        """The images with cameras in the frame ``scale * (x - shift)``."""
        c2w = self.camera.c2w.clone()
        c2w[:, :3, 3] = scale * (c2w[:, :3, 3] - shift)
        return replace(self, camera=replace(self.camera, c2w=c2w))

    def photographed(self) -> Tensor:
        """``(V, S, S)`` bool: False beyond the border of a photograph where the object may continue."""
        return (self.silhouette - self.mask).abs() < 1.0 - INSIDE_COVERAGE

    def inside(self) -> Tensor:
        """``(V, S, S)`` bool: pixels that contain only the object, as do their 8 neighbors."""
        return max_pool2d(1.0 - self.mask[:, None], 3, 1, 1)[:, 0] < 1.0 - INSIDE_COVERAGE
