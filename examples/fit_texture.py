"""Fits the textures of a known object to eight images under known lighting.

usage: python examples/fit_texture.py OUTPUT_FOLDER [--steps 150] [--size 96]

Writes ``found.png`` and ``true.png``, the base color maps, and prints the error of a novel view.
"""

import argparse
import math
from pathlib import Path

import torch

import reli3d

TEXELS, SAMPLES = 64, reli3d.Samples(light=4, bsdf=4, cosine=2)

parser = argparse.ArgumentParser()
parser.add_argument("output", type=Path)
parser.add_argument("--steps", type=int, default=150)
parser.add_argument("--size", type=int, default=96, help="pixels per side of an image")
args = parser.parse_args()
args.output.mkdir(parents=True, exist_ok=True)

x, y, z = torch.meshgrid(*[torch.linspace(-1, 1, 25)] * 3, indexing="ij")
torus = reli3d.extract_surface((((x**2 + z**2).sqrt() - 0.6) ** 2 + y**2).sqrt() - 0.25, radius=1.0)
mesh = reli3d.unwrap(torus, texture_size=TEXELS)
checker = reli3d.bake(mesh, TEXELS, lambda position, _: 0.2 + 0.6 * ((6 * position).floor() % 2))["value"]
reference = reli3d.Asset(mesh, reli3d.TextureSet(checker, roughness=0.4, metallic=0.0))

light = reli3d.Environment(torch.linspace(2.0, 0.2, 16)[:, None, None].expand(16, 32, 3).contiguous())  # bright above
poses = [reli3d.look_at([2.5 * math.cos(k), 1.5 * (-1) ** k, 2.5 * math.sin(k)]) for k in range(8)]
cameras = [reli3d.Camera.from_fov(pose, 0.9, args.size, args.size) for pose in poses]


def image(asset: reli3d.Asset, camera: reli3d.Camera, seed: int) -> torch.Tensor:
    return reli3d.render_asset(asset, camera, light, options=reli3d.ShadeOptions(samples=SAMPLES, seed=seed)).radiance


with torch.no_grad():
    photographs = [sum(image(reference, c, 1000 + i) for i in range(8)) / 8 for c in cameras]
color, rough = torch.zeros(TEXELS, TEXELS, 3, requires_grad=True), torch.zeros(TEXELS, TEXELS, requires_grad=True)
optimizer = torch.optim.Adam([color, rough], lr=0.1)
for step in range(args.steps):
    asset = reli3d.Asset(mesh, reli3d.TextureSet(color.sigmoid(), rough.sigmoid(), 0.0))
    camera, photograph = cameras[step % 8], photographs[step % 8]
    first, second = (image(asset, camera, 2 * step + k) for k in (0, 1))  # independent noise: the square has no bias
    loss = ((first - photograph) * (second - photograph)).mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

side = reli3d.Camera.from_fov(reli3d.look_at([0.0, 3.0, 0.5]), 0.9, args.size, args.size)
error = (image(asset.detach(), side, 1) - image(reference, side, 1)).square().mean().sqrt()
print(f"root mean squared error from a new side: {error:.4f}")
reli3d.write_image(args.output / "found.png", color.detach().sigmoid())
reli3d.write_image(args.output / "true.png", checker)
