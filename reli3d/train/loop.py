"""The training loop of all stages, which resumes from its last checkpoint; on a CPU bitwise identically."""

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import reduce
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from reli3d.errors import InputError
from reli3d.io.images import write_png
from reli3d.train import checkpoint
from reli3d.train.log import Log, summary_writer
from reli3d.train.stage import Options, Stage
from reli3d.train.workers import Workers


def progress(options: Options, step: int, seconds: float) -> float:
    """Completed fraction of the schedule, in [0, 1]: by steps or by time, whichever is larger."""
    return min(1.0, max(step / max(options.steps, 1), seconds / (60 * options.minutes)) if options.steps else 1.0)


def rate_at(options: Options, step: int, done: float) -> float:
    """Learning rate: linear warm-up times a cosine from ``rate`` to ``rate * final_rate``."""
    cosine = 0.5 * (1 + math.cos(math.pi * done))
    rate = options.rate * min(1.0, (step + 1) / options.warmup)
    return rate * (options.final_rate + (1 - options.final_rate) * cosine)


def parameter_groups(stage: Stage, weight_decay: float) -> list[dict]:
    """Parameter groups by weight decay (none for vectors) and by ``times``, the multiplier of the learning rate."""
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    for name, parameter in stage.model.named_parameters():
        times = stage.rate_factor(name) if parameter.requires_grad else 0.0
        if times:
            groups.setdefault((weight_decay if parameter.ndim > 1 else 0.0, times), []).append(parameter)
    return [{"params": group, "weight_decay": decay, "times": times} for (decay, times), group in groups.items()]


def accumulate(stage: Stage, items: Sequence[Any]) -> Tensor:
    """Accumulates the gradients of the mean loss over ``items``, one item at a time.

    Returns ``(T + 1, 2)`` for the log: the sum of the weighted losses and, for each of the T terms of
    ``stage.weights``, that of its values; and the number of items that have them.
    """
    names = ["loss", *stage.weights]
    values = torch.zeros(len(names), 2, dtype=torch.float64)
    for item in items:
        terms = stage.losses(item)
        loss = reduce(torch.add, [stage.weights[name] * value for name, value in terms.items()])
        (loss / len(items)).backward()
        index = [names.index(name) for name in ("loss", *terms)]
        values[index, 0] += torch.stack([loss, *terms.values()]).detach().double().cpu()
        values[index, 1] += 1
    return values


def row_of(stage: Stage, sums: Tensor) -> dict[str, float]:
    """Row of the log: the mean loss, and the mean of each term over the items that have it."""
    return {n: round(float(s / c), 6) for n, (s, c) in zip(("loss", *stage.weights), sums, strict=True) if c > 0}


@torch.no_grad()
def update_average(average: dict[str, Tensor], model: nn.Module, decay: float) -> None:
    """Exponential moving average: ``average = decay * average + (1 - decay) * parameters``, in place."""
    for key, value in model.state_dict().items():
        if value.is_floating_point():
            average[key].lerp_(value, 1 - decay)


def train(stage: Stage, options: Options, workers: Workers | None = None) -> None:
    """Trains ``stage.model`` in place to the end of the schedule; resumes from ``output/state.pt`` if it exists.

    workers: processes that divide each batch; the first one writes files.  A step whose gradients are not finite is
    skipped; ``options.bad_steps`` in a row raise RuntimeError.  Raises InputError for a wrong batch size or checkpoint.
    """
    workers = workers or Workers()
    model, folder, first = stage.model, Path(options.output), workers.rank == 0
    path = folder / "state.pt"
    if options.batch % workers.count:
        raise InputError("batch", f"expected a multiple of the {workers.count} processes, got {options.batch}")
    folder.mkdir(parents=True, exist_ok=True)
    groups = parameter_groups(stage, options.weight_decay)
    trained = [p for group in groups for p in group["params"]]
    optimizer = stage.optimizer(groups, lr=options.rate, betas=(0.9, 0.98), fused=True)
    step, seconds, average = 0, 0.0, {k: v.detach().clone() for k, v in model.state_dict().items()}
    if path.exists():
        state = checkpoint.to_resume(path, stage, groups)
        model.load_state_dict(state["model"])
        optimizer.load_state_dict(state["optimizer"])
        step, seconds = state["step"], state["seconds"]
        average = {k: v.to(average[k].device) for k, v in state["average"].items()}
        del state
    measures = stage.measures()
    about = {"stage": stage.name, "processes": workers.count, **asdict(options), **stage.configuration}
    log = Log(folder / "log.jsonl", step, about) if first else None
    board = summary_writer()(options.tensorboard, purge_step=step + 1) if first and options.tensorboard else None
    began, bad = time.monotonic() - seconds, 0
    sums = torch.zeros(len(stage.weights) + 1, 2, dtype=torch.float64)
    if step == 0 and first:
        checkpoint.save(folder, stage, optimizer, average, step, seconds, about, measures)
    bar = tqdm(total=100, disable=None if first else True, bar_format="{desc} {percentage:3.0f}% {bar}")
    while (done := progress(options, step, seconds)) < 1.0:
        rate = rate_at(options, step, done)
        for group in optimizer.param_groups:
            group["lr"] = group["times"] * rate
        optimizer.zero_grad(set_to_none=True)
        torch.manual_seed((options.seed << 32) + step)  # random losses draw the same numbers after resuming
        values = accumulate(stage, stage.batch(step, range(workers.rank, options.batch, workers.count)))
        clock = torch.tensor([time.monotonic() - began], dtype=torch.float64)
        values = workers.average(trained, torch.cat([values.flatten(), clock]).float()).double()
        norm = nn.utils.clip_grad_norm_(trained, options.clip)
        bad = 0 if torch.isfinite(norm) else bad + 1
        if not bad:
            optimizer.step()
        elif bad >= options.bad_steps:
            problem = f"expected finite ones, got none in {bad} steps; the last checkpoint is {path}"
            raise RuntimeError(f"gradients: {problem}")
        update_average(average, model, min(options.average, (1 + step) / (10 + step)))
        step, seconds, sums = step + 1, float(values[-1]), sums + values[:-1].view_as(sums)
        bar.set_description(f"{stage.name}, step {step}", refresh=False)
        bar.update(100 * progress(options, step, seconds) - bar.n)
        last = progress(options, step, seconds) >= 1.0
        saving = step % options.save_every == 0 or last
        if step % options.log_every == 0 or saving:
            row = {"seconds": round(seconds), **row_of(stage, sums)}
            row |= {"rate": rate, "norm": round(float(norm), 5), "bad": bad}
            sums = torch.zeros_like(sums)
            if log:
                log.write({"step": step, **row})
            if board:
                for name, value in row.items():
                    board.add_scalar(name, value, step)
        if saving:
            measures = stage.measures()
            if log:
                checkpoint.save(folder, stage, optimizer, average, step, seconds, about, measures)
                image = stage.validation(average)
                if image is not None:
                    write_png(folder / "validation.png", image)
                    if board:
                        board.add_image("validation", image, step, dataformats="HWC")
                        board.flush()
                found = "".join(f", {name} {value:.4g}" for name, value in measures.items())
                tqdm.write(f"{stage.name}: step {step}, {seconds:.0f} s, loss {row['loss']:.4g}{found}", sys.stderr)
    bar.close()
    for file in (log, board):
        if file:
            file.close()
