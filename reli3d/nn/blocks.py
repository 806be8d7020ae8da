"""Evaluation of large point sets in blocks that fit the cache, and tasks on the thread pool."""

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn

from reli3d._bridge import over_rows, pool, serial

ROWS = 8192  # points per block without gradient: features fit the cache, which halves the time of the heads

T = TypeVar("T")


def linear_of(layers: nn.Module, index: int) -> nn.Linear:
    """Layer ``index`` of ``layers`` as ``nn.Linear``.  Raises TypeError for another kind of layer."""
    layer = layers[index] if isinstance(layers, nn.Sequential) else None
    if not isinstance(layer, nn.Linear):
        raise TypeError(f"layers[{index}]: expected nn.Linear, got {type(layer).__name__}")
    return layer


def in_rows(evaluate: Callable[..., dict[str, Tensor]], *inputs: Tensor) -> dict[str, Tensor]:
    """``evaluate(*inputs)`` without gradient; on a CPU in parallel blocks of rows, which must be independent."""
    n = len(inputs[0])
    if inputs[0].is_cuda or n == 0:
        with torch.no_grad():
            return evaluate(*inputs)
    parts = over_rows(n, ROWS, lambda start, stop: evaluate(*(x[start:stop] for x in inputs)))
    return {name: torch.cat([p[name] for p in parts]) for name in parts[0]}


def submit(work: Callable[[], T], device: torch.device) -> Callable[[], T]:
    """Submits ``work()`` to the thread pool, without gradient; returns a function that waits.  On CUDA runs it now."""
    work = torch.no_grad()(work)
    if serial() or device.type == "cuda":
        value = work()
        return lambda: value
    return pool().submit(work).result
