"""Self-occlusion of irradiance in spherical harmonics: precomputed radiance transfer.

Sloan, Kautz and Snyder 2002, "Precomputed Radiance Transfer for Real-Time Rendering in Dynamic, Low-Frequency Lighting
Environments".  The harmonics are real, orthonormal, up to degree 3, with polar axis +Y, so that rotating an environment
about +Y rotates its coefficients in pairs.
"""

import math

import torch
from torch import Tensor

from reli3d._bridge import check, full_precision, present
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.geometry.topology import weld_rows
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions, texel_solid_angles

RAY_OFFSET_EDGES = 0.05  # of ray origins from the surface, in mean edge lengths: clears facets of convex surfaces


def spherical_harmonics(directions: Tensor) -> Tensor:
    """Values ``(..., 16)`` of the harmonics at unit ``directions (..., 3)``: degree l from column l^2 on, m ascending.

    Any dtype.  Differentiable.  Source: Sloan 2008, "Stupid Spherical Harmonics Tricks", appendix A2.
    """
    y, z, x = directions.unbind(-1)  # his z is +Y here
    xx, yy, zz = x * x, y * y, z * z
    one = torch.ones_like(x)
    values = [
        (1.0 / 4.0, one),
        *((3.0 / 4.0, v) for v in (y, z, x)),
        (15.0 / 4.0, x * y),
        (15.0 / 4.0, y * z),
        (5.0 / 16.0, 3.0 * zz - 1.0),
        (15.0 / 4.0, x * z),
        (15.0 / 16.0, xx - yy),
        (35.0 / 32.0, y * (3.0 * xx - yy)),
        (105.0 / 4.0, x * y * z),
        (21.0 / 32.0, y * (5.0 * zz - 1.0)),
        (7.0 / 16.0, z * (5.0 * zz - 3.0)),
        (21.0 / 32.0, x * (5.0 * zz - 1.0)),
        (105.0 / 16.0, z * (xx - yy)),
        (35.0 / 32.0, x * (xx - 3.0 * yy)),
    ]
    return torch.stack([math.sqrt(square / math.pi) * value for square, value in values], -1)


@full_precision
def light_harmonics(light: Environment) -> Tensor:
    """Coefficients ``(16, 3)`` of an environment, on its device: a sum over texels weighted by solid angle, computed in
    float64."""
    height, width = light.radiance.shape[:2]
    d = lat_long_directions(height, width, dtype=torch.float64)
    weight = spherical_harmonics(d) * texel_solid_angles(height, width)[:, None, None]
    return torch.einsum("hwk,hwc->kc", weight, light.radiance.detach().cpu().double()).to(light.radiance)


@full_precision
def blocked_transfer(mesh: Mesh, *, directions: int = 64, scene: RayScene | None = None) -> Tensor:
    """Blocked transfer ``(V, 16)``: cosine times harmonics, integrated over occluded directions; no gradient.

    Row i times the coefficients of an environment (:func:`light_harmonics`) is the irradiance that occlusion removes at
    vertex i; the row is exactly 0 if no ray is blocked.  mesh: with normals.  directions: number of directions over the
    whole sphere, on an equal-area spiral; all vertices use the same, so neighbors differ only by geometry.  scene: rays
    against the mesh; None: built here.  Raises TypeError for a wrong dtype; ValueError for a wrong shape or device, or
    for less than one direction.
    """
    normals = present("normals", mesh.normals).detach()
    check("vertices", mesh.vertices, last=3, like=normals)
    if directions < 1:
        raise ValueError(f"directions: expected at least 1, got {directions}")
    device = normals.device
    first, label = weld_rows(torch.cat([mesh.vertices.detach(), normals], 1).cpu().numpy())  # seams have copies
    rows = torch.from_numpy(first).to(device)
    position, normal = mesh.vertices.detach()[rows], normals[rows]
    corner = mesh.vertices.detach()[mesh.faces[:, :2].long()]
    mean_edge = (corner[:, 1] - corner[:, 0]).norm(dim=-1).sum() / max(len(mesh.faces), 1)
    start = position + RAY_OFFSET_EDGES * mean_edge * normal
    toward = sphere_spiral(directions).to(device)
    cosine = (normal @ toward.T).clamp(min=0.0)
    above = cosine > 0.0
    vertex, which = above.nonzero(as_tuple=True)  # rays of one vertex are consecutive
    far = start.new_full((len(vertex),), torch.inf)
    scene = scene if scene is not None else RayScene(mesh.vertices, mesh.faces)
    # index_select takes rows in a third of the time of an index
    free = scene.unoccluded(start.index_select(0, vertex), toward.index_select(0, which), far)
    cosine.masked_fill_(torch.zeros_like(above).masked_scatter_(above, free), 0.0)
    blocked = cosine @ (spherical_harmonics(toward) * (4.0 * math.pi / directions))
    return blocked[torch.from_numpy(label).to(device)]


def sphere_spiral(count: int) -> Tensor:
    """Unit directions ``(count, 3)`` on a Fibonacci spiral, each centered in an equal area of the sphere."""
    k = torch.arange(count, dtype=torch.float64, device="cpu") + 0.5
    height, turn = 1.0 - 2.0 * k / count, k * (math.pi * (3.0 - math.sqrt(5.0)))
    across = (1.0 - height * height).sqrt()
    return torch.stack([across * turn.cos(), height, across * turn.sin()], -1).float()
