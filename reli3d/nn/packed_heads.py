"""Heads without gradient on a CPU: their layers in the order in which one kernel reads them, look-up included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from reli3d._bridge import SLICE_MIN, launch, over_slices, struct_of
from reli3d.geometry.triplane import BLOCK, packed_planes, sizes_of
from reli3d.kernels import heads as kernels
from reli3d.kernels.heads import GROUP, LANES
from reli3d.kernels.triplane import vec8

PACK = {torch.float32: 1, torch.bfloat16: 2}  # numbers in a word of 32 bits


@dataclass(frozen=True)
class PackedHeads:
    """Some MLPs on the same features: linear layers with SiLU between them."""

    outputs: tuple[int, ...]
    channels: int  # of the triplane
    inputs: int  # features of a point; the channels of a plane padded to blocks
    width: int  # of hidden layers, padded
    pack: int
    native: kernels.Heads

    @property
    def words(self) -> int:
        """Words that the activations of a point take."""
        return len(self.outputs) * self.width // self.pack

    def at(self, planes: Tensor, points: Tensor) -> Tensor:
        """Outputs of all MLPs, ``(sum of outputs, N)`` float32, at ``points (N, 3)`` of a triplane ``(3, C, H, W)``.

        As :func:`~reli3d.geometry.triplane.sample_triplane` describes them.  The same bits for any number of threads.
        Raises ValueError for another number of channels.
        """
        if planes.shape[1] != self.channels:
            raise ValueError(
                f"features: expected a triplane of {self.channels} channels for these heads, got {planes.shape[1]}"
            )
        packed, n = packed_planes(planes[None]), len(points)
        _, _, height, width, padded = packed.shape
        sizes = sizes_of(n, height, width, padded // BLOCK)
        out = points.new_empty(sum(self.outputs), n)

        def work(_, start: int, length: int) -> None:
            features, hidden = torch.zeros(2 * kernels.TILE * self.inputs), torch.zeros(2 * kernels.TILE * self.words)
            args = [
                start,
                (packed.view(-1, BLOCK), vec8),
                (points, kernels.wp.vec3),
                sizes,
                self.native,
                (features[: kernels.TILE * self.inputs].view(-1, BLOCK), vec8),
                (features, kernels.wp.float32),
                (hidden, kernels.wp.float32),
                (out, kernels.wp.float32),
            ]
            launch(kernels.point_heads_kernel, length, args, points.device)

        if n:
            over_slices(-(-n // kernels.TILE), work, slice_min=SLICE_MIN // kernels.TILE)
        return out

    def on_grid(self, of_xy: Tensor, of_xz: Tensor, of_yz: Tensor) -> Tensor:
        """Outputs ``(outputs, n, n, n)`` of one MLP in float32 on a grid.

        Its first layer gives point (i, j, k) the sum of ``of_xy[i, j]``, ``of_xz[i, k]`` and ``of_yz[j, k]``, each
        ``(n, n, width)``.  Raises ValueError for several MLPs, or bfloat16.
        """
        if len(self.outputs) != 1 or self.pack != 1:
            raise ValueError(
                f"heads: expected one in float32 for a grid, got {', '.join(map(str, self.outputs))} outputs"
            )
        n = len(of_xy)
        of_xy, of_xz, of_yz = (pad(t, (0, self.width - t.shape[2])) for t in (of_xy, of_xz, of_yz))
        out = of_xy.new_empty(*self.outputs, n**3)

        def work(_, start: int, length: int) -> None:
            hidden = torch.zeros(2 * kernels.TILE * self.words)
            planes = ((t.view(-1), kernels.wp.float32) for t in (of_xy, of_xz, of_yz))
            args = [start, *planes, n, self.native, (hidden, kernels.wp.float32), (out, kernels.wp.float32)]
            launch(kernels.grid_heads_kernel, length, args, of_xy.device)

        over_slices(n * n, work, slice_min=max(1, SLICE_MIN // n))
        return out.view(*self.outputs, n, n, n)


def pack_heads(mlps: Sequence[Sequence[nn.Linear]], dtype: torch.dtype) -> PackedHeads:
    """The linear layers of each MLP, at least two, on triplane features of the same number.

    dtype: of the hidden layers, float32 or bfloat16.  Raises ValueError for another.
    """
    if dtype not in PACK:
        raise ValueError(f"dtype: expected float32 or bfloat16 for heads on a CPU, got {dtype}")
    per = PACK[dtype]
    firsts = [layers[0] for layers in mlps]
    channels = firsts[0].in_features // 3
    inputs = 3 * (-(-channels // BLOCK) * BLOCK)
    width = max(-(-layer.out_features // GROUP) * GROUP for layer in firsts)
    weights, bias = [], []
    for layer in firsts:
        planes = layer.weight.unflatten(1, (3, channels))
        weights.append(_words(_padded(pad(planes, (0, inputs // 3 - channels)).flatten(1), width, inputs), dtype))
        bias.append(_padded(layer.bias[:, None], width, 1))
    for _, *hidden, last in mlps:
        for layer in hidden:
            weight = _padded(layer.weight, width, width)
            if per == 2:  # activations lie in the order in which the kernel has them: a lane of two vectors is a word
                weight = weight.unflatten(1, (-1, 2, LANES)).transpose(2, 3).flatten(1)
            weights.append(_words(weight, dtype))
            bias.append(_padded(layer.bias[:, None], width, 1))
        weights.append(_padded(last.weight, last.out_features, width).reshape(-1))
        bias.append(last.bias[:, None])
    depths = torch.tensor([len(layers) - 1 for layers in mlps], dtype=torch.int32)
    outputs = tuple(layers[-1].out_features for layers in mlps)
    native = struct_of(
        kernels.Heads,
        inputs=inputs,
        width=width,
        pack=per,
        weights=(torch.cat(weights), kernels.wp.float32),
        bias=(torch.cat(bias).view(-1), kernels.wp.float32),
        hidden=(depths, kernels.wp.int32),
        outputs=(torch.tensor(outputs, dtype=torch.int32), kernels.wp.int32),
    )
    return PackedHeads(outputs, channels, inputs, width, per, native)


def _padded(weight: Tensor, rows: int, columns: int) -> Tensor:
    return pad(weight, (0, columns - weight.shape[1], 0, rows - weight.shape[0]))


def _words(weight: Tensor, dtype: torch.dtype) -> Tensor:
    """``(rows / 64, words of a row, 64)`` words as float32, flat."""
    words = weight.to(dtype).contiguous().view(torch.float32)
    return words.view(-1, GROUP, words.shape[1]).transpose(1, 2).reshape(-1)
