"""Lighting from which a fit starts: non-negative least squares, as radiance is linear in the lighting."""

from __future__ import annotations

import torch
from torch import Tensor

from reli3d.fit.bounce import reflected
from reli3d.fit.input_images import SATURATED_LINEAR
from reli3d.fit.lighting import DIFFUSE_MODEL
from reli3d.fit.losses import MIN_LINEAR
from reli3d.fit.maps import FixedSurface, Pixels
from reli3d.fit.unknowns import LIGHT_MAPS, Unknowns, material_of
from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions, texel_solid_angles
from reli3d.render.material import eval_bsdf
from reli3d.render.points import SurfacePoints
from reli3d.render.sampling import tangent_frame

LEVEL = 2  # of LIGHT_MAPS, the map that is solved for: 16 rows, which diffuse surfaces determine
POINTS = 4096  # pixels per lighting
POINTS_PER_BATCH = 256
MIN_ROUGHNESS = 0.35  # narrower lobes would fall between the directions of the texels
ITERATIONS = 100  # few: a constraint that keeps the solution near the start where images say little
HUBER_DELTA = 0.15  # display values; larger residuals come from base colors that are wrong at the start
MIN_CHANGE, MAX_CHANGE = -6.0, 9.0  # of log radiance; a start without sun is 1e4 times too dark there
RAY_OFFSET = 2e-3  # of shadow rays along the normal


@torch.no_grad()
def solve_lighting(unknowns: Unknowns, data: FixedSurface, pixels: Pixels, scene: RayScene) -> None:
    """Sets ``unknowns.light`` so that direct light on the start's material fits the pixels in display values.

    One texel's light on a point is the BSDF times cosine, solid angle and visibility.  From the start's radiance,
    multiplicative updates reduce the weighted squared error and keep radiance positive (Daube-Witherspoon and
    Muehllehner 1986, An iterative image space reconstruction algorithm), with Huber weights.  Descent on log radiance
    instead would need hundreds of steps to reach a sun, and base colors would explain it first.
    """
    rows_of_map, rotations = LIGHT_MAPS[LEVEL], data.images.light_rotations
    start = Environment(data.start.light.exp()).resized(rows_of_map).radiance
    group = torch.tensor(data.images.light_group, device=pixels.view.device)[pixels.view[pixels.order]]
    for k in range(len(unknowns.light[LEVEL])):
        rows = pixels.order[group == k][:POINTS]
        if len(rows) == 0:
            continue
        base_color, roughness, metallic = material_of(pixels.logits[rows])
        at = SurfacePoints(pixels.position[rows], pixels.ng[rows], pixels.normal[rows], base_color, roughness, metallic)
        turned = None if rotations is None else rotations[pixels.view[rows]]
        target = (pixels.target[rows] - reflected(at, pixels.received[rows])).clamp(min=0.0)
        transfer = light_transfer(at, pixels.wo[rows], scene, rows_of_map, turned)
        slope = (1.0 / 2.2) * target.clamp(min=MIN_LINEAR) ** (1.0 / 2.2 - 1.0)
        valid = (pixels.target[rows] < SATURATED_LINEAR).all(1, keepdim=True)
        solved = non_negative(transfer, target, slope * valid, start.reshape(-1, 3))
        change = (solved / start.reshape(-1, 3).clamp(min=1e-6)).log().clamp(MIN_CHANGE, MAX_CHANGE)
        unknowns.light[LEVEL][k] = change.reshape(start.shape)


def light_transfer(
    points: SurfacePoints, wo: Tensor, scene: RayScene, rows: int, rotations: Tensor | None = None
) -> Tensor:
    """Radiance ``(N, J, 3)`` from ``points`` towards ``wo (N, 3)`` per radiance of each of J = 2 rows^2 texels.

    rotations: ``(N, 3, 3)`` from the axes of the map to the object's; None: the same.
    """
    device = wo.device
    texels = lat_long_directions(rows, device=device).reshape(-1, 3)
    angle = texel_solid_angles(rows, 2 * rows).to(wo).reshape(-1, 1).expand(rows, 2 * rows).reshape(-1)
    parts = []
    for batch in torch.arange(len(wo), device=device).split(POINTS_PER_BATCH):
        at = points[batch]
        direction = texels.expand(len(batch), -1, 3)
        direction = direction if rotations is None else direction @ rotations[batch].mT
        direction = direction.contiguous()
        frame = tangent_frame(at.normal)
        local, toward = (value @ frame.mT for value in (direction, wo[batch, None]))
        alpha = at.roughness.clamp(min=MIN_ROUGHNESS).square()[:, None]
        material = at.base_color[:, None], alpha, at.metallic[:, None]
        value = eval_bsdf(toward, *material, local, diffuse_model=DIFFUSE_MODEL)
        origin = (at.position + RAY_OFFSET * at.ng)[:, None].expand_as(direction).contiguous()
        free = ~scene.occluded(origin, direction)
        parts.append(value * (local[..., 2].clamp(min=0.0) * angle * free)[..., None])
    return torch.cat(parts)


def non_negative(transfer: Tensor, target: Tensor, weight: Tensor, start: Tensor) -> Tensor:
    """Radiance ``(J, 3)``: robust non-negative least squares of ``weight * (transfer x - target)`` from ``start``.

    transfer: ``(N, J, 3)``.  target, weight: ``(N, 3)`` or weight ``(N, 1)``, non-negative.  start: ``(J, 3)``,
    positive.
    """
    radiance = start.clone()
    for _ in range(ITERATIONS):
        predicted = torch.einsum("njc,jc->nc", transfer, radiance)
        residual = weight * (predicted - target).abs()
        own = weight.square() * (HUBER_DELTA / residual.clamp(min=HUBER_DELTA))
        up, down = (torch.einsum("njc,nc->jc", transfer, own * value) for value in (target, predicted))
        radiance = radiance * (up.clamp(min=1e-12) / down.clamp(min=1e-12))
    return radiance
