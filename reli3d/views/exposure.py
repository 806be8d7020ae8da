"""Photographs of different exposure, scaled to the same one by their EXIF data."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from reli3d.fit.input_images import SATURATED_LINEAR
from reli3d.render.color import linear_to_srgb, srgb_to_linear

MIN_DIFFERENCE_EV = 0.1  # between two photographs, from which they are scaled


def equalize(images: Sequence[Tensor], masks: Sequence[Tensor], exposures: Sequence[float | None]) -> list[str]:
    """Scales the images in place, in linear light, to the geometric mean of the exposures; a note if these differ.

    images: ``(H, W, 3)`` sRGB in [0, 1].  masks: ``(H, W)`` coverage.  exposures: from
    :func:`~reli3d.io.images.exposure`; None: unknown, then nothing changes.  Saturated pixels are white, others are
    clipped.  Edited photographs may have another brightness than their exposure: unless scaling reduces the variance of
    the object's log brightness over the images, they are left as they are.
    """
    known = [value for value in exposures if value is not None]
    if len(known) < len(exposures) or len(known) < 2:
        return []
    relative = torch.tensor(known, dtype=torch.float64, device="cpu").log()
    relative = relative - relative.mean()
    difference = float(relative.max() - relative.min()) / math.log(2.0)
    if difference < MIN_DIFFERENCE_EV:
        return []
    means = [
        (srgb_to_linear(image).mean(-1) * mask).sum() / mask.sum() for image, mask in zip(images, masks, strict=True)
    ]
    brightness = torch.stack(means).cpu().double().clamp(min=1e-6).log()
    text = f"the exposures of the photographs differ by {difference:.1f} EV (EXIF)"
    if (brightness - relative).var() >= brightness.var():
        return [f"{text}, their brightness does not; left as they are"]
    for image, factor in zip(images, (-relative).exp().tolist(), strict=True):
        linear = srgb_to_linear(image)
        value = linear_to_srgb((factor * linear).clamp(0.0, 1.0))
        image.copy_(torch.where(linear >= SATURATED_LINEAR, 1.0, value))
    return [f"{text}; scaled to their mean"]
