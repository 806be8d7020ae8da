"""Small training samples of two objects."""

from pathlib import Path

import numpy as np
from safetensors.torch import save_file

from reli3d.render.latlong import lat_long_directions
from reli3d.synthetic.procedural import make_object
from reli3d.synthetic.samples import ObjectSurface, synthesize

SEEDS = (3, 12)


def write_samples(folder: Path) -> None:
    """Two samples of six views under a sky that is bright towards +X."""
    light = 0.2 + 3.0 * lat_long_directions(32)[..., :1].clamp(min=0).expand(-1, -1, 3).contiguous()
    for seed in SEEDS:
        sample = synthesize(ObjectSurface(make_object(seed)), light, np.random.default_rng(seed), views=6)
        save_file(sample, folder / f"{seed:010d}.safetensors")
