"""Each view by itself: a 2D U-Net that tells, pixel by pixel, the paint under the light and the shape that is seen.

Convolutions are local and the same everywhere, so they learn from few objects what a transformer over large patches
learns from millions.  Source of the form: Ronneberger et al. 2015, U-Net, arXiv 1505.04597.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.nn.presets import PyramidSizes

INPUTS = 6  # colour times mask, mask, place in the world
PREDICTED = 12  # see PixelMaps


def block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """3x3 convolution, group normalisation over groups of eight channels, SiLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.GroupNorm(max(1, outputs // 8), outputs), nn.SiLU()
    )


def place_of_pixels(c2w: Tensor, intrinsics: Tensor, size: int) -> Tensor:
    """Right and up, ``(V, S, S, 2)`` in world units, of where the pixels' rays meet the plane through the world's
    origin that faces the camera: a crop alone tells neither the scale of a picture nor where its middle is.

    c2w: ``(V, 4, 4)``.  intrinsics: ``(V, 4)`` in pixels of views of ``size`` by ``size``.
    """
    depth = (c2w[:, :3, 3] * c2w[:, :3, 2]).sum(-1)[:, None, None]  # of the origin
    pixel = torch.arange(size, device=c2w.device) + 0.5
    fx, fy, cx, cy = (k[:, None, None] for k in intrinsics.unbind(-1))
    x, y = ((pixel - cx) / fx).expand(-1, size, size), ((cy - pixel[:, None]) / fy).expand(-1, size, size)
    origin = -(c2w[:, :3, :2] * c2w[:, :3, 3:]).sum(1)[:, None, None]  # in the camera's axes
    return torch.stack([x * depth, y * depth], -1) - origin


class ImagePyramid(nn.Module):
    """Features of every view at a quarter of its resolution, predictions at half.

    The coarsest level exchanges one mean vector between the views: they stand under one light.
    """

    def __init__(self, sizes: PyramidSizes):
        super().__init__()
        widths = sizes.widths
        self.down = nn.ModuleList()
        for a, b in zip((INPUTS, *widths[:-1]), widths, strict=True):
            self.down.append(nn.Sequential(block(a, b, 2), block(b, b)))
        self.shared = nn.Linear(widths[-1], widths[-1])
        self.across = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.up = nn.ModuleList(block(a, a) for a in widths[:-1])
        self.features = nn.Conv2d(widths[1], sizes.features, 1)
        self.pixels = nn.Sequential(block(widths[0], widths[0]), nn.Conv2d(widths[0], PREDICTED, 1))
        nn.init.zeros_(self.pixels[1].weight)
        nn.init.zeros_(self.pixels[1].bias)

    def forward(self, images: Tensor, masks: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        """Features ``(V, S/4, S/4, F)`` and raw predictions ``(V, S/2, S/2, 12)`` of one object's views.

        images: ``(V, S, S, 3)`` sRGB.  masks: ``(V, S, S)``.  place: ``(V, S, S, 2)`` from :func:`place_of_pixels`.
        S is a multiple of two to the number of levels.
        """
        x = torch.cat([images * masks[..., None], masks[..., None], place], -1).permute(0, 3, 1, 2)
        levels = []
        for down in self.down:
            x = down(x)
            levels.append(x)
        x = x + self.shared(x.mean((0, 2, 3)))[:, None, None]
        for across, up, finer in zip(reversed(self.across), reversed(self.up), reversed(levels[:-1]), strict=True):
            coarse = functional.interpolate(across(x), size=finer.shape[-2:], mode="bilinear", align_corners=False)
            quarter, x = x, up(finer + coarse)
        return tuple(t.permute(0, 2, 3, 1).contiguous() for t in (self.features(quarter), self.pixels(x)))
