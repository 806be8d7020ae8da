"""Variables of a fit and the quantities that they parameterize.

Material and lighting are changes relative to the start in unbounded spaces (logits of base color, roughness and
metallic; logarithms of radiance): zero is the start, and every value is valid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial, reduce

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, interpolate, normalize, pad

from reli3d.fit.fields import space_field
from reli3d.geometry.bake import rasterize_texels
from reli3d.geometry.camera import Camera
from reli3d.render.asset import Asset
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import surface_points
from reli3d.render.latlong import lat_long_directions
from reli3d.render.points import SurfacePoints

LOGIT_MARGIN = 0.005  # from 0 and 1 at which values are clamped before the logit
MAX_ROUGHNESS, MIN_ROUGHNESS = 1.0, 0.05  # below, a lobe is narrower than the environment's texels
MATERIAL_GRIDS = (4, 8, 16, 32)  # points along a side of the box
FINISH_GRIDS = 2  # number of them that roughness and metallic have: images constrain these poorly
START_GRID = 32  # points along a side of the box
MAX_BEND = 0.3  # length of the vector added to a unit normal: 17 degrees
BEND_GRIDS = (8, 16, 32, 64)  # finer than the material's, which must not explain errors of the normals
LIGHT_ROWS = 32
LIGHT_MAPS = (4, 8, 16, 32)  # rows of the maps
MIN_RELATIVE_RADIANCE = 1e-4  # of the start's mean; its logarithm must be finite


@dataclass
class Unknowns:
    """Variables of the optimization, in a frame in which the object fills the box [-1, 1]^3.

    sdf: ``(X, Y, Z)`` signed distance, negative inside.  material: grids ``(n, n, n, 5)`` over the box, changes of
    logits.  detail: ``(T, T, 3)`` over the atlas, changes of base color logits.  bend: grids ``(n, n, n, 3)`` over the
    box, added to the unit shading normal.  light: maps ``(G, h, 2h, 3)`` of G lightings, changes of log radiance.
    exposure: ``(V,)`` logarithms.  pose: ``(V, 6)``, a rotation vector [rad] and a translation in the camera's axes.
    """

    sdf: Tensor
    material: list[Tensor]
    detail: Tensor
    bend: list[Tensor]
    light: list[Tensor]
    exposure: Tensor
    pose: Tensor

    @classmethod
    def zero(cls, sdf: Tensor, views: int, texels: int, lights: int = 1) -> Unknowns:
        """No change; ``sdf`` as given.  lights: number of lightings."""
        zeros = partial(torch.zeros, device=sdf.device, dtype=torch.float32)
        return cls(
            sdf.clone(),
            [zeros(n, n, n, 5) for n in MATERIAL_GRIDS],
            zeros(texels, texels, 3),
            [zeros(n, n, n, 3) for n in BEND_GRIDS],
            [zeros(lights, n, 2 * n, 3) for n in LIGHT_MAPS],
            zeros(views),
            zeros(views, 6),
        )

    def groups(self) -> dict[str, list[Tensor]]:
        return {name: value if isinstance(value, list) else [value] for name, value in vars(self).items()}

    @torch.no_grad()
    def reset_bend(self) -> None:
        """Sets the bend of all normals to zero."""
        for grid in self.bend:
            grid.zero_()


@dataclass(frozen=True)
class Start:
    """Initial values: logits of the material on a grid ``(n, n, n, 5)`` and log radiance ``(h, 2h, 3)``.

    observed: after :meth:`Background.over <reli3d.fit.background.Background.over>`, where ``light`` is ``(G, h, 2h,
    3)``, the fraction of each texel that the background of the images covers, ``(G, h, 2h, 1)``.  clipped: ``(G, h, 2h,
    3)`` bool, where it is saturated.
    """

    material: Tensor
    light: Tensor
    observed: Tensor | None = None
    clipped: Tensor | None = None

    @classmethod
    def of(cls, asset: Asset, texels: int = 256, rotations: Tensor | None = None) -> Start:
        """Initial values of an asset in the box [-1, 1]^3; the material is extrapolated from its surface.

        rotations: ``(V, 3, 3)``, as in :class:`~reli3d.fit.lighting.Lights`; the lighting is the mean over the views.
        """
        found = rasterize_texels(asset.mesh, texels)
        points = surface_points(asset.mesh, asset.textures, found.face[found.valid], found.bary[found.valid])
        material = filled_grid(points.position, material_logits(points), START_GRID)
        radiance = asset.light.resized(LIGHT_ROWS).radiance
        if rotations is not None:
            world = lat_long_directions(LIGHT_ROWS, device=radiance.device)[None, :, :] @ rotations[:, None].mT
            radiance = Environment(radiance).lookup(world.contiguous()).mean(0)
        return cls(material, radiance.clamp(min=MIN_RELATIVE_RADIANCE * float(radiance.mean())).log())


def material_logits(points: SurfacePoints) -> Tensor:
    """Logits ``(N, 5)`` of linear base color, roughness (mapped from its range to [0, 1]) and metallic."""
    rough = (points.roughness - MIN_ROUGHNESS) / (MAX_ROUGHNESS - MIN_ROUGHNESS)
    values = torch.cat([points.base_color, rough[:, None], points.metallic[:, None]], 1)
    return torch.logit(values.clamp(LOGIT_MARGIN, 1.0 - LOGIT_MARGIN))


def material_of(logits: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Base color ``(N, 3)`` linear, roughness and metallic ``(N,)``."""
    values = torch.sigmoid(logits)
    return values[:, :3], MIN_ROUGHNESS + (MAX_ROUGHNESS - MIN_ROUGHNESS) * values[:, 3], values[:, 4]


def material_change(unknowns: Unknowns, position: Tensor) -> Tensor:
    """Change of the logits ``(N, 5)`` at ``position (N, 3)``; roughness and metallic from the coarse grids only."""
    both = space_field(unknowns.material[:FINISH_GRIDS], position)
    fine = space_field([grid[..., :3] for grid in unknowns.material[FINISH_GRIDS:]], position)
    return both + torch.cat([fine, torch.zeros_like(both[:, 3:])], 1)


def bent(unknowns: Unknowns, position: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Unit shading normals ``(N, 3)``, ``normal`` plus the bend at ``position``, and the bend ``(N, 3)``.

    The bend is limited to ``MAX_BEND``: otherwise a normal turned away from the incident light could explain a black
    base color.
    """
    bend = space_field(unknowns.bend, position)
    bend = bend / (1.0 + (bend.square().sum(1, keepdim=True) / MAX_BEND**2)).sqrt()
    return unit(normal + bend), bend


def light_maps(light: list[Tensor]) -> Tensor:
    """Changes of log radiance ``(G, LIGHT_ROWS, 2 LIGHT_ROWS, 3)``: sum of the maps, bilinear, periodic in azimuth."""
    parts = []
    for values in light:
        planes, factor = values.permute(0, 3, 1, 2), LIGHT_ROWS // values.shape[1]
        if factor > 1:
            planes = pad(planes, (1, 1, 0, 0), mode="circular")
            planes = interpolate(planes, scale_factor=factor, mode="bilinear", align_corners=False)
            planes = planes[..., factor:-factor]
        parts.append(planes.permute(0, 2, 3, 1))
    return reduce(torch.add, parts).contiguous()


def corrected(camera: Camera, pose: Tensor) -> Camera:
    """``camera`` rotated and translated by ``pose (..., 6)`` in camera axes.  Gradients reach ``pose``.

    The rotation is the Cayley map of the rotation vector, which equals the exponential map to second order.
    """
    half, eye = 0.5 * pose[..., :3], torch.eye(3, device=pose.device, dtype=torch.float32)
    x, y, z = half.unbind(-1)
    none = torch.zeros_like(x)
    skew = torch.stack([none, -z, y, z, none, -x, -y, x, none], -1).reshape(*x.shape, 3, 3)
    turn = torch.linalg.solve(eye - skew, eye + skew)
    rotation = camera.c2w[..., :3, :3]
    shift = camera.c2w[..., :3, 3] + (rotation @ pose[..., 3:, None])[..., 0]
    rows = torch.cat([rotation @ turn, shift[..., None]], -1)
    return Camera(torch.cat([rows, camera.c2w[..., 3:, :]], -2), camera.intrinsics, camera.width, camera.height)


def filled_grid(position: Tensor, values: Tensor, n: int) -> Tensor:
    """Grid ``(n, n, n, C)`` over [-1, 1]^3: at each point, the mean of the ``values (N, C)`` nearest to it.

    Gaps are filled by pull-push over a mip pyramid (Grossman and Dally 1998, Point Sample Rendering).
    """
    index = ((position.detach().clamp(-1.0, 1.0) + 1.0) * (0.5 * (n - 1))).round().long()
    index = (index[:, 0] * n + index[:, 1]) * n + index[:, 2]
    channels = values.shape[1]
    total = values.new_zeros(n**3, channels + 1)
    total.index_add_(0, index, torch.cat([values.detach(), torch.ones_like(values[:, :1])], 1))
    return _pushed(total.T.reshape(1, channels + 1, n, n, n))[0].permute(1, 2, 3, 0).contiguous()


def _pushed(total: Tensor) -> Tensor:
    mean = total[:, :-1] / total[:, -1:].clamp(min=1e-9)
    if total.shape[-1] == 1:
        return mean
    coarse = avg_pool3d(total, 2)
    around = interpolate(_pushed(coarse), total.shape[2:], mode="trilinear", align_corners=False)
    return torch.where(total[:, -1:] > 0.0, mean, around)


def unit(value: Tensor) -> Tensor:
    """``value (..., 3)`` normalized to length 1."""
    return normalize(value, dim=-1)
