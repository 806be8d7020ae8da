"""What each stage of a training reached: its loss where it starts and where it ends, curves, pictures.

usage: python -m bench.studies.stages RUNS --train SAMPLES --held-back SAMPLES --prior FILE --out FOLDER

RUNS holds ``seed0/volume`` and so on, as ``reli3d-stages`` wrote them; a stage of another seed that lacks the one
before started from that of ``seed0``.  The loss of a stage is asked twice on the same views: with the averaged
parameters that it starts from and with those at its end.  ``shown`` is its part that compares pictures; where there is
no surface the picture is black.  Intervals (95 %) are of the mean over objects, by bootstrap.  Writes ``stages.md``,
``stages.png`` and ``stages.jpg``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import TINY
from reli3d.train.stages import config
from reli3d.train.stages.latents import fitted, load_prior
from reli3d.train.stages.loop import averaged, load_state
from reli3d.train.stages.losses import cover_error, gradients, shown_colors
from reli3d.train.stages.picture import Picture
from reli3d.train.stages.step import object_losses, total
from reli3d.train.stages.views import Draw, Samples, draw

STAGES = tuple(config.TINY)
PICTURES = ("image", "perceptual", "mask")
PARTS = ("image", "mask", "material", "normal")
COLORS = ("#1f5fa8", "#b3541e", "#3a8f4d")
PANEL, MARGIN = (270, 120), 36
OBJECTS = 2  # in the pictures


def drawn(source: Samples, stage: config.Stage, count: int) -> list[Draw]:
    """``count`` fixed objects and views, whole, none of which a training with a seed below 10^6 has drawn."""
    sizes = dict(input_size=TINY.image_size, target_size=stage.image_size, patch=0)
    return [draw([source], (10**6, k), inputs=4, targets=1, background=0.5, **sizes) for k in range(count)]


@torch.no_grad()
def losses(model: Reconstructor, stage: config.Stage, draws: list[Draw]) -> dict[str, np.ndarray]:
    """``shown``, the whole loss and some of its terms of each draw; NaN where a draw does not have a term."""
    rows = []
    for one in draws:
        terms = object_losses(model, one, stage, gradients)
        row = {"loss": float(total(terms, stage))} if "image" in terms else {}
        terms = {**black(one), **terms}
        row["shown"] = sum(getattr(stage.weights, name) * float(terms[name]) for name in PICTURES)
        rows.append({**row, **{n: float(v) for n, v in terms.items() if n in PARTS}})
    return {name: np.array([r.get(name, np.nan) for r in rows]) for name in ("shown", "loss", *PARTS)}


def black(one: Draw) -> dict[str, Tensor]:
    """The terms of :data:`PICTURES` of a picture that shows nothing."""
    view = one.targets.images[0]
    none, flat = torch.zeros_like(view), torch.zeros_like(view[..., 0])
    empty = Picture(none, flat, flat, torch.zeros(*flat.shape, 5), none, none[:0, 0])
    got, want = shown_colors(empty, one.targets, 0)
    pictured = {"image": (got - want).square().mean(), "perceptual": gradients(got, want)}
    return {**pictured, "mask": cover_error(empty, one.targets, 0)}


def start_of(runs: Path, seed: int, stage: str, prior: Path) -> Reconstructor:
    """The network that a stage starts from: of the stage before the averaged one, else a new one of the seed."""
    torch.manual_seed(seed)
    model = Reconstructor(TINY)
    load_prior(model, prior)
    before = STAGES.index(stage) - 1
    if before < 0:
        return model.eval()
    own, first = (runs_state(runs, k, STAGES[before]) for k in (seed, 0))
    return averaged(model, load_state(own if own.exists() else first, model)["average"])


def interval(values: np.ndarray) -> str:
    """Mean and 95 % interval of the mean, by bootstrap; - where a draw has no value."""
    if not np.isfinite(values).all():
        return "-"
    rng = np.random.default_rng(0)
    means = rng.choice(values, (4000, len(values))).mean(1)
    return f"{values.mean():.3f} ({np.quantile(means, 0.025):.3f} to {np.quantile(means, 0.975):.3f})"


def mean(values: np.ndarray, all_of_them: bool) -> str:
    """Mean over the draws that have a value, or - where none has, or where all must."""
    known = values[np.isfinite(values)]
    return f"{known.mean():.3f}" if len(known) and len(known) >= all_of_them * len(values) else "-"


def table(args: argparse.Namespace, seeds: list[int]) -> str:
    """Loss at start and end of each stage, in Markdown."""
    model = Reconstructor(TINY)
    load_prior(model, args.prior)
    sources = {}
    for name, folder in (("training", args.train), ("held-back", args.held_back)):
        latents = fitted(model.environment, sorted(folder.glob("*.safetensors")), args.out / f"{name}.latents")
        sources[name] = Samples(folder, latents)
    head = ["objects", "seed", "stage", "shown", "end less start", "whole loss", "end less start", *PARTS]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for name, source in sources.items():
        for stage in args.stages:
            for seed in seeds:
                end = runs_state(args.runs, seed, stage)
                if not end.exists():
                    continue
                settings = config.TINY[stage]
                draws = drawn(source, settings, args.count)
                start = start_of(args.runs, seed, stage, args.prior)
                first = losses(start, settings, draws)
                last = losses(averaged(start, load_state(end, start)["average"]), settings, draws)
                change = [f"{mean(first[p], False)} to {mean(last[p], False)}" for p in PARTS]
                cells = [f"{mean(first[p], True)} to {mean(last[p], True)}" for p in ("shown", "loss")]
                less = [interval(last[p] - first[p]) for p in ("shown", "loss")]
                change = [cells[0], less[0], cells[1], less[1], *change]
                lines.append(f"| {' | '.join([name, str(seed), stage, *change])} |")
                print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def runs_state(runs: Path, seed: int, stage: str) -> Path:
    return runs / f"seed{seed}" / stage / "state.pt"


def log_of(folder: Path) -> list[dict]:
    path = folder / "log.jsonl"
    rows = map(json.loads, path.read_text().splitlines()) if path.exists() else ()
    return [r for r in rows if "config" not in r]


def smoothed(values: np.ndarray, width: int) -> np.ndarray:
    """Means over ``width`` neighbours, fewer at the ends."""
    return np.array([np.nanmean(values[max(0, k - width // 2) : k + width // 2 + 1]) for k in range(len(values))])


def curves(runs: Path, seeds: list[int], path: Path) -> None:
    """Means of the training loss and its terms over 15 rows of the logs: a column a stage, a line a seed."""
    names = ("loss", *PARTS)
    sheet = Image.new("RGB", (len(STAGES) * (PANEL[0] + MARGIN) + 10, len(names) * (PANEL[1] + 26) + 6), "white")
    pen = ImageDraw.Draw(sheet)
    for column, stage in enumerate(STAGES):
        logs = {seed: log_of(runs / f"seed{seed}" / stage) for seed in seeds}
        logs = {seed: rows for seed, rows in logs.items() if len(rows) > 1}
        for line, name in enumerate(names if logs else ()):
            lines = {}
            for seed, rows in logs.items():
                values = smoothed(np.array([r.get(name, np.nan) for r in rows]), 15)
                lines[seed] = np.array([r["step"] for r in rows], float), np.log10(values)
            low = min(np.nanmin(y) for _, y in lines.values())
            high = max(max(np.nanmax(y) for _, y in lines.values()), low + 1e-6)
            most = max(x[-1] for x, _ in lines.values())
            x0, y0 = MARGIN + column * (PANEL[0] + MARGIN), 20 + line * (PANEL[1] + 26)
            pen.rectangle([x0, y0, x0 + PANEL[0], y0 + PANEL[1]], outline="#bbbbbb")
            pen.text((x0, y0 - 14), f"{stage}: {name}, {int(most)} steps", fill="black")
            pen.text((x0 - 34, y0), f"{10**high:.3g}", fill="#777777")
            pen.text((x0 - 34, y0 + PANEL[1] - 11), f"{10**low:.3g}", fill="#777777")
            for seed, (x, y) in lines.items():
                at = zip(x0 + PANEL[0] * x / most, y0 + PANEL[1] * (high - y) / (high - low))
                pen.line([p for p in at if np.isfinite(p[1])], fill=COLORS[seeds.index(seed) % len(COLORS)])
    sheet.quantize(32).save(path, optimize=True)


def pictures(runs: Path, seed: int, path: Path) -> None:
    """Rows of ``pictures.png`` of all stages, object after object."""
    found = [runs / f"seed{seed}" / stage / "pictures.png" for stage in STAGES]
    grids = [np.asarray(Image.open(p).convert("RGB")) for p in found if p.exists()]
    side = grids[0].shape[0] // 3  # of HELD objects in reli3d.cli.stages
    rows = [grid[k * side : (k + 1) * side] for k in range(OBJECTS) for grid in grids]
    Image.fromarray(np.concatenate(rows)).save(path, quality=85)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path)
    parser.add_argument("--train", type=Path, required=True)
    parser.add_argument("--held-back", type=Path, required=True)
    parser.add_argument("--prior", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=STAGES, help="that the table has")
    parser.add_argument("--count", type=int, default=64, help="views of a mean")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    seeds = sorted(int(p.name.removeprefix("seed")) for p in args.runs.glob("seed[0-9]*"))
    curves(args.runs, seeds, args.out / "stages.png")
    pictures(args.runs, seeds[0], args.out / "stages.jpg")
    (args.out / "stages.md").write_text(table(args, seeds))


if __name__ == "__main__":
    main()
