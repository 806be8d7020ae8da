"""The operations of geometry and renderer that have no gradient, as in ``tests/support/op_cases.py``."""

import torch
from torch.nn.functional import normalize

from reli3d.geometry import bake, hull
from reli3d.geometry.cover import cover_silhouettes
from reli3d.geometry.hits import interpolate
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.geometry.tangents import encode_normals
from reli3d.geometry.visibility import visible_from
from reli3d.nn import view_lookup
from reli3d.render import material, sampling
from reli3d.render.bump import radial_bump
from reli3d.render.environment import Environment
from reli3d.render.volume import OccupancyGrid, march_rays
from tests.support.op_cases import (
    FRAME,
    HOST,
    Case,
    above,
    ball,
    corners,
    numbers,
    rig,
    rng,
    soup,
    uniform,
    units,
    weights,
)


def traced(backend):
    def run(origins, directions):
        scene = RayScene(*ball(origins.device, 3), backend=backend if origins.device.type == "cpu" else "warp")
        hits = scene.closest(origins, directions)
        free = scene.unoccluded(origins, directions, origins[:, 0])  # some limits are below 0
        return hits.face, hits.t, hits.bary, scene.occluded(origins, directions, t_max=1.5), free

    return run


def rays(n):
    return {"origins": uniform(n, 3, seed=1, low=-1.0), "directions": torch.randn(n, 3, generator=rng(2), **HOST)}


def marched(origins, directions):
    occupied = (torch.rand(12, 12, 12, generator=rng(5), **HOST) < 0.3).to(origins.device)
    samples = march_rays(origins, directions, OccupancyGrid(occupied, 0.8), 0.013)
    ray = samples.ray.long()
    return samples.first.diff(), samples.t.new_zeros(len(origins)).index_add(0, ray, samples.t)


def texels(vertices):
    n = len(vertices)
    faces, _ = soup(vertices, 0)
    uv = torch.tensor([[0.05, 0.1], [0.9, 0.2], [0.15, 0.85]], device=vertices.device, dtype=torch.float32).repeat(
        n // 3, 1
    )
    cell = torch.arange(n // 3, device=vertices.device).repeat_interleave(3)
    uv = (uv + torch.stack([cell % 4, cell // 4], -1)) / 4.0
    mesh = Mesh(vertices, faces, normalize(vertices.contiguous(), dim=-1), uv)
    found = bake.rasterize_texels(mesh, 64)
    maps = bake.bake(mesh, 64, lambda position, normal: torch.cat([position, normal], 1), texels=found)
    near, square = bake.nearest_valid(found.valid)
    tangents = mesh.with_tangents().tangents
    mesh = Mesh(vertices, faces, mesh.normals, uv, tangents)
    along = bake.bake(mesh, 64, lambda position, normal, tangent: tangent, texels=found, tangents=True)
    colors = uniform(n, 5, seed=7).to(vertices)
    of_vertices = bake.bake(mesh, 64, lambda position, normal, value: value, texels=found, values=colors)["value"]
    return found.face, found.bary, near, square, maps["value"], along["value"], tangents, of_vertices


def seen_from(points, normal):
    camera = rig(points.device, 24, 24)
    scene = RayScene(*ball(points.device, radius=0.3), backend="warp")
    images = uniform(3, 24, 24, 4, seed=2).to(points)
    visible = visible_from(scene, points, normal, camera)
    own, fraction, total = view_lookup.summarize_views(images, camera, points, visible.float(), normal)
    tokens, mix = uniform(3, 4, 4, 8, seed=4).to(points), uniform(9, 8, seed=5).to(points)
    pooled, _ = view_lookup.pool_views(images, tokens, mix, camera, points, visible.float(), normal)
    pixels = uniform(3, 3, 8, 8, 4, seed=6).to(points)
    fused = view_lookup.fuse_views(images, pixels, camera, points, visible.float(), normal)
    return visible, own, fraction, total, pooled, *fused


def hulls(masks, points):
    camera = rig(points.device)
    distance = hull.mask_distance(masks)
    span = hull.hull_span(3.0 * points, -points, 1.0, distance, camera)
    known = torch.ones(len(points), 1, dtype=torch.bool, device=points.device)
    normal, offset = points.new_tensor([[1.0, 0.0, 0.0]]), points.new_tensor([0.9])  # to where the hull is not
    miss = hull.mirror_residual(points[:, None], known, normal, offset, 9.0, distance, camera)
    grid = hull.hull_grid(torch.linspace(-0.5, 0.5, 9, device=points.device, dtype=torch.float32), distance, camera)
    return distance, hull.hull_distance(points, distance, camera), grid, span, miss


def hull_masks():
    y, x = torch.meshgrid(torch.arange(24.0, **HOST), torch.arange(20.0, **HOST), indexing="ij")
    return ((y - 12.5).square() + (x - 10.5).square() < 60.0).float().expand(3, 24, 20).contiguous()


def covered(sdf, bound, masks):
    return (cover_silhouettes(sdf, bound, hull.mask_distance(masks), rig(sdf.device), radius=0.7),)


def drawn(u, radiance, wo, alpha):
    light = Environment(radiance)
    directions, density = light.sample(u)
    wi = sampling.sample_cosine(u)
    return (
        directions,
        density,
        light.pdf(wi),
        wi,
        material.pdf_lobes(wo, alpha, wi),
    )


def bent(world):
    normal, tangent = (v[: len(world)].to(world.device) for v in FRAME.values())
    return encode_normals(world, normal, tangent), radial_bump(units(len(world), 2).to(world), normal, world)


def four(values, bary):
    return (interpolate(values, *soup(values, len(bary)), bary),)


CASES = {
    "closest, Warp": Case(rays, traced("warp"), rows=("origins", "directions")),
    "closest, Embree": Case(rays, traced("embree"), rows=("origins", "directions")),
    "draws": Case(
        lambda n: {
            "u": numbers(n),
            "radiance": uniform(8, 16, 3, seed=5),
            "wo": above(n, 1),
            "alpha": uniform(n, seed=2, low=0.1),
        },
        drawn,
        rows=("u", "wo", "alpha"),
    ),
    "march_rays": Case(
        lambda n: {"origins": 2.0 * units(n, 1), "directions": units(n, 2)}, marched, rows=("origins", "directions")
    ),
    "bake": Case(lambda n: {"vertices": corners(12)}, texels),
    "views": Case(
        lambda n: {"points": uniform(n, 3, seed=1, low=-0.6, high=0.6), "normal": units(n, 2)},
        seen_from,
        rows=("points", "normal"),
    ),
    "hull": Case(
        lambda n: {"masks": (uniform(3, 24, 20, seed=1) > 0.6).float(), "points": uniform(n, 3, low=-0.8)},
        hulls,
        rows=("points",),
    ),
    "cover_silhouettes": Case(
        lambda n: {
            "sdf": uniform(12, 11, 10, seed=1, low=0.1, high=2.0),
            "bound": uniform(12, 11, 10, low=-3.0),
            "masks": hull_masks(),
        },
        covered,
    ),
    "normal maps": Case(lambda n: {"world": units(n, 1)}, bent, rows=("world",)),
    "interpolate tangents": Case(
        lambda n: {"values": uniform(180, 4, seed=1), "bary": weights(n)}, four, ("values", "bary"), ("bary",)
    ),
}
