"""Differentiable extraction and rendering of the predicted surface, for all stages but ``volume``."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize, relu
from torch.utils.checkpoint import checkpoint

from reli3d._bridge import present
from reli3d.geometry.camera import Camera
from reli3d.geometry.hits import interpolate
from reli3d.geometry.mesh import Mesh, vertex_normals
from reli3d.geometry.rays import RayScene
from reli3d.geometry.regularize import sign_entropy, vertex_deviation
from reli3d.geometry.surface import extract_surface, surface_cubes, surface_points
from reli3d.nn.field import MATERIAL
from reli3d.nn.heads import deformation
from reli3d.nn.model import Code, Reconstructor
from reli3d.render.bump import radial_bump
from reli3d.render.color import srgb_to_linear
from reli3d.render.gbuffer import primary_hits
from reli3d.render.points import SurfacePoints
from reli3d.render.silhouette import antialias, mesh_edges
from reli3d.train.stages.rendering import Rendering, display

Shader = Callable[[SurfacePoints, Tensor, RayScene], Tensor]  # points, directions to the camera, occluders
CORE = 0.3  # of the cube's half side: the region that :func:`seed_surface` pulls inside
CHUNK = 1 << 16  # grid points per chunk, whose features are recomputed in the backward pass


@dataclass(frozen=True)
class Surface:
    """The surface of one object with its ray tracing structure and edges."""

    mesh: Mesh
    scene: RayScene
    edges: Tensor
    terms: dict[str, Tensor]  # FlexiCubes' regularizers


def query_heads(model: Reconstructor, code: Code, points: Tensor, heads: tuple[str, ...]) -> dict[str, Tensor]:
    """Values ``(N, outputs)`` of the heads at ``points (N, 3)``; above CHUNK points with gradient checkpointing."""
    if len(points) <= CHUNK:
        return {k: v[0] for k, v in model.query(code, points[None], heads).items()}

    def values(part: Tensor) -> tuple[Tensor, ...]:
        return tuple(model.query(code, part[None], heads)[h][0] for h in heads)

    parts = [checkpoint(values, part, use_reentrant=False) for part in points.split(CHUNK)]
    return dict(zip(heads, (torch.cat(columns) for columns in zip(*parts)), strict=True))


def surface(model: Reconstructor, code: Code, resolution: int) -> Surface | None:
    """The surface on a grid of ``resolution`` cubes per side; None if the field has only one sign.

    Gradients reach the network: field values, over the density threshold, are evaluated again near the surface.
    """
    radius, threshold = model.preset.radius, model.preset.density_threshold
    axis = torch.linspace(-radius, radius, resolution + 1, device=code.latent.device)
    points = torch.cartesian_prod(axis, axis, axis)
    with torch.no_grad():
        density = query_heads(model, code, points, ("density",))["density"][:, 0]
        free = model.sdf(density).view((resolution + 1,) * 3) / threshold
        cubes = surface_cubes(free)
        if len(cubes) == 0:
            return None
        at, rows = surface_points(free, cubes)
    raw = query_heads(model, code, points[at], ("density", "deformation", "flexicubes"))
    known = model.sdf(raw["density"][:, 0]) / threshold
    # the two passes round differently, and a sign that flips would not fit the cubes
    known = torch.where((known < 0) == (free.view(-1)[at] < 0), known, free.view(-1)[at])
    sdf = free.reshape(-1).index_copy(0, at, known).view_as(free)
    offset = torch.zeros_like(points).index_copy(0, at, deformation(raw["deformation"], resolution))
    merged = model.merger(raw["flexicubes"].index_select(0, rows.reshape(-1)).view(len(cubes), 8, -1))
    weights = replace(merged, deformation=offset.view(*sdf.shape, 3), cubes=cubes)
    made = extract_surface(sdf, radius=radius, weights=weights, center=True)
    mesh = Mesh(made.vertices, made.faces, vertex_normals(made.vertices, made.faces))
    terms = {
        "deviation": vertex_deviation(sdf, radius=radius, weights=weights).mean(),
        "sign": sign_entropy(sdf),
        "spread": torch.cat([present("alpha", merged.alpha), present("beta", merged.beta)], -1).sub(1.0).abs().mean(),
    }
    scene = RayScene(mesh.vertices.detach(), mesh.faces)
    return Surface(mesh, scene, mesh_edges(mesh.vertices.detach(), mesh.faces), terms)


def seed_surface(model: Reconstructor, code: Code) -> Tensor:
    """Hinge loss that creates a surface in a field of one sign: inside at the core of the cube, outside at its border.

    As in nvdiffrec: an object without a surface would otherwise have no gradient.
    """
    axis = torch.linspace(-1.0, 1.0, 8, device=code.latent.device)
    points = torch.cartesian_prod(axis, axis, axis)
    far = points.abs().amax(-1)
    raw = query_heads(model, code, points * model.preset.radius, ("density",))["density"][:, 0] - model.surface_density
    return relu(1.0 - raw[far < CORE]).mean() + relu(1.0 + raw[far > 0.99]).mean()


def render_surface(model: Reconstructor, code: Code, found: Surface, camera: Camera, shader: Shader) -> Rendering:
    """Rendering of one object from ``camera``: one ray per pixel, antialiased silhouettes.

    Gradients reach heads, normals and silhouettes; hit positions are detached: their derivative is unbounded.
    """
    mesh = found.mesh
    hits, _, directions = primary_hits(found.scene, camera)
    seen = torch.nonzero(hits.face.reshape(-1) >= 0)[:, 0]
    face, bary = hits.face.reshape(-1)[seen], hits.bary.reshape(-1, 2)[seen]
    position = interpolate(mesh.vertices.detach(), mesh.faces, face, bary)
    normal = normalize(interpolate(present("normals", mesh.normals), mesh.faces, face, bary), dim=-1)
    values = query_heads(model, code, position, MATERIAL)
    bumped = radial_bump(position, normal, values["normal"])
    bumped = normalize(bumped + normal - normal.detach(), dim=-1)  # gradient to the normal: the frame has none
    wo = -directions.reshape(-1, 3)[seen]
    base, rough, metal = (values[name] for name in MATERIAL[:3])
    points = SurfacePoints(position, normal.detach(), bumped, srgb_to_linear(base), rough[:, 0], metal[:, 0])
    color = display(shader(points, wo, found.scene))
    layers = torch.cat([color, torch.ones_like(color[:, :1]), base, rough, metal, bumped], -1)
    full = layers.new_zeros(camera.height * camera.width, layers.shape[1]).index_copy(0, seen, layers)
    full = full.reshape(camera.height, camera.width, -1)
    shown = antialias(full[..., :4].contiguous(), mesh.vertices, mesh.faces, camera, found.scene, edges=found.edges)
    return Rendering(shown[..., :3], shown[..., 3], full[..., 3], full[..., 4:9], full[..., 9:], values["normal"])
