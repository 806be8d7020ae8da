"""Estimates the lighting around a known shiny ball from one image.

usage: python examples/fit_light.py OUTPUT_FOLDER [--steps 150] [--size 64]

Writes ``found.png`` and ``true.png``, maps with +X at the horizontal center, and prints the error of the log radiance.
"""

import argparse
from pathlib import Path

import torch

import reli3d

parser = argparse.ArgumentParser()
parser.add_argument("output", type=Path)
parser.add_argument("--steps", type=int, default=150)
parser.add_argument("--size", type=int, default=64, help="pixels per side of the image")
args = parser.parse_args()
args.output.mkdir(parents=True, exist_ok=True)

reference = torch.full((16, 32, 3), 0.3)
reference[:6] = torch.tensor([0.5, 0.8, 1.2])  # sky
reference[4:8, 20:24] = torch.tensor([8.0, 6.0, 3.0])  # a lamp
x, y, z = torch.meshgrid(*[torch.linspace(-1, 1, 41)] * 3, indexing="ij")
ball = reli3d.extract_surface((x**2 + y**2 + z**2).sqrt() - 0.8, radius=1.0)
camera = reli3d.Camera.from_fov(reli3d.look_at([0.0, 0.4, 3.0]), 0.6, args.size, args.size)

origins, directions = (v.reshape(-1, 3) for v in reli3d.camera_rays(camera))
hits = reli3d.RayScene(ball).intersect(origins, directions)
seen = hits.valid
normal = torch.nn.functional.normalize(origins[seen] + hits.t[seen, None] * directions[seen], dim=-1)
points = reli3d.SurfacePoints(0.8 * normal, normal, normal, base_color=0.9, roughness=0.2, metallic=1.0)


def image(radiance: torch.Tensor, seed: int, samples: tuple = (8, 8, 2)) -> torch.Tensor:
    options = reli3d.ShadeOptions(samples=samples, seed=seed)
    return reli3d.shade(points, -directions[seen], reli3d.Environment(radiance), options=options)


photograph = image(reference, seed=1, samples=(64, 64, 16))
log = torch.zeros(16, 32, 3, requires_grad=True)
optimizer = torch.optim.Adam([log], lr=0.1)
for step in range(args.steps):
    first, second = (image(log.exp(), 2 * step + k) for k in (2, 3))  # independent noise: the square has no bias
    loss = ((first - photograph) * (second - photograph)).mean()
    # smoothness, for texels that no pixel constrains
    loss = loss + 1e-3 * (log.diff(dim=0).square().mean() + log.diff(dim=1).square().mean())
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

print(f"mean error of the log radiance: {(log.detach() - reference.log()).abs().mean():.3f}")
for name, radiance in (("found", log.detach().exp()), ("true", reference)):
    reli3d.write_image(args.output / f"{name}.png", 0.5 * radiance)
