"""Find a surface from the silhouettes and depth images of twelve views.

usage: python examples/fit_shape.py OUTPUT_FOLDER [--steps 100] [--size 96]

Starts from the visual hull of the silhouettes.  Gradients reach the grid through depth and antialiased outlines.
Writes ``shape.glb`` and prints the mean distance between points of the found surface and the true one.
"""

import argparse
from pathlib import Path

import torch

import reli3d
from reli3d.geometry.hits import evaluate_hits
from reli3d.geometry.hull import hull_distance, mask_distance
from reli3d.geometry.regularize import sign_entropy
from reli3d.geometry.tangents import with_tangents
from reli3d.render.gbuffer import primary_hits
from reli3d.render.silhouette import antialias

parser = argparse.ArgumentParser()
parser.add_argument("output", type=Path)
parser.add_argument("--steps", type=int, default=100)
parser.add_argument("--size", type=int, default=96, help="pixels along a side of an image")
args = parser.parse_args()
args.output.mkdir(parents=True, exist_ok=True)

axis = torch.linspace(-1, 1, 33)
grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def distance(p: torch.Tensor) -> torch.Tensor:  # a bowl: the hull of its silhouettes is filled
    return torch.maximum((p.norm(dim=-1) - 0.6).abs() - 0.12, p[..., 1] - 0.2)


def layers(mesh: reli3d.Mesh, camera: reli3d.Camera) -> torch.Tensor:
    """Silhouette and depth along the rays, ``(H, W, 2)``."""
    hits, origins, directions = primary_hits(reli3d.RayScene(mesh.vertices.detach(), mesh.faces), camera)
    t = evaluate_hits(mesh.vertices, mesh.faces, hits, origins, directions).t
    seen = hits.face >= 0
    image = torch.stack([seen.float(), torch.where(seen, t, 0.0)], -1)
    return antialias(image, mesh.vertices, mesh.faces, camera)


height = torch.linspace(-0.9, 0.9, 12)
ring, turn = (1 - height**2).sqrt(), 2.4 * torch.arange(12)
poses = [reli3d.look_at(3 * e) for e in torch.stack([ring * turn.cos(), height, ring * turn.sin()], -1)]
cameras = [reli3d.Camera.from_fov(pose, 0.6, args.size, args.size) for pose in poses]
true = reli3d.extract_surface(distance(grid), radius=1.0)
targets = [layers(true, camera) for camera in cameras]

c2w, intrinsics = torch.stack([c.c2w for c in cameras]), torch.stack([c.intrinsics for c in cameras])
masks = mask_distance(torch.stack([t[..., 0] for t in targets]))
level = -hull_distance(grid.reshape(-1, 3), masks, c2w, intrinsics).reshape(33, 33, 33)
level.requires_grad_()
optimizer = torch.optim.Adam([level], lr=0.02)
for step in range(args.steps):
    mesh = reli3d.extract_surface(level, radius=1.0)
    image, target = layers(mesh, cameras[5 * step % 12]), targets[5 * step % 12]
    both = (image[..., 0] == 1) & (target[..., 0] == 1)
    loss = (image[..., 0] - target[..., 0]).abs().mean() + 3 * (image - target)[..., 1].abs()[both].mean()
    loss = loss + 0.02 * sign_entropy(16 * level)  # no loose pieces inside
    if step == 0:
        print(f"hull:  {distance(mesh.vertices.detach()).abs().mean():.4f}")
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

found = reli3d.extract_surface(level.detach(), radius=1.0)
print(f"found: {distance(found.vertices).abs().mean():.4f}")
clay = reli3d.TextureSet(torch.full((8, 8, 3), 0.7), roughness=0.8, metallic=0.0)
reli3d.write_glb(args.output / "shape.glb", reli3d.Asset(with_tangents(reli3d.unwrap(found, texture_size=256)), clay))
