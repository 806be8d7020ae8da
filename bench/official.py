"""A whole forward of a preset at its published size, part by part: ``python -m bench.official --views 4``.

It takes minutes and gigabytes, so it has no CASES and runs only when named.  Random weights (those that training starts
from) are written to a file by a process of their own and then mapped, as published ones would be.  FLOPs are counted
on the meta device, two a multiply-add.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import torch
from torch.utils.flop_counter import FlopCounterMode

from bench.timing import _status, synchronize
from reli3d.nn import weights
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import OFFICIAL, Preset
from reli3d.nn.reni import EnvironmentDecoder

PARTS = ("camera", "encoder", "bank", "backbone", "upsampler", "illumination", "environment", "heads", "merger")


def views(preset: Preset, count: int, device: torch.device) -> tuple[torch.Tensor, ...]:
    """Random images of one object from cameras on a circle about the vertical."""
    size, generator = preset.image_size, torch.Generator().manual_seed(0)
    angle = torch.arange(count) * 6.283 / count
    zero, one, c, s = torch.zeros(count), torch.ones(count), angle.cos(), angle.sin()
    c2w = torch.stack([c, zero, s, 2 * s, zero, one, zero, zero, -s, zero, c, 2 * c, zero, zero, zero, one], -1)
    intrinsics = torch.tensor([1.5 * size, 1.5 * size, size / 2, size / 2]).expand(count, 4)
    images = torch.rand(count, size, size, 3, generator=generator)
    masks = (torch.rand(count, size, size, generator=generator) > 0.5).float()
    return tuple(t[None].to(device) for t in (images, masks, c2w.unflatten(-1, (4, 4)), intrinsics))


def counted(preset: Preset, count: int) -> dict[str, float]:
    """Floating-point operations of each part for ``count`` views, by torch's counter."""
    with torch.device("meta"):
        model = Reconstructor(preset).eval().requires_grad_(False)
    counter = FlopCounterMode(display=False)
    with torch.no_grad(), counter:
        model.encode(*views(preset, count, torch.device("meta")))
    totals = counter.get_flop_counts()
    kinds = {part: type(getattr(model, part, None)).__name__ for part in PARTS}  # the counter's names of the outermost
    flops = {part: float(sum(totals.get(kind, {}).values())) for part, kind in kinds.items()}
    decoder, light = EnvironmentDecoder(preset.reni), torch.zeros(1, preset.reni.latents, 3)
    with torch.no_grad(), FlopCounterMode(display=False) as counter:  # a small one, and autocast knows no meta device
        decoder(light, torch.eye(3)[None], torch.zeros(1))
    return flops | {"environment": float(counter.get_total_flops())}


def write_random(path: Path, preset: Preset) -> None:
    torch.manual_seed(0)
    weights.save(path, Reconstructor(preset), license="none: random numbers", dtype=torch.float32)


class Clock:
    """Seconds of each part, by hooks on the modules."""

    def __init__(self, model: Reconstructor, device: torch.device):
        self.seconds: dict[str, float] = defaultdict(float)
        named = {name: getattr(model, name) for name in PARTS[:-2]}
        named |= {f"  block {k}": block for k, block in enumerate(model.backbone.main_blocks)}
        for name, module in named.items():
            module.register_forward_pre_hook(lambda *_, name=name: self._add(name, device, -1.0))
            module.register_forward_hook(lambda *_, name=name: self._add(name, device, 1.0))

    def _add(self, name: str, device: torch.device, sign: float) -> None:
        synchronize(device)
        self.seconds[name] += sign * time.perf_counter()


@torch.no_grad()
def forward(path: Path, count: int, trunk: torch.dtype, device: torch.device, runs: int) -> None:
    """Load the file, run the forward and print seconds and memory."""
    began = time.perf_counter()
    model, _ = weights.load(path, trunk=trunk, device=device)
    print(f"load {time.perf_counter() - began:.2f} s, {torch.get_num_threads()} threads, {device}, {trunk}")
    inputs = views(model.preset, count, device)
    flops = counted(model.preset, count)
    clock = Clock(model, device)
    for run in range(runs):
        clock.seconds.clear()
        processor, began = time.process_time(), time.perf_counter()
        code = model.encode(*inputs)
        environment = model.decode_environment(code)
        synchronize(device)
        whole, busy = time.perf_counter() - began, time.process_time() - processor
        finite = all(bool(t.isfinite().all()) for t in (code.triplane, code.latent, code.strength, environment))
        print(
            f"run {run + 1}: {whole:.2f} s with {count} views (processor {busy:.1f} s), "
            f"{sum(flops.values()) / whole / 1e9:.0f} GFLOP/s, {'finite' if finite else 'NOT FINITE'}"
        )
        for name, seconds in clock.seconds.items():
            rate = f"{flops[name] / seconds / 1e9:8.0f} GFLOP/s" if flops.get(name) else ""
            print(f"  {name:16s} {seconds:8.3f} s {rate}")
        began, side = time.perf_counter(), torch.linspace(-0.87, 0.87, model.preset.resolution + 1, device=device)
        model.sdf(model.query(code, torch.cartesian_prod(side, side, side)[None], ("density",))["density"])
        synchronize(device)
        print(f"  {'SDF on grid':16s} {time.perf_counter() - began:8.3f} s")
        if device.type == "cuda":
            print(f"  peak {torch.cuda.max_memory_allocated(device) / 2**30:.2f} GiB of the device")
        elif peak := _status("VmHWM"):
            mapped = _status("RssFile")
            print(f"  peak {peak / 2**30:.2f} GiB resident, of it {mapped / 2**30:.2f} GiB mapped files")
        sys.stdout.flush()


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.official", description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--precision", choices=("float32", "bfloat16"), default="float32", help="of the trunk")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--weights",
        type=Path,
        help="file to use; where it is missing random weights are written "
        "there (6.3 GB) and kept; default a temporary one",
    )
    parser.add_argument("--runs", type=int, default=1)
    options = parser.parse_args(argv)
    spawn = multiprocessing.get_context("spawn")  # a process of its own: the peak is the forward's alone
    with tempfile.TemporaryDirectory() as folder:
        path = options.weights or Path(folder) / "random.safetensors"
        jobs = [] if path.is_file() else [(write_random, (path, OFFICIAL))]
        trunk = getattr(torch, options.precision)
        jobs += [(forward, (path, n, trunk, torch.device(options.device), options.runs)) for n in options.views]
        for target, arguments in jobs:
            process = spawn.Process(target=target, args=arguments)
            process.start()
            process.join()
            if process.exitcode:
                return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
