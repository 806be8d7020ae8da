"""What a training is made of: the options of the loop and the interface of a stage."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor, nn


@dataclass(frozen=True)
class Options:
    """Of the loop, whatever the stage."""

    output: str  # folder of state.pt, log.jsonl, curves.png and validation.png
    steps: int = 20_000
    minutes: float = math.inf  # of training; the schedule follows whichever of steps and minutes runs out first
    batch: int = 4  # objects a step, over all processes
    rate: float = 1.5e-3  # peak learning rate
    final_rate: float = 0.02  # at the end of the schedule, as a fraction of the peak
    warmup: int = 100  # steps
    weight_decay: float = 0.02
    clip: float = 5.0  # largest norm of the gradient
    average: float = 0.999  # decay of the averaged weights
    seed: int = 0
    save_every: int = 200  # steps
    log_every: int = 10  # steps
    bad_steps: int = 20  # steps in a row without finite gradients after which a run ends with an error
    shard: bool = False  # divide parameters, gradients and moments of ``Stage.layers`` among the processes
    tensorboard: str = ""  # folder of event files; "": none


class Stage:
    """What :func:`reli3d.train.loop.train` trains.

    A new stage sets the four attributes and overrides ``batch`` and ``losses``.
    """

    name: str
    model: Any  # torch.nn.Module with ``preset``
    weights: Mapping[str, float]  # of the terms of ``losses``
    settings: Mapping[str, Any]  # defaults of :class:`Options` for this stage

    def batch(self, step: int, objects: range) -> Sequence[Any]:
        """Items for the ``objects`` of a step, by their places in the batch: a function of the seed, the step and the
        places alone, so that several processes train as one does.
        """
        raise NotImplementedError

    def losses(self, item: Any) -> dict[str, Tensor]:
        """Unweighted scalar terms of an item, by the names of ``weights``; a term without ground truth is left out."""
        raise NotImplementedError

    def rate_factor(self, parameter: str) -> float:
        """Multiplier of the learning rate for the parameter of this name; 0: not trained."""
        return 1.0

    def measures(self) -> dict[str, float]:
        """Numbers that are logged and stored with every checkpoint; raises where training cannot go on from here.

        Called before the first step and at every checkpoint, by all processes.
        """
        return {}

    def validation(self, average: dict[str, Tensor]) -> np.ndarray | None:
        """Image ``(H, W, 3)`` uint8 of what the averaged weights reconstruct; None: there is none."""
        return None

    def layers(self) -> list[nn.Module]:
        """Modules whose parameters ``Options.shard`` divides among the processes."""
        return []

    def configuration(self) -> dict[str, Any]:
        """What is stored with a run besides :class:`Options`."""
        return {}

    def options(self, output: str, **given: Any) -> Options:
        """The stage's settings with those ``given`` in their place."""
        return Options(output, **{**self.settings, **given})
