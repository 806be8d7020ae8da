"""A network that shows a ball from the first step on, and small samples to train it with."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from reli3d.cli.samples import SampleJob, SampleSpec
from reli3d.geometry.camera import Camera, look_at
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import TINY
from reli3d.render.latlong import lat_long_directions
from reli3d.synthetic.procedural import make_object
from reli3d.synthetic.samples import ObjectSurface, synthesize

RADIUS, SEEDS = 0.5, (3, 12)
WHITE = np.ones((6, 8, 16, 3), np.float32)  # six maps
SMALL = replace(TINY, name="smaller", image_size=32, plane_size=4, resolution=16)


class BallModel(Reconstructor):
    """``SMALL`` whose raw density is that of a ball plus the head's output."""

    steep = 12.0  # of the raw density, per model unit

    def query(self, code, points, heads=("density",)):
        values = super().query(code, points, heads)
        if "density" in values:
            ball = self.steep * (RADIUS - points.norm(dim=-1, keepdim=True))
            values["density"] = values["density"] + 2.0 + ball  # 2: the head starts that far outside
        return values


def ball_model(seed: int = 0) -> BallModel:
    """The same parameters for the same seed."""
    torch.manual_seed(seed)
    return BallModel(SMALL)


def flatten(model: Reconstructor) -> None:
    """Sets the predicted bumps to none: normals are those of the surface."""
    for value in model.heads["normal"][-1].parameters():
        value.data.zero_()


def camera(size: int) -> Camera:
    """From the side, far enough for the ball to stay in the image."""
    return Camera.from_fov(look_at([0.4, 0.5, 2.0], [0.0, 0.0, 0.0]), 0.75, size, size)


def rows(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]


def numbers(run: Path) -> list[dict]:
    """Rows of the log without the configuration and the time."""
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows(run) if "config" not in row]


def write_maps(folder: Path, maps: np.ndarray = WHITE) -> Path:
    """``maps.npz`` of environment maps ``(n, H, 2H, 3)`` in ``folder``."""
    np.savez(folder / "maps.npz", env=maps, names=[f"m{k:02d}" for k in range(len(maps))])
    return folder / "maps.npz"


def rendered_sample(folder: Path, maps: Path, *, views: int, size: int, meshes=(), shapes=(), seed: int = 0) -> Path:
    """A sample as ``reli3d-data render`` makes it, without the process of a worker."""
    threads, name = torch.get_num_threads(), f"{seed:010d}"
    folder.mkdir(exist_ok=True)
    spec = SampleSpec(maps, held_out=False, paper=False, views=views, size=size, meshes=meshes, shapes=shapes)
    SampleJob(spec).run(None, name, folder / f"{name}.safetensors")
    torch.set_num_threads(threads)
    return folder / f"{name}.safetensors"


def write_samples(folder: Path, seeds=SEEDS, views: int = 4, size: int = 48) -> Path:
    """Samples of a seed each, under a sky that is bright towards +X."""
    light = 0.2 + 3.0 * lat_long_directions(32)[..., :1].clamp(min=0).expand(-1, -1, 3).contiguous()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        sample = synthesize(ObjectSurface(make_object(seed)), light, rng, size=size, views=views)
        save_file(sample, folder / f"{seed:010d}.safetensors")
    return folder
