"""Transfer of texture maps between nearby surfaces, and baking of fitted changes into textures."""

from __future__ import annotations

from dataclasses import replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from reli3d._bridge import present
from reli3d.fit.unknowns import Unknowns, bent, material_change, material_logits, material_of, unit
from reli3d.geometry.bake import bake, rasterize_texels
from reli3d.geometry.hits import interpolate
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.geometry.tangents import encode_normals
from reli3d.geometry.uv import unwrap
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.gbuffer import sample_texture, surface_points
from reli3d.render.points import SurfacePoints

TEXELS_PER_CHUNK = 1 << 18
MAX_SURFACE_DISTANCE = 0.04  # of the surfaces along the new one's normal, of the longest side


def nearest_hits(mesh: Mesh, position: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Face ``(N,)`` and barycentrics ``(N, 2)`` of the points on ``mesh`` that correspond to points on another surface.

    The first hit from outside along the normal within ``MAX_SURFACE_DISTANCE``, otherwise the nearest vertex.
    """
    scene = RayScene(mesh.vertices, mesh.faces)
    reach = MAX_SURFACE_DISTANCE * float((mesh.vertices.amax(0) - mesh.vertices.amin(0)).max())
    hits = scene.closest(position + reach * normal, -normal, t_max=2.0 * reach)
    face, bary = hits.face.clone(), hits.bary.clone()
    missed = torch.nonzero(face < 0)[:, 0]
    if len(missed):
        corner = torch.zeros(len(mesh.vertices), dtype=torch.long, device=face.device)
        corner[mesh.faces.reshape(-1).long()] = torch.arange(mesh.faces.numel(), device=face.device, dtype=torch.int64)
        used = torch.unique(mesh.faces).long()
        _, found = cKDTree(mesh.vertices[used].cpu().numpy()).query(position[missed].cpu().numpy())
        at = corner[used[torch.as_tensor(found, device=face.device, dtype=torch.int64)]]
        face[missed] = (at // 3).int()
        bary[missed] = torch.stack([at % 3 == 1, at % 3 == 2], -1).float()
    return face, bary


def transfer_textures(mesh: Mesh, source: Asset, size: int, *, shape: bool = False) -> Asset:
    """``mesh`` with a new atlas of ``size`` texels per side, and the lighting and maps of ``source``.

    shape: whether shading normals show the shape of ``source``, of which ``mesh`` is an approximation; otherwise its
    normal map alone is transferred.
    """
    mesh = unwrap(mesh, texture_size=size)
    mesh = replace(mesh.with_tangents(), colors=None)  # vertex colors are baked into the maps below

    def at_texels(position: Tensor, normal: Tensor, tangent: Tensor) -> dict[str, Tensor]:
        face, bary = nearest_hits(source.mesh, position, normal)
        old = surface_points(source.mesh, source.textures, face, bary)
        if not shape:
            normals = present("mesh.normals", source.mesh.normals)
            bump = old.normal - unit(interpolate(normals, source.mesh.faces, face, bary))
            old = replace(old, normal=unit(normal + bump))
        return _maps(old, normal, tangent)

    factor = max(1, source.textures.size // size)  # smaller textures are averages
    baked = bake(mesh, factor * size, at_texels, tangents=True)
    return Asset(mesh, _textures({name: _means(v, factor) for name, v in baked.items()}), source.environment)


def _means(values: Tensor, factor: int) -> Tensor:
    """Means over squares of ``factor`` texels of a map ``(T, T, C)``."""
    return torch.nn.functional.avg_pool2d(values.permute(2, 0, 1)[None], factor)[0].permute(1, 2, 0).contiguous()


def changed(asset: Asset, unknowns: Unknowns) -> Asset:
    """``asset`` with its vertex colors and the changes of material and normals baked into its textures."""
    size = asset.textures.size
    texels = rasterize_texels(asset.mesh, size)
    parts = iter(torch.nonzero(texels.valid.reshape(-1))[:, 0].split(TEXELS_PER_CHUNK))  # of one call each

    def at_texels(position: Tensor, normal: Tensor, tangent: Tensor) -> dict[str, Tensor]:
        index = next(parts)
        row, column = torch.div(index, size, rounding_mode="floor"), index % size
        uv = (torch.stack([column, row], -1).float() + 0.5) / size
        face, bary = texels.face.reshape(-1)[index], texels.bary.reshape(-1, 2)[index]
        old = surface_points(asset.mesh, asset.textures, face, bary)
        logits = material_logits(old) + material_change(unknowns, position)
        logits[:, :3] += sample_texture(unknowns.detail, uv)
        color, roughness, metallic = material_of(logits)
        world, _ = bent(unknowns, position, old.normal)
        return _maps(SurfacePoints(position, old.ng, world, color, roughness, metallic), normal, tangent)

    baked = bake(asset.mesh, size, at_texels, texels=texels, tangents=True, chunk=TEXELS_PER_CHUNK)
    return replace(asset, mesh=replace(asset.mesh, colors=None), textures=_textures(baked))


def _maps(at: SurfacePoints, normal: Tensor, tangent: Tensor) -> dict[str, Tensor]:
    encoded = encode_normals(at.normal, normal, tangent)
    rough, metal = at.roughness[:, None], at.metallic[:, None]
    return {"base_color": at.base_color, "roughness": rough, "metallic": metal, "normal": encoded}


def _textures(baked: dict[str, Tensor]) -> TextureSet:
    return TextureSet(**{name: value.clamp(0.0, 1.0) for name, value in baked.items()})
