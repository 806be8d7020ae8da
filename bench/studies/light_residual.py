"""What the RENI++ prior cannot hold of real lights, and what a small map of factors on top of it restores.

usage: python -m bench.studies.light_residual WEIGHTS MAP.hdr [MAP.hdr ...] [--steps 300]

WEIGHTS: the published decoder (``reni++L49.safetensors``).  Each map is brought to 64 rows and its latents are fitted.
The residual is the logarithm of true by fitted radiance, averaged over each cell of a map of 8, 16 or 32 rows, and
added back with bilinear look-ups.  Prints means over the maps in Markdown: the difference of log radiance; the power of
the brightest hundredth of the sphere, by the truth's; the error of the irradiance, in per cent of its mean.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from reli3d.io.hdr import read_environment
from reli3d.nn.presets import OFFICIAL
from reli3d.nn.reni import EnvironmentDecoder, map_directions
from reli3d.nn.reni_fit import FLOOR, fit_latent
from reli3d.render.environment import Environment, texel_solid_angles

ROWS = 64
RESIDUALS = (8, 16, 32)


def texel_weights(rows: int) -> Tensor:
    """Weights ``(rows, 2 rows)`` of the texels of a map, sum 1."""
    weight = texel_solid_angles(rows, 2 * rows).float()[:, None].expand(rows, 2 * rows)
    return weight / weight.sum()


def figures(got: Tensor, true: Tensor) -> list[float]:
    """Difference of logarithms, share of the peak's power, and error of the irradiance of maps ``(64, 128, 3)``."""
    weight = texel_weights(ROWS)
    floor = FLOOR * float((true.mean(-1) * weight).sum())
    difference = ((got + floor).log() - (true + floor).log()).abs().mean(-1)
    shade, other = true.mean(-1), got.mean(-1)
    order = shade.flatten().argsort(descending=True)
    peak = order[weight.flatten()[order].cumsum(0) < 0.01]
    power = [float((x.flatten() * weight.flatten())[peak].sum()) for x in (shade, other)]
    normals = map_directions(8).reshape(-1, 3)
    cosine = (normals @ map_directions(ROWS).reshape(-1, 3).T).clamp(min=0) * weight.flatten()
    irradiance = [cosine @ x.reshape(-1, 3) for x in (true, got)]
    off = (irradiance[0] - irradiance[1]).abs().mean() / irradiance[0].mean()
    return [float((difference * weight).sum()), power[1] / power[0], 100 * float(off)]


def with_residual(got: Tensor, true: Tensor, rows: int) -> Tensor:
    """``got`` times the factors of a map of ``rows`` rows that bring its cells nearest to ``true``."""
    floor = FLOOR * float(true.mean())
    weight = texel_weights(ROWS)[..., None]
    ratio = ((true + floor).log() - (got + floor).log()) * weight
    cell = ROWS // rows
    means = [functional.avg_pool2d(t.permute(2, 0, 1)[None], cell) for t in (ratio, weight)]
    factors = Environment((means[0] / means[1])[0].permute(1, 2, 0).exp().contiguous())
    return (got + floor) * factors.lookup(map_directions(ROWS).contiguous())


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("weights", type=Path)
    p.add_argument("maps", type=Path, nargs="+")
    p.add_argument("--steps", type=int, default=300)
    args = p.parse_args()
    decoder = EnvironmentDecoder(OFFICIAL.reni)
    decoder.field.load_state_dict(load_file(args.weights))
    decoder.requires_grad_(False)
    rows: dict[str, list[list[float]]] = {}
    for path in args.maps:
        true = Environment(read_environment(path)).resized(ROWS).radiance
        fit = fit_latent(decoder, true, steps=args.steps)
        got = decoder.light(fit.latent, fit.rotation, fit.strength).environment(ROWS).radiance
        rows.setdefault("latents alone", []).append(figures(got, true))
        for size in RESIDUALS:
            rows.setdefault(f"and a map of {size} rows", []).append(figures(with_residual(got, true, size), true))
    print("| light | log radiance | power of the peak | light on a ball, per cent |\n|---|---|---|---|")
    for name, found in rows.items():
        print(f"| {name} | " + " | ".join(f"{x:.2f}" for x in np.mean(found, 0)) + " |")


if __name__ == "__main__":
    main()
