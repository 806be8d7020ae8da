"""Roughness and metallic of pixels as distributions over a few values instead of a single number.

A regression of values that cluster near 0 and 1 predicts their mean where it is uncertain.  A distribution over ``B``
values ``k / (B - 1)``, trained by cross-entropy, is not pulled to the mean; its expectation is the prediction (Imani
and White 2018, Improving Regression Performance with Distributional Losses, arXiv 1806.04613).  The zero input is the
binomial distribution, whose expectation for logits ``k l`` is ``sigmoid(l)``: a network of single logits is converted
exactly, by :func:`with_bins`.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from reli3d.errors import InputError
from reli3d.nn.local import LocalReconstructor
from reli3d.nn.pyramid import BINNED, OTHERS_BEFORE

L1_WEIGHT = 0.2  # of the expectation's absolute error, added to the cross-entropy


def two_bins(value: Tensor, bins: int) -> Tensor:
    """Distribution ``(..., bins)`` over the two values ``k / (bins - 1)`` next to ``value (...)`` in [0, 1], whose
    expectation is ``value``.
    """
    place = value[..., None] * (bins - 1)
    steps = torch.arange(bins, device=value.device, dtype=value.dtype)
    return (1.0 - (place - steps).abs()).clamp(min=0.0)


def bin_loss(log_probability: Tensor, value: Tensor) -> Tensor:
    """Mean cross-entropy of distributions ``(N, B)`` for the values ``(N,)``, by :func:`two_bins`, less its least value
    and divided by log(B), plus L1_WEIGHT times the mean absolute error of the expectation.  0 where they are equal.
    """
    bins = log_probability.shape[-1]
    target = two_bins(value, bins)
    entropy = -torch.xlogy(target, target).sum(-1)
    cross = -(target * log_probability).sum(-1)
    steps = torch.linspace(0.0, 1.0, bins, device=value.device, dtype=value.dtype)
    expected = (log_probability.exp() * steps).sum(-1)
    return (cross - entropy).mean() / math.log(bins) + L1_WEIGHT * functional.l1_loss(expected, value)


def with_bins(model: LocalReconstructor, bins: int) -> LocalReconstructor:
    """A network that predicts roughness and metallic of pixels as distributions over ``bins`` values, with the
    parameters and to rounding the predictions of ``model``, which predicts single logits.

    Raises InputError where ``model`` has another number of bins already.
    """
    have, preset = model.preset.pyramid.material_bins, model.preset
    if have == bins:
        return model
    if have > 1:
        raise InputError("material_bins", f"expected {have}, as the weights have, got {bins}; leave it out")
    made = type(model)(replace(preset, pyramid=replace(preset.pyramid, material_bins=bins)))
    state = {name: _widened(v, bins) if _predicts(name) else v for name, v in model.state_dict().items()}
    made.load_state_dict(state)
    return made.train(model.training)


def _predicts(name: str) -> bool:
    """Whether ``name`` is a parameter of a last layer of the 2D U-Net's predictions."""
    parts = name.split(".")
    return parts[:2] == ["pyramid", "says"] and parts[3] == "1"


def _widened(value: Tensor, bins: int) -> Tensor:
    """Rows of a last layer with those of the BINNED single logits replaced by their multiples 0 to ``bins - 1``."""
    before, binned, after = value.split([OTHERS_BEFORE, BINNED, len(value) - OTHERS_BEFORE - BINNED])
    steps = torch.arange(bins, dtype=value.dtype, device=value.device).view(1, bins, *[1] * (value.ndim - 1))
    return torch.cat([before, (binned[:, None] * steps).flatten(0, 1), after])
