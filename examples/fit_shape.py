"""Fits a surface to the silhouettes and depth images of six views.

usage: python examples/fit_shape.py OUTPUT_FOLDER [--steps 60] [--size 96]

Starts from the visual hull.  Gradients reach the grid through depth and antialiased outlines.  Writes ``shape.glb`` and
prints the mean distance from the true surface.
"""

import argparse
from pathlib import Path

import torch

import reli3d
from reli3d.geometry.hits import evaluate_hits
from reli3d.geometry.hull import hull_distance, mask_distance
from reli3d.render.gbuffer import primary_hits
from reli3d.render.silhouette import antialias

parser = argparse.ArgumentParser()
parser.add_argument("output", type=Path)
parser.add_argument("--steps", type=int, default=60)
parser.add_argument("--size", type=int, default=96, help="pixels per side of an image")
args = parser.parse_args()
args.output.mkdir(parents=True, exist_ok=True)


def distance(p: torch.Tensor) -> torch.Tensor:  # of the reference: two balls
    return torch.minimum((p - 0.25).norm(dim=-1) - 0.35, (p + 0.2).norm(dim=-1) - 0.5)


def layers(mesh: reli3d.Mesh, camera: reli3d.Camera) -> torch.Tensor:  # silhouette and depth along the rays
    hits, origins, directions = primary_hits(reli3d.RayScene(mesh.vertices.detach(), mesh.faces), camera)
    seen, t = hits.face >= 0, evaluate_hits(mesh.vertices, mesh.faces, hits, origins, directions).t
    return antialias(torch.stack([seen.float(), torch.where(seen, t, 0.0)], -1), mesh.vertices, mesh.faces, camera)


grid = torch.stack(torch.meshgrid(*[torch.linspace(-1, 1, 33)] * 3, indexing="ij"), -1)
eyes = [[0, 0.5, 3], [3, 0.5, 0], [0, 0.5, -3], [-3, 0.5, 0], [0.1, 3, 0], [0.1, -3, 0]]
cameras = reli3d.Camera.from_fov(reli3d.look_at(eyes, [0, 0, 0]), 0.6, args.size, args.size)
targets = [layers(reli3d.extract_surface(distance(grid), radius=1.0), camera) for camera in cameras]
masks = mask_distance(torch.stack([t[..., 0] for t in targets]))
sdf = -hull_distance(grid.reshape(-1, 3), masks, cameras).reshape(33, 33, 33)
print(f"hull:  {distance(reli3d.extract_surface(sdf, radius=1.0).vertices).abs().mean():.4f}")
optimizer = torch.optim.Adam([sdf.requires_grad_()], lr=0.01)
for step in range(args.steps):
    optimizer.param_groups[0]["lr"] = 0.01 * (1 - step / args.steps)
    mesh, loss = reli3d.extract_surface(sdf, radius=1.0), 0.0
    for camera, target in zip(cameras, targets, strict=True):
        image = layers(mesh, camera)
        both, off = (image[..., 0] == 1) & (target[..., 0] == 1), (image - target).abs()
        loss = loss + off[..., 0].mean() + off[..., 1][both].mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
found = reli3d.extract_surface(sdf.detach(), radius=1.0)
print(f"found: {distance(found.vertices).abs().mean():.4f}")
found, clay = reli3d.unwrap(found).with_tangents(), reli3d.TextureSet(torch.full((8, 8, 3), 0.7), 0.8, 0.0)
reli3d.write_glb(args.output / "shape.glb", reli3d.Asset(found, clay))
