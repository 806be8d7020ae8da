"""Checkpoints of a training run: one file with all that is needed to resume, the same for every stage."""

import json
import os
import pickle
from collections.abc import Container
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from reli3d.errors import InputError, shown
from reli3d.io.files import file_size
from reli3d.nn.presets import to_json
from reli3d.nn.weights import BROKEN_TORCH_FILE, check_keys
from reli3d.train.stage import Stage

REMEDY = "name another output folder, and this file by --weights"


def save(
    folder: Path,
    stage: Stage,
    optimizer: torch.optim.Optimizer,
    average: dict[str, Tensor],
    step: int,
    seconds: float,
    about: dict[str, Any],
    measures: dict[str, float],
) -> None:
    """Writes ``folder/state.pt`` atomically."""
    state = {
        "model": stage.model.state_dict(),
        "optimizer": optimizer.state_dict(),
        "average": average,
        "step": step,
        "seconds": seconds,
        "stage": stage.name,
        "preset": to_json(stage.model.preset),
        "about": json.dumps(about, sort_keys=True),
        "measures": measures,
    }
    with open(folder / "state.tmp", "wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(folder / "state.tmp", folder / "state.pt")


def load(path: Path) -> dict[str, Any]:
    """The dictionary that :func:`save` wrote, on the CPU; ``stage`` is empty in files of 0.2.  Raises InputError."""
    file_size(path)
    try:
        state = torch.load(path, weights_only=True, map_location="cpu")
    except (pickle.UnpicklingError, *BROKEN_TORCH_FILE) as error:
        reason = shown(" ".join(str(error).split()))
        raise InputError(path, f"expected a checkpoint of reli3d-train, got a broken file ({reason})") from None
    parts = ("model", "average", "optimizer")
    if not isinstance(state, dict) or not all(isinstance(state.get(part), dict) for part in parts):
        raise InputError(path, f"expected a checkpoint of reli3d-train with {', '.join(parts)}, got another file")
    if "param_groups" not in state["optimizer"]:
        raise InputError(path, "optimizer: expected param_groups, got none; remove the file to start again")
    if not isinstance(state.get("step"), int) or state["step"] < 0:
        raise InputError(
            path, f"step: expected a count, got {shown(state.get('step'))}; remove the file to start again"
        )
    return {"stage": "", "seconds": 0.0, "measures": {}, **state}


def to_resume(path: Path, stage: Stage, groups: list[dict]) -> dict[str, Any]:
    """The checkpoint from which ``stage`` resumes, with ``groups`` of parameters; InputError if it is of another."""

    def sizes(groups: list[dict]) -> list[tuple]:
        return [(len(group["params"]), group.get("times")) for group in groups]

    state = load(path)
    if state["stage"] not in ("", stage.name):
        raise InputError(path, f"expected a checkpoint of stage {stage.name}, got one of {state['stage']}; {REMEDY}")
    if sizes(state["optimizer"]["param_groups"]) != sizes(groups):
        raise InputError(path, f"expected a checkpoint of the same parameters, got one of others; {REMEDY}")
    for part in ("model", "average"):
        check_shapes(path, state[part], stage.model)
    return state


def check_shapes(path: Path, state: dict[str, Tensor], model: nn.Module, missing: Container[str] = ()) -> None:
    """Raises InputError unless ``state`` has the tensors of ``model`` except those named in ``missing``."""
    shapes = {k: tuple(v.shape) for k, v in model.state_dict().items() if k not in missing}
    check_keys(path, {k: tuple(v.shape) for k, v in state.items()}, shapes)


def load_average(
    path: Path, model: nn.Module, state: dict[str, Any] | None = None, missing: Container[str] = ()
) -> dict[str, Any]:
    """Loads the averaged weights of a checkpoint into ``model``; returns the checkpoint.

    state: the checkpoint if it is read already.  missing: names of parameters that it may lack.  Raises InputError.
    """
    state = state or load(path)
    check_shapes(path, state["average"], model, missing)
    model.load_state_dict(state["average"], strict=not missing)
    return state
