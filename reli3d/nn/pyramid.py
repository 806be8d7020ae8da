"""Each view by itself: a 2D U-Net that predicts, pixel by pixel, the paint under the light and the shape that is seen.

Convolutions are local and the same everywhere, so they learn from few objects what a transformer over large patches
learns from millions.  Source of the form: Ronneberger et al. 2015, U-Net, arXiv 1505.04597.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.geometry.camera import Camera, image_plane
from reli3d.geometry.hull import hull_span
from reli3d.nn.presets import PyramidSizes

INPUTS = 9  # colour times mask, mask, place in the world, where the ray enters and leaves the hull, 1 / views
PREDICTED = 12  # see PixelMaps
SEEN = 0.1  # least coverage of a pixel whose ray is intersected with the hull
REACH = 0.87  # radius of the sphere around the origin that the hull is cut off at: of a cube of side 1


def block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """3x3 convolution, group normalisation over groups of eight channels, SiLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.GroupNorm(max(1, outputs // 8), outputs), nn.SiLU()
    )


def channels_last(x: Tensor) -> Tensor:
    return x.float().permute(0, 2, 3, 1).contiguous()


def depth_of_origin(c2w: Tensor) -> Tensor:
    """Depth ``(V,)`` of the world's origin along the cameras' axes."""
    return (c2w[:, :3, 3] * c2w[:, :3, 2]).sum(-1)


def place_of_pixels(camera: Camera) -> Tensor:
    """Right and up, ``(V, S, S, 2)`` in world units, of where the pixels' rays meet the plane through the world's
    origin that faces the camera: a crop alone shows neither the scale of a picture nor where its middle is.

    camera: ``V`` views of ``S`` by ``S`` pixels.
    """
    c2w = camera.c2w
    depth = depth_of_origin(c2w)[:, None, None]
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
    span = hull_span(c2w[v, :3, 3].contiguous(), directions, REACH, silhouette, outlined)
    span = span - depth_of_origin(c2w)[v, None]
    return span.new_zeros(*seen.shape, 2).index_put((v, y, x), span)


def pyramid_input(images: Tensor, masks: Tensor, place: Tensor, span: Tensor, counts: Sequence[int]) -> Tensor:
    """What the first convolution reads, ``(V, INPUTS, S, S)``; see :meth:`ImagePyramid.forward`."""
    few = torch.cat([masks.new_full((count,), 1.0 / count) for count in counts])
    few = few[:, None, None, None].expand(*masks.shape, 1)
    x = torch.cat([images * masks[..., None], masks[..., None], place, few], -1).permute(0, 3, 1, 2)
    return torch.cat([x, functional.interpolate(span.permute(0, 3, 1, 2), size=x.shape[-2:], mode="nearest")], 1)


class ImagePyramid(nn.Module):
    """Features of every view at a quarter of its resolution, predictions at half.

    Level ``k`` has ``S / 2**(k + 1)`` pixels a side.  The finest levels, ``sizes.reading`` of them, read the picture at
    their own resolution too, and predict: each adds to what the coarser ones say.  So coarse levels can learn alone
    from small pictures, and finer ones then begin by adding nothing.  The coarsest level exchanges one mean vector
    between the views: they stand under one light.  ``in_bfloat16``: whether convolutions compute in it; parameters and
    results are float32.
    """

    in_bfloat16 = False

    def __init__(self, sizes: PyramidSizes, finest: int = 0):
        """finest: the level that the pictures enter, which are ``2**finest`` times smaller; the finer ones are left
        out, and there are no features where it is not 0.
        """
        super().__init__()
        widths, reading = sizes.widths, range(finest, sizes.reading)
        if not reading:
            raise ValueError(f"finest: expected a level of 0 to {sizes.reading - 1}, got {finest}")
        pairs = {str(k): (widths[k], widths[k + 1]) for k in range(finest, len(widths) - 1)}
        self.finest, self.deepest = finest, len(widths) - 1
        self.reads = nn.ModuleDict({str(k): block(INPUTS, widths[k], 2) for k in reading})
        down = {str(k): block(widths[k - 1], widths[k], 2) for k in range(finest + 1, len(widths))}
        self.down = nn.ModuleDict(down)
        self.body = nn.ModuleDict({str(k): block(widths[k], widths[k]) for k in range(finest, len(widths))})
        self.shared = nn.Linear(widths[-1], widths[-1])
        self.across = nn.ModuleDict({k: nn.Conv2d(coarse, fine, 1) for k, (fine, coarse) in pairs.items()})
        self.up = nn.ModuleDict({k: block(fine, fine) for k, (fine, _) in pairs.items()})
        said = {str(k): nn.Sequential(block(widths[k], widths[k]), nn.Conv2d(widths[k], PREDICTED, 1)) for k in reading}
        self.says = nn.ModuleDict(said)
        if finest == 0:
            self.features = nn.Conv2d(widths[1], sizes.features, 1)
        for head in said.values():
            for value in head[1].parameters():
                nn.init.zeros_(value)
        for k in reading[1:]:  # a finer level begins by adding nothing
            for value in down[str(k)][1].parameters():
                nn.init.zeros_(value)

    def forward(
        self, images: Tensor, masks: Tensor, place: Tensor, span: Tensor, counts: Sequence[int] | None = None
    ) -> tuple[Tensor | None, Tensor]:
        """Features ``(V, S/4, S/4, F)``, none of small pictures, and raw predictions ``(V, S/2, S/2, 12)`` of views.
        Gradients reach every parameter.

        images: ``(V, S, S, 3)`` sRGB.  masks: ``(V, S, S)``.  place: ``(V, S, S, 2)`` from :func:`place_of_pixels`.
        span: ``(V, S / k, S / k, 2)`` from :func:`span_of_pixels`.  S is a multiple of two to the number of levels.
        counts: how many views each object has, one after the other; all are of one object without it.
        """
        counts = [len(masks)] if counts is None else counts
        x = pyramid_input(images, masks, place, span, counts)
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.in_bfloat16):
            quarter, pixels = self._convolved(x, counts)
            features = self.features(quarter) if self.finest == 0 else None
        return None if features is None else channels_last(features), channels_last(pixels)

    def _convolved(self, x: Tensor, counts: Sequence[int]) -> tuple[Tensor, Tensor]:
        """What leaves level 1 on the way up, or the finest one, and the predictions of the finest level."""
        levels: dict[str, Tensor] = {}
        for k in range(self.finest, self.deepest + 1):
            at = str(k)
            parts = [self.reads[at](functional.avg_pool2d(x, 1 << k - self.finest))] if at in self.reads else []
            if k > self.finest:
                parts.append(self.down[at](levels[str(k - 1)]))
            levels[at] = self.body[at](sum(parts[1:], parts[0]))
        y = levels[str(self.deepest)]
        means = [self.shared(part.mean((0, 2, 3))).expand(len(part), -1) for part in y.split(list(counts))]
        y = y + torch.cat(means)[:, :, None, None]
        quarter, said = y, list[Tensor]()
        for k in reversed(range(self.finest, self.deepest)):
            at = str(k)
            y = self.up[at](levels[at] + _twice(self.across[at](y), levels[at]))
            quarter = y if k >= 1 else quarter
            if at in self.says:
                more = self.says[at](y)
                said.append(more + _twice(said[-1], more) if said else more)
        return quarter, said[-1]


def _twice(coarse: Tensor, fine: Tensor) -> Tensor:
    """``coarse`` at the resolution of ``fine``, bilinear."""
    return functional.interpolate(coarse, size=fine.shape[-2:], mode="bilinear", align_corners=False)
