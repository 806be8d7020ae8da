"""The lighting from which a fit starts: its transfer against path samples, and a sun that the start lacks."""

from dataclasses import replace

import pytest
import torch

from reli3d.fit.input_images import InputImages
from reli3d.fit.light_start import light_transfer, solve_lighting
from reli3d.fit.lighting import Lights
from reli3d.fit.maps import FixedSurface, traced
from reli3d.fit.unknowns import Start, Unknowns
from reli3d.geometry.camera import Camera
from reli3d.geometry.rays import RayScene
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.image import render_asset
from reli3d.render.latlong import lat_long_directions, texel_solid_angles
from reli3d.render.shading import ShadeOptions, shade
from tests.support import small_scene

VIEWS, SIZE, SUN = 6, 32, (4, 10)  # row and column of 16 by 32 texels


def sunny() -> Environment:
    """An even light and a sun of one texel, with three times its irradiance."""
    radiance = torch.full((16, 32, 3), 0.15)
    angle = float(texel_solid_angles(16, 32)[SUN[0]])
    radiance[SUN] = 3.0 * 0.15 * torch.pi / angle * torch.tensor([1.1, 1.0, 0.8])
    return Environment(radiance)


def solved(views, light: str) -> torch.Tensor:
    """Radiance ``(32, 64, 3)`` solved from an even light; the material is the true one."""
    images = InputImages.of(views, light)
    first = replace(small_scene.ball(), environment=Environment(torch.full((16, 32, 3), 0.5)))
    unknowns = Unknowns.zero(torch.ones(2, 2, 2), VIEWS, small_scene.TEXELS)
    none = torch.zeros_like(first.mesh.vertices)
    data = FixedSurface(Start.of(first), first, none, images, list(range(VIEWS)))
    scene = RayScene(first.mesh.vertices, first.mesh.faces)
    solve_lighting(unknowns, data, traced(data, scene, seed=0), scene)
    return Lights.of(unknowns, data.start, images).maps[0]


def rendered(lights):
    """The ball from all around, each view under ``lights(rotation of the camera)``."""
    batch, images = small_scene.input_views(small_scene.ball(), VIEWS, SIZE), []
    for k in range(VIEWS):
        camera = Camera(batch.c2w[k], batch.intrinsics[k], SIZE, SIZE)
        options = ShadeOptions(samples=(32, 16, 8), diffuse_model="published")
        image = render_asset(small_scene.ball(), camera, lights(batch.c2w[k, :3, :3]), options=options)
        images.append(linear_to_srgb((image.radiance / image.alpha.clamp(min=1e-3)[..., None]).clamp(0, 1)))
    return replace(batch, images=torch.stack(images))


def in_camera_axes(rotation: torch.Tensor) -> Environment:
    directions = lat_long_directions(32, 64).float().reshape(-1, 3)
    return Environment(sunny().lookup((directions @ rotation).contiguous()).reshape(32, 64, 3))


@pytest.mark.parametrize(("light", "lights"), [("object", lambda _: sunny()), ("camera", in_camera_axes)])
def test_a_sun_is_found_from_an_even_light(light, lights):
    found = solved(rendered(lights), light)
    direction = lat_long_directions(16)[SUN].float()
    brightest = lat_long_directions(32).reshape(-1, 3)[found.sum(-1).argmax()].float()
    assert float(brightest @ direction) > 0.97  # 14 degrees: a texel of the solved map
    normals = torch.randn(200, 3, generator=torch.Generator().manual_seed(1))
    normals = normals / normals.norm(dim=1, keepdim=True)
    normals = normals[normals[:, 2] > 0.3]  # those that a camera sees, in its axes
    got, expected = (irradiance(e, normals) for e in (Environment(found.contiguous()), sunny()))
    assert ((got - expected).abs() / expected).mean() < 0.08  # one texel of the upsampled map spreads to its neighbors


def irradiance(light: Environment, normals: torch.Tensor) -> torch.Tensor:
    """``(N, 3)``, by the sum over texels."""
    height, width = light.radiance.shape[:2]
    cosine = (normals @ lat_long_directions(height, width).float().reshape(-1, 3).T).clamp(min=0.0)
    weight = texel_solid_angles(height, width).float()[:, None].expand(height, width).reshape(-1)
    return (cosine * weight) @ light.radiance.reshape(-1, 3)


def test_the_transfer_times_the_radiance_is_the_light_on_the_points():
    asset = small_scene.two_colored(small_scene.ball(squeeze=0.4))
    scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
    points = small_scene.centers(asset)[::20]
    wo = torch.nn.functional.normalize(points.normal + torch.tensor([0.3, 0.2, -0.1]), dim=-1)
    got = torch.einsum("njc,jc->nc", light_transfer(points, wo, scene, 16), small_scene.sky().radiance.reshape(-1, 3))
    options = ShadeOptions(samples=(256, 256, 64), diffuse_model="published", seed=2)
    expected = shade(points, wo, small_scene.sky(), scene=scene, options=options)
    assert ((got - expected).abs() / expected).mean() < 0.02  # quadrature with 512 directions
