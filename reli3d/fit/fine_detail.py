"""Fine detail of the base color, from photographs of higher resolution than the images of the fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, max_pool2d

from reli3d._bridge import Movable, full_precision, present
from reli3d.fit.input_images import INSIDE_COVERAGE, SATURATED_LINEAR
from reli3d.geometry.bake import bake, rasterize_texels
from reli3d.geometry.camera import Camera, project
from reli3d.geometry.rays import RayScene
from reli3d.geometry.visibility import visible_from
from reli3d.render.asset import Asset
from reli3d.render.color import srgb_to_linear
from reli3d.render.gbuffer import primary_hits, surface_points

MIN_RATIO = 1.25  # pixels of a crop along a pixel of the fit's images, from which there is detail to add
LOW_PASS_SIGMA = 1.5  # of the filter that separates detail from shading, in pixels of the fit's images
NOISE_FLOOR = 0.02  # linear, added before the logarithm: darker pixels contain mostly noise
MAX_LOG_RATIO = 0.7  # a factor of 2; larger ones are highlights, shadows and wrong surfaces
MAX_DEPTH_RANGE = 10.0  # pixel widths, of 3 by 3 pixels on one surface: planes tilted by 79 degrees
MIN_FACING_COSINE = 0.2  # between normal and direction to the eye, from which a view counts
COSINE_POWER = 2.0  # of the weight of a view: oblique views are blurred
MIN_WEIGHT = 1e-6  # added to the sum of weights, far below that of one view: no detail where no view counts
TEXELS_PER_CHUNK = 1 << 19


@dataclass(frozen=True)
class Crop(Movable):
    """The part of a photograph that shows the object.

    color: ``(S, S, 3)`` uint8 sRGB.  mask: ``(S, S)`` uint8 coverage.  intrinsics: ``(4,)`` in pixels of the crop.
    """

    color: Tensor
    mask: Tensor
    intrinsics: Tensor

    def camera(self, c2w: Tensor) -> Camera:
        """The camera of the crop with the pose ``c2w (4, 4)``."""
        return Camera(c2w, self.intrinsics, self.mask.shape[1], self.mask.shape[0])


@torch.inference_mode(False)
@torch.no_grad()
@full_precision
def with_fine_detail(
    asset: Asset, crops: Sequence[Crop], c2w: Tensor, coarse: int, held: Sequence[int]
) -> tuple[Asset, tuple[float, float]]:
    """``asset`` with fine detail of photographs added to its base color, and the errors before and after.

    The weighted mean over the views of :func:`log_ratio` is added to the logarithm of the base color.

    asset: with textures, uv and normals.  c2w: ``(V, 4, 4)``, poses of the crops in its frame.  coarse: pixels per side
    of the fit's images of the same crops; crops below ``MIN_RATIO`` times as many are not used.  held: indices of crops
    that are only compared.  Errors: root mean square of the logarithms in these; if it does not fall, or without such
    crops, ``asset`` is returned.  No gradient.
    """
    views = [(crop, crop.camera(pose)) for crop, pose in zip(crops, c2w, strict=True)]
    fine = [v for v, (_, camera) in enumerate(views) if camera.width >= MIN_RATIO * coarse]
    compared, used = ([views[v] for v in fine if (v in held) == kept] for kept in (True, False))
    if not compared or not used:
        return asset, (0.0, 0.0)
    mesh, textures = asset.mesh, present("asset.textures", asset.textures)
    scene, size = RayScene(mesh.vertices, mesh.faces), textures.size
    texels = rasterize_texels(mesh, size)
    maps = bake(mesh, size, lambda position, normal: {"p": position, "n": normal}, texels=texels, fill=False)
    position, normal = (maps[name].reshape(-1, 3) for name in "pn")
    chunks = torch.nonzero(texels.valid.reshape(-1))[:, 0].split(TEXELS_PER_CHUNK)
    total, weights = torch.zeros_like(position), torch.full_like(position[:, :1], MIN_WEIGHT)
    for crop, camera in used:
        ratio, valid = log_ratio(asset, scene, crop, camera, coarse)
        for chunk in chunks:
            rows, value, weight = _at_points(ratio, valid, scene, position[chunk], normal[chunk], camera)
            total.index_add_(0, chunk[rows], weight * value)
            weights.index_add_(0, chunk[rows], weight)
    factor = (total / weights).exp().reshape(size, size, 3)
    base_color = (textures.base_color * factor).clamp(0.0, 1.0)
    found = replace(asset, textures=replace(textures, base_color=base_color))
    before, after = (_error(which, scene, compared, coarse) for which in (asset, found))
    return (found if after < before else asset), (before, after)


def log_ratio(asset: Asset, scene: RayScene, crop: Crop, camera: Camera, coarse: int) -> tuple[Tensor, Tensor]:
    """Logarithm ``(S, S, 3)`` of photograph over base color times local shading, and where it is valid ``(S, S)``.

    Shading: quotient of photograph and base color after low-pass filtering.  Left out are saturated pixels and those
    next to outlines and depth edges.
    """
    finer = camera.width / coarse
    hits, *_ = primary_hits(scene, camera)
    hit = hits.face >= 0
    base = torch.zeros(*hit.shape, 3, device=hit.device, dtype=torch.float32)
    base[hit] = surface_points(asset.mesh, asset.textures, hits.face[hit], hits.bary[hit]).base_color
    color = srgb_to_linear(crop.color.float() / 255.0)
    depth = torch.where(hit, hits.t, math.inf)
    near, far = -max_pool2d(-depth[None], 3, 1, 1)[0], max_pool2d(depth[None], 3, 1, 1)[0]
    inside = (crop.mask >= 255 * INSIDE_COVERAGE) & (far - near < MAX_DEPTH_RANGE / camera.intrinsics[0] * near)
    reach = 2 * round(finer) + 1
    valid = max_pool2d((~inside).float()[None], reach, 1, reach // 2)[0] == 0.0
    valid &= (color < SATURATED_LINEAR).all(-1)
    planes = (torch.cat([color, base], -1) * valid[..., None]).permute(2, 0, 1)
    means = blurred(planes, LOW_PASS_SIGMA * finer)
    shading = (means[:3] / means[3:].clamp(min=1e-6)).permute(1, 2, 0)
    ratio = ((color + NOISE_FLOOR) / (base * shading + NOISE_FLOOR)).log()
    return ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO) * valid[..., None], valid


def blurred(planes: Tensor, sigma: float) -> Tensor:
    """``planes (C, H, W)`` filtered by a Gaussian of standard deviation ``sigma`` pixels, 0 outside."""
    reach = math.ceil(3.0 * sigma)
    at = torch.arange(-reach, reach + 1, device=planes.device, dtype=torch.float32)
    kernel = torch.exp(-at.square() / (2.0 * sigma * sigma))
    kernel = kernel / kernel.sum()
    result = torch.empty_like(planes)
    for k, plane in enumerate(planes):  # one at a time: torch copies each value for every tap
        rows = conv2d(plane[None, None], kernel[None, None, :, None], padding=(reach, 0))
        result[k] = conv2d(rows, kernel[None, None, None, :], padding=(0, reach))[0, 0]
    return result


def _at_points(
    values: Tensor, valid: Tensor, scene: RayScene, position: Tensor, normal: Tensor, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """Indices ``(M,)`` of the visible points, ``values (S, S, 3)`` at their projections, and weights ``(M, 1)``."""
    one = Camera(camera.c2w[None], camera.intrinsics[None], camera.width, camera.height)
    eye = camera.position - position
    distance = eye.norm(dim=1)
    cosine = (eye * normal).sum(1) / distance
    rows = torch.nonzero(cosine > MIN_FACING_COSINE)[:, 0]
    rows = rows[visible_from(scene, position[rows], normal[rows], one)[:, 0]]
    pixels, _ = project(position[rows], camera.c2w, camera.intrinsics)
    where = (2.0 * pixels / camera.width - 1.0)[None, None]
    planes = torch.cat([values, valid[..., None].float()], -1).permute(2, 0, 1)[None]
    found = grid_sample(planes, where, mode="bilinear", padding_mode="zeros", align_corners=False)[0, :, 0].T
    resolution = camera.intrinsics[0] * scene.scale / distance[rows]
    weight = (found[:, 3] > 0.99) * cosine[rows] ** COSINE_POWER * resolution.square()
    return rows, found[:, :3], weight[:, None]


def _error(asset: Asset, scene: RayScene, views: Sequence[tuple[Crop, Camera]], coarse: int) -> float:
    """Root mean square of :func:`log_ratio` over the valid pixels of ``views``; 0 if there are none."""
    total, count = 0.0, 0
    for crop, camera in views:
        ratio, valid = log_ratio(asset, scene, crop, camera, coarse)
        total, count = total + float(ratio.square().sum()), count + 3 * int(valid.sum())
    return math.sqrt(total / max(count, 1))
