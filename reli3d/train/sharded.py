"""Layers whose parameters, gradients and optimizer moments lie in parts on several processes: torch's ``fully_shard``.

The layers of the trunk hold nearly all numbers of ``official``.  Each is gathered when it computes and given up after
it.  What is left is whole on every process, and its gradients are averaged by :mod:`reli3d.train.workers`.  Outside
this module a sharded tensor is a tensor; checkpoints hold whole ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor

EPSILON = 1e-6  # added to a norm that is divided by, as in torch's clip_grad_norm_


def shard(layers: Iterable[nn.Module], device: torch.device) -> None:
    """Cut the parameters of ``layers`` among all processes, in place.  All processes must hold the same values."""
    mesh = init_device_mesh(device.type, (distributed.get_world_size(),))
    for layer in layers:
        fully_shard(layer, mesh=mesh)


def gathered(tree: Any, keep: bool) -> Any:
    """``tree`` of dictionaries, lists and tensors, with whole tensors on the CPU in the place of sharded ones.

    All processes must call it.  Where ``keep`` is false nothing is kept but the structure.
    """
    if isinstance(tree, DTensor):
        whole = tree.full_tensor()
        return whole.cpu() if keep else None
    if isinstance(tree, dict):
        return {key: gathered(value, keep) for key, value in tree.items()}
    if isinstance(tree, list):
        return [gathered(value, keep) for value in tree]
    return tree


def scattered(whole: Tensor, like: Tensor) -> Tensor:
    """``whole`` where ``like`` lies, in parts if ``like`` is; unchanged where it has another shape."""
    if whole.shape != like.shape:
        return whole
    whole = whole.to(like.device)
    if not isinstance(like, DTensor):
        return whole
    return distribute_tensor(whole, like.device_mesh, like.placements, src_data_rank=None)


def plain(parameters: Iterable[Tensor]) -> list[Tensor]:
    """Those that every process has whole."""
    return [p for p in parameters if not isinstance(p, DTensor)]


def clip_gradients(parameters: Sequence[Tensor], limit: float) -> Tensor:
    """Norm ``()`` of all gradients; where it is above ``limit`` they are scaled to that norm, in place.

    Whole gradients must be the same on all processes.
    """
    grads = [p.grad for p in parameters if p.grad is not None]
    cut = [g.to_local() for g in grads if isinstance(g, DTensor)]
    if not cut:
        return nn.utils.clip_grad_norm_(parameters, limit)
    same = [g for g in grads if not isinstance(g, DTensor)]
    squares = torch.stack([g.square().sum() for g in cut]).sum()
    distributed.all_reduce(squares)
    norm = (squares + sum(g.square().sum() for g in same)).sqrt()
    scale = (limit / (norm + EPSILON)).clamp(max=1.0)
    for g in (*cut, *same):
        g.mul_(scale)
    return norm
