"""Each view by itself: a 2D U-Net that predicts, pixel by pixel, the paint under the light and the shape that is seen.

Convolutions are local and the same everywhere, so they learn from few objects what a transformer over large patches
learns from millions.  Source of the form: Ronneberger et al. 2015, U-Net, arXiv 1505.04597.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.geometry.camera import Camera, image_plane
from reli3d.geometry.hull import hull_span
from reli3d.nn.presets import PyramidSizes

INPUTS = 9  # colour times mask, mask, place in the world, where the ray enters and leaves the hull, 1 / views
PREDICTED = 12  # see PixelMaps, which reads 11: the last is a weight of trained networks, without a meaning
SEEN = 0.1  # least coverage of a pixel whose ray is intersected with the hull
REACH = 0.87  # radius of the sphere around the origin that the hull is cut off at: of a cube of side 1


def block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """3x3 convolution, group normalisation over groups of eight channels, SiLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.GroupNorm(max(1, outputs // 8), outputs), nn.SiLU()
    )


def _channels_last(x: Tensor) -> Tensor:
    return x.float().permute(0, 2, 3, 1).contiguous()


def place_of_pixels(camera: Camera) -> Tensor:
    """Right and up, ``(V, S, S, 2)`` in world units, of where the pixels' rays meet the plane through the world's
    origin that faces the camera: a crop alone shows neither the scale of a picture nor where its middle is.

    camera: ``V`` views of ``S`` by ``S`` pixels.
    """
    c2w = camera.c2w
    depth = (c2w[:, :3, 3] * c2w[:, :3, 2]).sum(-1)[:, None, None]  # of the origin
    x, y = image_plane(camera)
    origin = -(c2w[:, :3, :2] * c2w[:, :3, 3:]).sum(1)[:, None, None]  # in the camera's axes
    return torch.stack([x * depth, y * depth], -1) - origin


def span_of_pixels(silhouette: Tensor, outlined: Camera, seen: Tensor, camera: Camera) -> Tensor:
    """Depths, from the world's origin, ``(V, Q, Q, 2)`` at which pixels' rays enter and leave the silhouettes' hull.

    silhouette: ``(V, D, D)`` signed distance in pixels of the cameras ``outlined``.  seen: ``(V, Q, Q)`` coverage
    of the pixels of ``camera``: those above SEEN are evaluated, the others get 0.
    """
    c2w = camera.c2w
    v, y, x = (seen > SEEN).nonzero(as_tuple=True)
    right, up = (t[v, y, x] for t in image_plane(camera))
    local = torch.stack([right, up, -torch.ones_like(right)], -1)
    directions = (c2w[v, :3, :3] @ local[..., None])[..., 0]  # of depth 1
    depth = (c2w[:, :3, 3] * c2w[:, :3, 2]).sum(-1)  # of the origin
    span = hull_span(c2w[v, :3, 3].contiguous(), directions, REACH, silhouette, outlined) - depth[v, None]
    return span.new_zeros(*seen.shape, 2).index_put((v, y, x), span)


class ImagePyramid(nn.Module):
    """Features of every view at a quarter of its resolution, predictions at half.

    The coarsest level exchanges one mean vector between the views: they stand under one light.  ``in_bfloat16``:
    whether convolutions compute in it; parameters and results are float32.
    """

    in_bfloat16 = False

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
        for value in self.pixels[1].parameters():
            nn.init.zeros_(value)

    def forward(self, images: Tensor, masks: Tensor, place: Tensor, span: Tensor) -> tuple[Tensor, Tensor]:
        """Features ``(V, S/4, S/4, F)`` and raw predictions ``(V, S/2, S/2, 12)`` of one object's views.

        images: ``(V, S, S, 3)`` sRGB.  masks: ``(V, S, S)``.  place: ``(V, S, S, 2)`` from :func:`place_of_pixels`.
        span: ``(V, S / k, S / k, 2)`` from :func:`span_of_pixels`.  S is a multiple of two to the number of levels.
        """
        few = torch.full_like(masks, 1.0 / len(masks))
        x = torch.cat([images * masks[..., None], masks[..., None], place, few[..., None]], -1).permute(0, 3, 1, 2)
        span = functional.interpolate(span.permute(0, 3, 1, 2), size=x.shape[-2:], mode="nearest")
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.in_bfloat16):
            features, pixels = self._convolved(torch.cat([x, span], 1))
        return _channels_last(features), _channels_last(pixels)

    def _convolved(self, x: Tensor) -> tuple[Tensor, Tensor]:
        levels = []
        for down in self.down:
            x = down(x)
            levels.append(x)
        x = x + self.shared(x.mean((0, 2, 3)))[:, None, None]
        for across, up, finer in zip(reversed(self.across), reversed(self.up), reversed(levels[:-1]), strict=True):
            coarse = functional.interpolate(across(x), size=finer.shape[-2:], mode="bilinear", align_corners=False)
            quarter, x = x, up(finer + coarse)
        return self.features(quarter), self.pixels(x)
