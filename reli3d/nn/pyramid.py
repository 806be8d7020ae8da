"""Each view by itself: a 2D U-Net that tells, pixel by pixel, the paint under the light and the shape that is seen.

Convolutions are local and the same everywhere, so they learn from few objects what a transformer over large patches
learns from millions.  Source of the form: Ronneberger et al. 2015, U-Net, arXiv 1505.04597.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.nn.presets import PyramidSizes

INPUTS = 4  # colour times mask, mask
PREDICTED = 12  # see PixelMaps


def block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """3x3 convolution, group normalisation over groups of eight channels, SiLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.GroupNorm(max(1, outputs // 8), outputs), nn.SiLU()
    )


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

    def forward(self, images: Tensor, masks: Tensor) -> tuple[Tensor, Tensor]:
        """Features ``(V, S/4, S/4, F)`` and raw predictions ``(V, S/2, S/2, 12)`` of one object's views.

        images: ``(V, S, S, 3)`` sRGB.  masks: ``(V, S, S)``.  S is a multiple of two to the number of levels.
        """
        x = torch.cat([images * masks[..., None], masks[..., None]], -1).permute(0, 3, 1, 2)
        levels = []
        for down in self.down:
            x = down(x)
            levels.append(x)
        x = x + self.shared(x.mean((0, 2, 3)))[:, None, None]
        for across, up, finer in zip(reversed(self.across), reversed(self.up), reversed(levels[:-1]), strict=True):
            coarse = functional.interpolate(across(x), size=finer.shape[-2:], mode="bilinear", align_corners=False)
            quarter, x = x, up(finer + coarse)
        return tuple(t.permute(0, 2, 3, 1).contiguous() for t in (self.features(quarter), self.pixels(x)))
