"""Textured meshes, such as scans, as training objects."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from reli3d._bridge import present
from reli3d.geometry.distance import signed_distance
from reli3d.geometry.mesh import Mesh, joined
from reli3d.geometry.rays import RayScene
from reli3d.io.glb import read_glb
from reli3d.render.gbuffer import surface_points
from reli3d.render.points import SurfacePoints
from reli3d.synthetic.samples import Surface, enclosed, outer_faces

STRETCH_SIGMA = 0.18  # standard deviation of the logarithm of the scale along each axis
GAIN = 0.2  # standard deviation of the logarithm of the factor of the base color


_read = lru_cache(16)(read_glb)  # decoding a texture takes as long as rendering a view


def outside_distance(surface: Surface, points: Tensor) -> Tensor:
    """Distance ``(N,)`` to the outer faces of a mesh with holes and internal faces, negative where enclosed."""
    distance = signed_distance(surface.vertices, surface.faces[surface.outer], points).abs()
    return torch.where(enclosed(points, surface.scene), -distance, distance)


class ScannedSurface:
    """A GLB, centered, longest side 1, by ``rng`` randomly stretched and tinted: a ``Surface`` of :mod:`.samples`."""

    def __init__(self, path: Path, rng: np.random.Generator | None):
        self.assets = _read(path)
        stretch = self.gain = torch.ones(3)
        if rng is not None:
            stretch = _factors(rng.normal(0, STRETCH_SIGMA, 3))
            self.gain = _factors(rng.normal(0, GAIN, 3) + rng.normal(0, GAIN))
        points = torch.cat([a.mesh.vertices for a in self.assets]) * stretch
        low, high = points.amin(0), points.amax(0)
        size = float((high - low).max())
        self.assets = [replace(a, mesh=_moved(a.mesh, (low + high) / 2, stretch, size)) for a in self.assets]
        whole = joined([a.mesh for a in self.assets])
        self.vertices, self.faces = whole.vertices, whole.faces
        self.starts = torch.as_tensor(np.cumsum([0] + [len(a.mesh.faces) for a in self.assets]))
        self.scene = RayScene(self.vertices, self.faces)
        self.outer = outer_faces(self.vertices, self.faces, self.scene)

    distance = outside_distance

    def points_at(self, face: Tensor, bary: Tensor) -> SurfacePoints:
        vectors, numbers = torch.empty(4, len(face), 3), torch.empty(2, len(face))
        part = torch.searchsorted(self.starts, face, right=True) - 1
        for k, asset in enumerate(self.assets):
            index = (part == k).nonzero()[:, 0]
            local = (face[index] - self.starts[k]).to(torch.int32)
            points = surface_points(asset.mesh, asset.textures, local, bary[index])
            color = (points.base_color * self.gain).clamp(0.0, 1.0)
            vectors[:, index] = torch.stack([points.position, points.ng, points.normal, color])
            numbers[:, index] = torch.stack([points.roughness, points.metallic])
        return SurfacePoints(*vectors, *numbers)


def _factors(logarithms: np.ndarray) -> Tensor:
    return torch.as_tensor(np.exp(logarithms), dtype=torch.float32)


def _moved(mesh: Mesh, center: Tensor, stretch: Tensor, size: float) -> Mesh:
    normals = normalize(present("mesh.normals", mesh.normals) / stretch, dim=-1)
    tangents = mesh.tangents
    if tangents is not None:
        turned = tangents[:, :3] * stretch
        turned = normalize(turned - (turned * normals).sum(-1, keepdim=True) * normals, dim=-1)
        tangents = torch.cat([turned, tangents[:, 3:]], -1)
    vertices = (mesh.vertices * stretch - center) / size
    return replace(mesh, vertices=vertices.contiguous(), normals=normals.contiguous(), tangents=tangents)
