"""2D U-Net on every view, which predicts material, normal and depth per pixel (Ronneberger et al. 2015, 1505.04597)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.geometry.camera import Camera, image_plane
from reli3d.geometry.hull import hull_span
from reli3d.nn.presets import PyramidSizes

INPUTS = 9  # color times mask (3), mask, position in the world (2), depths of the hull along the ray (2), 1 / views
PREDICTIONS = 12  # of a pixel, see PixelMaps
MIN_COVERAGE = 0.1  # of a pixel whose ray is intersected with the hull
CLIP_RADIUS = 0.87  # of the sphere around the origin that clips the hull: circumscribes a cube of side 1


def block(inputs: int, outputs: int, stride: int = 1, kind: type[nn.Conv2d | nn.Conv3d] = nn.Conv2d) -> nn.Sequential:
    """Convolution ``kind`` of width 3, group normalization over groups of eight channels, SiLU."""
    norm = nn.GroupNorm(max(1, outputs // 8), outputs)
    return nn.Sequential(kind(inputs, outputs, 3, stride=stride, padding=1), norm, nn.SiLU())


def channels_last(x: Tensor) -> Tensor:
    return x.float().permute(0, 2, 3, 1).contiguous()


def depth_of_origin(c2w: Tensor) -> Tensor:
    """Depth ``(V,)`` of the world's origin along the cameras' axes."""
    return (c2w[:, :3, 3] * c2w[:, :3, 2]).sum(-1)


def pixel_positions(camera: Camera) -> Tensor:
    """Right and up ``(V, S, S, 2)`` where pixel rays hit the plane through the origin parallel to the image."""
    c2w = camera.c2w
    depth = depth_of_origin(c2w)[:, None, None]
    x, y = image_plane(camera)
    origin = -(c2w[:, :3, :2] * c2w[:, :3, 3:]).sum(1)[:, None, None]  # in the camera's axes
    return torch.stack([x * depth, y * depth], -1) - origin


def pixel_hull_depths(silhouette: Tensor, outlined: Camera, coverage: Tensor, camera: Camera) -> Tensor:
    """Depths ``(V, Q, Q, 2)``, relative to the world origin's, at which pixel rays enter and leave the visual hull.

    silhouette: ``(V, D, D)`` signed distance in pixels of the cameras ``outlined``.  coverage: ``(V, Q, Q)`` of the
    pixels of ``camera``; those of at most MIN_COVERAGE get 0.
    """
    c2w = camera.c2w
    v, y, x = (coverage > MIN_COVERAGE).nonzero(as_tuple=True)
    right, up = (t[v, y, x] for t in image_plane(camera))
    local = torch.stack([right, up, -torch.ones_like(right)], -1)
    directions = (c2w[v, :3, :3] @ local[..., None])[..., 0]  # of depth 1
    span = hull_span(c2w[v, :3, 3].contiguous(), directions, CLIP_RADIUS, silhouette, outlined)
    span = span - depth_of_origin(c2w)[v, None]
    return span.new_zeros(*coverage.shape, 2).index_put((v, y, x), span)


class ImagePyramid(nn.Module):
    """Features of every view at a quarter of its resolution and predictions at half.

    Level ``k`` has ``S / 2**(k + 1)`` pixels a side.  Each of the ``sizes.reading`` finest levels also reads the image
    at its own resolution and adds a residual to the prediction, initially zero, so that coarse levels can be trained
    first, on small images.  The coarsest level has one mean vector between the views, which have common lighting.
    ``in_bfloat16``: compute dtype of the convolutions; parameters and results are float32.
    """

    in_bfloat16 = False

    def __init__(self, sizes: PyramidSizes, finest: int = 0):
        """finest: finest level that is built, for images ``2**finest`` times smaller; above 0 without features."""
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
        last = {k: nn.Sequential(block(widths[k], widths[k]), nn.Conv2d(widths[k], PREDICTIONS, 1)) for k in reading}
        self.says = nn.ModuleDict({str(k): head for k, head in last.items()})
        if finest == 0:
            self.features = nn.Conv2d(widths[1], sizes.features, 1)
        # finer levels start by adding zero
        for layer in (*(head[1] for head in last.values()), *(down[str(k)][1] for k in reading[1:])):
            for value in layer.parameters():
                nn.init.zeros_(value)

    def forward(
        self, images: Tensor, masks: Tensor, place: Tensor, span: Tensor, counts: Sequence[int] | None = None
    ) -> tuple[Tensor | None, Tensor]:
        """Features ``(V, S/4, S/4, F)``, None if ``finest`` > 0, and raw predictions ``(V, S/2, S/2, C)`` of views.

        images: ``(V, S, S, 3)`` sRGB.  masks: ``(V, S, S)``.  place: ``(V, S, S, 2)`` from :func:`pixel_positions`.
        span: ``(V, S / k, S / k, 2)`` from :func:`pixel_hull_depths`.  S is a multiple of ``2**levels``.  counts:
        number of views of each object, in order; None if all are of one object.  Gradients reach every parameter.
        """
        counts = [len(masks)] if counts is None else counts
        inverse = torch.cat([masks.new_full((count,), 1.0 / count) for count in counts])
        inverse = inverse[:, None, None, None].expand(*masks.shape, 1)
        x = torch.cat([images * masks[..., None], masks[..., None], place, inverse], -1).permute(0, 3, 1, 2)
        x = torch.cat([x, functional.interpolate(span.permute(0, 3, 1, 2), size=x.shape[-2:], mode="nearest")], 1)
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.in_bfloat16):
            quarter, pixels = self._convolved(x, counts)
            features = self.features(quarter) if self.finest == 0 else None
        return None if features is None else channels_last(features), channels_last(pixels)

    def _convolved(self, x: Tensor, counts: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Activations of level 1 (or of the finest level) in the decoder, and the predictions of the finest level."""
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
        quarter, predicted = y, list[Tensor]()
        for k in reversed(range(self.finest, self.deepest)):
            at = str(k)
            y = self.up[at](levels[at] + _twice(self.across[at](y), levels[at]))
            quarter = y if k >= 1 else quarter
            if at in self.says:
                residual = self.says[at](y)
                predicted.append(residual + _twice(predicted[-1], residual) if predicted else residual)
        return quarter, predicted[-1]


def _twice(coarse: Tensor, fine: Tensor) -> Tensor:
    """``coarse`` at the resolution of ``fine``, bilinear."""
    return functional.interpolate(coarse, size=fine.shape[-2:], mode="bilinear", align_corners=False)
