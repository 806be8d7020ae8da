"""One picture of a reconstruction: what went in, and what comes out where nobody looked."""

from __future__ import annotations

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

TILE = 256  # pixels
COLUMNS = 4
TITLE = 14  # pixels of a line of text
SUBPIXELS = 2  # a side of a pixel
SAMPLES = (2, 1, 1)  # light, GGX and cosine samples a subpixel
WINDOW = 2  # pixels that noise is averaged over, to each side
SAME_NORMAL = 0.2  # length of a difference of normals above which pixels are averaged little
GLOSS = 0.1  # added to the base colour: highlights do not have it
PAPER = 0.93  # background of the tiles, sRGB
MEAN = 0.25  # of the environment as it is drawn, linear
FOV = math.radians(30.0)
ELEVATIONS = (5.0, 30.0)  # degrees, of views that nobody took
AZIMUTHS = 24  # places around the object to choose from


def preview(asset: Asset, views: Views, scene: RayScene | None = None) -> Callable[[], np.ndarray]:
    """Begin to render a picture beside the caller's work; the result gives it, ``(H, W, 3)`` uint8, when called.

    It shows up to four input views; four views that nobody photographed under the asset's own light, then under the
    studio of :mod:`reli3d.render.lights`; the maps of the first of them; the own light, row 0 up, centre +X as in its
    files, exposed so that its mean is ``MEAN``.

    views: in the frame of ``asset``.  scene: rays against its mesh, made here if None.  An error is raised by the call,
    or at once on CUDA and where the caller computes alone.
    """
    mesh = asset.mesh
    rays = scene if scene is not None else RayScene(mesh.vertices, mesh.faces)
    lights = (asset.environment, Environment(studio().radiance.to(mesh.vertices.device)))

    def tiles(camera: Camera, with_maps: bool) -> list[Image.Image]:
        shots = _rendered(asset, camera, rays, lights)
        lit = [_lit(radiance, shots[0].alpha) for radiance in _smoothed(*shots)]
        return [_image(tile) for tile in lit + (_maps(shots[0]) if with_maps else [])]

    cameras = unseen_cameras(mesh, views.c2w)
    begun = [submit(partial(tiles, camera, k == 0), mesh.vertices.device) for k, camera in enumerate(cameras)]

    def picture() -> np.ndarray:
        taken = views.select(choose_views(views.c2w, COLUMNS)).resampled(TILE, crop=True)
        inputs = [_image(_on_paper(i, m)) for i, m in zip(taken.images, taken.masks, strict=True)]
        light = _image(_map(asset.light))
        found = [result() for result in begun]
        rows = [
            ("input", inputs),
            ("views that nobody photographed, own light", [own for own, *_ in found]),
            ("the same views in a studio", [lit for _, lit, *_ in found]),
            ("base colour, roughness, metallic, normal", found[0][2:]),
            ("own light, its mean at a quarter", [light]),
        ]
        return _sheet(rows, COLUMNS, last=TILE // 2)

    return picture


def comparison(before: Asset, after: Asset, views: Views) -> np.ndarray:
    """Picture ``(H, W, 3)`` uint8 of three views: photographs, ``before`` and ``after`` in their own light."""
    count = min(len(views), 3)
    batch = views.select([k * len(views) // count for k in range(count)]).resampled(TILE, crop=True)
    rows = [("input", [_image(_on_paper(i, m)) for i, m in zip(batch.images, batch.masks, strict=True)])]
    for title, asset in (("before", before), ("after refinement", after)):
        scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
        shots = [_rendered(asset, batch.camera[i], scene, (None,))[0] for i in range(count)]
        rows.append((title, [_image(_lit(_smoothed(s)[0], s.alpha)) for s in shots]))
    return _sheet(rows, count)


def _rendered(asset: Asset, camera: Camera, scene: RayScene, lights: Sequence[Environment | None]) -> list[Render]:
    options = ShadeOptions(samples=SAMPLES)
    return render_lights(asset, camera, lights, options=options, supersampling=SUBPIXELS, scene=scene)


def _smoothed(*shots: Render) -> list[Tensor]:
    """The radiance of each shot with less noise: its ratio to the base colour, averaged over pixels of about the same
    normal.

    shots: of one camera, in several lights.  A joint bilateral filter (Petschnigg and others 2004): Monte Carlo noise
    is in the light, edges are in the maps, and so are the weights.
    """
    shot, count = shots[0], 3 * len(shots)
    paint = (shot.base_color + GLOSS) * shot.alpha[..., None]
    ratios = [s.radiance / paint.clamp(min=1e-6) for s in shots]
    # channels first: the products with the weights then run along rows, in half the time
    guides = torch.cat([*ratios, shot.normal, shot.alpha[..., None]], -1).permute(2, 0, 1).contiguous()
    padded, normal = pad(guides, (WINDOW,) * 4), guides[count:-1]
    height, width = shot.alpha.shape
    total, weights = guides.new_zeros(count, height, width), torch.zeros_like(shot.alpha)
    for row in range(2 * WINDOW + 1):
        for column in range(2 * WINDOW + 1):
            near = padded[:, row : row + height, column : column + width]
            apart = ((row - WINDOW) ** 2 + (column - WINDOW) ** 2) / (2 * WINDOW)
            bent = (near[count:-1] - normal).square().sum(0) / SAME_NORMAL**2
            weight = torch.exp(-apart - bent) * near[-1]
            total += weight * near[:count]
            weights += weight
    means = (total / weights.clamp(min=1e-6)).permute(1, 2, 0).contiguous()
    return [mean * paint for mean in means.split(3, -1)]


def _sheet(rows: list[tuple[str, list[Image.Image]]], columns: int, *, last: int = TILE) -> np.ndarray:
    """Rows of tiles under their titles, ``(H, W, 3)`` uint8; last: height of the last row's tiles."""
    height = TITLE + TILE
    sheet = Image.new("RGB", (columns * TILE, len(rows) * height - TILE + last), "white")
    draw = ImageDraw.Draw(sheet)
    for r, (title, tiles) in enumerate(rows):
        draw.text((3, r * height + 1), title, fill="black")
        for c, tile in enumerate(tiles):
            sheet.paste(tile, (c * TILE, r * height + TITLE))
    return np.asarray(sheet)


def unseen_cameras(mesh: Mesh, c2w: Tensor) -> list[Camera]:
    """``COLUMNS`` cameras of ``TILE`` pixels around ``mesh``, each as far as can be from the cameras ``c2w`` and from
    the others, in the order of their azimuth.

    They stand at ``ELEVATIONS`` above the horizon (+Y is up), where a beholder would, and see all of the mesh.
    """
    low, high = mesh.vertices.aminmax(dim=0)
    centre = (low + high) / 2
    radius = float((mesh.vertices - centre).norm(dim=-1).max())
    azimuth = torch.arange(AZIMUTHS, dtype=torch.float32, device="cpu") * (2.0 * math.pi / AZIMUTHS)
    places = []
    for lift in map(math.radians, ELEVATIONS):
        level = torch.full_like(azimuth, math.sin(lift))
        places.append(torch.stack([azimuth.sin() * math.cos(lift), level, azimuth.cos() * math.cos(lift)], -1))
    offered = torch.cat(places).to(centre)
    nearest = (offered @ normalize(c2w[:, :3, 3] - centre, dim=-1).T).amax(1)  # cosine of the angle to what is taken
    chosen = []
    for _ in range(COLUMNS):
        chosen.append(int(nearest.argmin()))
        nearest = torch.maximum(nearest, offered @ offered[chosen[-1]])
    eyes = centre + offered[sorted(chosen, key=lambda k: k % AZIMUTHS)] * (radius / math.sin(FOV / 2))
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float32, device="cpu").to(centre)
    return [Camera.from_fov(look_at(eye, centre, up), FOV, TILE, TILE) for eye in eyes]


def _lit(radiance: Tensor, alpha: Tensor) -> Tensor:
    """Tile of premultiplied linear radiance."""
    return _on_paper(linear_to_srgb((radiance / alpha.clamp(min=1e-3)[..., None]).clamp(0, 1)), alpha)


def _on_paper(color: Tensor, alpha: Tensor) -> Tensor:
    return torch.lerp(torch.full_like(color, PAPER), color, alpha[..., None])


def _maps(shot: Render) -> list[Tensor]:
    """Tiles of what was rendered: base colour, roughness, metallic, normal."""
    grey = (value[..., None].expand(-1, -1, 3) for value in (shot.roughness, shot.metallic))
    shown = (linear_to_srgb(shot.base_color), *grey, shot.normal * 0.5 + 0.5)
    return [_on_paper(tile, shot.alpha) for tile in shown]


def _map(light: Environment) -> Tensor:
    """The light as a tile of half the height."""
    radiance = light.radiance
    shown = linear_to_srgb((radiance * (MEAN / radiance.mean().clamp(min=1e-6))).clamp(0, 1)).permute(2, 0, 1)[None]
    return interpolate(shown, (TILE // 2, TILE), mode="bilinear", align_corners=False)[0].permute(1, 2, 0)


def _image(pixels: Tensor) -> Image.Image:
    return Image.fromarray((pixels.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy())
