"""Contact sheet of a reconstruction: input images, novel views, maps and environment."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn.functional import interpolate, normalize, pad

from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.nn.blocks import submit
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.image import Render, render_lights
from reli3d.render.lights import studio
from reli3d.render.shading import ShadeOptions
from reli3d.views.choose import choose_views
from reli3d.views.views import Views

TILE_PIXELS = 256  # pixels
COLUMNS = 4
TITLE = 14  # pixels of a line of text
SUBPIXELS = 2  # a side of a pixel
SUBPIXEL_SAMPLES = (2, 1, 1)  # of light, GGX and cosine
FILTER_RADIUS = 2  # pixels
NORMAL_SIGMA = 0.2  # of the range kernel: length of the difference of unit normals
SPECULAR_ALBEDO = 0.1  # added to the base color: highlights are not multiplied by it
BACKGROUND = 0.93  # of the tiles, sRGB
ENVIRONMENT_MEAN = 0.25  # linear, as displayed
FOV = math.radians(30.0)
ELEVATIONS = (5.0, 30.0)  # degrees, of the novel views
AZIMUTHS = 24  # number of candidates


def preview(asset: Asset, views: Views, scene: RayScene | None = None) -> Callable[[], np.ndarray]:
    """Starts rendering the contact sheet in the pool; calling the result returns the sheet, ``(H, W, 3)`` uint8.

    It shows up to four input views; four novel views under the estimated lighting, then under the studio of
    :mod:`reli3d.render.lights`; the maps of the first; and the environment as in files, scaled to ``ENVIRONMENT_MEAN``.

    views: in the frame of ``asset``.  scene: rays against the asset's mesh; None: built here.
    """
    mesh = asset.mesh
    rays = scene or RayScene(mesh.vertices, mesh.faces)
    lights = (asset.environment, Environment(studio().radiance.to(mesh.vertices.device)))

    def tiles(camera: Camera, with_maps: bool) -> list[Image.Image]:
        renderings = _rendered(asset, camera, rays, lights)
        lit = [_lit(radiance, renderings[0].alpha) for radiance in _denoised(*renderings)]
        return [_image(tile) for tile in lit + (_maps(renderings[0]) if with_maps else [])]

    cameras = unseen_cameras(mesh, views.c2w)
    begun = [submit(partial(tiles, camera, k == 0), mesh.vertices.device) for k, camera in enumerate(cameras)]

    def sheet() -> np.ndarray:
        taken = views.select(choose_views(views.c2w, COLUMNS)).resampled(TILE_PIXELS, crop=True)
        inputs = [_image(_on_background(i, m)) for i, m in zip(taken.images, taken.masks, strict=True)]
        light = _image(_map(asset.light))
        found = [result() for result in begun]
        rows = [
            ("input", inputs),
            ("novel views, estimated lighting", [estimated for estimated, *_ in found]),
            ("the same views, studio lighting", [lit for _, lit, *_ in found]),
            ("base color, roughness, metallic, normal", found[0][2:]),
            ("estimated environment, scaled to a mean of 0.25", [light]),
        ]
        return _sheet(rows, COLUMNS, last=TILE_PIXELS // 2)

    return sheet


def comparison(before: Asset, after: Asset, views: Views) -> np.ndarray:
    """Contact sheet ``(H, W, 3)`` uint8 of three views: input images, ``before``, ``after``, in their own lighting."""
    count = min(len(views), 3)
    batch = views.select([k * len(views) // count for k in range(count)]).resampled(TILE_PIXELS, crop=True)
    rows = [("input", [_image(_on_background(i, m)) for i, m in zip(batch.images, batch.masks, strict=True)])]
    for title, asset in (("before", before), ("after refinement", after)):
        scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
        renderings = [_rendered(asset, batch.camera[i], scene, (None,))[0] for i in range(count)]
        rows.append((title, [_image(_lit(_denoised(s)[0], s.alpha)) for s in renderings]))
    return _sheet(rows, count)


def _rendered(asset: Asset, camera: Camera, scene: RayScene, lights: Sequence[Environment | None]) -> list[Render]:
    options = ShadeOptions(samples=SUBPIXEL_SAMPLES)
    return render_lights(asset, camera, lights, options=options, supersampling=SUBPIXELS, scene=scene)


def _denoised(*renderings: Render) -> list[Tensor]:
    """Radiances denoised over base color by a joint bilateral filter (Petschnigg et al. 2004)."""
    rendering, count = renderings[0], 3 * len(renderings)
    albedo = (rendering.base_color + SPECULAR_ALBEDO) * rendering.alpha[..., None]
    ratios = [s.radiance / albedo.clamp(min=1e-6) for s in renderings]
    # channels first: the products with the weights then run along rows, in half the time
    guides = torch.cat([*ratios, rendering.normal, rendering.alpha[..., None]], -1).permute(2, 0, 1).contiguous()
    padded, normal = pad(guides, (FILTER_RADIUS,) * 4), guides[count:-1]
    height, width = rendering.alpha.shape
    total, weights = guides.new_zeros(count, height, width), torch.zeros_like(rendering.alpha)
    for row in range(2 * FILTER_RADIUS + 1):
        for column in range(2 * FILTER_RADIUS + 1):
            near = padded[:, row : row + height, column : column + width]
            distance = ((row - FILTER_RADIUS) ** 2 + (column - FILTER_RADIUS) ** 2) / (2 * FILTER_RADIUS)
            difference = (near[count:-1] - normal).square().sum(0) / NORMAL_SIGMA**2
            weight = torch.exp(-distance - difference) * near[-1]
            total += weight * near[:count]
            weights += weight
    means = (total / weights.clamp(min=1e-6)).permute(1, 2, 0).contiguous()
    return [mean * albedo for mean in means.split(3, -1)]


def _sheet(rows: list[tuple[str, list[Image.Image]]], columns: int, *, last: int = TILE_PIXELS) -> np.ndarray:
    """Rows of tiles under their titles, ``(H, W, 3)`` uint8; last: height of the last row's tiles."""
    height = TITLE + TILE_PIXELS
    sheet = Image.new("RGB", (columns * TILE_PIXELS, len(rows) * height - TILE_PIXELS + last), "white")
    draw = ImageDraw.Draw(sheet)
    for r, (title, tiles) in enumerate(rows):
        draw.text((3, r * height + 1), title, fill="black")
        for c, tile in enumerate(tiles):
            sheet.paste(tile, (c * TILE_PIXELS, r * height + TITLE))
    return np.asarray(sheet)


def unseen_cameras(mesh: Mesh, c2w: Tensor) -> list[Camera]:
    """Selects ``COLUMNS`` cameras of ``TILE_PIXELS`` pixels around ``mesh``, ordered by azimuth.

    Each is farthest in direction from the cameras ``c2w`` and those already selected.  Elevations above the horizon are
    ``ELEVATIONS`` (+Y is up), and the whole mesh is in view.
    """
    low, high = mesh.vertices.aminmax(dim=0)
    center = (low + high) / 2
    radius = float((mesh.vertices - center).norm(dim=-1).max())
    azimuth = torch.arange(AZIMUTHS, dtype=torch.float32, device="cpu") * (2.0 * math.pi / AZIMUTHS)
    places = []
    for lift in map(math.radians, ELEVATIONS):
        height_above = torch.full_like(azimuth, math.sin(lift))
        places.append(torch.stack([azimuth.sin() * math.cos(lift), height_above, azimuth.cos() * math.cos(lift)], -1))
    offered = torch.cat(places).to(center)
    nearest = (offered @ normalize(c2w[:, :3, 3] - center, dim=-1).T).amax(1)  # cosine of the angle to the nearest view
    chosen = []
    for _ in range(COLUMNS):
        chosen.append(int(nearest.argmin()))
        nearest = torch.maximum(nearest, offered @ offered[chosen[-1]])
    eyes = center + offered[sorted(chosen, key=lambda k: k % AZIMUTHS)] * (radius / math.sin(FOV / 2))
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float32, device="cpu").to(center)
    return [Camera.from_fov(look_at(eye, center, up), FOV, TILE_PIXELS, TILE_PIXELS) for eye in eyes]


def _lit(radiance: Tensor, alpha: Tensor) -> Tensor:
    return _on_background(linear_to_srgb((radiance / alpha.clamp(min=1e-3)[..., None]).clamp(0, 1)), alpha)


def _on_background(color: Tensor, alpha: Tensor) -> Tensor:
    return torch.lerp(torch.full_like(color, BACKGROUND), color, alpha[..., None])


def _maps(rendering: Render) -> list[Tensor]:
    """Tiles of the material layers: base color, roughness, metallic, normal."""
    gray = (value[..., None].expand(-1, -1, 3) for value in (rendering.roughness, rendering.metallic))
    shown = (linear_to_srgb(rendering.base_color), *gray, rendering.normal * 0.5 + 0.5)
    return [_on_background(tile, rendering.alpha) for tile in shown]


def _map(light: Environment) -> Tensor:
    """The environment as a tile of half the height."""
    radiance = light.radiance
    exposed = (radiance * (ENVIRONMENT_MEAN / radiance.mean().clamp(min=1e-6))).clamp(0, 1)
    shown = linear_to_srgb(exposed).permute(2, 0, 1)[None]
    return interpolate(shown, (TILE_PIXELS // 2, TILE_PIXELS), mode="bilinear", align_corners=False)[0].permute(1, 2, 0)


def _image(pixels: Tensor) -> Image.Image:
    return Image.fromarray((pixels.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy())
