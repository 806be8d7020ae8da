"""Features of points from a triplane: three feature planes over XY, XZ and YZ of the cube [-1, 1]^3."""

import itertools

import numpy as np
import torch
from torch import Tensor

from reli3d._bridge import check, launch, once_differentiable, over_rows, struct_of
from reli3d.kernels import triplane as kernels

BLOCK_CHANNELS = 8  # channels of a kernels.vec8
ROWS_MIN = 8  # rows of cells a CPU slice of the planes' adjoint: each adds all the points that fall in it
CACHED_FLOATS = 1 << 16  # floats of a plane that stay in a core's second-level cache whatever the order of the points
BANDS = 16  # of the rows of a plane, a CPU thread each: more copy more rows twice
PROBED = 4096  # consecutive points tested for coherence
STEP_TEXELS_MAX = 8.0  # distance of coherent consecutive points
SEGMENT = 8  # cells of a row that a CUDA thread adds the points of, at least: it writes one texel beyond them
WALK = 0.8  # fraction of coherent points from which the points are not sorted


class _SampleTriplane(torch.autograd.Function):
    """Custom backward without atomics, which Warp lacks on CPUs and which are not deterministic on CUDA.

    Points are sorted by row of cells, and each thread owns the texels that it accumulates into.  On a CPU the
    forward pass uses the same order, which keeps rows of large planes in the cache, and transposes channel-first rows
    to channel-last on the fly.  Coherent points (a grid, texels of an atlas) are not sorted.
    """

    @staticmethod
    def forward(ctx, planes: Tensor, points: Tensor) -> Tensor:
        batch, _, channels, height, width = planes.shape
        n, blocks = points.shape[1], -(-channels // BLOCK_CHANNELS)
        order = edges = points.new_empty(0, dtype=torch.int32)
        large = not planes.is_cuda and height * width * blocks * BLOCK_CHANNELS > CACHED_FLOATS
        scattered = large and not _is_walk(points, max(height, width))
        channel_first = planes.dtype == torch.float32 and planes.is_contiguous() and planes.numel() < 2**31
        by_rows = scattered and channel_first and not ctx.needs_input_grad[1]
        if ctx.needs_input_grad[0] or scattered:
            order, edges = _by_cell_row(points, height, width)
        features = points.new_empty(batch, n, 3, blocks * BLOCK_CHANNELS)
        packed = planes.detach() if by_rows else packed_planes(planes)
        inputs = points.view(-1, 3), order.view(-1)
        out, sizes = features.view(-1, BLOCK_CHANNELS), sizes_of(n, height, width, blocks)
        if by_rows:
            scratch = points.new_empty(batch * 3 * BANDS * 2 * (width + 2) * blocks, BLOCK_CHANNELS)
            args = [packed.view(-1), *inputs, edges.view(-1), sizes, channels, BANDS, scratch, out]
            launch(kernels.sample_rows_kernel, batch * 3 * BANDS, args, planes.device, slice_min=1)
        else:
            split = blocks if planes.is_cuda else 1  # neighboring GPU threads read neighboring blocks
            args = [packed.view(-1, BLOCK_CHANNELS), *inputs, sizes, split, out]
            launch(kernels.sample_kernel, batch * n * 3 * split, args, planes.device)
        sorted_points = (order, edges) if ctx.needs_input_grad[0] else (None, None)
        source = planes if all(ctx.needs_input_grad) else None  # makes a second derivative an error: packed is a copy
        ctx.save_for_backward(points, packed if ctx.needs_input_grad[1] else None, *sorted_points, source)
        ctx.shape, ctx.dtype = planes.shape, planes.dtype
        return features[..., :channels].reshape(batch, n, 3 * channels)

    @staticmethod
    @once_differentiable
    def backward(ctx, g_out: Tensor):
        points, packed, order, edges, _ = ctx.saved_tensors
        channels = ctx.shape[2]
        g = g_out.reshape(*points.shape[:2], 3, channels)
        if channels % BLOCK_CHANNELS:
            g = torch.nn.functional.pad(g, (0, -channels % BLOCK_CHANNELS))
        g = g.contiguous()
        g_planes = _planes_adjoint(points, g, order, edges, ctx.shape).to(ctx.dtype) if order is not None else None
        if packed is None:
            return g_planes, None
        at, g_points = points.view(-1, 3), torch.empty_like(points)
        height, width = ctx.shape[3:]
        sizes = sizes_of(points.shape[1], height, width, packed.shape[-1] // BLOCK_CHANNELS)
        args = [packed.view(-1, BLOCK_CHANNELS), at, g.view(-1, BLOCK_CHANNELS), sizes, g_points.view(-1, 3)]
        launch(kernels.points_adjoint_kernel, len(at), args, points.device)
        return g_planes, g_points


def sizes_of(points: int, height: int, width: int, blocks: int) -> kernels.Sizes:
    """Kernel struct with the numbers of points, texels per plane and blocks of 8 channels."""
    return struct_of(kernels.Sizes, points=points, height=height, width=width, blocks=blocks)


def packed_planes(planes: Tensor) -> Tensor:
    """``(B, 3, H, W, C')`` float32, C' the next multiple of 8; no copy if the planes already have this layout."""
    packed = planes.detach().permute(0, 1, 3, 4, 2)
    if planes.shape[2] % BLOCK_CHANNELS:
        packed = torch.nn.functional.pad(packed, (0, -planes.shape[2] % BLOCK_CHANNELS))
    return packed.to(torch.float32).contiguous()


def _is_walk(points: Tensor, size: int) -> bool:
    """Whether the first points mostly lie within a few texels, ``size`` along a plane, of those before them."""
    probed = points[:, :PROBED]
    near = (probed[:, 1:] - probed[:, :-1]).abs().amax(-1) < STEP_TEXELS_MAX * 2.0 / size
    return bool(near.sum() > WALK * near.numel())


def _segments(points: Tensor, width: int) -> int:
    """Segments of a row of cells in the adjoint: one on a CPU; on CUDA of ``SEGMENT`` cells, for more threads."""
    return max(1, (width + 1) // SEGMENT) if points.is_cuda else 1


def _by_cell_row(points: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Points of every plane ``(3 B, N)`` by row of cells, misses last; starts of :func:`_segments` and end."""
    slabs, n, segments = points.shape[0] * 3, points.shape[1], _segments(points, width)
    bins = segments * SEGMENT if points.is_cuda else 2**16 // (height + 2)
    keys = torch.empty(slabs, n, dtype=torch.int32, device=points.device)
    args = [points.view(-1, 3), sizes_of(n, height, width, 0), bins, keys.view(-1)]
    launch(kernels.cell_key_kernel, slabs * n, args, points.device)
    groups = (height + 1) * segments
    edges = keys.new_zeros(slabs, groups + 1)
    if points.is_cuda:
        order = torch.argsort(keys, dim=1, stable=True).to(torch.int32)
        group = keys // SEGMENT + torch.arange(slabs, device=points.device, dtype=torch.int64)[:, None] * (groups + 1)
        count = torch.bincount(group.view(-1), minlength=slabs * (groups + 1)).view(slabs, groups + 1)
        edges[:, 1:] = count[:, :-1].cumsum(1)
        return order, edges
    order = torch.empty_like(keys)

    def sort(slab: int, _stop: int) -> None:  # numpy sorts 16-bit keys by radix, about 10 times faster than torch.sort
        key = keys[slab].numpy().astype(np.uint16)
        order[slab] = torch.from_numpy(np.argsort(key, kind="stable"))
        edges[slab, 1:] = torch.from_numpy(np.bincount(key // bins, minlength=height + 2)[:-1].cumsum())

    over_rows(slabs, 1, sort)
    return order, edges


def _planes_adjoint(points: Tensor, g: Tensor, order: Tensor, edges: Tensor, shape: torch.Size) -> Tensor:
    batch, n, _ = points.shape
    channels, height, width = shape[2:]
    blocks = g.shape[-1] // BLOCK_CHANNELS
    g_planes = torch.zeros(batch, 3, height, width, blocks * BLOCK_CHANNELS, device=points.device, dtype=torch.float32)
    split, sizes = 1 if points.device.type == "cpu" else blocks, sizes_of(n, height, width, blocks)
    segments = _segments(points, width)
    inputs = [points.view(-1, 3), g.view(-1, BLOCK_CHANNELS), order.view(-1), edges.view(-1), sizes, segments]
    out = g_planes.view(-1, BLOCK_CHANNELS)
    for row_parity, parity in itertools.product((0, 1), (0, 1)):
        count = batch * 3 * ((height + 2 - row_parity) // 2) * ((segments + 1 - parity) // 2) * split
        args = [*inputs, row_parity, parity, split, out]
        launch(kernels.planes_adjoint_kernel, count, args, points.device, slice_min=ROWS_MIN)
    return g_planes[..., :channels].permute(0, 1, 4, 2, 3)


def sample_triplane(planes: Tensor, points: Tensor) -> Tensor:
    """Samples features ``(B, N, 3 * C)`` float32 at ``points``, bilinearly from the planes XY, XZ, YZ, in that order.

    planes: ``(B, 3, C, H, W)`` float32, bfloat16 or float16; the first coordinate of a plane runs along W.  As
    ``grid_sample`` with ``align_corners=False``, ``padding_mode="zeros"``, in float32.  Not copied if float32, C a
    multiple of 8, channels last.  points: ``(B, N, 3)`` float32 in [-1, 1]; NaN gives zeros.

    Gradients reach ``planes`` (in their dtype) and ``points`` (one-sided at texel centers), bitwise reproducibly.
    Raises TypeError for a wrong dtype, ValueError for a wrong shape, device or size (32-bit indices).

    >>> planes = torch.rand(1, 3, 8, 16, 16, requires_grad=True)
    >>> features = reli3d.sample_triplane(planes, torch.zeros(1, 100, 3))  # (1, 100, 24)
    """
    if not isinstance(planes, Tensor):
        raise TypeError(f"planes: expected a tensor, got {type(planes).__name__}")
    if planes.dtype not in (torch.float32, torch.bfloat16, torch.float16):
        raise TypeError(f"planes: expected float32, bfloat16 or float16, got {planes.dtype}")
    if planes.ndim != 5 or planes.shape[1] != 3 or 0 in planes.shape[2:]:
        raise ValueError(f"planes: expected shape (B, 3, C, H, W), got {tuple(planes.shape)}")
    check("points", points, last=3, like=planes)
    if points.ndim != 3 or points.shape[0] != planes.shape[0]:
        raise ValueError(f"points: expected shape ({planes.shape[0]}, N, 3), got {tuple(points.shape)}")
    batch, _, channels, height, width = planes.shape
    if max(height, width) > 32000:
        raise ValueError(f"planes: expected at most 32000 rows and columns, got {(height, width)}")  # 16-bit keys
    blocks = -(-channels // BLOCK_CHANNELS)
    largest = 3 * batch * max(height * width * blocks, (height + 2) * blocks, points.shape[1] * blocks)
    if largest >= 2**31:
        raise ValueError(f"planes, points: expected fewer than 2**31 blocks of 8 channels, got {largest}")
    return _SampleTriplane.apply(planes, points.contiguous())
