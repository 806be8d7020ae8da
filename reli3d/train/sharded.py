"""Fully sharded data parallelism of the trunk's layers, by torch's ``fully_shard``.

Parameters, gradients and optimizer moments of these layers, nearly all of preset ``official``, are divided among the
processes; a layer is gathered while it computes.  All other parameters are replicated, and
:mod:`reli3d.train.workers` averages their gradients.  Checkpoints hold full tensors.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor

EPSILON = 1e-6  # added to a norm that is divided by, as in torch's clip_grad_norm_


def shard(layers: Iterable[nn.Module], device: torch.device) -> None:
    """Divides the parameters of ``layers`` among all processes, in place.  They must be equal on all processes."""
    mesh = init_device_mesh(device.type, (distributed.get_world_size(),))
    for layer in layers:
        fully_shard(layer, mesh=mesh)


def gathered(tree: Any, keep: bool) -> Any:
    """``tree`` of dictionaries, lists and tensors with its sharded tensors replaced by full ones on the CPU.

    All processes must call it.  keep: False replaces them by None, which frees the memory on all but one process.
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
    """``whole`` on the device and with the sharding of ``like``; unchanged if the shapes differ."""
    if whole.shape != like.shape:
        return whole
    whole = whole.to(like.device)
    if not isinstance(like, DTensor):
        return whole
    return distribute_tensor(whole, like.device_mesh, like.placements, src_data_rank=None)


def replicated(parameters: Iterable[Tensor]) -> list[Tensor]:
    """The ``parameters`` that are not sharded."""
    return [p for p in parameters if not isinstance(p, DTensor)]


def clip_gradients(parameters: Sequence[Tensor], limit: float) -> Tensor:
    """Global norm ``()`` of the gradients, which are scaled in place to a norm of at most ``limit``.

    Gradients that are not sharded must be equal on all processes.
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
