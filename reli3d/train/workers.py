"""Data parallelism under ``torchrun --nproc-per-node N``: each process computes a part of the batch."""

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
    def join() -> "Workers":
        """Joins the process group of torchrun; a group of one process without torchrun."""
        if "RANK" not in os.environ:
            return Workers()
        devices, here = torch.cuda.device_count(), int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        if devices:
            torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", 0)) % devices)
        # NCCL needs a device for each process
        distributed.init_process_group("cpu:gloo,cuda:nccl" if devices >= here else "gloo")
        return Workers(distributed.get_rank(), distributed.get_world_size())

    def average(self, parameters: Sequence[Tensor], values: Tensor) -> Tensor:
        """Mean of ``values (k,)`` over the processes; also averages the gradients, of which missing ones are zero."""
        if self.count == 1:
            return values
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        device = grads[0].device if grads else values.device
        flat = torch.cat([g.reshape(-1) for g in grads] + [values.to(device)])
        distributed.all_reduce(flat)
        flat /= self.count
        for p, part in zip(parameters, flat[: -len(values)].split([p.numel() for p in parameters]), strict=True):
            p.grad = part.view_as(p)
        return flat[-len(values) :].to(values.device, copy=True)

    def leave(self) -> None:
        """With several processes destroys the group and exits with 0: Gloo's threads would abort a normal exit."""
        if self.count == 1:
            return
        distributed.barrier()
        distributed.destroy_process_group()
        os._exit(0)
