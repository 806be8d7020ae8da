"""Muon for matrices and convolutions (Jordan et al. 2024, kellerjordan.github.io/posts/muon), AdamW for the others."""

import torch
from torch import Tensor

MOMENTUM = 0.95
UPDATE_RMS = 0.2  # root mean square of an update over the learning rate, about that of AdamW (Liu et al. 2025)
MIN_RANK = 16  # matrices of smaller rank are left to AdamW
NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)  # coefficients of Jordan's quintic iteration
NEWTON_SCHULZ_STEPS = 5
MAX_TIMES = 1.0  # multiplier of the learning rate above which a layer, small at first, is left to AdamW


def orthogonalized(matrix: Tensor) -> Tensor:
    """``matrix (M, N)`` with all singular values moved to 0.7 to 1.2, by Newton-Schulz iterations."""
    a, b, c = NEWTON_SCHULZ
    x = matrix.T if matrix.shape[0] > matrix.shape[1] else matrix
    x = x / x.norm().clamp(min=1e-7)
    for _ in range(NEWTON_SCHULZ_STEPS):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.T if matrix.shape[0] > matrix.shape[1] else x


class Muon(torch.optim.AdamW):
    """AdamW in which matrices, and convolutions as such, of at least MIN_RANK follow Muon if ``times`` <= MAX_TIMES."""

    @torch.no_grad()
    def step(self, closure=None):
        """closure: None; gradients are there already."""
        for group in self.param_groups:
            for parameter in group["params"] if group.get("times", 1.0) <= MAX_TIMES else ():
                gradient = parameter.grad
                if gradient is None or gradient.ndim < 2 or min(gradient.flatten(1).shape) < MIN_RANK:
                    continue
                state = self.state[parameter]
                if "momentum" not in state:
                    state["momentum"] = torch.zeros_like(parameter)
                    state["step"] = torch.zeros(())  # AdamW loads no state without it
                momentum = state["momentum"]
                momentum.lerp_(gradient, 1 - MOMENTUM)
                update = orthogonalized(torch.lerp(gradient, momentum, MOMENTUM).flatten(1))
                scale = UPDATE_RMS * max(update.shape) ** 0.5
                parameter.mul_(1 - group["lr"] * group["weight_decay"])
                parameter.add_(update.view_as(parameter), alpha=-group["lr"] * scale)
                parameter.grad = None  # AdamW skips it
        return super().step(closure)
