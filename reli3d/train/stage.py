"""Options of the training loop, and the interface of a training stage."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Options:
    """Options of the training loop, for every stage."""

    output: str  # folder of state.pt, log.jsonl and validation.png
    steps: int = 20_000
    minutes: float = math.inf  # of training; the schedule ends at ``steps`` or ``minutes``, whichever is first
    batch: int = 4  # objects per step, over all processes
    rate: float = 1.5e-3  # peak learning rate
    final_rate: float = 0.02  # at the end of the schedule, as a fraction of the peak
    warmup: int = 100  # steps
    weight_decay: float = 0.02
    clip: float = 5.0  # maximum norm of the gradient
    average: float = 0.999  # decay of the averaged weights
    seed: int = 0
    save_every: int = 200  # steps
    log_every: int = 10  # steps
    bad_steps: int = 20  # consecutive steps with non-finite gradients that end the run with an error
    tensorboard: str = ""  # folder of event files; "": none


class Stage(ABC):
    """A model with its batches and losses, trained by :func:`reli3d.train.loop.train`."""

    name: str
    model: Any  # torch.nn.Module with ``preset``
    weights: Mapping[str, float]  # of the terms of ``losses``
    settings: Mapping[str, Any]  # defaults of :class:`Options` for this stage
    configuration: Mapping[str, Any] = {}  # logged with a run in addition to its Options
    optimizer: type[torch.optim.AdamW] = torch.optim.AdamW

    @abstractmethod
    def batch(self, step: int, objects: range) -> Sequence[Any]:
        """Items at the positions ``objects`` of the batch of ``step``: a function of these and the seed alone."""

    @abstractmethod
    def losses(self, item: Any) -> dict[str, Tensor]:
        """Unweighted scalar terms of an item, by the names of ``weights``; terms without ground truth are left out."""

    def rate_factor(self, parameter: str) -> float:
        """Multiplier of the learning rate for the parameter of this name; 0: not trained."""
        return 1.0

    def measures(self) -> dict[str, float]:
        """Metrics logged and stored at the start and at every checkpoint; InputError if training cannot continue."""
        return {}

    def validation(self, average: dict[str, Tensor]) -> np.ndarray | None:
        """Image ``(H, W, 3)`` uint8 of reconstructions by the averaged weights, or None."""
        return None

    def options(self, output: str, **given: Any) -> Options:
        """Options with the defaults of the stage, overridden by ``given``."""
        return Options(output, **{**self.settings, **given})
