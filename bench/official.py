"""A whole forward of a preset at its published size, part by part: ``python -m bench.official --views 4``.

It takes minutes and gigabytes, so it has no CASES and runs only when named.  Random weights (those that training starts
from) are written to a file by a process of their own and then mapped, as published ones would be.  FLOPs are counted
on the meta device, two a multiply-add, and compared with closed forms of the specification's sizes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
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
from reli3d.nn.presets import OFFICIAL, EncoderSizes, Preset
from reli3d.nn.reni import EnvironmentDecoder

PARTS = ("camera", "encoder", "bank", "backbone", "upsampler", "illumination", "environment", "heads", "merger")
# Parameters as the specification counts them, by part of ours.  It gives no number for the illumination: that is its
# whole, 1,574,452,729, less the others, 24,576 numbers of map directions and 10 of tone mapping, buffers here.
SPECIFIED = {
    "camera": 26_624,
    "encoder": 304_367_616 + 100_761_600,
    "bank": 28_311_552,
    "backbone": 996_710_448,
    "upsampler": 34_213_504,
    "illumination": 109_273_856,
    "environment": 659_854,
    "heads": 89_308,
    "merger": 13_781,
}


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


def specified_flops(preset: Preset, count: int) -> dict[str, float]:
    """The same from closed forms: matrix products and attention of the specification's sections 3 to 9."""

    def linear(tokens: int, a: int, b: int) -> float:
        return 2.0 * tokens * a * b

    def attention(queries: int, keys: int, width: int, context: int | None = None) -> float:
        projections = 2 * linear(queries, width, width) + 2 * linear(keys, context or width, width)
        return projections + 4.0 * queries * keys * width

    def gated(tokens: int, width: int) -> float:
        return linear(tokens, width, 8 * width) + linear(tokens, 4 * width, width)

    def encoder(sizes: EncoderSizes) -> tuple[float, int]:
        w, patches = sizes.hidden, (preset.image_size // sizes.patch) ** 2
        tokens = patches + 1
        layer = attention(tokens, tokens, w) + 2 * linear(tokens, w, 4 * w) + 2 * linear(1, w, 2 * w)
        project = 0.0 if w == preset.camera_width else linear(1, preset.camera_width, w)
        return count * (
            linear(patches, sizes.channels * sizes.patch**2, w) + project + sizes.layers * layer
        ), tokens + 1

    b, i, r, w = preset.backbone, preset.illumination, preset.reni, preset.encoder.hidden
    own, tokens = encoder(preset.encoder)
    planes, latents = 3 * preset.plane_size**2, tokens + b.latents
    fuse = attention(latents, planes, w) + gated(latents, w) + attention(planes, latents, w) + gated(planes, w)
    basic = attention(latents, latents, w) + attention(latents, count * tokens, w)
    mixed = (b.experts + 1) * gated(latents, w) + linear(latents, w, b.experts)
    with_experts = max(0, b.blocks - b.experts_from) if b.experts else 0
    two_stream = 2 * linear(planes, w, w) + linear(latents, w, w) + b.blocks * (fuse + b.basic_blocks * basic)
    two_stream += b.basic_blocks * (with_experts * mixed + (b.blocks - with_experts) * gated(latents, w))
    u = preset.upsampler
    upsampler = linear(planes, 9 * w, (u.convolutions - 1) * w + u.channels * u.scale**2)
    light, light_tokens = encoder(i.encoder)
    context = count * light_tokens + planes
    light += linear(planes, w, i.encoder.hidden) + 2 * linear(i.tokens, i.token_width, i.width)
    light += i.layers * (attention(i.tokens, i.tokens, i.width) + gated(i.tokens, i.width))
    light += i.layers * attention(i.tokens, context, i.width, i.encoder.hidden)
    rays, features = 2 * r.height**2, 5 * (r.latents + 2)
    reni = linear(rays, r.latents, 2) + linear(rays, features, r.width) + linear(rays, r.width, 3)
    reni += r.layers * (
        2 * linear(rays, r.width, r.width) + linear(1, 3 * r.latents, r.width) + linear(1, r.width, r.width)
    )
    return {
        "camera": linear(count, 25, preset.camera_width),
        "encoder": own,
        "bank": 0.0,
        "backbone": two_stream,
        "upsampler": upsampler,
        "illumination": light,
        "environment": reni + 2 * 9.0 * r.latents,
        "heads": 0.0,
        "merger": 0.0,
    }


def parameters(preset: Preset) -> dict[str, int]:
    """Parameters of each part that the preset has, buffers not counted."""
    with torch.device("meta"):
        model = Reconstructor(preset)
    return {part: sum(p.numel() for p in getattr(model, part).parameters()) for part in PARTS if hasattr(model, part)}


def table(preset: Preset, count: int) -> str:
    """Parameters and operations of each part and those of the specification, as rows of Markdown."""
    flops, formula = counted(preset, count), specified_flops(preset, count)
    own, stated = parameters(preset), SPECIFIED if preset.name == "official" else {}
    rows = [f"| part | parameters | specification | GFLOP, {count} views | closed form |", "|---|---|---|---|---|"]
    for part, number in own.items():
        rows.append(
            f"| {part} | {number:,} | {f'{stated[part]:,}' if part in stated else '-'} | "
            f"{flops[part] / 1e9:.3f} | {formula[part] / 1e9:.3f} |"
        )
    whole = f"{sum(stated.values()):,}" if stated else "-"
    rows.append(
        f"| sum | {sum(own.values()):,} | {whole} | {sum(flops.values()) / 1e9:.1f} | "
        f"{sum(formula.values()) / 1e9:.1f} |"
    )
    return "\n".join(rows)


def write_random(path: Path, preset: Preset) -> None:
    torch.manual_seed(0)
    weights.save(path, Reconstructor(preset), license="none: random numbers", dtype=torch.float32)


def matrix_rate(device: torch.device, dtype: torch.dtype, seconds: float = 2.0) -> float:
    """Operations a second of a matrix product of the model's sizes, the median of about ``seconds``."""
    a, b = torch.rand(3072, 1024, device=device, dtype=dtype), torch.rand(8192, 1024, device=device, dtype=dtype)
    times: list[float] = []
    while len(times) < 5 or sum(times) < seconds:
        synchronize(device)
        began = time.perf_counter()
        torch.nn.functional.linear(a, b)
        synchronize(device)
        times.append(time.perf_counter() - began)
    return 2.0 * 3072 * 1024 * 8192 / statistics.median(times[1:])


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
    before = matrix_rate(device, trunk)
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
        after = matrix_rate(device, trunk)
        floor = 2.0 * sum(flops.values()) / (before + after)
        print(
            f"  matrix products alone run at {before / 1e9:.0f} GFLOP/s before and {after / 1e9:.0f} after: floor "
            f"{floor:.2f} s, of which the forward reaches {floor / whole:.0%}"
        )
        before = after
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
    parser.add_argument("--table", action="store_true", help="only count parameters and operations")
    options = parser.parse_args(argv)
    preset = OFFICIAL
    if options.table:
        print(table(preset, max(options.views)))
        return 0
    spawn = multiprocessing.get_context("spawn")  # a process of its own: the peak is the forward's alone
    with tempfile.TemporaryDirectory() as folder:
        path = options.weights or Path(folder) / "random.safetensors"
        jobs = [] if path.is_file() else [(write_random, (path, preset))]
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
