"""Bilinear values of images: pixel centers lie at +0.5, beyond the outermost ones the border's value is taken."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})


@wp.func
def between_pixels(x: float, y: float, height: int, width: int) -> wp.vec4:
    """Column and row of the upper left of the four pixels about a point, and the point's place between them in [0, 1].

    height, width: at least 2.
    """
    u = wp.clamp(x - 0.5, 0.0, float(width - 1))
    v = wp.clamp(y - 0.5, 0.0, float(height - 1))
    column = float(wp.min(int(u), width - 2))
    row = float(wp.min(int(v), height - 2))
    return wp.vec4(column, row, u - column, v - row)


@wp.func
def blend(upper_left: Any, upper_right: Any, lower_left: Any, lower_right: Any, at: wp.vec4) -> Any:
    """The four pixels' values weighted by the place of :func:`between_pixels`."""
    top = upper_left * (1.0 - at[2]) + upper_right * at[2]
    bottom = lower_left * (1.0 - at[2]) + lower_right * at[2]
    return top * (1.0 - at[3]) + bottom * at[3]


@wp.func
def look_up(images: wp.array3d[Any], view: int, x: float, y: float) -> Any:
    """Value of image ``view`` of ``images (V, H, W)`` at pixel coordinates, the border's value outside."""
    at = between_pixels(x, y, images.shape[1], images.shape[2])
    i = int(at[0])
    j = int(at[1])
    return blend(images[view, j, i], images[view, j, i + 1], images[view, j + 1, i], images[view, j + 1, i + 1], at)
