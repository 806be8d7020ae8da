"""The one loop of all stages: resumable at any step, with the same bits on a CPU."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from reli3d.io.files import InputError
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import to_json
from reli3d.train.loop import update_average
from reli3d.train.pictures import write_curves
from reli3d.train.sharded import clip_gradients, gathered, plain, scattered, shard
from reli3d.train.stages.board import Board
from reli3d.train.stages.config import Run, Weights
from reli3d.train.stages.losses import Perceptual, perceptual
from reli3d.train.stages.sheet import write_sheet
from reli3d.train.stages.step import checkpointed, object_losses, total, trunk_layers
from reli3d.train.stages.views import Draw, Source, draw
from reli3d.train.workers import Workers

TERMS = tuple(vars(Weights()))


def rate_at(run: Run, step: int) -> float:
    """Linear warm-up, then a cosine to a tenth."""
    done = step / max(run.stage.steps, 1)
    return run.stage.rate * min(1.0, (step + 1) / run.warmup) * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * done)))


def drawn(run: Run, sources: Sequence[Source], model: Reconstructor, step: int, k: int) -> Draw:
    """Object ``k`` of a step: a function of the run's seed, the step and ``k``, whoever asks."""
    stage = run.stage
    return draw(
        sources,
        (run.seed, step, k),
        inputs=run.inputs,
        targets=stage.targets,
        background=run.background,
        input_size=model.preset.image_size,
        target_size=stage.image_size,
        patch=stage.patch,
    )


def accumulate(model: Reconstructor, run: Run, draws: Iterable[Draw], distance: Perceptual, share: int) -> Tensor:
    """Add the gradients of the objects of a step, each over ``share``; the sums and counts of their terms.

    ``(2 T + 1,)``: for each name of ``TERMS`` the sum of its values, then how many objects have it, then the sum of
    the weighted losses.  Object after object: they have different numbers of views.
    """
    values = torch.zeros(2 * len(TERMS) + 1, dtype=torch.float64)
    for one in draws:
        terms = object_losses(model, one, run.stage, distance, bfloat16=run.bfloat16)
        loss = total(terms, run.stage)
        (loss / share).backward()
        for name, value in terms.items():
            values[TERMS.index(name)] += float(value.detach())
            values[len(TERMS) + TERMS.index(name)] += 1
        values[-1] += float(loss.detach())
    return values


def train(
    model: Reconstructor,
    run: Run,
    sources: Sequence[Source],
    workers: Workers | None = None,
    *,
    held_back: Sequence[Draw] = (),
) -> None:
    """Train ``model`` in place for one stage; continue from ``output/state.pt`` where there is one.

    Otherwise ``run.start`` gives the averaged parameters of the stage before; the optimizer starts anew.  Writes
    ``state.pt``, ``log.jsonl``, ``curves.png`` and ``pictures.png`` of ``held_back``.  workers: processes that share
    the batch; all start from the same parameters.  A step without finite gradients is left out and counted;
    RuntimeError after ``run.bad_steps`` in a row.
    """
    workers = workers or Workers()
    stage, folder = run.stage, Path(run.output)
    if run.shard and workers.count == 1:
        raise ValueError("shard: expected several processes to share the parameters, got one; start with torchrun")
    if stage.batch % workers.count:
        raise ValueError(f"batch: expected a multiple of the {workers.count} processes, got {stage.batch}")
    folder.mkdir(parents=True, exist_ok=True)
    if run.checkpointing:
        checkpointed(model)
    distance = perceptual(run.perceptual)
    state: dict = {}
    if (folder / "state.pt").exists():
        state = load_state(folder / "state.pt", model)
        model.load_state_dict(state["model"])
    elif run.start:
        model.load_state_dict(load_state(Path(run.start), model)["average"])
    if run.shard:
        shard(trunk_layers(model), model.device)
    trained = [p for p in model.parameters() if p.requires_grad]
    groups = [
        {"params": [p for p in trained if p.ndim > 1], "weight_decay": run.weight_decay},
        {"params": [p for p in trained if p.ndim <= 1], "weight_decay": 0.0},
    ]
    # one call for many tensors takes no mixture of sharded and whole ones
    optimizer = torch.optim.AdamW(groups, lr=stage.rate, betas=(0.9, 0.98), foreach=False if run.shard else None)
    step, average = 0, {k: v.detach().clone() for k, v in model.state_dict().items()}
    if state:
        step = state["step"]
        average = {k: scattered(v, average[k]) for k, v in state["average"].items()}
        resume(optimizer, state["optimizer"])
        state.clear()
    log = open_log(folder / "log.jsonl", step, run) if workers.rank == 0 else None
    board = Board(run.tensorboard, step) if run.tensorboard and log else None
    bad, began, device = 0, time.monotonic(), model.device
    sums = torch.zeros(2 * len(TERMS) + 1, dtype=torch.float64)
    if step == 0:
        save(folder, model, optimizer, average, step, run, workers)
    while step < stage.steps:
        for group in optimizer.param_groups:
            group["lr"] = rate_at(run, step)
        optimizer.zero_grad(set_to_none=True)
        mine = range(workers.rank, stage.batch, workers.count)
        draws = (drawn(run, sources, model, step, k) for k in mine)
        values = accumulate(model, run, (_on(d, device) for d in draws), distance, stage.batch // workers.count)
        values = workers.average(plain(trained), values.float()).double() * workers.count
        norm = clip_gradients(trained, run.clip)
        finite = bool(torch.isfinite(norm))
        bad = 0 if finite else bad + 1
        if finite:
            optimizer.step()
        elif bad >= run.bad_steps:
            raise RuntimeError(
                f"gradients: expected finite ones, got none in {bad} steps; the last checkpoint is "
                f"{folder / 'state.pt'}"
            )
        update_average(average, model, min(run.average, (1 + step) / (10 + step)))
        step, sums = step + 1, sums + values
        if log and step % run.log_every == 0:
            row = write_row(log, step, sums, stage.batch * run.log_every, rate_at(run, step - 1), float(norm), bad)
            if board:
                board.numbers(row)
        if step % run.log_every == 0:
            sums = torch.zeros_like(sums)
        if step % run.save_every == 0 or step == stage.steps:
            whole = save(folder, model, optimizer, average, step, run, workers)
            if log:
                write_curves(folder / "log.jsonl", folder / "curves.png")
                if held_back:
                    grid = write_sheet(folder / "pictures.png", averaged(model, whole), held_back, stage)
                    if board:
                        board.pictures(grid, step)
                print(f"{stage.name}: step {step}, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    if log:
        log.close()
    if board:
        board.close()


def _on(one: Draw, device: torch.device) -> Draw:
    return Draw(one.inputs.to(device), one.targets.to(device), one.background_visible, one.seed)


def write_row(log, step: int, sums: Tensor, objects: int, rate: float, norm: float, bad: int) -> dict:
    """One line of the log, which comes back: each term's mean over the objects that have it."""
    count = sums[len(TERMS) : -1]
    means = {n: round(float(s / c), 6) for n, s, c in zip(TERMS, sums, count, strict=False) if c > 0}
    row = {
        "step": step,
        "loss": round(float(sums[-1]) / objects, 6),
        **means,
        "rate": rate,
        "norm": round(norm, 5),
        "bad": bad,
    }
    log.write(json.dumps(row) + "\n")
    return row


def open_log(path: Path, step: int, run: Run):
    """The log, without rows after ``step``: those steps are taken again.  A new run begins with its configuration."""
    kept = []
    if path.exists():
        for line in path.read_text().splitlines():
            try:
                row = json.loads(line)
            except ValueError:  # the line that was being written
                break
            if row["step"] > step:
                break
            kept.append(line)
    path.write_text("".join(f"{line}\n" for line in kept))
    log = open(path, "a", buffering=1)  # noqa: SIM115 - open for the whole run
    log.write(json.dumps({"step": step, "config": json.loads(run.text())}) + "\n")
    return log


def save(
    folder: Path,
    model: Reconstructor,
    optimizer: torch.optim.Optimizer,
    average: dict[str, Tensor],
    step: int,
    run: Run,
    workers: Workers,
) -> dict[str, Tensor]:
    """Replace the checkpoint whole: a stop in the middle leaves the old one.  All processes must call it.

    The first one writes, and has the whole averaged parameters.
    """
    first = workers.rank == 0
    state = {
        "model": gathered(model.state_dict(), first),
        "optimizer": gathered(optimizer.state_dict(), first),
        "average": gathered(average, first),
        "step": step,
        "run": run.text(),
        "preset": to_json(model.preset),
    }
    if first:
        with open(folder / "state.tmp", "wb") as file:
            torch.save(state, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(folder / "state.tmp", folder / "state.pt")
    return state["average"]


def resume(optimizer: torch.optim.Optimizer, state: dict) -> None:
    """Give ``optimizer`` the whole moments of a checkpoint, in parts where its parameters are."""
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    for k, values in state["state"].items():
        state["state"][k] = {name: scattered(value, parameters[k]) for name, value in values.items()}
    for saved, group in zip(state["param_groups"], optimizer.param_groups, strict=True):
        saved["foreach"] = group["foreach"]
    optimizer.load_state_dict(state)


def load_state(path: Path, model: Reconstructor) -> dict:
    """A checkpoint of this loop for this network.  Raises InputError for anything else."""
    try:
        state = torch.load(path, weights_only=True)
        preset, step = state["preset"], state["step"]
    except Exception as error:  # of a broken file torch, pickle and zipfile raise almost anything
        reason = " ".join(str(error).split())[:80]
        raise InputError(path, f"expected a checkpoint of a stage, got a broken file ({reason})") from None
    if preset != to_json(model.preset) or not isinstance(step, int):
        raise InputError(path, f"expected a checkpoint of the preset {model.preset.name}, got one of another")
    return state


def averaged(model: Reconstructor, average: dict[str, Tensor]) -> Reconstructor:
    """A network of its own with the averaged parameters."""
    other = Reconstructor(model.preset).to(model.device)
    other.load_state_dict(average)
    return other.eval()
