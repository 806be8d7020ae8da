"""Training of the small network: one visible loop, resumable at any step."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from pathlib import Path

import torch

from reli3d.nn.local import LocalReconstructor
from reli3d.nn.presets import LOCAL
from reli3d.train.objectives import WEIGHTS, objectives
from reli3d.train.objects import objects


def main() -> None:
    p = argparse.ArgumentParser()
    p.add_argument("samples", type=Path)
    p.add_argument("output", type=Path)
    p.add_argument("--steps", type=int, default=4000)
    p.add_argument("--batch", type=int, default=4)
    p.add_argument("--points", type=int, default=2048)
    p.add_argument("--max-views", type=int, default=6)
    p.add_argument("--rate", type=float, default=2e-3)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--threads", type=int, default=1)
    a = p.parse_args()
    torch.set_num_threads(a.threads)
    torch.manual_seed(a.seed)
    model = LocalReconstructor(LOCAL)
    print(sum(p.numel() for p in model.parameters()), "parameters", file=sys.stderr)
    a.output.mkdir(parents=True, exist_ok=True)
    optimizer = torch.optim.AdamW(model.parameters(), lr=a.rate, betas=(0.9, 0.98), weight_decay=0.02, fused=True)
    average = {k: v.detach().clone() for k, v in model.state_dict().items()}
    step, file = 0, a.output / "state.pt"
    if file.exists():
        state = torch.load(file, weights_only=True)
        model.load_state_dict(state["model"]), optimizer.load_state_dict(state["optimizer"])
        average, step = state["average"], state["step"]
    log = open(a.output / "log.jsonl", "a", buffering=1)  # noqa: SIM115
    source = objects(a.samples, size=a.batch, points=a.points, max_views=a.max_views, seed=a.seed, start=step)
    sums, saved, began = {}, time.monotonic(), time.monotonic()
    while step < a.steps:
        schedule = a.output / "steps"  # the end of the schedule may be moved while it runs
        if schedule.exists():
            a.steps = int(schedule.read_text())
        rate = a.rate * min(1.0, (step + 1) / 100) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * step / a.steps)))
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.zero_grad(set_to_none=True)
        for sample in next(source):
            terms = objectives(model, sample)
            (sum(WEIGHTS[k] * v for k, v in terms.items()) / a.batch).backward()
            for k, v in terms.items():
                sums[k] = sums.get(k, 0.0) + float(v.detach()) / a.batch
        norm = torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        if torch.isfinite(norm):
            optimizer.step()
        sums["norm"] = sums.get("norm", 0.0) + float(norm)
        decay = min(0.998, (1 + step) / (10 + step))
        with torch.no_grad():
            for key, value in model.state_dict().items():
                average[key].lerp_(value, 1 - decay) if value.is_floating_point() else None
        step += 1
        if step % 25 == 0:
            row = {"step": step, "seconds": round(time.monotonic() - began), "rate": rate,
                   **{k: round(v / 25, 4) for k, v in sums.items()}}  # fmt: skip
            log.write(json.dumps(row) + "\n")
            print(row, file=sys.stderr, flush=True)
            sums = {}
        if time.monotonic() - saved > 180 or step == a.steps:
            state = {"model": model.state_dict(), "optimizer": optimizer.state_dict(), "average": average, "step": step}
            torch.save(state, file.with_suffix(".tmp"))
            os.replace(file.with_suffix(".tmp"), file)
            saved = time.monotonic()


if __name__ == "__main__":
    main()
