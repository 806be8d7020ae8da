"""Light of a RENI++ latent, evaluated direction by direction without a map."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from reli3d._bridge import check, empty, launch
from reli3d.kernels import reni as kernels
from reli3d.render.environment import Environment

SLICE_MIN = 64  # directions of a CPU slice: each takes some 20 us


@dataclass(frozen=True)
class ReniLight:
    """One latent's network as plain numbers, made by ``reli3d.nn.reni.EnvironmentDecoder.light``.

    latent: ``(L, 2)`` horizontal parts, turned.  first: ``(5 (L + 2) + 1, 128)``, last row the offset.  matrices:
    ``(256 K, 128)`` and vectors: ``(7 K, 128)`` of K layers.  last: ``(3, 128)``, offset ``(1, 3)``.  See
    :func:`reli3d.kernels.reni.eval_reni`.  No gradient passes through here: fit latents through the decoder.
    """

    latent: Tensor
    first: Tensor
    matrices: Tensor
    vectors: Tensor
    last: Tensor
    offset: Tensor

    def __post_init__(self):
        check("latent", self.latent, last=2)
        for name in ("first", "matrices", "vectors", "last"):
            check(name, getattr(self, name), last=kernels.WIDTH, like=self.latent)
        check("offset", self.offset, last=3, like=self.latent)
        layers = self.matrices.shape[0] // (2 * kernels.WIDTH)
        wanted = {
            "first": kernels.CODES * (len(self.latent) + 2) + 1,
            "matrices": 2 * kernels.WIDTH * layers,
            "vectors": kernels.VECTORS * layers,
            "last": 3,
            "offset": 1,
        }
        for name, rows in wanted.items():
            if getattr(self, name).shape[:-1] != (rows,):
                raise ValueError(f"{name}: expected {rows} rows, got {tuple(getattr(self, name).shape)}")

    @torch.no_grad()
    def lookup(self, directions: Tensor) -> Tensor:
        """Radiance ``(..., 3)`` from unit world ``directions (..., 3)``, linear Rec. 709."""
        check("directions", directions, last=3, like=self.latent)
        flat = directions.reshape(-1, 3).contiguous()
        return self._run(kernels.eval_reni_kernel, len(flat), (flat, wp.vec3)).reshape(directions.shape)

    @torch.no_grad()
    def environment(self, height: int) -> Environment:
        """The light at the texel centres of a lat-long map of ``height`` x 2 ``height``."""
        if height < 1:
            raise ValueError(f"height: expected at least 1, got {height}")
        radiance = self._run(kernels.decode_reni_kernel, 2 * height * height, int(height))
        return Environment(radiance.reshape(height, 2 * height, 3))

    def _run(self, kernel, n: int, at) -> Tensor:
        device, part, row = self.latent.device, kernels.Part, kernels.Row
        radiance = empty((n,), wp.vec3, device)
        numbers = [
            (self.latent, wp.vec2),
            (self.first.view(-1, 16), part),
            (self.matrices.view(-1, 16), part),
            (self.vectors, row),
            (self.last, row),
            (self.offset, wp.vec3),
        ]
        launch(kernel, n, [*numbers, at, (radiance, wp.vec3)], device, slice_min=SLICE_MIN)
        return radiance
