"""Fine detail of the base color, from photographs of higher resolution than the images of the fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, max_pool2d

from reli3d._bridge import Movable, present
from reli3d.fit.input_images import INSIDE_COVERAGE, SATURATED_LINEAR
from reli3d.geometry.bake import bake
from reli3d.geometry.camera import Camera, project
from reli3d.geometry.hits import interpolate
from reli3d.geometry.rays import RayScene
from reli3d.geometry.visibility import visible_from
from reli3d.render.asset import Asset
from reli3d.render.color import srgb_to_linear
from reli3d.render.gbuffer import primary_hits, sample_texture

CUTOFF = 1.5  # standard deviation of the low-pass filter, in pixels of the fit's images
DARK = 0.02  # linear, added before the logarithm: darker pixels contain mostly noise
DEPTH_EDGE = 0.01  # difference of depth of neighboring pixels, of the longest side, from which a pixel is left out
COSINE_POWER = 2.0  # of the weight of a view at a texel: oblique views are blurred
MIN_COSINE = 0.2  # between normal and direction to the eye, from which a view counts
MIN_WEIGHT = 1e-6  # added to the sum of weights: no detail where no view counts


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


@torch.no_grad()
def with_fine_detail(
    asset: Asset, crops: Sequence[Crop], c2w: Tensor, coarse: int, held: Sequence[int]
) -> tuple[Asset, tuple[float, float]]:
    """``asset`` with fine detail of photographs added to its base color, and the errors before and after.

    A photograph is compared with the base color in its view times the local mean of the shading, the quotient of the
    low-pass filtered photograph and base color.  The logarithms of the ratios are averaged over the views at every
    texel and added to the base color's.

    asset: with textures, uv and normals.  c2w: ``(V, 4, 4)``, poses of the crops in its frame.  coarse: pixels per side
    of the fit's images, which show the same crops.  held: indices of the crops that are not used.  Errors: root mean
    square of the logarithms in the held-out crops; if it does not fall, or without such crops, ``asset`` is returned.
    """
    mesh, textures = asset.mesh, present("asset.textures", asset.textures)
    scene = RayScene(mesh.vertices, mesh.faces)
    used = [(crops[v], crops[v].camera(c2w[v])) for v in range(len(crops)) if v not in held]

    def at_texels(position: Tensor, normal: Tensor) -> Tensor:
        total, weights = torch.zeros_like(position), position.new_full((len(position), 1), MIN_WEIGHT)
        for crop, camera in used:
            ratio, valid = log_ratio(asset, scene, crop, camera, coarse)
            rows, value, weight = _at_points(ratio, valid, scene, position, normal, camera)
            total.index_add_(0, rows, weight * value)
            weights.index_add_(0, rows, weight)
        return total / weights

    size = textures.size
    detail = bake(mesh, size, at_texels, chunk=size * size)["value"]
    base_color = (textures.base_color * detail.exp()).clamp(0.0, 1.0)
    found = replace(asset, textures=replace(textures, base_color=base_color))
    before, after = (
        _error(which, scene, [(crops[v], crops[v].camera(c2w[v])) for v in held], coarse) for which in (asset, found)
    )
    return (found if after < before else asset), (before, after)


def log_ratio(asset: Asset, scene: RayScene, crop: Crop, camera: Camera, coarse: int) -> tuple[Tensor, Tensor]:
    """Logarithm ``(S, S, 3)`` of photograph over base color times local shading, and where it is valid ``(S, S)``.

    Left out are saturated pixels and those next to outlines and depth edges.
    """
    mesh = asset.mesh
    ratio = max(1.0, camera.width / coarse)
    hits, *_ = primary_hits(scene, camera)
    hit = hits.face >= 0
    uv = interpolate(present("mesh.uv", mesh.uv), mesh.faces, hits.face[hit], hits.bary[hit])
    base = torch.zeros(*hit.shape, 3, device=hit.device)
    base[hit] = sample_texture(present("asset.textures", asset.textures).base_color, uv)
    color = srgb_to_linear(crop.color.float() / 255.0)
    low, high = mesh.vertices.aminmax(dim=0)
    depth = torch.where(hit, hits.t, math.inf)
    near, far = -max_pool2d(-depth[None], 3, 1, 1)[0], max_pool2d(depth[None], 3, 1, 1)[0]
    inside = (crop.mask >= 255 * INSIDE_COVERAGE) & (far - near < DEPTH_EDGE * float((high - low).max()))
    reach = 2 * round(ratio) + 1
    valid = max_pool2d((~inside).float()[None], reach, 1, reach // 2)[0] == 0.0
    valid &= (color < SATURATED_LINEAR).all(-1)
    sigma = CUTOFF * ratio
    planes = (torch.cat([color, base], -1) * valid[..., None]).permute(2, 0, 1)
    means = blurred(planes, sigma)
    shading = (means[:3] / means[3:].clamp(min=1e-6)).permute(1, 2, 0)
    return ((color + DARK) / (base * shading + DARK)).log() * valid[..., None], valid


def blurred(planes: Tensor, sigma: float) -> Tensor:
    """``planes (C, H, W)`` filtered by a Gaussian of standard deviation ``sigma`` pixels, 0 outside."""
    reach = math.ceil(3.0 * sigma)
    at = torch.arange(-reach, reach + 1, device=planes.device, dtype=torch.float32)
    kernel = torch.exp(-at.square() / (2.0 * sigma * sigma))
    kernel = kernel / kernel.sum()
    planes = conv2d(planes[:, None], kernel[None, None, :, None], padding=(reach, 0))
    return conv2d(planes, kernel[None, None, None, :], padding=(0, reach))[:, 0]


def _at_points(
    values: Tensor, valid: Tensor, scene: RayScene, position: Tensor, normal: Tensor, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """Indices ``(M,)`` of the visible points, ``values (S, S, 3)`` at their projections, and weights ``(M, 1)``."""
    one = Camera(camera.c2w[None], camera.intrinsics[None], camera.width, camera.height)
    eye = camera.position - position
    distance = eye.norm(dim=1)
    cosine = (eye * normal).sum(1) / distance
    rows = torch.nonzero(cosine > MIN_COSINE)[:, 0]
    rows = rows[visible_from(scene, position[rows], normal[rows], one)[:, 0]]
    pixels, _ = project(position[rows], camera.c2w, camera.intrinsics)
    where = (2.0 * pixels / camera.width - 1.0)[None, None]
    planes = torch.cat([values, valid[..., None].float()], -1).permute(2, 0, 1)[None]
    found = grid_sample(planes, where, mode="bilinear", padding_mode="zeros", align_corners=False)[0, :, 0].T
    density = camera.intrinsics[0] / camera.width / distance[rows]  # about 1
    weight = (found[:, 3] > 0.99) * cosine[rows] ** COSINE_POWER * density.square()
    return rows, found[:, :3], weight[:, None]


def _error(asset: Asset, scene: RayScene, held: Sequence[tuple[Crop, Camera]], coarse: int) -> float:
    total, count = 0.0, 0
    for crop, camera in held:
        ratio, valid = log_ratio(asset, scene, crop, camera, coarse)
        total, count = total + float(ratio.square().sum()), count + 3 * int(valid.sum())
    return math.sqrt(total / max(count, 1))
