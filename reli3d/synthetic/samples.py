"""Training samples: an object under one environment, rendered in several views, with ground truth at points.

A sample is a dictionary of tensors, stored as one safetensors file; ``docs/model.md``, "A sample", lists its entries.
World +Y up, object centered, longest side 1.  Radiance is scaled by the exposure of the first view.
"""

from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from reli3d.geometry.camera import Camera, camera_rays, project
from reli3d.geometry.distance import signed_distance
from reli3d.geometry.mesh import face_normals
from reli3d.geometry.rays import RayScene
from reli3d.geometry.visibility import visible_from
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.latlong import quarter_turn
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from reli3d.synthetic.materials import evaluate
from reli3d.synthetic.procedural import ProceduralObject, sample_cameras

SAMPLES = (4, 3, 1)  # light, GGX and cosine samples per ray; with FINE**2 rays per pixel the noise is a photograph's
FINE = 2  # rays along each side of a pixel
DIFFUSE_MODEL = "published"  # the training data of the bundled weights, and the formula of glTF viewers
EXPOSURE_TARGET = 0.6  # linear value of the 90th percentile of the object in the first view
SKY_DIRECTIONS = 48  # tested rays to the outside: they find an opening of a tenth of the sphere
OFF_SURFACE = 1e-3  # distance of the points from which a face is tested
VOLUME_POINTS, SURFACE_POINTS, PIXELS = 16384, 8192, 1024


def crop_camera(vertices: Tensor, c2w: Tensor, size: int, padding: float) -> Tensor:
    """Intrinsics ``(4,)`` that fit the projected ``vertices`` into a ``size`` square with a relative ``padding``."""
    xy, _ = project(vertices, c2w, torch.tensor([1.0, 1.0, 0.0, 0.0]))
    low, high = xy.amin(0), xy.amax(0)
    focal = size * (1 - 2 * padding) / (high - low).max()
    center = size / 2 - focal * (low + high) / 2
    return torch.stack([focal, focal, center[0], center[1]])


def enclosed(points: Tensor, scene: RayScene) -> Tensor:
    """Whether all SKY_DIRECTIONS rays from each of ``points (N, 3)`` hit ``scene``, which may have holes, ``(N,)``."""
    z = 1 - (2 * torch.arange(SKY_DIRECTIONS) + 1) / SKY_DIRECTIONS
    phi = torch.arange(SKY_DIRECTIONS) * (np.pi * (3 - 5**0.5))
    radius = (1 - z * z).sqrt()
    sphere = torch.stack([radius * phi.cos(), z, radius * phi.sin()], -1).float()
    hidden = torch.ones(len(points), dtype=torch.bool)
    for direction in sphere:
        index = hidden.nonzero()[:, 0]
        hidden[index] = scene.occluded(points[index], direction.expand(len(index), 3).contiguous())
    return hidden


def outer_faces(vertices: Tensor, faces: Tensor, scene: RayScene) -> Tensor:
    """Faces ``(F,)`` bool of which a point, on either side, is not :func:`enclosed`; all if every one is."""
    corners = vertices[faces.long()]
    offset = OFF_SURFACE * functional.normalize(face_normals(vertices, faces), dim=-1)
    center, outer = corners.mean(1), torch.zeros(len(faces), dtype=torch.bool)
    for points in (center, *(0.4 * center[:, None] + 0.6 * corners).unbind(1)):
        rows = (~outer).nonzero()[:, 0]
        sides = torch.stack([points[rows] + offset[rows], points[rows] - offset[rows]], 1)
        outer[rows] = ~enclosed(sides.reshape(-1, 3), scene).view(-1, 2).all(1)
    return outer if bool(outer.any()) else ~outer


class Surface(Protocol):
    """Interface of an object: its mesh, and geometry and material at ray hits."""

    vertices: Tensor  # (V, 3)
    faces: Tensor  # (F, 3) int32
    scene: RayScene
    outer: Tensor  # (F,) bool, faces outside the solid, see outer_faces

    def distance(self, points: Tensor) -> Tensor:
        """Signed distance ``(N,)`` of points ``(N, 3)``, positive outside."""

    def points_at(self, face: Tensor, bary: Tensor) -> SurfacePoints:
        """Geometry and material at hits ``face (N,)``, ``bary (N, 2)``; the shading normal is bump mapped."""


class ObjectSurface:
    """:class:`Surface` of a procedural object."""

    def __init__(self, shape: ProceduralObject):
        self.shape = shape
        self.vertices = torch.as_tensor(shape.vertices)
        self.faces = torch.as_tensor(shape.faces)
        self.corner_normals = torch.as_tensor(shape.normals)
        self.part = torch.as_tensor(shape.part)
        self.ng = functional.normalize(face_normals(self.vertices, self.faces), dim=-1)
        self.scene = RayScene(self.vertices, self.faces)
        self.outer = outer_faces(self.vertices, self.faces, self.scene)

    def distance(self, points: Tensor) -> Tensor:
        return signed_distance(self.vertices, self.faces, points)

    def points_at(self, face: Tensor, bary: Tensor) -> SurfacePoints:
        weights = torch.stack([1 - bary.sum(-1), bary[:, 0], bary[:, 1]], -1)[..., None]
        position = (self.vertices[self.faces[face].long()] * weights).sum(1)
        normal = functional.normalize((self.corner_normals[face] * weights).sum(1), dim=-1)
        base, rough, metal, bump = evaluate(self.shape.materials, position, normal, self.part[face])
        return SurfacePoints(position, self.ng[face], bump, base, rough, metal)


def _render(surface: Surface, camera: Camera, light: Environment, seed: int):
    """Radiance ``(H * W, 3)`` of all rays; of the rays that hit: indices, points, view directions and radiance."""
    origins, directions = (r.reshape(-1, 3) for r in camera_rays(camera))
    hits = surface.scene.closest(origins, directions)
    seen = (hits.face >= 0).nonzero()[:, 0]
    points, wo = surface.points_at(hits.face[seen].long(), hits.bary[seen]), -directions[seen]
    points = _turned(points, (points.ng * wo).sum(-1) < 0.0)  # as shading does
    options = ShadeOptions(samples=SAMPLES, seed=seed, diffuse_model=DIFFUSE_MODEL)
    radiance = shade(points, wo, light, scene=surface.scene, options=options)
    image = light.lookup(directions)
    image[seen] = radiance
    return image, seen, points, wo, radiance


def _turned(points: SurfacePoints, back: Tensor) -> SurfacePoints:
    """``points`` with reversed normals where ``back (N,)``: of a surface that is seen from behind."""
    sign = 1.0 - 2.0 * back[:, None].float()
    return replace(points, ng=sign * points.ng, normal=sign * points.normal)


def synthesize(
    surface: Surface,
    light: Tensor,
    rng: np.random.Generator,
    *,
    size: int = 256,
    views: int = 6,
    views_only: bool = False,
    finish_known: bool = True,
) -> dict[str, Tensor]:
    """One sample of an object under the lat-long map ``light`` ``(H, 2H, 3)``, turned by a random yaw.

    finish_known: stored for each view; False if roughness and metallic of the object are placeholders.
    """
    environment = Environment(torch.roll(light, int(rng.integers(light.shape[1])), 1).contiguous())
    c2w = torch.as_tensor(np.asarray(sample_cameras(rng, views)[0]), dtype=torch.float32)
    intrinsics = torch.stack([crop_camera(surface.vertices, m, size, rng.uniform(0.04, 0.12)) for m in c2w])
    sample = render_sample(surface, environment, Camera(c2w, intrinsics, size, size), rng, views_only=views_only)
    return {**sample, "finish_known": torch.full((views,), finish_known, dtype=torch.uint8)}


def render_sample(
    surface: Surface, environment: Environment, cameras: Camera, rng: np.random.Generator, *, views_only: bool = False
) -> dict[str, Tensor]:
    """The sample of an object under ``environment`` with ``V`` square ``cameras``.

    views_only: one ray per pixel, and no points of the volume and the surface; enough for training the 2D U-Net alone.
    """
    c2w, views, size = cameras.c2w, len(cameras.c2w), cameras.width
    fine = 1 if views_only else FINE
    exposure, images, pixels, pixel_radiance = 0.0, [], [], []
    maps: dict[str, list[Tensor]] = {"view_material": [], "view_normal": [], "view_depth": []}
    for k in range(views):
        seed = int(rng.integers(1 << 30))
        image, seen, points, wo, radiance = _render(surface, cameras[k].scaled(fine), environment, seed)
        if k == 0:
            bright = max(float(radiance.mean(-1).quantile(0.9)), 1e-3)
            exposure = EXPOSURE_TARGET / bright * float(np.exp(rng.normal(0, 0.25)))
        hit = surface.scene.occluded(*camera_rays(cameras[k].scaled(fine + 1))).float()
        alpha = functional.avg_pool2d(hit[None, None], fine + 1)[0, 0]  # antialiased
        image = pooled_pixels((image * exposure).clamp(0, 4), size, fine).clamp(0, 1)  # sensor saturation
        encoded = torch.cat([linear_to_srgb(image), alpha[..., None]], -1)
        images.append((encoded * 255 + 0.5).to(torch.uint8))
        for name, value in _view_maps(points, seen, c2w[k], size, fine).items():
            maps[name].append(value)
        pick = torch.as_tensor(rng.integers(len(seen), size=PIXELS))
        pixels.append(torch.stack([points.position, points.normal, wo], 1)[pick])
        pixel_radiance.append((radiance[pick] * exposure).clamp(max=64.0))
    sample = {"images": torch.stack(images), "c2w": c2w, "intrinsics": cameras.intrinsics}
    sample |= {name: torch.stack(values) for name, values in maps.items()}
    exposed = (environment.radiance * exposure).permute(2, 0, 1)[None]
    pooled = functional.interpolate(exposed, (32, 64), mode="area")[0].permute(1, 2, 0)
    sample["environment"] = quarter_turn(pooled, 1).clamp(max=6e4).half()  # stored with -Z at the horizontal center
    if not views_only:
        sample.update(pixels=torch.stack(pixels).half(), pixel_radiance=torch.stack(pixel_radiance).half())
        sample.update(_volume(surface, rng), **_surface_points(surface, cameras, rng))
    return {k: v.contiguous() for k, v in sample.items()}


def _view_maps(points: SurfacePoints, seen: Tensor, c2w: Tensor, size: int, fine: int) -> dict[str, Tensor]:
    """Ground-truth maps of one view from the ``points`` at the hits of the rays ``seen (N,)``."""
    rays = (size * fine) ** 2
    depth = -((points.position - c2w[:3, 3]) @ c2w[:3, 2])
    finish, last = torch.stack([points.roughness, points.metallic], 1), torch.stack([depth, torch.ones_like(depth)], 1)
    values = [points.base_color.clamp(0, 1), finish, points.normal, last]
    dense = torch.zeros(rays, 10).index_copy_(0, seen, torch.cat(values, -1))
    base, rest, normal, depth, hit = pooled_pixels(dense, size, fine).split([3, 2, 3, 1, 1], -1)
    fraction = hit.clamp(min=0.5 / fine**2)
    material = torch.cat([linear_to_srgb((base / fraction).clamp(0, 1)), rest / fraction], -1)
    normal = functional.normalize(normal, dim=-1)
    whole = hit > 0.5
    return {
        "view_material": (material * whole * 255 + 0.5).to(torch.uint8),
        "view_normal": (normal * whole * 127).round().to(torch.int8),
        "view_depth": (depth / fraction * whole)[..., 0].half(),
    }


def pooled_pixels(rays: Tensor, size: int, fine: int = FINE) -> Tensor:
    """Means ``(S, S, C)`` over the ``fine**2`` rays of each pixel, of values ``(rays, C)``."""
    image = rays.reshape(1, size * fine, size * fine, -1).permute(0, 3, 1, 2)
    return functional.avg_pool2d(image, fine)[0].permute(1, 2, 0)


def random_faces(surface: Surface, count: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Faces ``(N,)`` and barycentrics ``(N, 2)`` of random points on ``surface.outer``, uniform by area."""
    corners = surface.vertices[surface.faces.long()].numpy()
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    area = area * surface.outer.numpy()
    face = rng.choice(len(area), count, p=area / area.sum())
    u = np.sqrt(rng.random(count))
    v = rng.random(count)
    return torch.as_tensor(face), torch.as_tensor(np.stack([u * (1 - v), u * v], -1), dtype=torch.float32)


def _volume(surface: Surface, rng: np.random.Generator) -> dict[str, Tensor]:
    """Points with signed distances: half near the surface (deviation 0.01 or 0.05), half uniform in a larger box."""
    near = surface.points_at(*random_faces(surface, VOLUME_POINTS // 2, rng)).position.numpy()
    near = near + rng.normal(size=near.shape) * rng.choice([0.01, 0.05], (len(near), 1))
    box = surface.vertices.abs().amax(0).numpy() + 0.12
    anywhere = rng.uniform(-box, box, (VOLUME_POINTS // 2, 3))
    points = torch.as_tensor(np.concatenate([near, anywhere]), dtype=torch.float32)
    points = points.half().float()  # distances of the points as stored, in half precision
    return {"points": points.half(), "distance": surface.distance(points).half()}


def _surface_points(surface: Surface, cameras: Camera, rng: np.random.Generator) -> dict[str, Tensor]:
    points = surface.points_at(*random_faces(surface, SURFACE_POINTS, rng))
    visible, behind = (visible_from(surface.scene, points.position, sign * points.ng, cameras) for sign in (1, -1))
    back = behind.any(1) & ~visible.any(1)
    points, visible = _turned(points, back), torch.where(back[:, None], behind, visible)
    finish = torch.stack([points.roughness, points.metallic], 1)
    encoded = torch.cat([linear_to_srgb(points.base_color.clamp(0, 1)), finish], -1)
    return {
        "surface": torch.stack([points.position, points.ng, points.normal], 1).half(),
        "material": (encoded * 255 + 0.5).to(torch.uint8),
        "visible": visible.to(torch.uint8),
    }
