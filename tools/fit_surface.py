"""Fit FlexiCubes surfaces to a mesh: to its signed distance, and to rendered masks and depth.

usage: python tools/fit_surface.py OUTPUT_FOLDER [--mesh FILE] [--resolution 48] [--steps 300]

(a) From the signed distance at the grid's vertices.  Random points of the extracted surface are pulled onto the zero
set; FlexiCubes' weights and offsets learn what lies between the vertices.
(b) From the visual hull of 32 masks, with their depth images.  Gradients: depth of the hits, antialiased outlines.

Without ``--mesh`` it takes Keenan Crane's spot from ``../shared/data``.  Writes ``fitted.png``: truth, (a) and (b) from
two sides.  Prints the Chamfer distance: from 30,000 random points of each surface to the other, mean of both
directions, in half extents of the mesh.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.distance import signed_distance
from reli3d.geometry.hits import evaluate_hits, interpolate
from reli3d.geometry.hull import hull_distance, mask_distance
from reli3d.geometry.mesh import Mesh, report, vertex_normals
from reli3d.geometry.rays import RayScene
from reli3d.geometry.regularize import sign_entropy, vertex_deviation
from reli3d.geometry.surface import extract_surface
from reli3d.io.images import write_png
from reli3d.render.gbuffer import primary_hits
from reli3d.render.silhouette import antialias, mesh_edges

RADIUS = 1.0  # of the grid's box
HALF_EXTENT = 0.85  # of the mesh in it
VIEWS, PIXELS, BATCH = 32, 160, 4
POINTS = 20_000  # on the surface, a step of (a)
LOOK = ((-0.6, 0.3, -0.8), (0.9, 0.35, 0.5))  # directions of the picture's eyes


def load(path: Path) -> Mesh:
    """Welded mesh, its box's centre at 0 and its largest half extent ``HALF_EXTENT``."""
    shape = trimesh.load(path, force="mesh", process=False)
    shape.merge_vertices(merge_tex=True, merge_norm=True)
    v = np.asarray(shape.vertices)
    centre, half = 0.5 * (v.min(0) + v.max(0)), 0.5 * np.ptp(v, axis=0).max()
    v = (v - centre) * (HALF_EXTENT / half)
    return Mesh(torch.tensor(v, dtype=torch.float32), torch.tensor(np.asarray(shape.faces), dtype=torch.int32))


def view(direction: Tensor, pixels: int) -> Camera:
    pose = look_at(
        3.5 * torch.nn.functional.normalize(direction, dim=-1), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])
    )
    return Camera.from_fov(pose, math.radians(36.0), pixels, pixels)


def cameras() -> Camera:
    """Eyes spread evenly over the sphere, on a spiral."""
    height = 1 - 2 * (torch.arange(VIEWS) + 0.5) / VIEWS
    turn = 2.399963 * torch.arange(VIEWS)
    ring = (1 - height**2).sqrt()
    return view(torch.stack([ring * turn.sin(), height, ring * turn.cos()], -1), PIXELS)


def surface_points(mesh: Mesh, n: int, rng: torch.Generator) -> Tensor:
    """``(n, 3)`` points, uniform by area; gradients reach the vertices."""
    a, b, c = (mesh.vertices[mesh.faces[:, k].long()] for k in range(3))
    area = torch.linalg.cross(b - a, c - a).detach().norm(dim=-1).double()
    face = torch.searchsorted(area.cumsum(0), torch.rand(n, generator=rng, dtype=torch.float64) * area.sum())
    face = face.clamp(max=len(area) - 1)
    r, s = torch.rand(n, generator=rng).sqrt()[:, None], torch.rand(n, generator=rng)[:, None]
    return (1 - r) * a[face] + r * (1 - s) * b[face] + r * s * c[face]


def chamfer(one: Mesh, other: Mesh) -> float:
    rng = torch.Generator().manual_seed(1)
    total = 0.0
    for source, target in ((one, other), (other, one)):
        points = surface_points(source, 30_000, rng)
        total += float(signed_distance(target.vertices, target.faces, points).abs().mean())
    return 0.5 * total / HALF_EXTENT


class Grid(torch.nn.Module):
    """Level, offsets and weights as free parameters, activated as the paper's."""

    def __init__(self, level: Tensor):
        super().__init__()
        n = level.shape[0] - 1
        self.level = torch.nn.Parameter(level.clone())
        self.offset = torch.nn.Parameter(torch.zeros(*level.shape, 3))
        self.weights = torch.nn.Parameter(torch.zeros(n**3, 21))

    def fields(self) -> dict[str, Tensor]:
        n = self.level.shape[0] - 1
        weights = 1 + 0.5 * torch.tanh(self.weights[:, :20])
        return {"deformation": torch.tanh(self.offset) * (0.45 / n), "alpha": weights[:, :8], "beta": weights[:, 8:]}

    def surface(self, fields: dict[str, Tensor], *, centre: bool) -> Mesh:
        gamma = 0.25 + 0.5 * torch.sigmoid(self.weights[:, 20])
        return extract_surface(self.level, radius=RADIUS, gamma=gamma, centre=centre, **fields)

    @torch.no_grad()
    def mesh(self) -> Mesh:
        return self.surface(self.fields(), centre=False)


def vertices_of(resolution: int) -> Tensor:
    axis = torch.linspace(-RADIUS, RADIUS, resolution + 1)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def fit_distance(truth: Mesh, resolution: int, steps: int) -> Grid:
    def distance(points: Tensor) -> Tensor:
        return signed_distance(truth.vertices, truth.faces, points.reshape(-1, 3)).reshape(points.shape[:-1])

    grid = Grid(distance(vertices_of(resolution)))
    cell = 2 * RADIUS / resolution
    optimizer = torch.optim.Adam(
        [{"params": [grid.level], "lr": 0.02 * cell}, {"params": [grid.offset, grid.weights], "lr": 0.02}]
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    rng, step = torch.Generator().manual_seed(0), 1e-3
    for _ in range(steps):
        fields = grid.fields()
        points = surface_points(grid.surface(fields, centre=True), POINTS, rng)
        at = points.detach()
        here = distance(at)
        slope = torch.stack([distance(at + step * e) - distance(at - step * e) for e in torch.eye(3)], -1) / (2 * step)
        error = ((points - at) * slope).sum(-1) + here  # the distance, to first order where the point moves
        flat = vertex_deviation(grid.level, radius=RADIUS, **fields)
        loss = (error / cell).square().mean() + 0.05 * flat.mean() / cell
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return grid


def layers(mesh: Mesh, rig: Camera) -> list[Tensor]:
    """Mask and depth along the rays, 0 outside, ``(H, W, 2)`` with antialiased outlines, for every camera."""
    vertices, faces = mesh.vertices, mesh.faces
    scene, edges = RayScene(vertices.detach(), faces), mesh_edges(vertices, faces)
    images = []
    for camera in rig:
        hits, origins, directions = primary_hits(scene, camera)
        t = evaluate_hits(vertices, faces, hits, origins, directions).t
        seen = hits.face >= 0
        image = torch.stack([seen.float(), torch.where(seen, t, 0.0)], -1)
        images.append(antialias(image, vertices, faces, camera, scene, edges=edges))
    return images


def fit_images(truth: Mesh, resolution: int, steps: int) -> Grid:
    rig = cameras()
    with torch.no_grad():
        targets = layers(truth, rig)
    masks = mask_distance(torch.stack([t[..., 0] for t in targets]))
    hull = hull_distance(vertices_of(resolution).reshape(-1, 3), masks, rig)
    grid = Grid(-hull.reshape((resolution + 1,) * 3))
    cell = 2 * RADIUS / resolution
    sys.stdout.write(f"visual hull of the masks: Chamfer {chamfer(grid.mesh(), truth):.5f}\n")
    optimizer = torch.optim.Adam(
        [{"params": [grid.level], "lr": 0.2 * cell}, {"params": [grid.offset, grid.weights], "lr": 0.02}]
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda i: 0.02 ** (i / steps))
    order = torch.Generator().manual_seed(0)
    for i in range(steps):
        fields = grid.fields()
        mesh = grid.surface(fields, centre=True)
        loss = 0.0
        chosen = torch.randperm(VIEWS, generator=order)[:BATCH].tolist()
        for k, image in zip(chosen, layers(mesh, rig[chosen])):
            both = (image[..., 0] == 1) & (targets[k][..., 0] == 1)
            depth = (image[..., 1] - targets[k][..., 1]).abs()[both].sum() / PIXELS**2
            loss = loss + (image[..., 0] - targets[k][..., 0]).abs().mean() + 10 * depth
        flat = vertex_deviation(grid.level, radius=RADIUS, **fields).mean() / cell
        lonely = sign_entropy(grid.level / cell)
        loss = loss / BATCH + 0.01 * flat + 0.02 * (1 - i / steps) * lonely
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return grid


def picture(meshes: list[Mesh], pixels: int = 320) -> Tensor:
    """The meshes side by side from both eyes, lit from the upper left; ``(2 * pixels, 3 * pixels, 3)``."""
    light, rows = torch.nn.functional.normalize(torch.tensor([-0.4, 0.7, 0.6]), dim=0), []
    for direction in LOOK:
        row = []
        for mesh in meshes:
            camera = view(torch.tensor(direction), pixels)
            scene = RayScene(mesh.vertices, mesh.faces)
            hits = primary_hits(scene, camera)[0]
            normal = interpolate(vertex_normals(mesh.vertices, mesh.faces), mesh.faces, hits.face, hits.bary)
            shade = 0.25 + 0.7 * (normal @ camera.c2w[:3, :3].T.inverse() @ light).clamp(min=0)
            image = torch.where((hits.face >= 0)[..., None], shade[..., None], 1.0).expand(-1, -1, 3)
            row.append(antialias(image.contiguous(), mesh.vertices, mesh.faces, camera, scene))
        rows.append(torch.cat(row, 1))
    return torch.cat(rows, 0).clamp(0, 1)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Fit FlexiCubes surfaces to a mesh.")
    parser.add_argument("output", type=Path)
    parser.add_argument("--mesh", type=Path, help="a closed mesh that trimesh reads")
    parser.add_argument("--resolution", type=int, default=48, help="cubes a side")
    parser.add_argument("--steps", type=int, default=300, help="of (b); (a) takes a quarter")
    options = parser.parse_args(argv)
    path = options.mesh or Path(__file__).parents[2] / "shared" / "data" / "classic" / "spot" / "spot.obj"
    if not path.is_file():
        sys.stdout.write(f"skipped: expected a mesh at {path}, got none; name one with --mesh\n")
        return 0
    options.output.mkdir(parents=True, exist_ok=True)
    truth = load(path)
    if not report(truth).watertight:
        parser.error(f"--mesh: expected a closed surface, got an open one: {path}")
    n = options.resolution
    grid = Grid(
        signed_distance(truth.vertices, truth.faces, vertices_of(n).reshape(-1, 3)).reshape(n + 1, n + 1, n + 1)
    )
    sys.stdout.write(
        f"plain extraction of the distance at {n} cubes a side: Chamfer {chamfer(grid.mesh(), truth):.5f}\n"
    )
    meshes = [truth]
    for name, fit, steps in (
        ("(a) distance", fit_distance, options.steps // 4),
        ("(b) masks and depth", fit_images, options.steps),
    ):
        began = time.perf_counter()
        mesh = fit(truth, n, steps).mesh()
        seconds, found = time.perf_counter() - began, report(mesh)
        sys.stdout.write(
            f"{name}: Chamfer {chamfer(mesh, truth):.5f}, {len(mesh.faces)} faces, {found.components} "
            f"components, watertight {found.watertight}, {steps} steps in {seconds:.0f} s\n"
        )
        sys.stdout.flush()
        meshes.append(mesh)
    write_png(options.output / "fitted.png", picture(meshes))
    sys.stdout.write(f"wrote {options.output / 'fitted.png'}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
