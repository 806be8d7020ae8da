"""Central differences."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def directional_derivatives(
    loss: Callable[[], Tensor], values: Sequence[Tensor], directions: Sequence[Tensor], step: float
) -> tuple[float, float]:
    """The change of ``loss`` as ``values`` move along ``directions``: by its gradient, and by central differences.

    The values are changed in place, to one ``step`` below their own.
    """
    for value in values:
        value.requires_grad_(True)
    gradients = torch.autograd.grad(loss(), values, allow_unused=True)
    got = sum(float((g.double() * d).sum()) for g, d in zip(gradients, directions, strict=True) if g is not None)
    ends = []
    with torch.no_grad():
        for sign in (1.0, -2.0):
            for value, direction in zip(values, directions, strict=True):
                value += sign * step * direction
            ends.append(float(loss().double()))
    return got, (ends[0] - ends[1]) / (2.0 * step)
