"""Triplane tokens to the triplane that is sampled: convolutions and a pixel shuffle, the same for the three planes.

Source: pixel shuffle, Shi et al. 2016, arXiv 1609.05158.  Parameter names are the published checkpoint's.
"""

from torch import Tensor, nn

from reli3d.nn.presets import UpsamplerSizes


class PixelShuffleUpsampler(nn.Module):
    """3x3 convolutions with ReLU between them; pixel (y*s + i, x*s + j) of channel c is channel (c*s + i)*s + j."""

    def __init__(self, sizes: UpsamplerSizes, width: int):
        super().__init__()
        layers = []
        for _ in range(sizes.convolutions - 1):
            layers += [nn.Conv2d(width, width, 3, padding=1), nn.ReLU()]
        layers += [nn.Conv2d(width, sizes.channels * sizes.scale**2, 3, padding=1), nn.PixelShuffle(sizes.scale)]
        self.upsample = nn.Sequential(*layers)

    def forward(self, planes: Tensor) -> Tensor:
        """``(B, 3, C, S, S)`` to ``(B, 3, channels, scale*S, scale*S)``."""
        return self.upsample(planes.flatten(0, 1)).unflatten(0, planes.shape[:2])
