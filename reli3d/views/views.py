"""Posed images of one object with masks: the result of the readers and the input of the pipeline."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from reli3d._bridge import Movable, check
from reli3d.geometry.camera import Camera
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.views.similarity import Similarity

LEAST_WHOLE = 8  # views with the complete object; if there are as many, cropped views are left out
PADDING = 0.08  # of a crop, on each side, of the mask's longer side
MASK_EDGE = 0.1  # alpha from which a pixel counts into the bounding box: keeps hair and thin wires, drops codec noise


@dataclass(frozen=True)
class ViewBatch(Movable):
    """Views resampled to one size: ``images (V, S, S, 3)``, ``masks (V, S, S)``, and their cameras."""

    images: Tensor
    masks: Tensor
    c2w: Tensor  # (V, 4, 4)
    intrinsics: Tensor  # (V, 4) of the resampled images
    silhouettes: Tensor | None = None  # (V, S, S) masks, continued beyond the image border

    def __len__(self) -> int:
        return self.images.shape[0]

    @property
    def camera(self) -> Camera:
        """The cameras of all views."""
        return Camera(self.c2w, self.intrinsics, *self.images.shape[2:0:-1])


@dataclass(frozen=True)
class Views(Movable):
    """``V`` posed images, which may have different sizes; view 0 is the reference view of the published network.

    images: V tensors ``(H, W, 3)``, float32 sRGB in [0, 1], with the background.  masks: V tensors ``(H, W)``, float32
    straight alpha in [0, 1].  c2w: ``(V, 4, 4)`` float32 rigid camera-to-world matrices, OpenGL axes (+X right, +Y up,
    looking along -Z).  intrinsics: ``(V, 4)`` as ``fx, fy, cx, cy`` in pixels, pixel centers at +0.5.  names: V file
    stems.  All on one device, without gradient.  Raises TypeError for a wrong dtype, ValueError for shapes or devices
    that do not match.

    >>> views = reli3d.load_views("photos/shoe")
    >>> size = [image.shape for image in views.images]
    """

    images: tuple[Tensor, ...]
    masks: tuple[Tensor, ...]
    c2w: Tensor
    intrinsics: Tensor
    names: tuple[str, ...]
    notes: tuple[str, ...] = ()  # changes and assumptions made on reading, one line each
    in_folder: int | None = None  # number of views in the folder
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of this world frame, in the folder's world frame
    lighting: str = "object"  # as in reli3d.fit.input_images: object, camera or turntable
    chosen: tuple[int, ...] | None = None  # indices of the views for the network (at most 16) if all were read
    object_box: tuple[tuple[float, ...], ...] | None = None  # lower and upper corner, if the folder has it

    def __post_init__(self):
        count = len(self.images)
        check("c2w", self.c2w, last=4)
        check("intrinsics", self.intrinsics, last=4, like=self.c2w)
        if count == 0:
            raise ValueError("images: expected at least one view, got none")
        for name, value, shape in (("c2w", self.c2w, (count, 4, 4)), ("intrinsics", self.intrinsics, (count, 4))):
            if value.shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {tuple(value.shape)}")
        if len(self.masks) != count or len(self.names) != count:
            raise ValueError(f"masks, names: expected {count} each, got {len(self.masks)} and {len(self.names)}")
        for i, (image, mask) in enumerate(zip(self.images, self.masks)):
            check(f"images[{i}]", image, last=3, like=self.c2w)
            check(f"masks[{i}]", mask, like=self.c2w)
            if image.ndim != 3 or image.numel() == 0:
                raise ValueError(f"images[{i}]: expected shape (H, W, 3), got {tuple(image.shape)}")
            if mask.shape != image.shape[:2]:
                raise ValueError(f"masks[{i}]: expected shape {tuple(image.shape[:2])}, got {tuple(mask.shape)}")

    def __len__(self) -> int:
        return len(self.images)

    def select(self, which: int | Sequence[int]) -> "Views":
        """The first ``which`` views, or the views with indices ``which`` in this order.

        Raises ValueError for an index out of range.
        """
        indices = list(range(which)) if isinstance(which, int) else list(which)
        if not indices or min(indices) < 0 or max(indices) >= len(self):
            raise ValueError(f"which: expected 1 to {len(self)} views of {len(self)}, got {which}")
        lists: dict[str, Any] = {k: tuple(getattr(self, k)[i] for i in indices) for k in ("images", "masks", "names")}
        return replace(self, **lists, c2w=self.c2w[indices], intrinsics=self.intrinsics[indices], chosen=None)

    def taken(self) -> "Views":
        """The views for the network: the views in ``chosen``, or all views if ``chosen`` is None."""
        return self if self.chosen is None else self.select(self.chosen)

    def transformed(self, similarity: Similarity) -> "Views":
        """The same images with the cameras transformed by ``similarity``; intrinsics are unchanged.

        ``object_box`` is dropped because it is axis-aligned in the old frame.
        """
        return replace(self, c2w=similarity.of_cameras(self.c2w), object_box=None)

    def resampled(self, size: int, *, crop: bool = True, padding: float = PADDING, linear: bool = False) -> ViewBatch:
        """All views at ``size`` x ``size`` pixels, with the intrinsics of the new pixels.

        crop: crop to a square around the mask, with a margin of ``padding`` times its side on each side; beyond the
        image border, the mask is 0 and the color is the nearest edge pixel's.  If False, the whole image is stretched
        to the square.  linear: average linear instead of sRGB values.  Downsampling uses a triangle filter over the
        area of the new pixels, upsampling is bilinear.  Raises ValueError for a size below 1 or, with ``crop``, for an
        empty mask.
        """
        if size < 1:
            raise ValueError(f"size: expected at least 1, got {size}")
        images = self.c2w.new_empty(len(self), size, size, 3)
        masks, silhouettes = (self.c2w.new_empty(len(self), size, size) for _ in range(2))
        intrinsics = []
        for k, camera in enumerate(self.intrinsics.double()):
            image, mask = self.images[k], self.masks[k]
            x, y, width, height = _window(mask, padding) if crop else (0, 0, mask.shape[1], mask.shape[0])
            pixels = _cut(image, mask, x, y, width, height)[None]
            if linear:
                pixels[:, :3] = srgb_to_linear(pixels[:, :3])
            pixels = interpolate(pixels, (size, size), mode="bilinear", align_corners=False, antialias=True)[0]
            if linear:
                pixels[:3] = linear_to_srgb(pixels[:3].clamp(0.0, 1.0))
            images[k] = pixels[:3].permute(1, 2, 0).clamp(0.0, 1.0)
            masks[k], silhouettes[k] = pixels[3:].clamp(0.0, 1.0)
            scale = camera.new_tensor([size / width, size / height] * 2)
            intrinsics.append((camera - camera.new_tensor([0, 0, x, y])) * scale)
        cameras = torch.stack(intrinsics).to(self.intrinsics.dtype)
        return ViewBatch(images, masks, self.c2w, cameras, silhouettes)


def mask_box(mask: Tensor) -> tuple[int, int, int, int]:
    """Pixel box ``(x0, y0, x1, y1)``, ends exclusive, of ``mask (H, W)`` above MASK_EDGE; ValueError if empty."""
    inside = mask > MASK_EDGE
    columns, rows = inside.any(0).nonzero()[:, 0], inside.any(1).nonzero()[:, 0]
    if len(rows) == 0:
        raise ValueError(f"mask: expected a pixel above {MASK_EDGE}, got an empty mask")
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def touches_border(mask: Tensor) -> bool:
    """Whether ``mask (H, W)`` exceeds one half in a pixel at the image border: the object may be cut off there."""
    return any(bool((line > 0.5).any()) for line in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))


def whole_views(masks: Sequence[Tensor], least: int = LEAST_WHOLE) -> list[int]:
    """Indices of the ``masks`` that do not touch the border if there are ``least`` of them, else of all."""
    whole = [i for i, mask in enumerate(masks) if not touches_border(mask)]
    return whole if len(whole) >= least else list(range(len(masks)))


def crop_side(mask: Tensor, padding: float = PADDING) -> int:
    """Side in pixels of the square to which :meth:`Views.resampled` crops an image with ``mask (H, W)``."""
    x0, y0, x1, y1 = mask_box(mask)
    return max(1, round(max(x1 - x0, y1 - y0) * (1.0 + 2.0 * padding)))


def _window(mask: Tensor, padding: float) -> tuple[int, int, int, int]:
    x0, y0, x1, y1 = mask_box(mask)
    side = crop_side(mask, padding)
    return (x0 + x1 - side) // 2, (y0 + y1 - side) // 2, side, side


def _cut(image: Tensor, mask: Tensor, x: int, y: int, width: int, height: int) -> Tensor:
    """``(5, height, width)``: color, mask, and the mask continued beyond the border, of a window that may exceed it."""
    rows, columns = mask.shape
    left, top = max(0, -x), max(0, -y)
    right, bottom = max(0, x + width - columns), max(0, y + height - rows)
    inner = slice(y + top, y + height - bottom), slice(x + left, x + width - right)
    around = (left, right, top, bottom)
    pixels = torch.cat([image[inner].permute(2, 0, 1), mask[inner][None]])
    pixels = pad(pixels[None], around, mode="replicate")[0]
    return torch.cat([pixels[:3], pad(mask[inner][None], around), pixels[3:]])
