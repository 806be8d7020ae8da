"""What a fit may change, as plain tensors, and what they mean.

Material and light are held as changes of the start in spaces without bounds (logits of base colour, roughness and
metallic; logarithms of radiance), so zero is the start and every value is allowed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reli3d.fit.fields import light_field, space_field
from reli3d.geometry.bake import rasterize_texels
from reli3d.geometry.camera import Camera
from reli3d.render.asset import Asset
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import surface_points
from reli3d.render.points import SurfacePoints

ROOM = 0.005  # base colours and metallic end this far from 0 and 1, where their logits are still near
ROUGHEST, SMOOTHEST = 1.0, 0.05  # roughness: below, a lobe is narrower than the light's texels
MATERIAL_GRIDS = (4, 8, 16, 32)  # points along a side of the box
FINISH_GRIDS = 2  # how many of them roughness and metallic take part in: photographs tell little of them
START_GRID = 32
MOST_BENT = 0.3  # 17 degrees
BEND_GRIDS = (8, 16, 32, 64)  # finer than the paint's: what it takes must not be left to them
LIGHT_ROWS = 32
LIGHT_MAPS = (4, 8, 16, 32)
DARKEST = 1e-4  # of the start's mean radiance: its logarithm must exist


@dataclass
class Unknowns:
    """Everything that gradients may reach.  Lengths are those of the fit's own box, [-1, 1]^3 and what lies around.

    level: ``(X, Y, Z)`` negative inside.  material: grids ``(n, n, n, 5)`` over the box.  detail: ``(T, T, 3)`` base
    colour over the atlas.  bend: grids ``(n, n, n, 3)`` over the box, added to the shading normal, which has length 1.
    light: maps ``(h, 2h, 3)``.  exposure: ``(V,)`` logarithms.  pose: ``(V, 6)``, a rotation vector [rad] and a shift
    in the camera's own axes.
    """

    level: Tensor
    material: list[Tensor]
    detail: Tensor
    bend: list[Tensor]
    light: list[Tensor]
    exposure: Tensor
    pose: Tensor

    @classmethod
    def zero(cls, level: Tensor, views: int, texels: int) -> Unknowns:
        """No change of anything; ``level`` as given."""
        device = level.device
        return cls(
            level.clone(),
            [torch.zeros(n, n, n, 5, device=device, dtype=torch.float32) for n in MATERIAL_GRIDS],
            torch.zeros(texels, texels, 3, device=device, dtype=torch.float32),
            [torch.zeros(n, n, n, 3, device=device, dtype=torch.float32) for n in BEND_GRIDS],
            [torch.zeros(n, 2 * n, 3, device=device, dtype=torch.float32) for n in LIGHT_MAPS],
            torch.zeros(views, device=device, dtype=torch.float32),
            torch.zeros(views, 6, device=device, dtype=torch.float32),
        )

    def groups(self) -> dict[str, list[Tensor]]:
        """The tensors by name."""
        return {name: value if isinstance(value, list) else [value] for name, value in vars(self).items()}

    @torch.no_grad()
    def straighten(self) -> None:
        """No bend of any normal."""
        for grid in self.bend:
            grid.zero_()

    def clone(self) -> Unknowns:
        """A copy that shares nothing."""
        copy: dict[str, Any] = {
            name: [t.detach().clone() for t in value] if isinstance(value, list) else value.detach().clone()
            for name, value in vars(self).items()
        }
        return Unknowns(**copy)


@dataclass(frozen=True)
class Start:
    """What the changes count from: logits of the material on a grid ``(n, n, n, 5)``, log radiance ``(h, 2h, 3)``."""

    material: Tensor
    light: Tensor

    @classmethod
    def of(cls, asset: Asset, texels: int = 256) -> Start:
        """The start that an asset in the fit's box gives; its surface's material fills space around it."""
        found = rasterize_texels(asset.mesh, texels)
        valid = found.face.reshape(-1) >= 0
        points = surface_points(
            asset.mesh, asset.textures, found.face.reshape(-1)[valid], found.bary.reshape(-1, 2)[valid]
        )
        material = filled_grid(points.position, material_logits(points), START_GRID)
        radiance = asset.light.resized(LIGHT_ROWS).radiance
        return cls(material, radiance.clamp(min=DARKEST * float(radiance.mean())).log())


def material_logits(points: SurfacePoints) -> Tensor:
    """``(N, 5)``: logits of linear base colour, roughness in its range, and metallic."""
    rough = (points.roughness - SMOOTHEST) / (ROUGHEST - SMOOTHEST)
    values = torch.cat([points.base_color, rough[:, None], points.metallic[:, None]], 1)
    return torch.logit(values.clamp(ROOM, 1.0 - ROOM))


def material_of(logits: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Base colour ``(N, 3)`` linear, roughness and metallic ``(N,)``."""
    values = torch.sigmoid(logits)
    return values[:, :3], SMOOTHEST + (ROUGHEST - SMOOTHEST) * values[:, 3], values[:, 4]


def material_change(unknowns: Unknowns, position: Tensor) -> Tensor:
    """Change of the logits ``(N, 5)`` at ``position (N, 3)``; roughness and metallic from the coarse grids only."""
    both = space_field(unknowns.material[:FINISH_GRIDS], position)
    fine = space_field([grid[..., :3] for grid in unknowns.material[FINISH_GRIDS:]], position)
    return both + torch.cat([fine, torch.zeros_like(both[:, 3:])], 1)


def bent(unknowns: Unknowns, position: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Shading normals ``(N, 3)`` that ``normal`` becomes at ``position``, unit, and what was added ``(N, 3)``.

    What is added is shorter than ``MOST_BENT``: a normal that may turn away from the light explains black paint.
    """
    bend = space_field(unknowns.bend, position)
    bend = bend / (1.0 + (bend.square().sum(1, keepdim=True) / MOST_BENT**2)).sqrt()
    return unit(normal + bend), bend


def environment(unknowns: Unknowns, start: Start) -> Environment:
    """The light."""
    return Environment((start.light + light_field(unknowns.light, LIGHT_ROWS)).exp().contiguous())


def corrected(camera: Camera, pose: Tensor) -> Camera:
    """``camera`` turned and moved by ``pose (..., 6)`` in its own axes.  Gradients reach ``pose``.

    The turn is the Cayley map, a rotation for any vector and to second order the exponential one.
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
    """Grid ``(n, n, n, C)`` over [-1, 1]^3 of the means of ``values (N, C)`` near its points; empty ones take what lies
    around.

    Means over ever larger blocks fill what is empty (pull and push; Grossman and Dally 1998, Point Sample Rendering).
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
    coarse = torch.nn.functional.avg_pool3d(total, 2)
    around = torch.nn.functional.interpolate(_pushed(coarse), total.shape[2:], mode="trilinear", align_corners=False)
    return torch.where(total[:, -1:] > 0.0, mean, around)


def unit(value: Tensor) -> Tensor:
    """``value (..., 3)`` at length 1."""
    return normalize(value, dim=-1)
