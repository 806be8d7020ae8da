"""Solid noise with gradients: fractal sums of gradient noise, and cellular noise."""

from torch import Tensor

from reli3d import _bridge
from reli3d.kernels import noise as kernels


def fbm(
    points: Tensor, *, octaves: int = 4, gain: float = 0.5, ridged: bool = False, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Fractal sum of gradient noise at ``points (N, 3)``: value ``(N,)`` and its gradient ``(N, 3)`` in the points.

    One octave has mean 0 and standard deviation 0.5.  gain: amplitude ratio of successive octaves.  ridged: sums
    absolute values (turbulence, Perlin 1985).  Not differentiable by autograd.  Raises ValueError.
    """
    _bridge.check("points", points, shape=("N", 3))
    if not 1 <= octaves <= 16:
        raise ValueError(f"octaves: expected 1 to 16, got {octaves}")
    value = points.new_empty(len(points))
    gradient = points.new_empty(points.shape)
    args = [points.contiguous(), int(octaves), float(gain), int(ridged), int(seed) & 0xFFFFFF, value, gradient]
    _bridge.launch(kernels.fbm_kernel, len(points), args, points.device)
    return value, gradient


def cells(points: Tensor, *, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Cellular noise (Worley 1996) at ``points (N, 3)``, with one jittered feature point per lattice cell.

    Returns the distances to the nearest two feature points ``(N, 2)``, a random number in [0, 1) of the nearest one
    ``(N,)``, and the gradient of the second minus the first distance ``(N, 3)``.  Not differentiable by autograd.
    """
    _bridge.check("points", points, shape=("N", 3))
    distance = points.new_empty((len(points), 2))
    cell = points.new_empty(len(points))
    gradient = points.new_empty(points.shape)
    args = [points.contiguous(), int(seed) & 0xFFFFFF, distance, cell, gradient]
    _bridge.launch(kernels.cells_kernel, len(points), args, points.device)
    return distance, cell, gradient
