"""Volume rendering of the predicted density, with deferred shading of the material composited along each ray."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reli3d.geometry.camera import Camera, camera_rays
from reli3d.nn.model import Code, Reconstructor
from reli3d.render.bump import radial_bump
from reli3d.render.color import srgb_to_linear
from reli3d.render.gaussians import SphericalGaussians, shade_gaussians
from reli3d.render.points import SurfacePoints
from reli3d.render.volume import OccupancyGrid, composite, march_rays
from reli3d.train.stages.config import StageConfig
from reli3d.train.stages.rendering import Rendering, display

MIN_STEP_OPACITY = 1e-3  # of a step; cells below it are skipped
MIN_RAY_OPACITY = 1e-2  # of a ray; rays below it are not shaded
GRADIENT_STEP = 0.02  # of the cube's half side: finite-difference step of the density gradient


def occupied(model: Reconstructor, code: Code, stage: StageConfig) -> OccupancyGrid:
    """Occupancy grid of the cells that rays must sample; without gradient."""
    radius = model.preset.radius
    step = 2.0 * radius / stage.samples_along

    def field(points: Tensor) -> Tensor:
        return model.density(model.query(code, points[None], ("density",))["density"][0, :, 0])

    threshold = MIN_STEP_OPACITY / step
    return OccupancyGrid.of_density(field, stage.grid, radius, threshold=threshold, device=code.latent.device)


def density_normals(model: Reconstructor, code: Code, points: Tensor) -> Tensor:
    """Unit normals ``(N, 3)``: negative gradient of the raw density, by differences over a tetrahedron."""
    corners = points.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    around = (points[:, None] + GRADIENT_STEP * model.preset.radius * corners).reshape(1, -1, 3)
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
) -> Rendering:
    """Rendering of one object from ``camera``, shaded at the expected depth.  seed: of the jittered samples."""
    origins, directions = (r.reshape(-1, 3).contiguous() for r in camera_rays(camera))
    step = 2.0 * model.preset.radius / stage.samples_along
    shift = torch.rand(len(origins), generator=torch.Generator().manual_seed(seed)).clamp(max=0.999999)
    samples = march_rays(origins, directions, grid, step, shift=shift.to(origins.device))
    along, heads = samples.positions(origins, directions), ("density", "base_color", "roughness", "metallic")
    raw = {name: value[0] for name, value in model.query(code, along[None], heads).items()}
    sigma = model.density(raw["density"][:, 0])
    first = composite(sigma, raw["base_color"].contiguous(), samples)
    rest = torch.cat([raw["roughness"], raw["metallic"], torch.zeros_like(raw["metallic"])], -1)
    material = torch.cat([first.color, composite(sigma, rest, samples).color[:, :2]], -1)
    opacity = first.opacity
    at = torch.nonzero(opacity.detach() > MIN_RAY_OPACITY)[:, 0]
    whole = opacity.index_select(0, at)[:, None]
    depth = first.depth.index_select(0, at)[:, None] / whole
    position = origins[at] + directions[at] * depth
    normal = density_normals(model, code, position)
    bump = model.query(code, position[None], ("normal",))["normal"][0]
    bumped = radial_bump(position, normal, bump)
    bumped = normalize(bumped + normal - normal.detach(), dim=-1)  # gradient to the normal: the frame has none
    of_ray = (material.index_select(0, at) / whole).clamp(0.0, 1.0)  # clamps rounding errors
    points = SurfacePoints(
        position.detach(), normal.detach(), bumped, srgb_to_linear(of_ray[:, :3]), of_ray[:, 3], of_ray[:, 4]
    )
    lit = display(shade_gaussians(points, -directions[at], light))
    shape = (camera.height, camera.width)
    values = torch.cat([lit * whole, torch.ones_like(whole), of_ray, bumped], -1)
    full = values.new_zeros(len(origins), values.shape[1]).index_copy(0, at, values).reshape(*shape, -1)
    return Rendering(full[..., :3], opacity.reshape(shape), full[..., 3], full[..., 4:9], full[..., 9:], bump)
