"""What bfloat16 and int8 do to the published network's modules: ``python -m bench.studies.precision GOLDENS``.

GOLDENS: a folder of inputs, parameters and outputs of the published modules.  The error is the norm of the difference
from the published output by the norm of that output.  int8 is torch's dynamic quantisation of the feed-forward layers
(weights by tensor or by channel, activations by tensor).  The last rows are one feed-forward layer of the published
width with random weights, with its time: the second has one input channel 60 times as large as the others.

``--meshes FOLDER`` prints instead what bfloat16 does to the published heads' material at the vertices of GLB files.
"""

from __future__ import annotations

import argparse
import copy
import math
import statistics
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor, nn

from reli3d.nn.heads import Heads
from reli3d.nn.illumination import Transformer1D
from reli3d.nn.presets import BackboneSizes, EncoderSizes, IlluminationSizes, UpsamplerSizes
from reli3d.nn.published import our_key
from reli3d.nn.tokenizers import ImageTokenizer, _Mlp
from reli3d.nn.transformer import FeedForward, TwoStreamTransformer
from reli3d.nn.upsample import PixelShuffleUpsampler

CASES: dict = {}
WIDTH, TOKENS = 1024, 3093  # of the published latents
DINO = EncoderSizes(hidden=48, layers=2, heads=3, patch=14, grid=7, mask_channel=False)
LIGHT = EncoderSizes(hidden=24, layers=2, heads=2, patch=14, grid=7, mask_channel=True)
MODULES = {  # file: the module, its published prefix and ours, names of the inputs
    "dinov2_tokenizer_small": (
        lambda: ImageTokenizer(DINO, 48),
        ("tokenizer.0.", "encoder."),
        ("image", "camera_embedding"),
    ),
    "two_stream_small": (
        lambda: TwoStreamTransformer(BackboneSizes(4, 12, 3, 2, 3, 1, 8), 32),
        ("backbone.", "backbone."),
        ("input", "cross"),
    ),
    "transformer1d_small": (
        lambda: Transformer1D(IlluminationSizes(LIGHT, 78, 32, 32, 4, 3, 4)),
        ("postprocessor.1.backbone.", "illumination.transformer."),
        ("input", "cross"),
    ),
    "pixel_shuffle_small": (
        lambda: PixelShuffleUpsampler(UpsamplerSizes(convolutions=4, scale=4, channels=5), 16),
        ("postprocessor.0.", "upsampler."),
        ("triplane",),
    ),
}


def variants(module: nn.Module) -> dict[str, nn.Module]:
    """The module in float32, in bfloat16, and with int8 feed-forward layers."""
    found = {"float32": module, "bfloat16": copy.deepcopy(module).bfloat16()}
    kinds = {"tensor": torch.ao.quantization.default_dynamic_qconfig,
             "channel": torch.ao.quantization.per_channel_dynamic_qconfig}  # fmt: skip
    for name, config in kinds.items():
        low = nn.Sequential(copy.deepcopy(module))
        layers = {
            f"{path}.{inner}": config
            for path, part in low.named_modules()
            if isinstance(part, FeedForward | _Mlp)
            for inner, layer in part.named_modules()
            if isinstance(layer, nn.Linear)
        }
        found[f"int8 by {name}"] = torch.ao.quantization.quantize_dynamic(low, layers)[0] if layers else module
    return found


def error(got: Tensor, want: Tensor) -> float:
    return float((got.float() - want).norm() / want.norm())


@torch.no_grad()
def material(goldens: Path, meshes: Path) -> list[str]:
    """Rows of Markdown: a mesh, its points, and how far the published heads in bfloat16 are from float32."""
    with np.load(goldens / "object_representation_heads.npz") as file:
        held = {k: torch.from_numpy(file[k]) for k in file.files if file[k].dtype.kind in "fi"}
    names, heads = ("base_color", "roughness", "metallic", "normal"), Heads(120, 64).eval()
    prefix = "param.net.heads."
    state = {k[len("param.") :]: v for k, v in held.items() if k.startswith(prefix)}
    heads.load_state_dict({our_key("object_representation." + k)[len("heads.") :]: v for k, v in state.items()})
    rows = [f"| mesh | points | {', '.join(names[:3])}, dB | normal, degrees: mean, 99 % |", "|---|---|---|---|"]
    for path in sorted(meshes.glob("*.glb")):
        shape = trimesh.load(path, force="mesh", process=False)
        points = torch.from_numpy(np.array(shape.vertices, np.float32))
        low, high = points.aminmax(dim=0)
        points = (2.0 * points - low - high) / float((high - low).max())
        asked = held["triplane"], points[None], names
        full, low16 = heads.at(*asked), heads.at(*asked, torch.bfloat16)
        noise = [-10.0 * math.log10(float((low16[k] - full[k]).square().mean())) for k in names[:3]]
        cosine = (low16["normal"].double() * full["normal"].double()).sum(-1)
        angle = torch.rad2deg(torch.acos((cosine / low16["normal"].double().norm(dim=-1)).clamp(-1, 1)))
        decibels = ", ".join(f"{v:.1f}" for v in noise)
        rows.append(f"| {path.stem} | {len(points)} | {decibels} | {angle.mean():.3f}, {angle.quantile(0.99):.3f} |")
    return rows


def like(module: nn.Module, *values: Tensor) -> list[Tensor]:
    """``values`` in the dtype of the module's parameters."""
    dtype = next((p.dtype for p in module.parameters()), torch.float32)
    return [v.to(dtype) for v in values]


def published(folder: Path, name: str) -> dict[str, float]:
    """Error of each variant of one module against the published output."""
    make, (theirs, ours), inputs = MODULES[name]
    with np.load(folder / f"{name}.npz") as file:
        held = {k: torch.from_numpy(file[k]) for k in file.files if file[k].dtype.kind in "fi"}
    state = {our_key(theirs + k[len("param.") :])[len(ours) :]: v for k, v in held.items() if k.startswith("param.")}
    module = make().eval()
    module.load_state_dict(state, strict=True)
    given, want = [held[k] for k in inputs], held["out"]
    if name == "two_stream_small":
        given[0], want = given[0].squeeze(1), want.squeeze(1)
    return {kind: error(low(*like(low, *given)), want) for kind, low in variants(module).items()}


def feed_forward(large: float) -> dict[str, tuple[float, float]]:
    """Error and milliseconds of each variant of one layer, for an input with one channel ``large`` times the others."""
    torch.manual_seed(0)
    layer, x = FeedForward(WIDTH).eval(), torch.randn(1, TOKENS, WIDTH)
    x[..., 7] *= large
    want, found = layer(x), {}
    for kind, low in variants(layer).items():
        (given,) = like(low, x)
        times = []
        for _ in range(6):
            began = time.perf_counter()
            got = low(given)
            times.append(time.perf_counter() - began)
        found[kind] = error(got, want), 1e3 * statistics.median(times[1:])
    return found


@torch.no_grad()
def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.studies.precision", description=__doc__.splitlines()[0])
    parser.add_argument("goldens", type=Path)
    parser.add_argument("--meshes", type=Path, help="folder of GLB files: only the table of materials")
    options = parser.parse_args(argv)
    if options.meshes is not None:
        sys.stdout.write("\n".join(material(options.goldens, options.meshes)) + "\n")
        return 0
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    torch.backends.quantized.engine = "onednn"
    rows = {name: {k: f"{v:.1e}" for k, v in published(options.goldens, name).items()} for name in MODULES}
    for large in (1.0, 60.0):
        cells = {k: f"{e:.1e}, {ms:.0f} ms" for k, (e, ms) in feed_forward(large).items()}
        rows[f"feed-forward {WIDTH} wide, one channel times {large:.0f}"] = cells
    kinds = list(next(iter(rows.values())))
    lines = [f"| module | {' | '.join(kinds)} |", "|---" * (len(kinds) + 1) + "|"]
    lines += [f"| {name} | {' | '.join(cells[k] for k in kinds)} |" for name, cells in rows.items()]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
