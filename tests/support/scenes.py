"""Small scenes: an eye, balls with their textures, a mesh that casts a shadow, maps of light."""

from dataclasses import replace

import torch
import trimesh

from reli3d.geometry.camera import look_at
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.environment import Environment
from tests.support.meshes import mesh_from

SKIES = ("constant", "sky", "sun")


def eye(device, *position):
    """Pose of a camera that looks at the origin."""
    return look_at(torch.tensor(position, dtype=torch.float32, device=device))


def textures(size, device, color=(0.5, 0.5, 0.5), roughness=0.5, metallic=0.0, normal=(0.5, 0.5, 1.0)):
    """Maps of one value each."""
    color, normal = (torch.tensor(v, device=device).expand(size, size, 3).contiguous() for v in (color, normal))
    return TextureSet(color, roughness, metallic, normal)


def ball_mesh(subdivisions: int, radius: float) -> Mesh:
    """A ball with smooth normals, tangents, and its view from +Z as texture coordinates."""
    mesh = mesh_from(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius))
    n = torch.nn.functional.normalize(mesh.vertices, dim=-1)
    tangent = torch.nn.functional.normalize(torch.linalg.cross(n.new_tensor([0.3, 0.5, 0.81]).expand_as(n), n), dim=-1)
    tangents = torch.nn.functional.pad(tangent, (0, 1), value=1.0)
    return replace(mesh, normals=n, uv=(0.5 + 0.45 * n[:, :2]).contiguous(), tangents=tangents)


def ball(device, color=(0.7, 0.7, 0.7)):
    """An asset of one finish."""
    return Asset(ball_mesh(3, 0.6), textures(4, "cpu", color)).to(device)


def shadow_caster(device, backend="auto"):
    """A ball above the unit ball's points: it hides part of the sky."""
    shape = trimesh.creation.icosphere(subdivisions=3, radius=0.4).apply_translation([0, 1.2, 0])
    return RayScene(mesh_from(shape, device), backend=backend)


def sky(height=16, seed=0):
    """A map of random texels up to 2, few of them bright."""
    g = torch.Generator().manual_seed(seed)
    return Environment(torch.rand(height, 2 * height, 3, generator=g) ** 3.0 * 2.0)


def light(name, device):
    """One of :data:`SKIES`: even light, a sky brighter above, and the sky with a sun of one texel."""
    up = torch.linspace(1, -1, 32)[:, None, None].clamp(min=0.0)
    map_ = (0.4 + 0.6 * up).expand(32, 64, 3).clone()
    if name == "constant":
        map_ = torch.full((32, 64, 3), 0.7)
    if name == "sun":
        map_[7, 4] = 2000.0
    return Environment(map_.to(device))
