"""Training of the environment prior: a RENI++ decoder, jointly with one latent code per map (an auto-decoder).

The decoder is equivariant to rotation about the vertical axis, so maps need no augmentation by yaw.  Blends of two
maps with a relative rotation and a tint augment a small collection.  Maps are scaled to a geometric mean of 1; the
exposure is a separate output of the network.  Source: Gardner et al. 2023, RENI++, arXiv 2311.09361, section 4.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from reli3d.nn.presets import OFFICIAL, TINY
from reli3d.nn.reni import EnvironmentDecoder, reni_frame
from reli3d.nn.reni_fit import fit_latent
from reli3d.render.latlong import lat_long_directions
from reli3d.synthetic.maps import ROWS, held_out, load_maps

FLOOR = 1e-2  # of the geometric mean, added before the logarithm
PEAK = 2e3  # of the geometric mean, clipped above: a smooth decoder cannot represent the sun, 1e4 to 1e5


def scale_free(maps: Tensor) -> Tensor:
    """Maps over their solid-angle-weighted geometric mean."""
    weight = torch.sin((torch.arange(maps.shape[1]) + 0.5) * torch.pi / maps.shape[1])[:, None]
    log = (maps.mean(-1) + 1e-4).log()
    mean = (log * weight).sum((1, 2)) / (weight.sum() * maps.shape[2])
    return (maps / mean.exp()[:, None, None, None]).clamp(max=PEAK)


def blends(maps: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """``count`` blends of two maps, linear or geometric, one of them mirrored or rotated, tinted."""
    out = []
    for _ in range(count):
        a, b = (maps[int(rng.integers(len(maps)))] for _ in range(2))
        b = torch.roll(b.flip(1) if rng.random() < 0.5 else b, int(rng.integers(maps.shape[2])), 1)
        t = rng.beta(0.5, 0.5)
        tint = torch.as_tensor(np.exp(rng.normal(0, 0.15, 3)), dtype=torch.float32)
        out.append((a ** (1 - t) * b**t if rng.random() < 0.5 else a * (1 - t) + b * t) * tint)
    return torch.stack(out)


def fit(
    decoder: EnvironmentDecoder,
    maps: Tensor,
    *,
    steps: int,
    minutes: float,
    rays: int = 512,
    batch: int = 16,
    seed: int = 0,
    log=sys.stderr,
) -> Tensor:
    """Fits ``decoder`` in place and returns the latents ``(n, L, 3)`` of ``maps (n, H, 2H, 3)``."""
    generator = torch.Generator().manual_seed(seed)
    latents = torch.nn.Parameter(
        0.1 * torch.randn(len(maps), decoder.field.network.layers[0].mha.key.in_features // 3, 3, generator=generator)
    )
    base = [1e-2, 1e-3]
    groups = zip(([latents], list(decoder.field.parameters())), base, strict=True)
    optimizer = torch.optim.Adam([{"params": values, "lr": rate} for values, rate in groups])
    directions, flat = reni_frame(lat_long_directions(ROWS)).reshape(-1, 3), maps.reshape(len(maps), -1, 3)
    height = torch.sin((torch.arange(ROWS) + 0.5) * torch.pi / ROWS).repeat_interleave(2 * ROWS)
    began, mean = time.monotonic(), 0.0
    for step in range(steps):
        done = max(step / steps, (time.monotonic() - began) / (60 * minutes))
        if done >= 1:
            break
        for group, rate in zip(optimizer.param_groups, base, strict=True):
            group["lr"] = rate * min(1, (step + 1) / 100) * 0.5 * (1 + np.cos(np.pi * done)) + 1e-6
        pick = torch.randint(len(maps), (min(batch, len(maps)),), generator=generator)
        ray = torch.multinomial(height, rays, generator=generator)  # uniform over the sphere
        log_radiance = decoder.field(latents[pick], directions[ray][None])
        target = (flat[pick][:, ray] + FLOOR).log()
        predicted = torch.logaddexp(log_radiance, torch.full_like(log_radiance, float(np.log(FLOOR))))
        cosine = (
            1
            - torch.nn.functional.cosine_similarity(
                log_radiance.exp() + FLOOR, flat[pick][:, ray] + FLOOR, dim=-1
            ).mean()
        )
        loss = (predicted - target).abs().mean() + 0.3 * cosine + 1e-4 * latents[pick].square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        mean += float(loss.detach()) / 200
        if step % 200 == 199:
            print(
                f"light prior: step {step + 1}, {time.monotonic() - began:.0f} s, loss {mean:.4f}", file=log, flush=True
            )
            mean = 0.0
    return latents.detach()


def main() -> None:
    """Fits the prior and writes the decoder and the latents; prints the error on held-out maps."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("maps", type=Path, help=".npz with env (n, H, 2H, 3) and names")
    parser.add_argument("output", type=Path, help="safetensors file to write")
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--minutes", type=float, default=12.0)
    parser.add_argument("--blends", type=int, default=400)
    parser.add_argument("--preset", choices=("tiny", "official"), default="official", help="whose decoder it is")
    args = parser.parse_args()
    torch.manual_seed(0)
    maps, names = load_maps(args.maps)
    kept = scale_free(maps[[not h for h in held_out(names)]])
    decoder = EnvironmentDecoder((TINY if args.preset == "tiny" else OFFICIAL).reni)
    every = torch.cat([kept, scale_free(blends(kept, args.blends, np.random.default_rng(0)))])
    latents = fit(decoder, every, steps=args.steps, minutes=args.minutes)
    state = {k: v.contiguous() for k, v in decoder.state_dict().items()}
    save_file({**state, "latents": latents}, args.output)
    test = scale_free(maps[held_out(names)])
    fitted = [fit_latent(decoder, radiance) for radiance in test]
    with torch.no_grad():
        radiance = torch.cat([decoder(f.latent[None], f.rotation[None], f.strength[None], ROWS) for f in fitted])
    error = ((radiance + FLOOR).log() - (test + FLOOR).log()).abs().mean((1, 2, 3))
    mean_map = every[: len(kept)].log1p().mean(0).expm1()
    base = ((mean_map + FLOOR).log() - (test + FLOOR).log()).abs().mean((1, 2, 3))
    print(f"held-out maps: log error {error.mean():.3f}, of the mean map {base.mean():.3f}", file=sys.stderr)


if __name__ == "__main__":
    main()
