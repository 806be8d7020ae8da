"""Crops and downsamples large images to the resolution that later stages need."""

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

MAX_FULL_PIXELS = 1 << 21  # up to which an image is kept as it is: 1920 x 1080
MAX_OBJECT_PIXELS = 768  # along the object's longer side: later stages read at most 512
MARGIN = 1.25  # side of the square that is kept, in sides of the object


@dataclass(frozen=True)
class Cut:
    """A part ``(x0, y0, x1, y1)`` of an image and the size ``(width, height)`` it is scaled to."""

    part: tuple[int, int, int, int]
    size: tuple[int, int]

    def pixels(self, bitmap: Image.Image) -> Image.Image:
        """The part of ``bitmap`` at the new size, area-filtered; straight alpha stays straight."""
        if bitmap.mode == "RGBA":  # Pillow would multiply the color by alpha, and lose that under alpha 0
            return Image.merge("RGBA", [self.pixels(band) for band in bitmap.split()])
        return bitmap.resize(self.size, Image.Resampling.BILINEAR, box=self.part)

    def intrinsics(self, camera: list[float]) -> list[float]:
        """``[fx, fy, cx, cy]`` of the new pixels."""
        x0, y0, x1, y1 = self.part
        sx, sy = self.size[0] / (x1 - x0), self.size[1] / (y1 - y0)
        fx, fy, cx, cy = camera
        return [fx * sx, fy * sy, (cx - x0) * sx, (cy - y0) * sy]


def cut(size: tuple[int, int], inside: np.ndarray, *, whole: bool) -> Cut | None:
    """Crop and size for an image of ``size`` (width, height); None if the image is kept unchanged.

    inside: ``(H, W)`` bool, the pixels of the object, at least one.  whole: keep the background as well, with fewer
    pixels on the object.
    """
    width, height = size
    if width * height <= MAX_FULL_PIXELS:
        return None
    if whole:
        scale, part = math.sqrt(MAX_FULL_PIXELS / (width * height)), (0, 0, width, height)
    else:
        columns, rows = (np.flatnonzero(inside.any(axis)).tolist() for axis in (0, 1))
        x0, y0, x1, y1 = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
        side = max(x1 - x0, y1 - y0)
        reach = math.ceil(0.5 * MARGIN * side)
        x, y = (x0 + x1) // 2, (y0 + y1) // 2
        scale = min(1.0, MAX_OBJECT_PIXELS / side)
        part = max(0, x - reach), max(0, y - reach), min(width, x + reach), min(height, y + reach)
    return Cut(part, (max(1, round(scale * (part[2] - part[0]))), max(1, round(scale * (part[3] - part[1])))))
