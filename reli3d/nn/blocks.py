"""Large sets of points in blocks that stay in the processor's cache."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn

from reli3d._bridge import over_rows, pool, serial

ROWS = 8192  # points at a time without gradient: their features stay in the cache, which halves the time of the heads

T = TypeVar("T")


def linear_of(layers: nn.Module, index: int) -> nn.Linear:
    """Layer ``index`` of a stack, which is a linear one."""
    layer = layers[index] if isinstance(layers, nn.Sequential) else None
    if not isinstance(layer, nn.Linear):
        raise TypeError(f"layers[{index}]: expected nn.Linear, got {type(layer).__name__}")
    return layer


def in_rows(evaluate: Callable[..., dict[str, Tensor]], *inputs: Tensor) -> dict[str, Tensor]:
    """``evaluate(*inputs)`` without gradient; on a CPU in blocks of ROWS rows of the inputs.

    The blocks run on the threads of the bridge's pool, so ``evaluate`` must work row by row and keep no state.
    """
    n = len(inputs[0])
    if inputs[0].is_cuda or n == 0:
        with torch.no_grad():
            return evaluate(*inputs)
    parts = over_rows(n, ROWS, lambda start, stop: evaluate(*(x[start:stop] for x in inputs)))
    return {name: torch.cat([p[name] for p in parts]) for name in parts[0]}


def beside(work: Callable[[], T], device: torch.device) -> Callable[[], T]:
    """Begin ``work()`` on one thread of the bridge's pool, without gradient; the result gives its value when called.

    For long chains that leave a processor idle.  The work is done at once where the caller computes alone, and on CUDA.
    What it raises comes out of the result, or at once.
    """
    work = torch.no_grad()(work)
    if serial() or device.type == "cuda":
        value = work()
        return lambda: value
    return pool().submit(work).result
