"""Several processes that train one network together: each sees its share of a batch, gradients are averaged.

Start them with ``torchrun --nproc-per-node N``.  On a CPU one process a core, each with one thread, does twice the
steps of one process with all threads: the operations of a small network are too short to be split.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, distributed


@dataclass(frozen=True)
class Workers:
    rank: int = 0
    count: int = 1

    @staticmethod
    def join() -> Workers:
        """The group that torchrun started this process in; alone where it did not."""
        if "RANK" not in os.environ:
            return Workers()
        distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
        return Workers(distributed.get_rank(), distributed.get_world_size())

    def average(self, parameters: Sequence[Tensor], values: Tensor) -> Tensor:
        """Mean of ``values (k,)`` over the processes; the gradients of ``parameters`` become their means in place.

        A parameter without a gradient counts as zero, so that all processes send the same bytes.
        """
        if self.count == 1:
            return values
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([g.reshape(-1) for g in grads] + [values])
        distributed.all_reduce(flat)
        flat /= self.count
        for p, part in zip(parameters, flat[: -len(values)].split([p.numel() for p in parameters]), strict=True):
            p.grad = part.view_as(p)
        return flat[-len(values) :].clone()

    def leave(self) -> None:
        """End the group, and this process with exit code 0 where there are several.

        Gloo's threads give up the tensors of an operation some time after it has ended, and need the interpreter for
        it.  One that comes while the interpreter ends aborts the process, so the process ends without that: what the
        program has printed must be flushed before.
        """
        if self.count == 1:
            return
        distributed.barrier()
        distributed.destroy_process_group()
        os._exit(0)
