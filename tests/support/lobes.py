"""Irradiance under spherical Gaussians, by the integral that the kernels of the package use."""

import warp as wp
from torch import Tensor

from reli3d._bridge import call
from reli3d.kernels.sg import cosine_integral
from reli3d.render.gaussians import SphericalGaussians

wp.set_module_options({"enable_backward": True})


@wp.kernel
def irradiance_kernel(
    start: int,
    axis: wp.array[wp.vec3],
    sharpness: wp.array[float],
    amplitude: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    out: wp.array[wp.vec3],  # out
):
    i = start + wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(axis.shape[0]):
        total += amplitude[k] * cosine_integral(sharpness[k], wp.dot(normals[i], axis[k]))
    out[i] = total


def irradiance(light: SphericalGaussians, normals: Tensor) -> Tensor:
    """``(N, 3)`` at unit ``normals (N, 3)``; gradients reach all lobes and the normals."""
    n = len(normals)
    (out,) = call(irradiance_kernel, n, [*vars(light).values(), normals], [(n,)], shared=(0, 1, 2))
    return out
