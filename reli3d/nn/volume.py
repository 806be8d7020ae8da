"""Feature volume of an object: view features pooled on a grid, a 3D U-Net, and trilinear lookup."""

from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.geometry.grid import sample_grid
from reli3d.geometry.hull import hull_grid
from reli3d.geometry.projection import gather_views
from reli3d.nn.presets import VolumeSizes
from reli3d.nn.pyramid import block
from reli3d.nn.view_features import AHEAD, ViewMaps, ahead_of_surface
from reli3d.nn.view_lookup import NUMBERS, summarize_views

NEAR_HULL = 0.08  # model units: grid points farther outside the visual hull are left zero
HULL_SCALE = 0.1  # model units per unit of the hull distance as a feature
HIDDEN, SPREAD = 32, 24  # widths of the two layers on the features of a view


_block = partial(block, kind=nn.Conv3d)


class FeatureVolume(nn.Module):
    """Features on a grid over ``[-R, R]^3`` with ``N`` points a side, order-invariant in any number of views.

    ``in_bfloat16``: compute dtype of the convolutions; parameters and results are float32.
    """

    in_bfloat16 = False

    def __init__(self, sizes: VolumeSizes, features: int):
        super().__init__()
        widths = sizes.widths
        self.mix = nn.Sequential(nn.Linear(features + NUMBERS, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, SPREAD))
        self.reduce = nn.Sequential(nn.Linear(2 * SPREAD + NUMBERS + 2 + AHEAD, widths[0]), nn.SiLU())
        self.first = _block(widths[0], widths[0])
        self.down = nn.ModuleList(
            nn.Sequential(_block(a, b, 2), _block(b, b)) for a, b in zip(widths[:-1], widths[1:], strict=True)
        )
        self.deepest = _block(widths[-1], widths[-1])
        self.across = nn.ModuleList(nn.Conv3d(b, a, 1) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.up = nn.ModuleList(_block(a, a) for a in widths[:-1])
        self.out = nn.Conv3d(widths[0], sizes.features, 1)
        self.side, self.radius = sizes.side, sizes.radius

    def forward(self, maps: ViewMaps, surface: Tensor, widening: Tensor | float = 0.0) -> Tensor:
        """Features ``(N, N, N, F)``, indexed x, y, z; differentiable.  surface: as in :func:`ahead_of_surface`."""
        axis = torch.linspace(-self.radius, self.radius, self.side, device=maps.images.device, dtype=torch.float32)
        hull = hull_grid(axis, maps.silhouette, maps.camera, far=NEAR_HULL).view(-1)
        near = (hull > -NEAR_HULL).nonzero()[:, 0]
        points = torch.cartesian_prod(axis, axis, axis)[near]
        reduced = self._reduced(maps, points, hull[near], ahead_of_surface(surface, maps, points, widening))
        x = reduced.new_zeros(self.side**3, reduced.shape[1]).index_copy(0, near, reduced)
        x = x.reshape(1, self.side, self.side, self.side, -1).permute(0, 4, 1, 2, 3)  # channels last: half the time
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.in_bfloat16):
            x = self._convolved(x)
        return x[0].float().permute(1, 2, 3, 0).contiguous()

    def _convolved(self, x: Tensor) -> Tensor:
        levels = [self.first(x)]
        for down in self.down:
            levels.append(down(levels[-1]))
        x = self.deepest(levels[-1])
        for across, up, finer in zip(reversed(self.across), reversed(self.up), reversed(levels[:-1]), strict=True):
            coarse = functional.interpolate(across(x), size=finer.shape[-3:], mode="trilinear", align_corners=False)
            x = up(finer + coarse)
        return self.out(x)

    def _reduced(self, maps: ViewMaps, points: Tensor, hull: Tensor, ahead: Tensor) -> Tensor:
        """Features of ``points (N, 3)``: weighted mean and variance of two layers over the views, and numbers."""
        gathered, _ = gather_views(maps.tokens, points, maps.camera)
        numbers, weight, summary = summarize_views(maps.images, maps.camera, points, None, None)
        mixed = self.mix(torch.cat([gathered, numbers], -1))
        mean = (mixed * weight[..., None]).sum(1)
        variance = ((mixed - mean[:, None]).square() * weight[..., None]).sum(1)
        rest = torch.stack([(hull / HULL_SCALE).clamp(-2, 2), torch.full_like(hull, 1.0 / len(maps.images))], -1)
        return self.reduce(torch.cat([mean, variance, summary, rest, ahead], -1))

    def sample(self, volume: Tensor, points: Tensor) -> Tensor:
        """Trilinear interpolation ``(N, F)`` of ``volume`` at ``points (N, 3)``, clamped to the border."""
        return sample_grid(volume, points / self.radius)
