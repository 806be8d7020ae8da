"""Every public operation of geometry and renderer, once: inputs, which of them have a gradient, the call.

``tests/bridge/test_ops.py`` tests all of them for the properties of any (layouts, one gradient alone, edits in place,
dtypes, no rows, second derivatives, CPU against CUDA); each operation has tests of its values elsewhere.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor
from torch.nn.functional import normalize

from reli3d.geometry import bake, hull, projection
from reli3d.geometry.camera import Camera, camera_rays, look_at, project
from reli3d.geometry.cover import cover_silhouettes
from reli3d.geometry.grid import sample_grid, squared_laplacian
from reli3d.geometry.hits import Hits, evaluate_hits, hit_normals, interpolate
from reli3d.geometry.mesh import Mesh, vertex_normals
from reli3d.geometry.rays import RayScene
from reli3d.geometry.regularize import sign_entropy, vertex_deviation
from reli3d.geometry.smooth import taubin_smooth
from reli3d.geometry.surface import CubeWeights, extract_surface
from reli3d.geometry.tangents import encode_normals
from reli3d.geometry.triplane import sample_triplane
from reli3d.geometry.visibility import visible_from
from reli3d.nn import view_lookup
from reli3d.render import color, gbuffer, material, sampling
from reli3d.render.asset import TextureSet
from reli3d.render.bump import radial_bump
from reli3d.render.environment import Environment
from reli3d.render.gaussians import SphericalGaussians, shade_gaussians
from reli3d.render.shading import ShadeOptions, shade
from reli3d.render.silhouette import antialias
from reli3d.render.volume import OccupancyGrid, RaySamples, composite, march_rays
from tests.support.meshes import mesh_from
from tests.support.surfaces import at, on_ball

N = 5200  # rows: five slices of a CPU launch
HOST = {"dtype": torch.float32, "device": "cpu"}


@dataclass(frozen=True)
class Case:
    """inputs: ``(n)`` to float32 tensors by name, on the CPU, the same for the same n.  run: takes them on any device.

    grads: those with a gradient.  rows: those whose first axis is n; empty where no n can be 0.  second: those whose
    gradient is plain torch and has a derivative in every input; that of any other must raise.  dtypes: those that take
    other floating-point types too.
    """

    inputs: Callable[[int], dict[str, Tensor]]
    run: Callable[..., tuple[Tensor, ...]]
    grads: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    second: tuple[str, ...] = ()
    dtypes: tuple[str, ...] = ()


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def uniform(*shape: int, seed: int = 0, low: float = 0.0, high: float = 1.0) -> Tensor:
    return low + (high - low) * torch.rand(*shape, generator=rng(seed), **HOST)


def units(n: int, seed: int = 0) -> Tensor:
    return normalize(torch.randn(n, 3, generator=rng(seed), **HOST), dim=-1)


def above(n: int, seed: int = 0) -> Tensor:
    """Unit directions at least 0.1 above the horizon of +z."""
    height = uniform(n, 1, seed=seed + 50, low=0.15, high=2.0)
    return normalize(torch.cat([units(n, seed)[:, :2], height], 1), dim=-1)


def numbers(n: int) -> Tensor:
    """For samplers: not at the rims, where gradients are unbounded."""
    return uniform(n, 2, seed=8, low=0.02, high=0.95)


def ball(device, subdivisions: int = 2, radius: float = 0.5) -> tuple[Tensor, Tensor]:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    # no ties with any axis
    mesh = mesh_from(shape.apply_transform(trimesh.transformations.euler_matrix(0.4, 0.7, 0.2)), device)
    return mesh.vertices, mesh.faces


def corners(count: int) -> Tensor:
    center = uniform(count, 1, 3, seed=1, low=-1.0)
    return (center + 0.3 * torch.randn(count, 3, 3, generator=rng(2), **HOST)).reshape(-1, 3)


def soup(vertices: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Faces of separate triangles, and which of them each of n rows is about."""
    faces = torch.arange(len(vertices), dtype=torch.int32, device=vertices.device).reshape(-1, 3)
    return faces, (torch.arange(n, dtype=torch.int32, device=vertices.device) * 7) % len(faces)


def weights(n: int) -> Tensor:
    raw = uniform(n, 3, seed=3, low=0.05)
    return (raw / raw.sum(1, keepdim=True))[:, 1:].contiguous()


def aimed(n: int) -> dict[str, Tensor]:
    v, bary = corners(60), weights(n)
    faces, face = soup(v, n)
    a, b, c = (v[faces[face.long(), k].long()] for k in range(3))
    point = a + bary[:, :1] * (b - a) + bary[:, 1:] * (c - a)
    o = uniform(n, 3, seed=4, low=-2.0, high=2.0)
    return {"vertices": v, "origins": o, "directions": point - o}


def reevaluate(vertices, origins, directions):
    n = len(origins)
    faces, face = soup(vertices, n)
    hits = Hits(face, origins.new_ones(n), origins.new_zeros(n, 2))
    hits = evaluate_hits(vertices, faces, hits, origins, directions)
    return hits.t, hits.bary


def camera(device, size: int = 32) -> Camera:
    pose = look_at(torch.tensor([0.7, 0.9, 2.0], device=device, dtype=torch.float32))
    return Camera.from_fov(pose, 0.7, size, size)


def rig(device, width: int = 20, height: int = 24) -> Camera:
    poses = [look_at(2.5 * e, torch.zeros(3, **HOST), torch.tensor([0.0, 1.0, 0.0], **HOST)) for e in units(3, 9)]
    intrinsics = torch.tensor([30.0, 28.0, 11.0, 13.0], **HOST).expand(3, 4).contiguous()
    return Camera(torch.stack(poses), intrinsics, width, height).to(device)


def shaded(n: int) -> dict[str, Tensor]:
    finish = {"metallic": uniform(n, seed=4), "roughness": uniform(n, seed=3, low=0.2)}
    radiance = uniform(8, 16, 3, seed=5) ** 3 * 2.0
    return {"normal": units(n, 1), "base_color": uniform(n, 3, seed=2, low=0.1), **finish, "radiance": radiance}


def lit(shadows: str | None = None, **options):
    def run(normal, base_color, metallic, roughness, radiance):
        ng = normal.detach()
        wo = normalize(ng + 0.5 * units(len(ng), 6).to(ng), dim=-1)
        scene = None
        if shadows:
            vertices, faces = ball(normal.device)
            backend = shadows if normal.device.type == "cpu" else "warp"
            scene = RayScene(vertices + vertices.new_tensor([0.0, 1.0, 0.0]), faces, backend=backend)
        points, wo = at(0.2 * ng, normal, ng, wo, base_color, roughness, metallic)
        return (shade(points, wo, Environment(radiance), scene=scene, options=ShadeOptions(seed=3, **options)),)

    return run


def packed(density) -> RaySamples:
    """Rays of 0, 1, 2 ... samples, as many as there are."""
    n, device = len(density), density.device
    ray = torch.repeat_interleave(torch.arange(n + 1, device="cpu"), torch.arange(n + 1, device="cpu"))[:n]
    rays = int(ray[-1]) + 1 if n else 1
    first = torch.searchsorted(ray, torch.arange(rays + 1, device="cpu"))
    t = 0.3 + 0.05 * (torch.arange(n, **HOST) - first[ray])
    return RaySamples(ray.int().to(device), t.float().to(device), first.int().to(device), 0.05)


def composited(density, color):
    out = composite(density, color, packed(density))
    return out.color, out.opacity, out.depth


def outlines(image, vertices):
    _, faces = ball(vertices.device)
    return (antialias(image, vertices, faces, camera(vertices.device), RayScene(vertices, faces, backend="warp")),)


def grid_inputs(_, shape=(7, 6, 8), seed: int = 3) -> dict[str, Tensor]:
    sdf = torch.nn.functional.pad(torch.randn(shape, generator=rng(seed), **HOST), (1,) * 6, value=0.7)
    sdf = sdf + 0.2 * sdf.sign()  # no crossing next to a grid point, where gradients are unbounded
    cubes = (sdf.shape[0] - 1) * (sdf.shape[1] - 1) * (sdf.shape[2] - 1)
    deformation = uniform(*sdf.shape, 3, seed=4, low=-0.02, high=0.02)
    alpha, beta, gamma = (
        uniform(*size, seed=k, low=0.5) for size, k in (((cubes, 8), 5), ((cubes, 12), 6), ((cubes,), 7))
    )
    return {"sdf": sdf, "deformation": deformation, "alpha": alpha, "beta": beta, "gamma": gamma}


def surface(sdf, deformation, alpha, beta, gamma):
    weights = CubeWeights(deformation, alpha, beta, gamma)
    mesh = extract_surface(sdf, radius=0.8, weights=weights, center=True)
    return mesh.vertices, mesh.faces


def points_of(vertices, normals, uv, base_color, roughness, metallic, normal, bary):
    faces, face = soup(vertices, len(bary))
    mesh = Mesh(vertices, faces, normals, uv)
    maps = TextureSet(base_color, roughness, metallic, normal)
    return tuple(vars(gbuffer.surface_points(mesh, maps, face, bary)).values())


def textured(n: int) -> dict[str, Tensor]:
    maps = {name: uniform(6, 6, seed=k) for k, name in ((11, "roughness"), (12, "metallic"))}
    maps["base_color"], maps["normal"] = uniform(6, 6, 3, seed=10), 0.5 + 0.5 * above(36, 13).reshape(6, 6, 3)
    v = corners(60)
    uv = uniform(len(v), 2, seed=9, high=2.0)
    return {"vertices": v, "normals": above(len(v), 8), "uv": uv, **maps, "bary": weights(n)}


def lobes(n: int, name: str) -> dict[str, Tensor]:
    sharpness = uniform(12, seed=2, low=0.5, high=30.0)
    return {"axis": units(12, 1), "sharpness": sharpness, "amplitude": uniform(12, 3), name: units(n, 3)}


def bsdf(diffuse_model):
    return lambda wo, wi, base_color, alpha, metallic: (
        material.eval_bsdf(wo, base_color, alpha, metallic, wi, diffuse_model=diffuse_model),
    )


def bsdf_inputs(n):
    directions = {"wo": above(n, 1), "wi": above(n, 2)}
    finish = {"alpha": uniform(n, seed=4, low=0.1), "metallic": uniform(n, seed=5)}
    return {**directions, "base_color": uniform(n, 3, seed=3), **finish}


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
    uv = vertices.new_tensor([[0.05, 0.1], [0.9, 0.2], [0.15, 0.85]]).repeat(n // 3, 1)
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


def drawn(u, radiance, wo, alpha):
    light = Environment(radiance)
    directions, density = light.sample(u)
    wi = sampling.sample_cosine(u)
    return directions, density, light.pdf(wi), wi, material.pdf_lobes(wo, alpha, wi)


FRAME = dict(normal=units(N, 5), tangent=torch.nn.functional.pad(units(N, 6), (0, 1), value=1.0))
SG, MAP = ("axis", "sharpness", "amplitude"), ("normal", "base_color", "metallic", "roughness")
MATERIAL = ("wo", "wi", "base_color", "alpha", "metallic")
GRID = ("sdf", "deformation", "alpha", "beta")

CASES = {
    **{name: Case(lambda n, width=width: {"values": uniform(180, width, seed=1), "bary": weights(n)},
                  lambda values, bary: (interpolate(values, *soup(values, len(bary)), bary),), ("values", "bary"),
                  ("bary",))
       for name, width in (("interpolate", 3), ("interpolate tangents", 4))},
    "hit_normals": Case(
        lambda n: {"vertices": corners(60)}, lambda vertices: (hit_normals(vertices, *soup(vertices, N)),),
        ("vertices",)),
    "evaluate_hits": Case(aimed, reevaluate, ("vertices", "origins", "directions"), ("origins", "directions")),
    "sample_texture": Case(
        lambda n: {"texture": uniform(9, 11, 3, seed=1), "uv": uniform(n, 2, seed=2, low=-1.0, high=2.0)},
        lambda texture, uv: (gbuffer.sample_texture(texture, uv),), ("texture", "uv"), ("uv",)),
    "surface_points": Case(
        textured, points_of, ("vertices", "normals", "base_color", "roughness", "metallic", "normal", "bary"),
        ("bary",)),
    "eval_bsdf": Case(bsdf_inputs, bsdf("conserving"), MATERIAL, MATERIAL),
    "eval_bsdf published": Case(bsdf_inputs, bsdf("published"), MATERIAL, MATERIAL),
    "sample_ggx_vndf": Case(
        lambda n: {"wo": above(n, 1), "alpha": uniform(n, seed=2, low=0.1), "u": numbers(n)},
        lambda wo, alpha, u: (sampling.sample_ggx_vndf(wo, alpha, u),), ("wo", "alpha"), ("wo", "alpha", "u")),
    "pdf_ggx_vndf": Case(
        lambda n: {"wo": above(n, 1), "alpha": uniform(n, seed=2, low=0.1), "wm": above(n, 3)},
        lambda wo, alpha, wm: (sampling.pdf_ggx_vndf(wo, alpha, wm),), ("wo", "alpha", "wm"), ("wo", "alpha", "wm")),
    "sample_bsdf": Case(
        lambda n: {"wo": above(n, 1), "alpha": uniform(n, seed=2, low=0.1), "u": numbers(n)},
        lambda wo, alpha, u: (material.sample_bsdf(wo, alpha, u, lobe="mirrored"),),
        ("wo", "alpha"),
        ("wo", "alpha", "u"),
    ),
    "Environment.lookup": Case(
        lambda n: {"radiance": uniform(8, 16, 3, seed=1), "directions": units(n, 2)},
        lambda radiance, directions: (Environment(radiance).lookup(directions),), ("radiance", "directions"),
        ("directions",)),
    "shade_gaussians": Case(
        lambda n: {**lobes(n, "normal"), **{k: v for k, v in shaded(n).items() if k != "radiance"},
                   "wo": normalize(units(n, 1) + 0.5 * units(n, 6), dim=-1)},
        lambda normal, wo, base_color, roughness, metallic, **g: (
            shade_gaussians(*on_ball(normal, wo, base_color, roughness, metallic), SphericalGaussians(**g)),),
        (*SG, "wo", *MAP), ("wo", *MAP)),
    "shade": Case(shaded, lit(), (*MAP, "radiance"), MAP),
    "shade, shadows by Embree": Case(shaded, lit("embree"), (*MAP, "radiance"), MAP),
    "shade, shadows, power, random": Case(
        shaded, lit("warp", heuristic="power", sequence="random", clamp=5.0), (*MAP, "radiance"), MAP),
    "composite": Case(
        lambda n: {"density": uniform(n, seed=1, low=-3.0, high=27.0), "color": uniform(n, 3, seed=2)}, composited,
        ("density", "color"), ("density", "color")),
    "sample_triplane": Case(
        lambda n: {"planes": torch.randn(1, 3, 5, 9, 7, generator=rng(1), **HOST),
                   "points": uniform(n, 3, low=-1.3, high=1.3)},
        lambda planes, points: (sample_triplane(planes, points[None])[0],), ("planes", "points"), ("points",),
        dtypes=("planes",)),
    "antialias": Case(
        lambda n: {"image": uniform(32, 32, 2, seed=1), "vertices": ball("cpu")[0]}, outlines, ("image", "vertices"),
        second=("image", "vertices")),
    "extract_surface": Case(grid_inputs, surface, (*GRID, "gamma"), second=("gamma",)),
    "vertex_deviation": Case(
        # few crossings, none within 3e-4 of a kink of the mean absolute deviation
        lambda n: {k: v for k, v in grid_inputs(n, (3, 3, 4), 24).items() if k in GRID},
        lambda sdf, **weights: (vertex_deviation(sdf, radius=0.8, weights=CubeWeights(**weights)),), GRID, second=GRID),
    "sign_entropy": Case(
        lambda n: {"sdf": torch.randn(6, 7, 8, generator=rng(1), **HOST)}, lambda sdf: (sign_entropy(sdf),),
        ("sdf",), second=("sdf",)),
    "vertex_normals": Case(
        lambda n: {"vertices": ball("cpu")[0]}, lambda vertices: (vertex_normals(vertices, ball(vertices.device)[1]),),
        ("vertices",), second=("vertices",)),
    "taubin_smooth": Case(
        lambda n: {"vertices": ball("cpu")[0]},
        lambda vertices: (taubin_smooth(Mesh(vertices, ball(vertices.device)[1]), iterations=3).vertices,),
        ("vertices",)),
    "gather_views": Case(
        lambda n: {"maps": uniform(3, 24, 20, 5, seed=1), "points": uniform(n, 3, low=-0.8, high=0.8)},
        lambda maps, points: projection.gather_views(maps, points, rig(points.device)), ("maps", "points"),
        ("points",)),
    "sample_grid": Case(
        lambda n: {"grid": uniform(6, 5, 7, 4, seed=1), "points": uniform(n, 3, low=-1.2, high=1.2)},
        lambda grid, points: (sample_grid(grid, points),), ("grid", "points"), ("points",)),
    "squared_laplacian": Case(
        lambda n: {"field": uniform(48, 40, 6, seed=1), "weight": uniform(48, 40, 6, seed=2)},
        lambda field, weight: (squared_laplacian(field, weight),), ("field",)),
    "project": Case(
        lambda n: {"points": uniform(n, 3, low=-0.8, high=0.8)},
        lambda points: project(points, rig(points.device).c2w[0], rig(points.device).intrinsics[0]), ("points",),
        ("points",),
        second=("points",)),
    "camera_rays": Case(
        lambda n: {"c2w": rig("cpu").c2w, "intrinsics": rig("cpu").intrinsics},
        lambda c2w, intrinsics: camera_rays(Camera(c2w, intrinsics, 12, 9)), ("c2w", "intrinsics"),
        second=("c2w", "intrinsics")),
    "radial_bump": Case(
        lambda n: {"bump": above(n, 1)},
        lambda bump: (radial_bump(*(units(len(bump), k).to(bump) for k in (2, 3)), bump),), ("bump",), ("bump",),
        second=("bump",), dtypes=("bump",)),
    "encode_normals": Case(
        lambda n: {"world": units(n, 1)},
        lambda world: (encode_normals(world, *(v[: len(world)].to(world.device) for v in FRAME.values())),), ("world",),
        ("world",), second=("world",)),
    **{f.__name__: Case(lambda n: {"value": uniform(n, 3, seed=1, low=0.01, high=1.5)}, lambda value, f=f: (f(value),),
                        ("value",), ("value",), second=("value",), dtypes=("value",))
       for f in (color.srgb_to_linear, color.linear_to_srgb, color.agx)},
}  # fmt: skip

CASES |= {  # without gradient
    "closest, Warp": Case(rays, traced("warp"), rows=("origins", "directions")),
    "closest, Embree": Case(rays, traced("embree"), rows=("origins", "directions")),
    "draws": Case(
        lambda n: {"u": numbers(n), "radiance": uniform(8, 16, 3, seed=5), "wo": above(n, 1),
                   "alpha": uniform(n, seed=2, low=0.1)},
        drawn, rows=("u", "wo", "alpha")),
    "march_rays": Case(
        lambda n: {"origins": 2.0 * units(n, 1), "directions": units(n, 2)}, marched, rows=("origins", "directions")),
    "bake": Case(lambda n: {"vertices": corners(12)}, texels),
    "views": Case(
        lambda n: {"points": uniform(n, 3, seed=1, low=-0.6, high=0.6), "normal": units(n, 2)}, seen_from,
        rows=("points", "normal")),
    "hull": Case(
        lambda n: {"masks": (uniform(3, 24, 20, seed=1) > 0.6).float(), "points": uniform(n, 3, low=-0.8)}, hulls,
        rows=("points",)),
    "cover_silhouettes": Case(
        lambda n: {"sdf": uniform(12, 11, 10, seed=1, low=0.1, high=2.0), "bound": uniform(12, 11, 10, low=-3.0),
                   "masks": hull_masks()},
        lambda sdf, bound, masks: (
            cover_silhouettes(sdf, bound, hull.mask_distance(masks), rig(sdf.device), radius=0.7),)),
}  # fmt: skip
