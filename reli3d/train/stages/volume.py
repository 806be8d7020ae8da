"""Stage one: the predicted density as a volume, its materials collected along rays and lit where the ray ends."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reli3d.geometry.camera import Camera, camera_rays
from reli3d.nn.heads import truncated_exp
from reli3d.nn.model import Code, Reconstructor
from reli3d.render.bump import radial_bump
from reli3d.render.color import srgb_to_linear
from reli3d.render.gaussians import SphericalGaussians, shade_gaussians
from reli3d.render.points import SurfacePoints
from reli3d.render.volume import OccupancyGrid, composite, march_rays
from reli3d.train.stages.config import StageConfig
from reli3d.train.stages.picture import Picture, display

EMPTY = 1e-3  # opacity of a step below which a cell is not asked
FAINT = 1e-2  # opacity of a ray below which it is not lit: it shows a hundredth of what it hits
APART = 0.02  # of the cube's half side: where the density is asked for its slope


def density(model: Reconstructor, raw: Tensor) -> Tensor:
    """Density per model unit of the ``density`` head's raw values."""
    return truncated_exp(raw + model.preset.density_bias)


def occupied(model: Reconstructor, code: Code, stage: StageConfig) -> OccupancyGrid:
    """Cells that a ray may not skip; no gradient."""
    radius = model.preset.radius
    step = 2.0 * radius / stage.samples_along

    def field(points: Tensor) -> Tensor:
        return density(model, model.query(code, points[None], ("density",))["density"][0, :, 0])

    return OccupancyGrid.of_density(field, stage.grid, radius, threshold=EMPTY / step, device=code.latent.device)


def slope_normals(model: Reconstructor, code: Code, points: Tensor) -> Tensor:
    """Unit normals ``(N, 3)`` against the slope of the raw density, by differences over a tetrahedron.

    Raw values, not densities: these differ by powers of ten.  No second derivative of the network is needed.
    """
    corners = points.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    around = (points[:, None] + APART * model.preset.radius * corners).reshape(1, -1, 3)
    raw = model.query(code, around, ("density",))["density"].reshape(-1, 4, 1)
    return normalize(-(raw * corners).sum(1), dim=-1, eps=1e-6)


def render_volume(
    model: Reconstructor,
    code: Code,
    camera: Camera,
    light: SphericalGaussians,
    grid: OccupancyGrid,
    stage: StageConfig,
    seed: int,
) -> Picture:
    """The view of one object from ``camera``; samples lie at random places of their steps, drawn from ``seed``.

    Material is the mean along the ray; light falls on the mean depth, on the normal of the density's slope there, bent
    by the bump that is predicted there.  Gradients reach the network.
    """
    origins, directions = (r.reshape(-1, 3).contiguous() for r in camera_rays(camera))
    step = 2.0 * model.preset.radius / stage.samples_along
    shift = torch.rand(len(origins), generator=torch.Generator().manual_seed(seed)).clamp(max=0.999999)
    samples = march_rays(origins, directions, grid, step, shift=shift.to(origins.device))
    raw = model.query(
        code, samples.positions(origins, directions)[None], ("density", "base_color", "roughness", "metallic")
    )
    raw = {name: value[0] for name, value in raw.items()}
    sigma = density(model, raw["density"][:, 0])
    first = composite(sigma, raw["base_color"].contiguous(), samples)
    rest = torch.cat([raw["roughness"], raw["metallic"], torch.zeros_like(raw["metallic"])], -1)
    material = torch.cat([first.color, composite(sigma, rest, samples).color[:, :2]], -1)
    opacity = first.opacity
    at = torch.nonzero(opacity.detach() > FAINT)[:, 0]
    whole = opacity.index_select(0, at)[:, None]
    depth = first.depth.index_select(0, at)[:, None] / whole
    position = origins[at] + directions[at] * depth
    normal = slope_normals(model, code, position)
    bump = model.query(code, position[None], ("normal",))["normal"][0]
    bent = radial_bump(position, normal, bump)
    bent = normalize(bent + normal - normal.detach(), dim=-1)  # its slope in the normal: the frame has none
    of_ray = (material.index_select(0, at) / whole).clamp(0.0, 1.0)  # rounding of the sum
    points = SurfacePoints(
        position.detach(), normal.detach(), bent, srgb_to_linear(of_ray[:, :3]), of_ray[:, 3], of_ray[:, 4]
    )
    lit = display(shade_gaussians(points, -directions[at], light))
    shape = (camera.height, camera.width)
    values = torch.cat([lit * whole, torch.ones_like(whole), of_ray, bent], -1)
    full = values.new_zeros(len(origins), values.shape[1]).index_copy(0, at, values).reshape(*shape, -1)
    return Picture(full[..., :3], opacity.reshape(shape), full[..., 3], full[..., 4:9], full[..., 9:], bump)
