"""Primary visibility: camera-ray hits, and textures and materials at hits, with gradients."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reli3d._bridge import call, check, present
from reli3d.geometry.camera import Camera, camera_rays
from reli3d.geometry.hits import Hits, hit_normals, interpolate
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.kernels import hits as kernels
from reli3d.render.asset import TextureSet
from reli3d.render.points import SurfacePoints


def primary_hits(scene: RayScene, camera: Camera) -> tuple[Hits, Tensor, Tensor]:
    """Closest hits ``(..., H, W)`` of the rays through the pixel centers, and their origins and unit directions."""
    origins, directions = camera_rays(camera)
    return scene.closest(origins, directions), origins, directions


def sample_texture(texture: Tensor, uv: Tensor) -> Tensor:
    """Bilinear values ``(..., 3)`` of ``texture (H, W, 3)`` at ``uv (..., 2)``, repeating; v counts rows downwards.

    Gradients reach the texels and ``uv``.  Raises ValueError for a coordinate that is non-finite or beyond a million.
    """
    check("texture", texture, last=3)
    check("uv", uv, last=2, like=texture)
    if texture.ndim != 3 or texture.numel() == 0:
        raise ValueError(f"texture: expected shape (H, W, 3), got {tuple(texture.shape)}")
    if uv.numel() and not float(uv.detach().abs().max()) < 1e6:  # beyond, float32 has no texel resolution left
        raise ValueError("uv: expected finite coordinates of magnitude below 1e6, got others")
    flat = uv.reshape(-1, 2)
    n = flat.shape[0]
    (out,) = call(kernels.sample_texture_kernel, n, [texture, flat], [(n,)], shared=(0,))
    return out.reshape(*uv.shape[:-1], 3)


def wrap_uv(uv: Tensor, wrap: tuple[str, str], size: tuple[int, int]) -> Tensor:
    """``uv (..., 2)`` remapped so that the repeating :func:`sample_texture` has the wrap modes ``wrap`` (u, v).

    size: texels along u and v.  Gradients pass through; they are 0 where ``uv`` is clamped.
    """
    if wrap == ("repeat", "repeat"):
        return uv
    axes = []
    for value, mode, texels in zip(uv.unbind(-1), wrap, size, strict=True):
        if mode == "mirror":
            value = 1.0 - (value.remainder(2.0) - 1.0).abs()
        if mode != "repeat":  # from the outermost centers on the lookup has no neighbor to blend with
            value = value.clamp(0.5 / texels, 1.0 - 0.5 / texels)
        axes.append(value)
    return torch.stack(axes, -1)


def tangent_normals(mesh: Mesh, face: Tensor, bary: Tensor, normal: Tensor, mapped: Tensor) -> Tensor:
    """World-space normals ``(N, 3)`` from tangent-space normals ``mapped (N, 3)`` around ``normal (N, 3)``.

    Uses the mesh's tangents if present, otherwise the face's UV tangents, orthogonalized to ``normal``.  The bitangent
    points up in the texture (glTF 2.0, 3.7.2.1: v is down, +Y is up).
    """
    if mesh.tangents is not None:
        tangent = interpolate(mesh.tangents, mesh.faces, face, bary)
        tangent, sign = tangent[:, :3], torch.where(tangent[:, 3:] < 0.0, -1.0, 1.0).to(tangent)
    else:
        tangent, sign = _uv_tangent(mesh, face)
    tangent = normalize(tangent - (tangent * normal).sum(-1, keepdim=True) * normal, dim=-1)
    bitangent = sign * torch.linalg.cross(normal, tangent)
    world = mapped[:, :1] * tangent + mapped[:, 1:2] * bitangent + mapped[:, 2:] * normal
    return normalize(world, dim=-1)


def surface_points(mesh: Mesh, textures: TextureSet | None, face: Tensor, bary: Tensor) -> SurfacePoints:
    """Geometry and material at hits of a mesh, the input of :func:`reli3d.shade`.

    mesh: with ``uv`` if textured.  textures: None: a dielectric with base color and roughness 0.5.  face: ``(N,)``
    int32, without misses.  bary: ``(N, 2)`` weights of vertices 1 and 2.  The shading normal is the interpolated vertex
    normal (without ``mesh.normals``: the geometric normal), perturbed by the normal map in the frame of
    ``mesh.tangents`` (without them: of the UV gradients).

    Gradients reach the mesh's arrays, the textures and ``bary``.  Raises TypeError for a wrong type or dtype;
    ValueError for a wrong shape or device, a face index out of range, or textures without ``mesh.uv``.

    >>> hits = reli3d.RayScene(mesh).intersect(*reli3d.camera_rays(camera))
    >>> points = reli3d.surface_points(mesh, asset.textures, hits.face[hits.valid], hits.bary[hits.valid])
    """
    if face.ndim != 1:
        raise ValueError(f"face: expected shape (N,), as hits.face[hits.valid], got {tuple(face.shape)}")
    if len(face) and int(face.min()) < 0:
        raise ValueError("face: expected hits only, as hits.face[hits.valid], got -1")
    position = interpolate(mesh.vertices, mesh.faces, face, bary)
    ng = hit_normals(mesh.vertices, mesh.faces, face)
    normal = ng
    if mesh.normals is not None:
        smooth = interpolate(mesh.normals, mesh.faces, face, bary)
        square = (smooth * smooth).sum(-1, keepdim=True)
        normal = torch.where(square > 1e-8, smooth * torch.rsqrt(square.clamp(min=1e-8)), ng)  # opposed normals cancel
    if textures is None:
        gray = position.new_full((len(position),), 0.5)
        return SurfacePoints(position, ng, normal, gray[:, None].expand(-1, 3), gray, torch.zeros_like(gray))
    if mesh.uv is None:
        raise ValueError("mesh.uv: expected texture coordinates for a textured asset, got None (see unwrap)")
    uv = wrap_uv(interpolate(mesh.uv, mesh.faces, face, bary), textures.wrap, (textures.size, textures.size))
    maps = torch.stack([textures.roughness, textures.metallic, textures.metallic], -1)
    rough_metal = sample_texture(maps, uv)  # one three-channel lookup reads both
    mapped = sample_texture(textures.normal, uv) * 2.0 - 1.0
    color = sample_texture(textures.base_color, uv)
    if mesh.colors is not None:
        color = color * interpolate(mesh.colors, mesh.faces, face, bary)
    return SurfacePoints(
        position, ng, tangent_normals(mesh, face, bary, normal, mapped), color, rough_metal[:, 0], rough_metal[:, 1]
    )


def _uv_tangent(mesh: Mesh, face: Tensor) -> tuple[Tensor, Tensor]:
    """Tangent ``(N, 3)`` along u and handedness ``(N, 1)`` of faces, from the gradients of uv; no gradient."""
    corners = mesh.faces[face.long()].long()
    p, uv = mesh.vertices.detach()[corners], present("mesh.uv", mesh.uv).detach()[corners]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = d1[:, :1] * d2[:, 1:] - d1[:, 1:] * d2[:, :1]
    side = torch.where(area < 0.0, -1.0, 1.0).to(area)
    along_u = side * (e1 * d2[:, 1:] - e2 * d1[:, 1:])
    fallback = torch.linalg.cross(torch.linalg.cross(e1, e2), e1)  # any tangent serves a face without uv area
    along_u = torch.where(area.abs() > 1e-20, along_u, fallback)
    # v is down, so the up bitangent is -dp/dv: a chart that is not mirrored has area < 0 in these coordinates
    return along_u, -side
