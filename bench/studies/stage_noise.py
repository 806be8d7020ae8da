"""Whether a stage can gain, and what hinders it: ``python -m bench.studies.stage_noise SAMPLES STATE [--stage NAME]``.

Three questions to the averaged parameters of STATE, asked as a stage of ``tiny`` asks them.  Of what does the gradient
of one object consist: the mean over objects, which training follows, or what differs between objects, between views
of one object, or between two estimates of one view?  How much worse is a prediction made from another object's views?
And does the loss fall where two objects, each with fixed views, are shown again and again?
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bench.studies.stage_speed import network, row
from bench.studies.stages import PICTURES, drawn, interval, losses, mean
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import TINY
from reli3d.train.stages import config
from reli3d.train.stages.losses import gradients
from reli3d.train.stages.step import object_losses, total
from reli3d.train.stages.views import Draw, Samples, draw

GROUPS = {
    "pictures": ("image", "perceptual"),
    "mask": ("mask",),
    "material": ("material",),
    "normal": ("normal",),
    "others": ("flat", "latent", "neutral", "deviation", "sign", "spread"),
}
FITTED = 2  # objects


def gradients_of(model: Reconstructor, one: Draw, stage: config.Stage) -> dict[str, Tensor]:
    """Gradient of all parameters by group of terms, and of the whole loss."""
    trained = [p for p in model.parameters() if p.requires_grad]
    terms = object_losses(model, one, stage, gradients)
    found = {}
    for name, group in GROUPS.items():
        loss = total({k: v for k, v in terms.items() if k in group}, stage)
        flat = torch.zeros(sum(p.numel() for p in trained))
        if loss.requires_grad:
            parts = torch.autograd.grad(loss, trained, retain_graph=True, allow_unused=True)
            flat = torch.cat([(torch.zeros_like(p) if g is None else g).reshape(-1) for p, g in zip(trained, parts)])
        found[name] = flat
    return {"whole": torch.stack(list(found.values())).sum(0), **found}


def noise(model: Reconstructor, source: Samples, stage: config.Stage, count: int) -> str:
    """Squared norms of the parts of an object's gradient, in Markdown.

    From objects i and views v, w of each: the mean over objects is estimated by the products of gradients of different
    objects, what differs between objects by those of two views of one object less that, what differs between views by
    the rest, and what differs between estimates by half the square of the difference of two.
    """
    sizes = dict(input_size=TINY.image_size, target_size=stage.image_size, patch=stage.patch)
    square, same, estimate = (dict.fromkeys(("whole", *GROUPS), 0.0) for _ in range(3))
    sums: dict[str, Tensor] = {}
    means_square = dict.fromkeys(square, 0.0)
    for k in range(count):
        both = draw([source], (10**6, k), inputs=4, targets=2, background=0.5, **sizes)
        views = [replace(both, targets=both.targets.select([v])) for v in (0, 1)]
        first, second = (gradients_of(model, one, stage) for one in views)
        again = gradients_of(model, replace(views[0], seed=views[0].seed + 1), stage)
        for name in square:
            a, b, c = first[name], second[name], again[name]
            square[name] += float(a @ a + b @ b) / 2 / count
            same[name] += float(a @ b) / count
            estimate[name] += float((a - c) @ (a - c)) / 2 / count
            sums[name] = sums.get(name, 0) + (a + b) / 2
            means_square[name] += float((a + b) @ (a + b)) / 4
    head = ["terms", "square norm", "mean over objects", "objects", "views", "estimates"]
    lines = [row(head), "|" + "---|" * len(head)]
    for name in square:
        whole = float(sums[name] @ sums[name])
        signal = (whole - means_square[name]) / (count * (count - 1))
        parts = [signal, same[name] - signal, square[name] - same[name] - estimate[name], estimate[name]]
        lines.append(row([name, f"{square[name]:.3g}", *(f"{p:.2g}" for p in parts)]))
    return "\n".join(lines)


def seen(model: Reconstructor, source: Samples, stage: config.Stage, count: int) -> str:
    """What a prediction from another object's views costs."""
    own = drawn(source, stage, count)
    other = [replace(d, inputs=own[(k + 1) % count].inputs) for k, d in enumerate(own)]
    a, b = losses(model, stage, own), losses(model, stage, other)
    rows = [f"{n} {mean(a[n], False)} to {mean(b[n], False)}" for n in ("mask", "material", "normal")]
    return f"another object's views: shown {interval(b['shown'] - a['shown'])} more; {', '.join(rows)}"


def fit(model: Reconstructor, source: Samples, stage: config.Stage, count: int) -> str:
    """Loss of :data:`FITTED` fixed draws over ``count`` steps at the stage's rate."""
    trained = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=stage.rate, betas=(0.9, 0.98))
    values = []
    fixed = drawn(source, stage, FITTED)
    for _ in range(count):
        optimizer.zero_grad()
        values.append(0.0)
        for one in fixed:
            terms = object_losses(model, one, stage, gradients)
            loss = total(terms, stage) / FITTED
            loss.backward()
            values[-1] += sum(getattr(stage.weights, n) * float(terms[n].detach()) for n in PICTURES) / FITTED
        torch.nn.utils.clip_grad_norm_(trained, 1.0)
        optimizer.step()
    at = np.linspace(0, count - 1, 5).astype(int)
    return f"{FITTED} objects: shown {', '.join(f'{values[k]:.3f} at step {k}' for k in at)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("samples", type=Path)
    parser.add_argument("state", type=Path)
    parser.add_argument("--stage", choices=config.TINY, default="monte_carlo")
    parser.add_argument("--objects", type=int, default=64, help="that gradients are compared of")
    parser.add_argument("--steps", type=int, default=120, help="of the fit of two objects; 0: none")
    args = parser.parse_args()
    torch.set_num_threads(1)
    source, stage = Samples(args.samples), config.TINY[args.stage]
    print(noise(network(args.state), source, stage, args.objects), flush=True)
    print("\n" + seen(network(args.state), source, stage, args.objects), flush=True)
    if args.steps:
        print("\n" + fit(network(args.state), source, stage, args.steps), flush=True)


if __name__ == "__main__":
    main()
