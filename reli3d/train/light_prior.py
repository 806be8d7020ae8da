"""Training of the environment prior: a RENI++ decoder, jointly with one latent code per map (an auto-decoder).

The decoder is equivariant to rotation about the vertical axis.  Blends of two maps augment a small collection.  Maps
are scaled to a geometric mean of 1.  Source: Gardner et al. 2023, RENI++, arXiv 2311.09361, section 4.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from reli3d.nn.presets import Preset
from reli3d.nn.reni import EnvironmentDecoder, reni_frame
from reli3d.nn.reni_fit import FLOOR, WEIGHTS, terms
from reli3d.render.latlong import lat_long_directions
from reli3d.synthetic.maps import ROWS, training_maps
from reli3d.train.stage import Stage

PEAK = 2e3  # of the geometric mean, clipped above: a smooth decoder cannot represent the sun, 1e4 to 1e5
BLENDS = 400  # added to the maps
RAYS = 512  # per map and step


def scale_free(maps: Tensor) -> Tensor:
    """Maps over their solid-angle-weighted geometric mean."""
    weight = torch.sin((torch.arange(maps.shape[1]) + 0.5) * torch.pi / maps.shape[1])[:, None]
    log = (maps.mean(-1) + 1e-4).log()
    mean = (log * weight).sum((1, 2)) / (weight.sum() * maps.shape[2])
    return (maps / mean.exp()[:, None, None, None]).clamp(max=PEAK)


def blends(maps: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """``count`` blends of two maps, linear or geometric, one of them mirrored or rotated, tinted."""
    out = []
    for _ in range(count):
        a, b = (maps[int(rng.integers(len(maps)))] for _ in range(2))
        b = torch.roll(b.flip(1) if rng.random() < 0.5 else b, int(rng.integers(maps.shape[2])), 1)
        t = rng.beta(0.5, 0.5)
        tint = torch.as_tensor(np.exp(rng.normal(0, 0.15, 3)), dtype=torch.float32)
        out.append((a ** (1 - t) * b**t if rng.random() < 0.5 else a * (1 - t) + b * t) * tint)
    return torch.stack(out) if out else maps[:0]


class LightPrior(nn.Module):
    """The decoder and the latents ``(n, L, 3)`` of ``count`` maps."""

    def __init__(self, preset: Preset, count: int):
        super().__init__()
        self.preset, self.decoder = preset, EnvironmentDecoder(preset.reni)
        self.latents = nn.Parameter(0.1 * torch.randn(count, preset.reni.latents, 3))


class LightPriorStage(Stage):
    """The decoder of ``preset``, on the maps of :func:`~reli3d.synthetic.maps.load_maps` that are not held out."""

    name = "light_prior"
    weights = WEIGHTS
    settings = {"steps": 8000, "batch": 16, "rate": 1e-2, "final_rate": 1e-4, "weight_decay": 0.0}

    def __init__(self, preset: Preset, maps: Path, *, seed: int = 0, added: int = BLENDS):
        """maps: ``.npz``.  added: number of blends that are added to the maps."""
        own = scale_free(training_maps(maps))
        every = torch.cat([own, scale_free(blends(own, added, np.random.default_rng(seed)))])
        self.seed, self.model = seed, LightPrior(preset, len(every))
        self.configuration = {"maps": str(maps), "added": added}
        self.texels, self.directions = every.flatten(1, 2), reni_frame(lat_long_directions(ROWS)).reshape(-1, 3)
        self.area = torch.sin((torch.arange(ROWS) + 0.5) * torch.pi / ROWS).repeat_interleave(2 * ROWS)

    def batch(self, step: int, objects: range) -> Sequence[Any]:
        """A single item: indices of maps and of texels, which are uniform over the sphere."""
        generator = torch.Generator().manual_seed((self.seed << 32) + step)
        texel = torch.multinomial(self.area, RAYS, generator=generator)
        return [(torch.randint(len(self.texels), (objects.stop,), generator=generator)[list(objects)], texel)]

    def losses(self, item: Any) -> dict[str, Tensor]:
        picked, texel = item
        latents, target = self.model.latents[picked], self.texels[picked][:, texel] + FLOOR
        log_radiance = self.model.decoder.field(latents, self.directions[texel][None])
        return terms(log_radiance, target, latents)

    def rate_factor(self, parameter: str) -> float:
        return 1.0 if parameter == "latents" else 0.1
