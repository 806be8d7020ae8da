"""Cost of a call from torch to Warp: a launch of one thread, its gradient, and a stream through memory."""

import torch
import warp as wp

from reli3d import _bridge

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})


@wp.kernel
def square_kernel(
    start: int,
    x: wp.array[float],
    y: wp.array[float],  # out
):
    i = start + wp.tid()
    y[i] = x[i] * x[i]


def square(device, n, backward, square_of=lambda x: _bridge.call(square_kernel, len(x), [x], [(len(x),)])[0]):
    """Squares of ``n`` numbers through a kernel, with the gradient of their sum if ``backward``."""
    x = torch.linspace(0, 1, n, device=device).requires_grad_(backward)

    def step():
        y = square_of(x)
        return torch.autograd.grad(y.sum(), x) if backward else y

    return step, {"numbers": n}


def torch_square(device, n, backward):
    return square(device, n, backward, lambda x: x * x)


CASES = {
    "one": (square, dict(n=1, backward=False)),
    "one_grad": (square, dict(n=1, backward=True)),
    "stream": (square, dict(n=1 << 22, backward=False)),
    "stream_grad": (square, dict(n=1 << 22, backward=True)),
}
PEERS = dict.fromkeys(CASES, ("torch", torch_square))
