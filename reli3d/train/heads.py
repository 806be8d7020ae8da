"""Second part of the training: the heads alone, on codes that are computed once.

The trunk's gradient is noisy and takes nine tenths of a step.  When it is trained, the small networks that read its
code, the views and the shading gain from many quick steps over many objects.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from reli3d.nn.field import LIGHT_ROWS
from reli3d.nn.light_features import Shading
from reli3d.nn.model import Code, Reconstructor
from reli3d.nn.view_features import ViewMaps
from reli3d.train.batches import Batch, load_sample
from reli3d.train.loop import WEIGHTS, TrainConfig, rate_at, update_average
from reli3d.train.losses import field_losses, maps_of, sample_shading
from reli3d.train.workers import Workers

KEPT = 4096  # volume points of an object that are kept; half as many surface points
PASSES = 2  # codes of an object, each from its own views, turned, mirrored and recoloured


@dataclass(frozen=True)
class Coded:
    """One object, all that its heads are asked and told."""

    code: Code
    maps: ViewMaps
    shading: Shading | None
    batch: Batch  # of one object


def train_heads(model: Reconstructor, config: TrainConfig, workers: Workers | None = None) -> None:
    """Train heads and view features of ``model``, in place, for ``config.minutes``; then replace the checkpoint.

    ``config.output`` holds the ``state.pt`` of :func:`reli3d.train.loop.train`; its averaged weights are the start and
    become the result.  Raises ValueError without it, without samples and where the processes cannot share a batch.
    """
    workers = workers or Workers()
    state_file = Path(config.output) / "state.pt"
    files = sorted(Path(config.samples).glob("*.safetensors"))[workers.rank :: workers.count]
    if not state_file.exists():
        raise ValueError(f"output: expected a folder with state.pt of a training, got {config.output}")
    if not files:
        raise ValueError(f"samples: expected *.safetensors files, got none in {config.samples}")
    if config.batch % workers.count:
        raise ValueError(f"batch: expected a multiple of the {workers.count} processes, got {config.batch}")
    if not math.isfinite(config.minutes):
        raise ValueError("minutes: expected the length of the training, got none")
    state = torch.load(state_file, weights_only=True)
    model.load_state_dict(state["average"])
    rng = np.random.default_rng((config.seed, workers.rank))
    objects = [encode_sample(model, f, config.max_views, rng)
               for f in tqdm(files * PASSES, file=sys.stderr, unit="code", disable=workers.rank > 0)]  # fmt: skip

    parts = nn.ModuleDict({"heads": model.heads, "view_features": model.view_features})  # named as in the model
    trained = list(parts.parameters())
    optimizer = torch.optim.AdamW(trained, lr=config.rate, betas=(0.9, 0.98), weight_decay=config.weight_decay)
    average = {k: v.detach().clone() for k, v in parts.state_dict().items()}
    began, seconds, step, sums = time.monotonic(), 0.0, 0, {}
    log = open(state_file.with_name("heads.jsonl"), "a", buffering=1) if workers.rank == 0 else None  # noqa: SIM115
    if log:
        log.write(json.dumps({"config": asdict(config), "objects": len(objects), "processes": workers.count}) + "\n")
    while seconds < 60 * config.minutes:
        optimizer.param_groups[0]["lr"] = rate_at(config, step, seconds / (60 * config.minutes))
        optimizer.zero_grad(set_to_none=True)
        values = torch.zeros(0)
        share = config.batch // workers.count
        for k in rng.integers(len(objects), size=share):
            own = objects[k]
            terms = field_losses(model, own.code, own.maps, some(own.batch, config.points, rng), 0, own.shading)
            (sum(WEIGHTS[name] * value for name, value in terms.items()) / share).backward()
            row = torch.stack([value.detach() for value in terms.values()]) / share
            values = row if len(values) == 0 else values + row
        values = workers.average(trained, torch.cat([values, torch.tensor([time.monotonic() - began])]))
        torch.nn.utils.clip_grad_norm_(trained, config.clip)
        optimizer.step()
        update_average(average, parts, min(config.average, (1 + step) / (10 + step)))
        step, seconds = step + 1, float(values[-1])
        for name, value in zip(terms, values[:-1].tolist(), strict=True):
            sums[name] = sums.get(name, 0.0) + value / 200
        if step % 200 == 0:
            if log:
                row = {"step": step, "seconds": round(seconds), **{k: round(v, 5) for k, v in sums.items()}}
                log.write(json.dumps(row) + "\n")
                print(f"heads {row}", file=sys.stderr, flush=True)
            sums = {}
    parts.load_state_dict(average)
    if log:
        log.close()
        torch.save(state | {"model": model.state_dict(), "average": model.state_dict()}, state_file.with_suffix(".tmp"))
        os.replace(state_file.with_suffix(".tmp"), state_file)


@torch.no_grad()
def encode_sample(model: Reconstructor, file: Path, max_views: int, rng: np.random.Generator) -> Coded:
    """The code of a sample from 1 to ``max_views`` random views of it, augmented; with its points."""
    sample = load_sample(file, int(rng.integers(1, max_views + 1)), KEPT, rng)
    batch = Batch(**{name: value[None] for name, value in sample.items()})
    code = model.encode(batch.images, batch.masks, batch.c2w, batch.intrinsics)
    maps = maps_of(code, batch.images[0], batch.silhouette[0], batch.c2w[0], batch.intrinsics[0])
    shading = sample_shading(model, model.decode_environment(code, LIGHT_ROWS)[0], maps, batch, 0)
    none = batch.pixels[:, :0]
    batch = replace(batch, images=none, masks=none, silhouette=none, pixels=none, pixel_radiance=none, light=none)
    return Coded(code, maps, shading, batch)


def some(batch: Batch, points: int, rng: np.random.Generator) -> Batch:
    """Random ``points`` of the volume, and half as many of the surface, of a batch of one object."""
    volume = torch.as_tensor(rng.integers(batch.points.shape[1], size=points))
    surface = torch.as_tensor(rng.integers(batch.surface.shape[1], size=points // 2))
    return replace(batch, points=batch.points[:, volume], distance=batch.distance[:, volume],
                   surface=batch.surface[:, surface], material=batch.material[:, surface],
                   visible=batch.visible[:, surface])  # fmt: skip
