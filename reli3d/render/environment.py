"""Distant lighting as a lat-long map: lookup with gradients, importance sampling by a piecewise-constant CDF.

Mapping as in :mod:`reli3d.render.latlong`: upper edge +Y, horizontal center +X, +Z right of the center.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import torch
import warp as wp
from torch import Tensor

from reli3d import _bridge
from reli3d._bridge import Movable, check, empty, full_precision, launch, tensor_of
from reli3d.kernels import envmap as kernels
from reli3d.render.latlong import lat_long_directions, texel_solid_angles

_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709


@dataclass(frozen=True)
class EnvironmentCDF:
    """Importance-sampling CDF of an environment, with constant density over each texel.

    rows: ``(2, H + 1)``, the CDF over rows, and y = cos(theta) of the row edges.  columns: ``(H, W + 1)``, the CDF
    within each row.  row_guide ``(1, H)`` and column_guide ``(H, W)``: int32, where to start the search.  density:
    ``(H, W)`` [1/sr].
    """

    rows: Tensor
    columns: Tensor
    row_guide: Tensor
    column_guide: Tensor
    density: Tensor


@dataclass(frozen=True)
class Environment(Movable):
    """Distant lighting as a lat-long map ``radiance (H, W, 3)``, normally W = 2 H, linear Rec. 709 radiance.

    The upper edge is +Y, the horizontal center (the border of columns W/2 - 1 and W/2) is +X, and +Z is right of the
    center.  Methods: ``.lookup(directions)``, ``.rotated(yaw)`` [rad], ``.resized(height)``, ``.sample(u)``,
    ``.pdf(directions)``, ``.irradiance()``.  Gradients reach the texels.  ``radiance`` must not be modified in place:
    the sampling CDF would be outdated (more noise), so in optimization construct a new Environment in every step.
    Negative values are rejected only when a file is written: optimize log radiance, or clamp.  Raises TypeError for a
    wrong dtype, ValueError for a wrong shape.

    >>> light = reli3d.Environment(torch.rand(16, 32, 3))
    >>> radiance = light.rotated(0.5).lookup(torch.tensor([0.0, 1.0, 0.0]))
    """

    radiance: Tensor

    def __post_init__(self):
        object.__setattr__(self, "radiance", tensor_of(self.radiance))
        check("radiance", self.radiance, last=3)
        if self.radiance.ndim != 3 or self.radiance.numel() == 0:
            raise ValueError(f"radiance: expected (H, W, 3), got {tuple(self.radiance.shape)}")

    @classmethod
    def constant(cls, rgb: Tensor | Sequence[float], height: int = 16) -> "Environment":
        """Uniform lighting with radiance ``rgb (3,)``, a tensor or numbers."""
        color = rgb if isinstance(rgb, Tensor) else torch.as_tensor(rgb, dtype=torch.float32)
        check("rgb", color, shape=(3,))
        return cls(color.expand(height, 2 * height, 3).contiguous())

    def lookup(self, directions: Tensor) -> Tensor:
        """Radiance ``(..., 3)`` from unit ``directions (..., 3)``: bilinear between texel centers, periodic in azimuth.

        Gradients reach the texels and the directions, except at the poles, where the azimuth is undefined.
        """
        check("directions", directions, last=3, like=self.radiance)
        flat = directions.reshape(-1, 3).contiguous()
        return _Lookup.apply(self.radiance.contiguous(), flat).reshape(directions.shape)

    @full_precision
    def irradiance(self) -> "Environment":
        """Irradiance [radiance times sr] for every surface normal, as a lat-long map of the same size.

        A sum of n^2 terms for n texels, so use maps of at most 32 rows.  Gradients reach the texels.
        """
        height, width = self.radiance.shape[:2]
        directions = lat_long_directions(height, width, dtype=torch.float64).reshape(-1, 3)
        angle = texel_solid_angles(height, width)[:, None].expand(-1, width).reshape(-1)
        weight = ((directions @ directions.T).clamp(min=0.0) * angle).to(self.radiance)
        return Environment((weight @ self.radiance.reshape(-1, 3)).reshape(self.radiance.shape))

    def rotated(self, yaw: float) -> "Environment":
        """The environment rotated by ``yaw`` [rad] about +Y, counter-clockwise seen from above: -Z moves towards -X.

        yaw: a Python number, without gradient.  Columns are interpolated linearly; multiples of 2 pi / W shift exactly.
        Raises TypeError if ``yaw`` is not a number.
        """
        if not isinstance(yaw, Real):
            raise TypeError(f"yaw: expected a number, got {type(yaw).__name__}")
        width = self.radiance.shape[1]
        shift = yaw * width / (2.0 * torch.pi)
        whole = round(shift) if abs(shift - round(shift)) < 1e-6 * width else int(shift // 1)  # rounding of yaw itself
        part = shift - whole
        radiance = torch.roll(self.radiance, -whole, 1)
        if abs(part) >= 1e-6 * width:
            radiance = (1.0 - part) * radiance + part * torch.roll(radiance, -1, 1)
        return Environment(radiance)

    def resized(self, height: int) -> "Environment":
        """The environment at ``height`` x 2 ``height`` texels: area-averaged when reduced, bilinear when enlarged."""
        if height > self.radiance.shape[0]:
            return Environment(self.lookup(lat_long_directions(height, device=self.radiance.device)))
        planes = self.radiance.permute(2, 0, 1)[None]
        out = torch.nn.functional.interpolate(planes, size=(height, 2 * height), mode="area")
        return Environment(out[0].permute(1, 2, 0).contiguous())

    @cached_property
    @full_precision
    def cdf(self) -> EnvironmentCDF:
        """Importance-sampling CDF; the weight of a texel is the integral of the bilinear luminance over it.

        This integral equals the luminance filtered by (1/8, 3/4, 1/8) along each axis.  A black map is sampled
        uniformly over the sphere.  Raises ValueError for a non-finite texel.
        """
        radiance = self.radiance.detach().double()
        if not bool(torch.isfinite(radiance).all()):
            raise ValueError("radiance: expected finite texels, got NaN or infinity")
        value = radiance.clamp(min=0.0) @ radiance.new_tensor(_LUMINANCE)
        value = 0.75 * value + 0.125 * (value.roll(1, 1) + value.roll(-1, 1))
        above, below = torch.cat([value[:1], value[:-1]]), torch.cat([value[1:], value[-1:]])
        value = 0.75 * value + 0.125 * (above + below)
        height, width = value.shape
        angle = texel_solid_angles(height, width, value.device)
        if not bool(value.max() > 0.0):
            value = torch.ones_like(value)
        weight = value * angle[:, None]
        per_row = weight.sum(1)
        weight = torch.where(per_row[:, None] > 0.0, weight, torch.ones_like(weight))  # an empty row is never chosen
        columns, rows = _cdf(weight), _cdf(per_row[None])
        heights = torch.cos(torch.linspace(0.0, torch.pi, height + 1, dtype=torch.float64, device=value.device))
        # from the rounded CDFs, so that density and samples agree to the last bit
        density = rows.double().diff()[0][:, None] * columns.double().diff() / angle[:, None]
        return EnvironmentCDF(
            torch.cat([rows, heights[None].float()]), columns, _guide(rows), _guide(columns), density.float()
        )

    def sample(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Directions ``(..., 3)`` and density ``(...)`` [1/sr] for uniform ``u (..., 2)`` in [0, 1).  No gradient."""
        check("u", u, last=2, like=self.radiance)
        flat = u.detach().reshape(-1, 2).contiguous()
        directions, pdf = (empty((len(flat),), kind, flat.device) for kind in (wp.vec3, wp.float32))
        launch(kernels.sample_envmap_kernel, len(flat), [*vars(self.cdf).values(), flat, directions, pdf], flat.device)
        return directions.reshape(*u.shape[:-1], 3), pdf.reshape(u.shape[:-1])

    def pdf(self, directions: Tensor) -> Tensor:
        """Density ``(...)`` [1/sr] of :meth:`sample` at unit ``directions (..., 3)``.  No gradient."""
        check("directions", directions, last=3, like=self.radiance)
        flat = directions.detach().reshape(-1, 3).contiguous()
        pdf = empty((flat.shape[0],), wp.float32, flat.device)
        launch(kernels.pdf_envmap_kernel, flat.shape[0], [self.cdf.density, flat, pdf], flat.device)
        return pdf.reshape(directions.shape[:-1])


class _Lookup(torch.autograd.Function):
    """Own backward: Warp's adjoint would go through the direction's angles where only the texels need a gradient."""

    @staticmethod
    def forward(ctx, radiance: Tensor, directions: Tensor) -> Tensor:
        out = empty((directions.shape[0],), wp.vec3, directions.device)
        launch(kernels.lookup_envmap_kernel, directions.shape[0], [radiance, directions, out], directions.device)
        ctx.save_for_backward(radiance, directions)
        return out

    @staticmethod
    @_bridge.once_differentiable
    def backward(ctx, g_out: Tensor):
        radiance, directions = ctx.saved_tensors
        n, device, needed = directions.shape[0], directions.device, ctx.needs_input_grad
        height, width = radiance.shape[:2]
        # a slice's own accumulator must not cost more than its lookups; on CUDA one launch for all
        least = max(_bridge.SLICE_MIN, height * width) if device.type == "cpu" else n + 1
        parts = len(_bridge.slices(n, least))
        g_radiance = torch.zeros(parts, height if needed[0] else 0, width, 3, device=device, dtype=torch.float32)
        g_directions = torch.empty(n if needed[1] else 0, 3, device=device, dtype=torch.float32)
        ins = [radiance, directions, g_out.contiguous()]

        def work(k, start, count):
            outs = [g_radiance[k], g_directions]
            launch(kernels.lookup_adjoint_kernel, count, [start, *ins, *outs], device, slice_min=count)

        _bridge.over_slices(n, work, slice_min=least)
        return g_radiance.sum(0) if needed[0] else None, g_directions if needed[1] else None


def _cdf(weight: Tensor) -> Tensor:
    """Float32 CDF ``(R, n + 1)`` along the last axis of float64 weights; ends are exactly 0 and 1."""
    total = torch.cat([torch.zeros_like(weight[:, :1]), weight.cumsum(1)], 1)
    out = (total / total[:, -1:]).float()
    out[:, -1] = 1.0
    return out.contiguous()


def _guide(cdf: Tensor) -> Tensor:
    """Cell of u = j / n, ``(R, n)`` int32, for each row of a CDF ``(R, n + 1)``."""
    n = cdf.shape[1] - 1
    u = torch.arange(n, dtype=torch.float64, device=cdf.device).div(n) * (1.0 - 2.0**-22)
    u = u.expand(cdf.shape[0], n).contiguous()  # a little less: the kernel's float product u n may round up to j
    return (torch.searchsorted(cdf.double(), u, right=True) - 1).clamp(0, n - 1).int()
