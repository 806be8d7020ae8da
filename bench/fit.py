"""One step of a fit of surface, material and light to four images, by stage, compared with Mitsuba's llvm variant.

Ours extracts the surface from a signed distance grid of 128 cells, traces and shades the pixels with shadows, compares
colors and antialiased silhouettes, and updates distances, material grids, light maps and exposures by their gradients.
Mitsuba's surface is fixed, so it neither extracts nor antialiases: it traces the same rays, takes as many samples
in two strategies (``direct``: emitter and BSDF, material ``principled``), compares the same colors by the same loss,
and updates the material at the same mesh's vertices and the texels of the light.
"""

from __future__ import annotations

import torch
import trimesh

from bench.peers.mitsuba_llvm import fit_step, mitsuba
from bench.timing import Clock
from reli3d._bridge import present
from reli3d.fit import losses
from reli3d.fit.fields import EvenAdam, blurred_grid
from reli3d.fit.lighting import radiance
from reli3d.fit.shape import Grid, extracted
from reli3d.fit.unknowns import (
    LIGHT_ROWS,
    START_GRID,
    Start,
    Unknowns,
    light_maps,
    material_change,
    material_of,
    unit,
)
from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.grid import sample_grid
from reli3d.geometry.hits import Hits, evaluate_hits, interpolate
from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import primary_hits
from reli3d.render.points import SurfacePoints
from reli3d.render.silhouette import antialias, mesh_edges

SHADING_SAMPLES = (7, 7, 2)  # of 16; Mitsuba's are 8 and 8
LEARNING_RATE = 1e-6  # of all unknowns: each run does the same work
COLOR, ROUGHNESS, METALLIC = 0.5, 0.5, 0.1  # where both begin
VIEWS, TARGET = 4, 0.3


def body(resolution: int) -> tuple[torch.Tensor, Grid]:
    """Signed distance of a ball with dents on a grid."""
    grid = Grid.around(torch.as_tensor(trimesh.creation.icosphere(radius=0.9).vertices).float(), resolution)
    at = grid.points(torch.device("cpu"))
    return at.norm(dim=-1) - 0.8 + 0.06 * (6.0 * at).sin().prod(-1), grid


def cameras(device, size: int) -> Camera:
    """Four views from around and a little above; the object fills two thirds of an image's side."""
    angle = torch.arange(VIEWS) * (2.0 * torch.pi / VIEWS)
    eyes = torch.stack([2.6 * angle.sin(), 0.4 + 0.2 * angle, 2.6 * angle.cos()], -1).to(device)
    poses = look_at(eyes, torch.zeros(3, device=device), torch.tensor([0.0, 1.0, 0.0], device=device))
    return Camera.from_fov(poses, 0.9, size, size)


def sky() -> torch.Tensor:
    """Log radiance ``(LIGHT_ROWS, 2 LIGHT_ROWS, 3)``."""
    return torch.rand(LIGHT_ROWS, 2 * LIGHT_ROWS, 3, generator=torch.Generator().manual_seed(0)) - 0.5


def detached(tensors) -> list[torch.Tensor]:
    """The values as new leaves: the backward pass of each stage is timed alone."""
    return [t.detach().requires_grad_() for t in tensors]


def step_of_a_fit(device, size, resolution):
    sdf, grid = body(resolution)
    sdf = sdf.to(device)
    unknowns, bound = Unknowns.zero(sdf, VIEWS, 1), torch.full_like(sdf, -9.0)
    middle = (COLOR, COLOR, COLOR, (ROUGHNESS - 0.05) / 0.95, METALLIC)
    logits = torch.logit(torch.tensor(middle, device=device)).expand(START_GRID, START_GRID, START_GRID, 5)
    start, camera = Start(logits.contiguous(), sky().to(device)), cameras(device, size)
    mask = torch.zeros(VIEWS, size, size, device=device)
    maps = [*unknowns.material, *unknowns.light, unknowns.exposure]
    moving, mover = torch.optim.Adam(maps, lr=LEARNING_RATE), EvenAdam(unknowns.sdf)
    for value in (unknowns.sdf, *maps):
        value.requires_grad_(True)

    def run():
        tick = Clock(device)
        mesh = extracted(unknowns.sdf, bound, grid)
        ends = [mesh.vertices, present("mesh.normals", mesh.normals)]
        vertices, normals = detached(ends)
        tick("extract")
        scene = RayScene(vertices.detach(), mesh.faces)
        hits, origins, directions = primary_hits(scene, camera)
        hit = hits.face >= 0
        tick("rays")
        wo, view = -directions[hit], torch.nonzero(hit)[:, 0]
        eye, found = origins.expand_as(directions)[hit], Hits(hits.face[hit], hits.t[hit], hits.bary[hit])
        found = evaluate_hits(vertices, mesh.faces, found, eye, -wo)
        position = eye - found.t[:, None] * wo
        normal = unit(interpolate(normals, mesh.faces, found.face, found.bary))
        material = material_of(sample_grid(start.material, position) + material_change(unknowns, position))
        light = (start.light + light_maps(unknowns.light)[0]).exp()
        given = [normal, *material, light, unknowns.exposure.exp()[view, None]]
        tick("points")
        leaves = detached(given)
        points = SurfacePoints(position.detach(), normal.detach(), *leaves[:4])
        image = radiance(points, wo, Environment(leaves[4]), samples=SHADING_SAMPLES, scene=scene, seed=0) * leaves[5]
        target = torch.full_like(image, TARGET)
        loss = losses.display_error(image, image, target, target > 1.0)
        tick("shade, forward")
        gradients = torch.autograd.grad(loss, leaves)
        tick("shade, backward")
        edges = mesh_edges(vertices, mesh.faces)
        covers = [
            antialias(hit[k].float()[..., None], vertices, mesh.faces, camera[k], scene, edges=edges)[..., 0]
            for k in range(VIEWS)
        ]
        (outline,) = torch.autograd.grad((torch.stack(covers) - mask).abs().mean(), vertices)
        tick("antialias")
        of_vertices, of_normals, *of_maps = torch.autograd.grad(given, [vertices, normals, *maps], gradients)
        tick("points")
        (of_sdf,) = torch.autograd.grad(ends, unknowns.sdf, [of_vertices + outline, of_normals])
        tick("extract")
        for value, gradient in zip(maps, of_maps, strict=True):
            value.grad = gradient
        moving.step()
        mover.step(blurred_grid(of_sdf, 4), LEARNING_RATE)
        tick("optimizer")
        return tick.seconds

    return run, {"steps": 1}


def mitsuba_step(device, size, resolution):
    """None where Mitsuba does not run."""
    mi = mitsuba(device)
    if mi is None:
        return None
    sdf, grid = body(resolution)
    mesh = extracted(sdf, torch.full_like(sdf, -9.0), grid)
    material = COLOR, ROUGHNESS, METALLIC
    samples = sum(SHADING_SAMPLES) // 2
    run = fit_step(mi, mesh, sky().exp(), cameras(device, size), material, TARGET, samples, LEARNING_RATE)
    return run, {"steps": 1}


CASES = {"step": (step_of_a_fit, dict(size=256, resolution=128))}
PEERS = {"step": ("mitsuba", mitsuba_step)}
