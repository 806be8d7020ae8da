"""Renders assets: primary visibility, materials, direct lighting with shadows, background, subpixel averaging.

Radiance gradients reach the textures, the environment texels, and the mesh's normals, tangents, colors and UV; they
reach the vertices only if the mesh has no vertex normals, because shading then uses the face normals.  ``alpha`` has no
gradient.  The motion of silhouettes and shadow boundaries contributes to no gradient.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reli3d._bridge import expect, full_precision
from reli3d.geometry.camera import Camera, box_of, camera_rays
from reli3d.geometry.mesh import joined
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import surface_points
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import DEFAULT, ShadeOptions, shade

if TYPE_CHECKING:
    from reli3d.render.allocation import SamplePlan

PLAN_RAYS = 32768  # of a view, whose hits are candidates for the points of the pilot
BAND_RAYS = 1 << 18  # rays of one band of rows: bounds memory at about 40 MB whatever the image size


@dataclass(frozen=True)
class Render:
    """Result of :func:`render_asset`: radiance, coverage and G-buffers of one image.

    radiance: ``(H, W, 3)`` linear Rec. 709, mean over all subpixels: premultiplied by alpha with
    ``background="transparent"``, composited with ``background="environment"``.  alpha: ``(H, W)`` coverage of the
    object in [0, 1], for both backgrounds.  The G-buffers are means over the covered subpixels: base_color ``(H, W,
    3)`` linear; roughness, metallic ``(H, W)``; normal ``(H, W, 3)`` shading normal in the world frame, normalized
    after averaging; position ``(H, W, 3)`` world; depth ``(H, W)`` along the viewing axis.  Where alpha is 0, depth is
    inf and the other G-buffers are 0.  Gradients: see :func:`render_asset`.

    >>> image = reli3d.render_asset(asset, camera, light)
    >>> reli3d.write_image("image.png", image.rgba)
    """

    radiance: Tensor
    alpha: Tensor
    base_color: Tensor
    roughness: Tensor
    metallic: Tensor
    normal: Tensor
    position: Tensor
    depth: Tensor

    @property
    def rgba(self) -> Tensor:
        """``(H, W, 4)``: premultiplied radiance and alpha, for :func:`reli3d.write_image`.

        Only valid with ``background="transparent"``.  With ``background="environment"``, save ``radiance``: it includes
        the background, which ``alpha`` does not, and a PNG file stores colors divided by alpha.
        """
        return torch.cat([self.radiance, self.alpha[..., None]], -1)

    def display(
        self, *, exposure: float = 0.0, tone: Callable[[Tensor], Tensor] = linear_to_srgb, transparent: bool = True
    ) -> Tensor:
        """Display values in [0, 1]: ``(H, W, 4)`` with straight alpha, or ``(H, W, 3)`` if not ``transparent``.

        For screens: :func:`write_image` would encode it again; for a file, scale the color of ``rgba`` instead.
        exposure: in stops.  tone: transform from linear radiance to display values.  transparent: use False for images
        rendered with ``background="environment"``.
        """
        radiance = self.radiance * 2.0**exposure
        if transparent:  # tone mapping is nonlinear and needs straight color
            radiance = radiance / self.alpha[..., None].clamp(min=1e-6)
        shown = tone(radiance).clamp(0.0, 1.0)
        return torch.cat([shown, self.alpha[..., None]], -1) if transparent else shown


@full_precision
def render_asset(
    asset: Asset | Sequence[Asset],
    camera: Camera,
    environment: Environment | None = None,
    *,
    options: ShadeOptions = DEFAULT,
    supersampling: int = 1,
    shadows: bool = True,
    background: str = "transparent",
    scene: RayScene | None = None,
) -> Render:
    """Renders ``asset``, or several that shadow each other, under an environment with direct lighting and shadows.

    Without textures: a dielectric with base color and roughness 0.5.  environment: None: the first of an asset.
    supersampling: k x k rays per pixel, each with all samples.  background: ``transparent`` or ``environment``
    (then save ``radiance``, not ``rgba``).  scene: of all meshes, concatenated in order; None: built in each call.

    Gradients as in :func:`surface_points` and :func:`shade`, at constant hits and visibility; depth's also reach the
    camera; silhouettes' need :func:`antialias`.  Raises TypeError for a wrong type; ValueError without environment or
    UV, for a batch of cameras or an unknown background.

    >>> camera = reli3d.Camera.from_fov(reli3d.look_at([0.0, 0.5, 3.0]), 0.7, 512, 512)
    >>> image = reli3d.render_asset(asset, camera, reli3d.Environment.constant(torch.ones(3)), supersampling=2)
    """
    (image,) = render_lights(
        asset,
        camera,
        (environment,),
        options=options,
        supersampling=supersampling,
        shadows=shadows,
        background=background,
        scene=scene,
    )
    return image


@full_precision
def render_lights(
    asset: Asset | Sequence[Asset],
    camera: Camera,
    environments: Sequence[Environment | None],
    *,
    options: ShadeOptions = DEFAULT,
    supersampling: int = 1,
    shadows: bool = True,
    background: str = "transparent",
    scene: RayScene | None = None,
) -> list[Render]:
    """:func:`render_asset` under each of ``environments``, bitwise equal to single calls.

    Primary hits and materials are evaluated once; all images share every field except ``radiance``.  The other
    arguments are those of :func:`render_asset`.
    """
    parts, lights = _checked(asset, camera, environments)
    if background not in ("transparent", "environment"):
        raise ValueError(f"background: expected transparent or environment, got {background}")
    scene = scene if scene is not None else joined_scene(parts)
    expect("scene", scene, RayScene)
    if supersampling < 1:
        raise ValueError(f"supersampling: expected at least 1, got {supersampling}")
    fine = camera.scaled(supersampling)
    band = max(1, BAND_RAYS // (fine.width * supersampling)) * supersampling
    bands = []
    for row in range(0, fine.height, band):
        rows = min(band, fine.height - row)
        part = Camera(fine.c2w, fine.intrinsics - fine.intrinsics.new_tensor([0.0, 0.0, 0.0, row]), fine.width, rows)
        layers = _band(parts, part, lights, scene, row * fine.width, shadows, background, options)
        bands.append([_resolve(layer, supersampling) for layer in layers])  # one at a time: they are large
    *radiances, alpha, base_color, orm, normal, position, depth = (torch.cat(p) for p in zip(*bands))
    cover = alpha.clamp(min=1e-6)  # alpha is 0 or at least 1 / supersampling^2
    roughness, metallic = (orm / cover).unbind(-1)
    inside = alpha[..., 0] > 0.0
    depth = torch.where(inside, (depth / cover)[..., 0], torch.inf)
    normal, position = normalize(normal, dim=-1), position / cover
    shared = alpha[..., 0], base_color / cover, roughness, metallic, normal, position, depth
    return [Render(radiance, *shared) for radiance in radiances]


@full_precision
def plan_render(
    asset: Asset | Sequence[Asset],
    camera: Camera,
    environment: Environment | None = None,
    *,
    total: int = 64,
    options: ShadeOptions = DEFAULT,
    shadows: bool = True,
    scene: RayScene | None = None,
    relative: bool = False,
) -> "SamplePlan":
    """Divides ``total`` samples among the strategies to minimize the noise of :func:`render_asset` for this view.

    Use the plan's counts with ``antithetic="none"``.  Arguments as in :func:`render_asset`; total, relative: as in
    :func:`reli3d.render.allocation.plan_samples`, which is applied to the hits of 32768 camera rays.  No gradient.
    Raises ValueError without an environment or if no ray hits the asset.
    """
    from reli3d.render.allocation import plan_samples, spread_rows  # lazily: few images have a plan

    parts, (light,) = _checked(asset, camera, (environment,))
    scene = scene if scene is not None else joined_scene(parts)
    origins, directions = (v.reshape(-1, 3) for v in camera_rays(camera))
    rays = spread_rows(len(directions), min(len(directions), PLAN_RAYS), options.seed).to(directions.device)
    directions = directions[rays]
    hits = scene.closest(origins[rays], directions)
    seen = hits.face >= 0
    if not bool(seen.any()):
        raise ValueError(f"camera: expected the asset in view, got {len(rays)} rays without a hit")
    points = _points(parts, hits.face[seen], hits.bary[seen])
    shadowed, wo = scene if shadows else None, -directions[seen]
    return plan_samples(points, wo, light, total=total, scene=shadowed, options=options, relative=relative)


def _checked(
    asset: Asset | Sequence[Asset], camera: Camera, environments: Sequence[Environment | None]
) -> tuple[list[Asset], list[Environment]]:
    """The parts, and the environments, with None replaced by that of the first part that has one."""
    parts: list[Asset] = list(asset) if isinstance(asset, (list, tuple)) else [asset]  # type: ignore[list-item]
    for part in parts:
        expect("asset", part, Asset)
    expect("camera", camera, Camera)
    own = next((p.environment for p in parts if p.environment is not None), None)
    lights = [light if light is not None else own for light in environments]
    found = [light for light in lights if light is not None]
    if len(found) < len(lights):
        raise ValueError("environment: expected one, got None from the argument and from the asset")
    if camera.c2w.ndim != 2:
        raise ValueError(f"camera.c2w: expected one camera (4, 4), got {tuple(camera.c2w.shape)}")
    return parts, found


def joined_scene(parts: Sequence[Asset]) -> RayScene:
    """Acceleration structure over all ``parts``; face indices continue from one part to the next."""
    if not parts:
        raise ValueError("parts: expected at least one asset, got none")
    return RayScene(joined([part.mesh.detach() for part in parts]))


def _points(parts: Sequence[Asset], face: Tensor, bary: Tensor) -> SurfacePoints:
    """Surface points of hits on :func:`joined_scene`, in the order of the hits."""
    if len(parts) == 1:
        return surface_points(parts[0].mesh, parts[0].textures, face, bary)
    first, pieces, order = 0, [], []
    for part in parts:
        count = len(part.mesh.faces)
        chosen = torch.nonzero((face >= first) & (face < first + count))[:, 0]
        pieces.append(surface_points(part.mesh, part.textures, face[chosen] - first, bary[chosen]))
        order.append(chosen)
        first += count
    back = torch.argsort(torch.cat(order))
    return SurfacePoints(*(torch.cat(columns)[back] for columns in zip(*(vars(p).values() for p in pieces))))


def _band(parts, camera, lights, scene, first, shadows, background, options) -> Iterator[Tensor]:
    """Premultiplied layers ``(rows, W, C)`` of a band of subpixels: radiance under each environment, then G-buffers."""
    whole = (0, 0, camera.width, camera.height)
    left, top, right, bottom = box_of(scene.vertices, camera) if background == "transparent" else whole
    corner = camera.intrinsics.new_tensor([0.0, 0.0, left, top])  # integers: rays are bitwise unchanged
    inner = Camera(camera.c2w, camera.intrinsics - corner, right - left, bottom - top)
    origins, directions = (v.reshape(-1, 3) for v in camera_rays(inner))
    hits = scene.closest(origins, directions)
    seen = torch.nonzero(hits.face >= 0)[:, 0]
    index = (seen // inner.width + top) * camera.width + seen % inner.width + left
    points = _points(parts, hits.face[seen], hits.bary[seen])
    shadowed, pixels, wo = scene if shadows else None, (index + first).int(), -directions[seen]
    lit = [shade(points, wo, light, scene=shadowed, options=options, pixels=pixels) for light in lights]
    axis = -camera.c2w[:3, 2]
    depth = ((points.position - camera.position) * axis).sum(-1, keepdim=True)
    rough_metal = torch.stack([points.roughness, points.metallic], -1)
    layers = [*lit, torch.ones_like(depth), points.base_color, rough_metal, points.normal, points.position, depth]
    for k, layer in enumerate(layers):
        image = layer.new_zeros(camera.height * camera.width, layer.shape[1]).index_copy(0, index, layer)
        if background == "environment" and k < len(lights):
            image = torch.where((hits.face >= 0)[:, None], image, lights[k].lookup(directions))
        yield image.reshape(camera.height, camera.width, -1)


def _resolve(layer: Tensor, factor: int) -> Tensor:
    """Box mean over ``factor`` x ``factor`` subpixels of ``(H, W, C)``."""
    if factor == 1:
        return layer
    height, width, channels = layer.shape
    layer = layer.reshape(height // factor, factor, width // factor, factor, channels)
    if factor == 2:  # the sums that torch makes for the mean, in a quarter of its time
        pairs = layer[:, :, :, 0] + layer[:, :, :, 1]
        return (pairs[:, 0] + pairs[:, 1]) / 4.0
    return layer.mean((1, 3))
