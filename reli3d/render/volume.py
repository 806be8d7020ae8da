"""Volume rendering for the first training stage: ray marching through an occupancy grid, and compositing.

Density is per world unit, so a step of length ``s`` transmits ``exp(-density s)`` of the light.  As in NerfAcc (Li et
al. 2023), empty cells of the grid need no field queries.  The caller queries the field: march, query at ``positions``,
composite.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from reli3d._bridge import check, empty, launch, once_differentiable
from reli3d.kernels import volume as kernels

CHUNK = 1 << 18  # points a call when a field is evaluated over a whole grid: 3 MB of positions


@dataclass(frozen=True)
class OccupancyGrid:
    """occupied: ``(R, R, R)`` bool, index (x, y, z), over the cube [-radius, radius]^3."""

    occupied: Tensor
    radius: float

    def __post_init__(self):
        check("occupied", self.occupied, dtype=torch.bool)
        if self.occupied.ndim != 3 or len(set(self.occupied.shape)) != 1 or self.occupied.numel() == 0:
            raise ValueError(f"occupied: expected shape (R, R, R), got {tuple(self.occupied.shape)}")
        if not 0.0 < self.radius < float("inf"):
            raise ValueError(f"radius: expected a positive number, got {self.radius}")

    @classmethod
    def of_density(
        cls,
        field: Callable[[Tensor], Tensor],
        resolution: int,
        radius: float,
        *,
        threshold: float,
        device: torch.device | None = None,
    ) -> "OccupancyGrid":
        """Cells where ``field`` exceeds ``threshold`` at the center or a corner, grown by one cell on every side.

        field: maps points ``(N, 3)`` to densities ``(N,)``; evaluated without gradient, in chunks.  Detail smaller than
        half a cell may be missed between center and corners.
        """
        k = (torch.arange(2 * resolution + 1, device=device, dtype=torch.float32) / resolution - 1.0) * radius
        with torch.no_grad():
            values = [field(part) > threshold for part in torch.cartesian_prod(k, k, k).split(CHUNK)]
        fine = torch.cat(values).reshape(1, 1, *(2 * resolution + 1,) * 3).float()
        cells = torch.nn.functional.max_pool3d(fine, 3, 2)
        return cls(torch.nn.functional.max_pool3d(cells, 3, 1, 1)[0, 0] > 0.0, radius)


@dataclass(frozen=True)
class RaySamples:
    """Concatenated samples of N rays; ray ``i`` has samples ``first[i]`` to ``first[i + 1] - 1``, in ascending ``t``.

    ray: ``(S,)`` int32 ray index.  t: ``(S,)`` ray parameter, in units of the direction's length.  first: ``(N + 1,)``
    int32.  step: sample spacing in t.
    """

    ray: Tensor
    t: Tensor
    first: Tensor
    step: float

    def positions(self, origins: Tensor, directions: Tensor) -> Tensor:
        """World positions ``(S, 3)`` of the samples along rays ``(N, 3)``.  Gradients reach origins and directions."""
        ray = self.ray.long()
        return origins.index_select(0, ray) + directions.index_select(0, ray) * self.t[:, None]


@dataclass(frozen=True)
class Composite:
    """color ``(N, 3)`` and depth ``(N,)`` premultiplied by opacity, depth as the mean t; opacity ``(N,)`` in [0, 1]."""

    color: Tensor
    opacity: Tensor
    depth: Tensor


def march_rays(
    origins: Tensor,
    directions: Tensor,
    grid: OccupancyGrid,
    step: float,
    *,
    near: float = 0.0,
    far: float = float("inf"),
    shift: Tensor | None = None,
) -> RaySamples:
    """Samples at a spacing of ``step`` in the ray parameter t along N rays, in the occupied cells only.

    origins, directions: ``(N, 3)``; directions are usually unit.  near, far: limits of t.  shift: ``(N,)`` in [0, 1),
    position of each ray's samples within their steps; random values give an unbiased integral; None: 0.5.  Non-finite
    rays and rays that miss the cube have no samples.  No gradient.  Raises ValueError above 2^31 samples.
    """
    check("origins", origins, shape=("N", 3))
    n = len(origins)
    check("directions", directions, shape=(n, 3), like=origins)
    if grid.occupied.device != origins.device:
        raise ValueError(f"grid: expected device {origins.device}, got {grid.occupied.device}")
    if not (0.0 < step < float("inf") and 0.0 <= near <= far):
        raise ValueError(f"step, near, far: expected step > 0 and 0 <= near <= far, got {step}, {near}, {far}")
    shift = origins.new_full((1,), 0.5) if shift is None else shift
    check("shift", shift, like=origins)
    if shift.shape not in ((1,), (n,)) or (shift.numel() and not 0.0 <= float(shift.min()) <= float(shift.max()) < 1.0):
        raise ValueError(f"shift: expected ({n},) numbers in [0, 1), got {tuple(shift.shape)} or others")
    device = origins.device
    rays = [v.detach().contiguous() for v in (grid.occupied.view(torch.uint8), origins, directions, shift)]
    numbers = [float(grid.radius), float(step), float(near), float(min(far, 3.0e38))]
    count = torch.zeros(n, dtype=torch.int32, device=device)
    launch(kernels.samples_kernel, n, [*rays, *numbers, 0, count[:0], count, origins.new_empty(0)], device)
    total = torch.nn.functional.pad(count.long().cumsum(0), (1, 0))
    if int(total[-1]) >= 2**31:
        raise ValueError(f"step: expected fewer than 2**31 samples, got {int(total[-1])}")
    first = total.int()
    ray = torch.arange(n, dtype=torch.int32, device=device).repeat_interleave(count, output_size=int(total[-1]))
    t = torch.empty(len(ray), device=device, dtype=torch.float32)
    launch(kernels.samples_kernel, n, [*rays, *numbers, 1, first, count, t], device)
    return RaySamples(ray, t, first, float(step))


def composite(density: Tensor, color: Tensor, samples: RaySamples) -> Composite:
    """Color, opacity and depth of every ray; add ``(1 - opacity) * background`` for a background.

    density: ``(S,)`` per unit of t; negative values count as 0.  color: ``(S, 3)`` linear.  Gradients reach both and
    are exactly 0 for a density that is not positive.  Once differentiable.  Bitwise identical for any number of
    threads.  Source: Max 1995, Optical Models for Direct Volume Rendering.
    """
    check("density", density, shape=samples.t.shape, like=samples.t)
    check("color", color, shape=(len(density), 3), like=density)
    return Composite(*_Composite.apply(samples, density.contiguous(), color.contiguous()))


class _Composite(torch.autograd.Function):
    """Own backward: Warp's adjoint does not replay the optical depth that the loop carries."""

    @staticmethod
    def forward(ctx, samples: RaySamples, density: Tensor, color: Tensor):
        n, device = len(samples.first) - 1, density.device
        outs = [empty((n,), kind, device) for kind in (wp.vec3, wp.float32, wp.float32)]
        tensors = (density, color, samples.t, samples.first)
        launch(kernels.composite_kernel, n, [*tensors, samples.step, *outs], device)
        ctx.step = samples.step
        ctx.save_for_backward(*tensors)
        return tuple(outs)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_color: Tensor, g_opacity: Tensor, g_depth: Tensor):
        tensors, (_, *needed) = ctx.saved_tensors, ctx.needs_input_grad
        # gradients that are not needed have no rows, and the kernel skips them
        outs = [torch.zeros_like(v if w else v[:0]) for v, w in zip(tensors[:2], needed, strict=True)]
        gs = [g_color.contiguous(), g_opacity.contiguous(), g_depth.contiguous()]
        launch(kernels.composite_adjoint_kernel, len(tensors[3]) - 1, [*tensors, ctx.step, *gs, *outs], g_color.device)
        return None, *(g if w else None for g, w in zip(outs, needed, strict=True))
