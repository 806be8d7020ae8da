"""What each part of the small network contributes: the same training without it, in the same processor time.

usage: python -m bench.studies.ablation SAMPLES VALIDATION OUT [--maps MAPS.npz] [--minutes 15] [--runs whole:0 ...]

Every run starts from random weights and ends after ``--minutes`` of processor time; torch has one thread, convolutions
and the trunk compute in bfloat16.  A run that has its row in ``OUT/rows.jsonl`` is not done again.  Rows are the means
over the objects of VALIDATION.  Prints the table in Markdown.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import time
from functools import reduce
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.geometry.camera import Camera
from reli3d.nn.field import TriplaneField, bound_level
from reli3d.nn.local import LocalField, LocalReconstructor, PixelMaps
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import (
    SMALL,
    TINY,
    BackboneSizes,
    EncoderSizes,
    LocalPreset,
    Preset,
    UpsamplerSizes,
)
from reli3d.nn.view_features import ViewMaps
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.synthetic.maps import training_maps
from reli3d.train.batches import Sample, batches, load_sample
from reli3d.train.loop import update_average
from reli3d.train.losses import (
    GRADIENT_POINTS,
    GRADIENT_STEP,
    WEIGHTS,
    astray,
    encode_sample,
    excess_entropy,
    losses,
    pattern_loss,
)

TRUNK = dataclasses.replace(  # of the paper's form, with about as many parameters as SMALL
    TINY,
    name="trunk",
    image_size=256,
    encoder=EncoderSizes(hidden=192, layers=4, heads=3, patch=16, grid=16, mask_channel=True),
    plane_size=24,
    backbone=BackboneSizes(heads=3, latents=128, blocks=2, basic_blocks=1, experts=0, experts_from=0, groups=8),
    upsampler=UpsamplerSizes(convolutions=2, scale=4, channels=24),
    head_width=64,
)
RATE, WARMUP, BATCH, POINTS, VIEWS = 1.5e-3, 50, 4, 2048, 4
TRUNK_RATE = 4e-4  # transformers do not take the rate of convolutions
ASKED = 4096  # points of a validation object
COUNTS = (1, 2, 4)
"""Numbers of views at which the validation objects are asked."""


class WithoutVolume(LocalReconstructor):
    """Points know what the views say of them, and nothing of their neighbours."""

    def __init__(self, preset: LocalPreset):
        super().__init__(preset)
        self.volume.forward = lambda maps, surface: maps.images.new_zeros(2, 2, 2, preset.volume.features)


class WithoutPixels(LocalReconstructor):
    """The 2D U-Net gives features alone: no paint, normal and depth of its pixels."""

    def read_pixels(self, *views: Tensor) -> tuple[Tensor, PixelMaps, Camera]:
        features, pixels, camera = super().read_pixels(*views)
        shape = (*pixels.depth.shape[:3], 12)
        span = pixels.depth.detach().expand(*shape[:3], 2)  # of neutral predictions only the depth is read from it
        return features, PixelMaps.of(pixels.depth.new_zeros(shape), span, camera, span.new_zeros(())), camera


@dataclasses.dataclass(frozen=True)
class FreeField(LocalField):
    def level(self, points: Tensor) -> Tensor:
        return self.free_level(points)


class WithoutBound(LocalReconstructor):
    """The silhouettes' hull is a feature, but the surface may leave it."""

    def encode(self, *views: Tensor, mirrored: int = 0) -> LocalField:
        field = super().encode(*views, mirrored=mirrored)
        return FreeField(*(getattr(field, f.name) for f in dataclasses.fields(field)))


class Trunk(nn.Module):
    """The paper's network (two-stream transformer, triplane) with the silhouettes' bound, asked at points."""

    def __init__(self, preset: Preset):
        super().__init__()
        self.net = Reconstructor(preset)

    def encode(self, sample: Sample) -> TriplaneField:
        views = (sample.images, sample.masks, sample.c2w, sample.intrinsics)
        with torch.autocast("cpu", torch.bfloat16):
            code = self.net.encode(*(t[None] for t in views))
        detail = torch.cat([sample.images, sample.silhouette[..., None]], -1).contiguous()
        size = detail.shape[2:0:-1]
        return TriplaneField(ViewMaps(detail, detail, Camera(sample.c2w, sample.intrinsics, *size)), self.net, code)

    def level(self, field: TriplaneField, points: Tensor, bounded: bool = True) -> Tensor:
        """Logarithm of the density in the place of the density: the unit of the level of the small network."""
        raw = self.net.query(field.code, points[None], ("density",))["density"][0, :, 0]
        level = self.net.surface_density - raw
        return torch.maximum(level, bound_level(field.maps, points, SMALL.softness)) if bounded else level

    def losses(self, sample: Sample) -> dict[str, Tensor]:
        """The terms of :func:`reli3d.train.losses.losses` that ask points; the light is left out."""
        field = self.encode(sample)
        position, normal, bumped = (t.contiguous() for t in sample.surface.unbind(1))
        normal, bumped = functional.normalize(normal, dim=-1), functional.normalize(bumped, dim=-1)
        target = (-sample.distance / SMALL.softness).sigmoid()
        corners = GRADIENT_STEP * position.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
        few = position[:GRADIENT_POINTS]
        near, _ = astray(few, normal[:GRADIENT_POINTS])
        around = self.level(field, (near[:, None] + corners).reshape(-1, 3), False).reshape(-1, 4)
        slope = (around[..., None] * corners).sum(1)
        on_surface = self.level(field, few, False)
        got = field.material(*astray(position, normal), sample.visible)
        base, rough, metal = sample.material[:, :3], sample.material[:, 3], sample.material[:, 4]
        cosine = functional.cosine_similarity
        return {
            "occupancy": functional.binary_cross_entropy_with_logits(-self.level(field, sample.points), target),
            "surface": functional.smooth_l1_loss(on_surface, torch.zeros_like(on_surface)),
            "gradient": (1 - cosine(slope, normal[:GRADIENT_POINTS], dim=-1, eps=1e-6)).mean(),
            "base_color": excess_entropy(got.base_color.clamp(1e-4, 1 - 1e-4), base),
            "pattern": pattern_loss(got.base_color, base),
            "roughness": excess_entropy(got.roughness, rough),
            "metallic": excess_entropy(got.metallic.clamp(1e-4, 1 - 1e-4), metal),
            "normal": (1 - cosine(got.normal, bumped, dim=-1)).mean(),
        }


VARIANTS = {
    "whole": lambda: LocalReconstructor(SMALL),
    "without volume": lambda: WithoutVolume(SMALL),
    "without pixels": lambda: WithoutPixels(SMALL),
    "without bound": lambda: WithoutBound(SMALL),
    "trunk": lambda: Trunk(TRUNK),
}


def terms_of(model: nn.Module, sample: Sample) -> dict[str, Tensor]:
    return model.losses(sample) if isinstance(model, Trunk) else losses(model, sample)


def trained(model: nn.Module, args: argparse.Namespace, seed: int) -> tuple[dict[str, Tensor], int]:
    """Averaged parameters after ``args.minutes`` of processor time, and the number of steps."""
    lights = training_maps(args.maps) if args.maps else None
    source = batches(args.samples, size=BATCH, points=POINTS, max_views=VIEWS, seed=seed, lights=lights)
    parameters = [p for p in model.parameters() if p.requires_grad]
    rate = TRUNK_RATE if isinstance(model, Trunk) else RATE
    optimizer = torch.optim.AdamW(parameters, lr=rate, betas=(0.9, 0.98), weight_decay=0.02, fused=True)
    average = {k: v.detach().clone() for k, v in model.state_dict().items()}
    step, began = 0, time.process_time()
    while (done := (time.process_time() - began) / (60 * args.minutes)) < 1.0:
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / WARMUP) * (0.02 + 0.49 * (1 + math.cos(math.pi * done)))
        optimizer.zero_grad(set_to_none=True)
        for sample in next(source):
            terms = terms_of(model, sample)
            (reduce(torch.add, [WEIGHTS[k] * v for k, v in terms.items()]) / BATCH).backward()
        norm = torch.nn.utils.clip_grad_norm_(parameters, 5.0)
        if torch.isfinite(norm):
            optimizer.step()
        step += 1
        update_average(average, model, min(0.995, step / (10 + step)))
    return average, step


@torch.no_grad()
def asked(model: nn.Module, path: Path, views: int) -> tuple[float, float, float]:
    """Of a validation object: occupancy error, angle of the level's slope [degree] and PSNR of base colour [dB]."""
    sample = load_sample(path, views, ASKED, np.random.default_rng(0), augment=False)
    position, normal, _ = (t.contiguous() for t in sample.surface.unbind(1))
    normal = functional.normalize(normal, dim=-1)
    corners = GRADIENT_STEP * position.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    around = (position[:, None] + corners).reshape(-1, 3)
    if isinstance(model, Trunk):
        field = model.encode(sample)
        level, slope = model.level(field, sample.points), model.level(field, around, False)
    else:
        field = encode_sample(model, sample).with_shading(position, normal, sample.visible)
        level, slope = field.level(sample.points), field.free_level(around)
    slope = (slope.reshape(-1, 4)[..., None] * corners).sum(1)
    target = (-sample.distance / SMALL.softness).sigmoid()
    cosine = functional.cosine_similarity(slope, normal, dim=-1, eps=1e-6).clamp(-1, 1)
    got = srgb_to_linear(field.material(position, normal, sample.visible).base_color)
    want = sample.material[:, :3]
    factor = (got * srgb_to_linear(want)).sum(0) / got.square().sum(0).clamp(min=1e-4)
    error = functional.mse_loss(linear_to_srgb((got * factor).clamp(0, 1)), want).clamp(min=1e-6)
    occupancy = functional.binary_cross_entropy_with_logits(-level, target)
    return float(occupancy), float(torch.rad2deg(cosine.acos()).mean()), float(-10 * error.log10())


def run(name: str, seed: int, args: argparse.Namespace) -> dict:
    torch.manual_seed(seed)
    model = VARIANTS[name]()
    if isinstance(model, LocalReconstructor):
        model.to_compute(torch.bfloat16)
    average, steps = trained(model, args, seed)
    model.load_state_dict(average)
    model.eval()
    row = {"variant": name, "seed": seed, "minutes": args.minutes, "steps": steps}
    row["parameters"] = sum(p.numel() for p in model.parameters())
    for views in COUNTS:
        values = np.array([asked(model, path, views) for path in sorted(args.validation.glob("*.safetensors"))])
        row[str(views)] = [round(float(v), 4) for v in values.mean(0)]
    return row


def table(rows: list[dict]) -> str:
    lines = [
        "| network | seed | parameters | steps | occupancy: 1, 2, 4 views | slope | base colour [dB] |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        columns = [[f"{row[str(v)][k]:.{digits}f}" for v in COUNTS] for k, digits in ((0, 3), (1, 1), (2, 1))]
        cells = [
            row["variant"],
            row["seed"],
            f"{row['parameters'] / 1e6:.1f} M",
            row["steps"],
            *map(", ".join, columns),
        ]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("samples", type=Path)
    p.add_argument("validation", type=Path)
    p.add_argument("out", type=Path)
    p.add_argument("--maps", type=Path)
    p.add_argument("--minutes", type=float, default=15.0, help="of processor time, each run")
    p.add_argument("--runs", nargs="+", default=[f"{name}:0" for name in VARIANTS], help="VARIANT:SEED")
    args = p.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    file = args.out / "rows.jsonl"
    for one in args.runs:
        name, seed = one.rsplit(":", 1)
        rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
        if not any(r["variant"] == name and r["seed"] == int(seed) for r in rows):
            row = run(name, int(seed), args)
            with file.open("a") as log:
                log.write(json.dumps(row) + "\n")
    print(table([json.loads(line) for line in file.read_text().splitlines()]))


if __name__ == "__main__":
    main()
