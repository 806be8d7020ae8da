"""The extracted surface follows the normals of the views, on a ball with bumps whose true normals are rendered."""

from dataclasses import replace

import torch
import trimesh

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.geometry.hits import interpolate
from reli3d.geometry.mesh import Mesh, vertex_normals
from reli3d.geometry.rays import RayScene
from reli3d.nn.weights import load_model
from reli3d.pipeline import encode, extract
from reli3d.prepare import prepare
from reli3d.views.similarity import Similarity
from reli3d.views.views import Views
from tests.support.meshes import mesh_from

EYES = [(0.3, 0.9, 2.4), (2.3, 0.4, -0.8), (-2.2, 0.9, 0.4), (0.2, -0.3, -2.2)]


def normal_maps(mesh, camera):
    """World normals ``(V, H, W, 3)`` of ``mesh`` and coverage ``(V, H, W)``."""
    hits = RayScene(mesh.vertices, mesh.faces).closest(*(t.reshape(-1, 3) for t in camera_rays(camera)))
    normals = torch.nn.functional.normalize(interpolate(mesh.normals, mesh.faces, hits.face, hits.bary), dim=-1)
    size = len(camera.c2w), camera.height, camera.width
    return normals.reshape(*size, 3), (hits.face >= 0).reshape(size)


def test_the_surface_follows_the_normals_of_the_views():
    ball = mesh_from(trimesh.creation.icosphere(subdivisions=5))
    radius = 0.38 + 0.012 * torch.sin(16 * ball.vertices).prod(-1, keepdim=True)
    vertices = (ball.vertices * radius).contiguous()
    bumpy = Mesh(vertices, ball.faces, vertex_normals(vertices, ball.faces))
    camera = Camera.from_fov(torch.stack([look_at(eye) for eye in EYES]), 0.5, 256, 256)
    normals, covered = normal_maps(bumpy, camera)
    shade = 0.3 + 0.5 * (normals @ torch.tensor([0.3, 0.9, 0.3])).clamp(min=0)[..., None].expand(-1, -1, -1, 3)
    views = Views(tuple(shade), tuple(covered.float()), camera.c2w, camera.intrinsics, tuple("abcd"))
    model = load_model("small")
    prepared = prepare(model, views, Similarity.identity())
    field = encode(model, prepared)
    size = field.pixels.normal.shape[1]
    true, _ = normal_maps(bumpy, Camera(prepared.batch.c2w, prepared.batch.intrinsics, 256, 256).resized(size, size))
    informed = replace(field, pixels=replace(field.pixels, normal=true.contiguous()))

    def error(field):
        got, filled = normal_maps(extract(field, model.preset.resolution), camera)
        cosine = (got * normals).sum(-1).clamp(-1, 1)[filled & covered]
        return float(torch.rad2deg(cosine.arccos()).mean())

    predicted, given = error(field), error(informed)
    assert given < 0.95 * predicted  # equal if the surface ignores them
