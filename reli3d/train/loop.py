"""Supervised training of a reconstructor on synthetic samples: one visible loop, resumable at any step."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import reduce
from pathlib import Path

import torch
from torch import Tensor, nn

from reli3d.nn.local import LocalReconstructor
from reli3d.nn.presets import SMALL
from reli3d.synthetic.maps import training_maps
from reli3d.train.batches import batches
from reli3d.train.losses import PIXEL_TERMS, WEIGHTS, losses, pixel_losses
from reli3d.train.pictures import write_curves, write_validation
from reli3d.train.pixels import groups_of_views, predicts
from reli3d.train.workers import Workers


@dataclass(frozen=True)
class TrainConfig:
    samples: str  # folder of *.safetensors made by reli3d.synthetic.samples
    output: str  # folder of checkpoints, log.jsonl and pictures
    steps: int = 20000
    minutes: float = math.inf  # the schedule follows whichever of steps and minutes runs out first
    batch: int = 4  # objects a step
    points: int = 2048  # volume points an object; half as many surface points
    max_views: int = 6  # an object is read from 1 to this many views
    rate: float = 1.5e-3  # peak learning rate; convolutions from scratch take thirty times the paper's 5e-5
    pyramid_rate: float = 1.0  # times the rate for the 2D U-Net: with few objects a step it forgets at the full rate
    warmup: int = 100  # steps
    weight_decay: float = 0.02
    clip: float = 5.0  # of the gradient norm
    average: float = 0.999  # decay of the averaged weights that are saved for use
    checkpoint_seconds: float = 300.0
    seed: int = 0
    pixels: int = 0  # side of the pictures from which the 2D U-Net alone learns, all views of each object; 0: the whole
    bfloat16: bool = False  # of the convolutions; parameters and their updates are float32
    maps: str = ""  # file of environment maps, .npz, under which some samples are relit
    validation: str = ""  # folder of held-back samples; the first ones are drawn at every checkpoint


LAST_LAYERS = (*(f"pyramid.says.{k}.1." for k in range(SMALL.pyramid.reading)), "color.4.", "surface.4.", "light.out.")
LAST_RATE = 10.0  # times the rate for these: they begin near zero, and Adam moves a number by hardly more than the rate
PICTURED = 3  # validation objects in the picture, from one and from four views


def progress(config: TrainConfig, step: int, seconds: float) -> float:
    """Share of the training that is done, by steps or by time, whichever is further."""
    return min(1.0, max(step / config.steps, seconds / (60 * config.minutes)))


def parameter_groups(model: LocalReconstructor, config: TrainConfig) -> list[dict]:
    """What ``config`` trains, in groups of an optimizer: with and without weight decay, and by ``times`` the rate,
    which is LAST_RATE for last layers.
    """
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    for name, parameter in model.named_parameters():
        if parameter.requires_grad and (not config.pixels or predicts(name)):
            decay = config.weight_decay if parameter.ndim > 1 else 0.0
            times = LAST_RATE if name.startswith(LAST_LAYERS) else 1.0
            times *= config.pyramid_rate if predicts(name) else 1.0
            groups.setdefault((decay, times), []).append(parameter)
    return [{"params": group, "weight_decay": decay, "times": times} for (decay, times), group in groups.items()]


def rate_at(config: TrainConfig, step: int, done: float) -> float:
    """Linear warm-up, then a cosine to 2 % of the peak."""
    return config.rate * min(1.0, (step + 1) / config.warmup) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * done)))


def train(model: LocalReconstructor, config: TrainConfig, workers: Workers | None = None) -> None:
    """Train ``model`` in place until the schedule ends; continue from ``output/state.pt`` where there is one.

    Writes ``state.pt`` (all that resuming needs), ``log.jsonl`` and the pictures.  workers: processes that share the
    batch; all start from the same parameters, the first one writes.
    """
    workers = workers or Workers()
    if config.batch % workers.count:
        raise ValueError(f"batch: expected a multiple of the {workers.count} processes, got {config.batch}")
    folder = Path(config.output)
    folder.mkdir(parents=True, exist_ok=True)
    model.to_compute(torch.bfloat16 if config.bfloat16 else torch.float32)
    ask, names = (pixel_losses, PIXEL_TERMS) if config.pixels else (losses, tuple(WEIGHTS))
    parts = parameter_groups(model, config)
    trained = [p for part in parts for p in part["params"]]
    optimizer = torch.optim.AdamW(parts, lr=config.rate, betas=(0.9, 0.98), fused=True)
    average = {k: v.detach().clone() for k, v in model.state_dict().items()}
    step, seconds = 0, 0.0
    if (folder / "state.pt").exists():
        state = torch.load(folder / "state.pt", weights_only=True)
        model.load_state_dict(state["model"]), optimizer.load_state_dict(state["optimizer"])
        average, step, seconds = state["average"], state["step"], state["seconds"]
    log = None
    if workers.rank == 0:
        log = open(folder / "log.jsonl", "a", buffering=1)  # noqa: SIM115 - open for the whole run
        log.write(json.dumps({"step": step, "config": asdict(config), "processes": workers.count}) + "\n")
    source = _source(model, config, workers, step)
    began, saved = time.monotonic() - seconds, time.monotonic()
    sums: dict[str, float] = {}
    while progress(config, step, seconds) < 1.0:
        done = progress(config, step, seconds)
        for group in optimizer.param_groups:
            group["lr"] = group["times"] * rate_at(config, step, done)
        optimizer.zero_grad(set_to_none=True)
        values = torch.zeros(len(names) + 1)
        samples = next(source)
        for sample in samples:  # whole ones go one after the other: they have different numbers of views
            terms = ask(model, sample)
            (reduce(torch.add, [WEIGHTS[k] * v for k, v in terms.items()]) / len(samples)).backward()
            values[:-1] += torch.stack([terms[k].detach() for k in names]) / len(samples)
        values[-1] = time.monotonic() - began
        values = workers.average(trained, values)  # one clock for all: they must agree when to stop
        norm = torch.nn.utils.clip_grad_norm_(trained, config.clip)
        if torch.isfinite(norm):
            optimizer.step()
        update_average(average, model, min(config.average, (1 + step) / (10 + step)))
        step, seconds = step + 1, float(values[-1])
        for k, v in zip([*names, "norm", "bad"], [*values[:-1].tolist(), float(norm), float(not torch.isfinite(norm))]):
            sums[k] = sums.get(k, 0.0) + v
        if step % 50 == 0:
            means = {k: round(v / 50, 5) for k, v in sums.items()}
            sums = {}
            if log:
                row = {"step": step, "seconds": round(seconds), "rate": rate_at(config, step, done), **means}
                log.write(json.dumps(row) + "\n")
                print(f"step {step} {seconds:.0f} s {means}", file=sys.stderr, flush=True)
        if log and time.monotonic() - saved > config.checkpoint_seconds:
            save(folder, model, optimizer, average, step, seconds, config)
            saved = time.monotonic()
    if log:
        save(folder, model, optimizer, average, step, seconds, config)
        log.close()


def _source(model: LocalReconstructor, config: TrainConfig, workers: Workers, start: int) -> Iterator[list]:
    """What the steps from ``start`` on learn from, the share of this process."""
    places = {"size": config.batch // workers.count, "seed": config.seed, "start": start, "rank": workers.rank}
    if config.pixels:
        finest = model.pyramid.finest
        return groups_of_views(Path(config.samples), finest=finest, max_views=config.max_views, **places)
    lights = training_maps(Path(config.maps)) if config.maps else None
    return batches(Path(config.samples), points=config.points, max_views=config.max_views, lights=lights, **places)


def update_average(average: dict[str, Tensor], model: nn.Module, decay: float) -> None:
    with torch.no_grad():
        for key, value in model.state_dict().items():
            if value.is_floating_point():
                average[key].lerp_(value, 1 - decay)


def save(folder: Path, model, optimizer, average, step: int, seconds: float, config: TrainConfig) -> None:
    """Replace the checkpoint and the pictures whole: a stop in the middle leaves the old ones."""
    state = {
        "model": model.state_dict(),
        "optimizer": optimizer.state_dict(),
        "average": average,
        "step": step,
        "seconds": seconds,
    }
    torch.save(state, folder / "state.tmp")
    os.replace(folder / "state.tmp", folder / "state.pt")
    write_curves(folder / "log.jsonl", folder / "curves.png")
    if config.validation and model.pyramid.finest == 0:  # else it is no whole network yet
        averaged = LocalReconstructor(model.preset)
        averaged.load_state_dict(average)
        write_validation(averaged.eval(), sorted(Path(config.validation).glob("*.safetensors"))[:PICTURED], folder)


def averaged_model(state: Path, model: LocalReconstructor) -> LocalReconstructor:
    """``model`` with the averaged weights of a checkpoint, for use."""
    model.load_state_dict(torch.load(state, weights_only=True)["average"])
    return model.eval()
