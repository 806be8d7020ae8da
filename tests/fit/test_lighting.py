"""Lighting that moves with the camera or differs between groups of views is recovered, and relights as a fixed one."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch.nn.functional import normalize

from reli3d.fit import light_frame, maps
from reli3d.fit.bounce import gathered
from reli3d.fit.budget import Budget, Part
from reli3d.fit.input_images import InputImages
from reli3d.fit.light_frame import explained_deviations, light_follows_camera
from reli3d.fit.lighting import Lights, radiance
from reli3d.fit.losses import Weights
from reli3d.fit.maps import FixedSurface
from reli3d.fit.refine import RefineOptions, refine
from reli3d.fit.transfer import changed
from reli3d.fit.unknowns import Start, Unknowns
from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import TextureSet
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import primary_hits
from reli3d.render.image import render_asset
from reli3d.render.latlong import lat_long_directions, texel_solid_angles
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions
from reli3d.views.views import ViewBatch
from tests.support import small_scene

VIEWS, SIZE, STEPS = 6, 28, 30
OPTIONS = ShadeOptions(samples=(24, 8, 8), diffuse_model="published")


def input_views(lights):
    """The two-colored ball from all around, each view under the lighting ``lights(rotation of the camera)``."""
    true, views = small_scene.two_colored(small_scene.ball()), []
    batch = small_scene.input_views(small_scene.ball(), VIEWS, SIZE)
    for k in range(VIEWS):
        camera = Camera(batch.c2w[k], batch.intrinsics[k], SIZE, SIZE)
        image = render_asset(true, camera, lights(k, batch.c2w[k, :3, :3]), options=OPTIONS, supersampling=2)
        views.append(linear_to_srgb((image.radiance / image.alpha.clamp(min=1e-3)[..., None]).clamp(0, 1)))
    return replace(batch, images=torch.stack(views))


def camera_light(_, rotation) -> Environment:
    """The sky in the axes of a camera, evaluated by the definition: radiance from d is that of the sky from R^T d."""
    directions = lat_long_directions(32, 64).float().reshape(-1, 3)
    return Environment(small_scene.sky().lookup((rotation.T @ directions.T).T.contiguous()).reshape(32, 64, 3))


def fitted(views, light, steps: int = STEPS) -> tuple:
    """Base color after a fit on the true surface from a gray ball under even light, and the lights."""
    images = InputImages.of(views, light)
    first = replace(small_scene.ball(), environment=Environment(torch.full((16, 32, 3), 0.5)))
    unknowns = Unknowns.zero(torch.ones(2, 2, 2), VIEWS, small_scene.TEXELS, max(images.light_group) + 1)
    data = FixedSurface(Start.of(first), first, gathered(first.mesh, images, seed=0), images, list(range(VIEWS)))
    part = Budget(steps=steps), Part("light", 1.0)
    maps.fit_maps(unknowns, data, Weights(), *part, seed=0, detail=False)  # and the base color's grids
    return changed(first, unknowns), Lights.of(unknowns, data.start, images)


def relighting_error(asset) -> float:
    """Mean square display error under another light, after the best factor, over four views."""
    true, light = small_scene.two_colored(small_scene.ball()), small_scene.sky().rotated(2.0)
    batch, errors = small_scene.input_views(small_scene.ball(), 4, 24), []
    for k in range(4):
        camera = Camera(batch.c2w[k], batch.intrinsics[k], 24, 24)
        got, expected = (render_asset(a, camera, light, options=OPTIONS) for a in (asset, true))
        hit = expected.alpha > 0.5
        a, b = got.radiance[hit], expected.radiance[hit]
        a = a * (a * b).sum() / (a * a).sum()
        errors.append((linear_to_srgb(a.clamp(0, 1)) - linear_to_srgb(b.clamp(0, 1))).square().mean())
    return float(torch.stack(errors).mean())


@pytest.fixture(scope="module")
def fixed():
    return fitted(input_views(lambda *_: small_scene.sky()), "object")[0]


@pytest.fixture(scope="module")
def moving_views():
    return input_views(camera_light)


def test_a_light_that_moves_with_the_camera_relights_as_a_fixed_one(fixed, moving_views):
    moving, lights = fitted(moving_views, "camera")
    assert relighting_error(moving) < 10**0.1 * relighting_error(fixed)  # within 1 dB
    # the fitted map is in the camera's axes: bright above the camera, dark below, as the sky
    rows = lights.maps[0].mean((1, 2))
    assert float(rows[4:12].mean()) > 1.5 * float(rows[20:28].mean())


def test_groups_of_views_have_lights_of_their_own():
    dark = 0.4 * torch.tensor([0.6, 1.0, 1.4])
    groups = ["day", "night"] * (VIEWS // 2)

    def light(k, _):
        return small_scene.sky() if groups[k] == "day" else Environment(small_scene.sky().radiance * dark)

    _, lights = fitted(input_views(light), groups, steps=90)
    means = lights.maps.mean((1, 2))
    # measured 0.31; without a map for each group it is the log factors themselves, 1.4, 0.9 and 0.6
    assert float((means[1] / means[0] / dark).log().abs().max()) < 0.45


def test_a_camera_light_is_turned_into_the_frame_of_the_object(moving_views):
    images = InputImages.of(moving_views, "camera")
    lights = Lights(small_scene.sky().resized(64).radiance[None], images.light_group, images.light_rotations)
    for k in (0, 3):
        expected = camera_light(k, images.camera.c2w[k, :3, :3]).resized(64).radiance
        assert float((lights.of_view(k).radiance - expected).abs().mean()) < 0.02  # two bilinear lookups


@pytest.mark.parametrize("roll", [0, 90])  # degrees, about the direction of view: of landscape and portrait
def test_the_light_of_a_turntable_turns_about_y_with_cameras_of_any_height(moving_views, roll):
    """The object turns under the sky; the camera is first level with it, then looks down."""
    azimuth, height = torch.tensor([0.0, 1.0, 2.5, 0.3, 4.0, 5.0]), torch.tensor([0.0, 0.0, 0.0, 1.5, 1.5, 1.5])
    eyes = torch.stack([azimuth.sin(), height, azimuth.cos()], -1)
    c2w = torch.stack([look_at(2.0 * eye) for eye in eyes])
    if roll == 0:  # straight down and up: the azimuth is that of the images' upward direction
        for k, side in ((2, -1.0), (5, 1.0)):
            toward = torch.stack([azimuth[k].sin(), torch.tensor(0.0), azimuth[k].cos()])
            c2w[k] = look_at([0.0, -2.0 * side, 0.0], up=side * toward)
    else:
        c2w[:, :3, :2] = torch.stack([c2w[:, :3, 1], -c2w[:, :3, 0]], -1)
    images = InputImages.of(replace(moving_views, c2w=c2w), "turntable")
    rotations = images.light_rotations
    assert torch.equal(images.select([4, 1]).light_rotations, rotations[[4, 1]])
    lights = Lights(small_scene.sky().resized(64).radiance[None], images.light_group, rotations)
    for k in range(VIEWS):
        expected = small_scene.sky().rotated(float(azimuth[k])).resized(64).radiance
        assert float((lights.of_view(k).radiance - expected).abs().mean()) < 0.02  # two bilinear lookups


def test_lights_are_evaluated_for_their_own_rows():
    lights = Lights(torch.tensor([1.0, 2.0])[:, None, None, None].expand(-1, 4, 8, 3), (0, 1, 0))
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(5, -1).contiguous()
    points = SurfacePoints(0.0 * up, up, up, torch.full((5, 3), 0.5), torch.full((5,), 0.5), torch.zeros(5))
    got = lights.evaluate(points, up, torch.tensor([0, 1, 2, 1, 0]), lambda p, wo, light, **_: light.lookup(wo))
    assert got[:, 0].tolist() == [1.0, 2.0, 1.0, 2.0, 1.0]


def test_points_are_shaded_in_the_frame_of_the_light_of_their_view(moving_views):
    """A diffuse surface under the map that the rotation turns, looked up bilinearly twice."""
    images = InputImages.of(moving_views, "camera")
    lights = Lights(small_scene.sky().resized(64).radiance[None], images.light_group, images.light_rotations)
    up = torch.tensor([[0.0, 0.8, 0.6]]).expand(500, -1).contiguous()
    points = SurfacePoints(0.0 * up, up, up, torch.full((500, 3), 0.5), torch.full((500,), 0.5), torch.zeros(500))
    shaded = partial(radiance, samples=(32, 16, 8), scene=None, seed=0)
    view = torch.arange(500) % len(images)
    got = lights.evaluate(points, up, view, shaded)
    for k in range(len(images)):
        expected = shaded(points, up, lights.of_view(k)).mean(0)
        assert float((got[view == k].mean(0) / expected).log().abs().max()) < 0.03  # noise, and the second lookup


def test_another_light_is_refused(moving_views):
    with pytest.raises(
        ValueError, match="light: expected object, camera, turntable or a name for each view, got 'sun'"
    ):
        InputImages.of(moving_views, "sun")
    with pytest.raises(ValueError, match="light: expected the lighting of 6 views, got 2"):
        InputImages.of(moving_views, [0, 1])


def shaded(moves: bool, exposure=1.0):
    """A diffuse ball of two colors in 16 views, under a light from above and the side of the camera or the object."""
    batch = small_scene.input_views(small_scene.ball(), 16, 32)
    images = InputImages.of(batch)
    mesh, color = small_scene.ball().mesh, torch.zeros_like(images.color)
    scene, toward = RayScene(mesh.vertices, mesh.faces), torch.tensor([0.48, 0.8, 0.36])
    for k in range(16):
        hits, origins, directions = primary_hits(scene, images.camera[k])
        hit = hits.face >= 0
        normal = normalize((origins + hits.t[..., None] * directions)[hit], dim=-1)
        albedo = torch.where(normal[:, :1] > 0.0, torch.tensor([0.8, 0.2, 0.2]), torch.tensor([0.2, 0.5, 0.2]))
        axis = images.camera.c2w[k, :3, :3] @ toward if moves else toward
        color[k][hit] = albedo * (0.52 + 0.46 * (normal @ axis))[:, None]
    return replace(images, color=exposure * color)


def test_light_that_moves_with_the_camera_is_detected():
    mesh = small_scene.ball().mesh
    moving, fixed = (explained_deviations(mesh, shaded(moves)) for moves in (True, False))
    assert moving[0] > 3.0 * moving[1] and light_follows_camera(mesh, shaded(True))
    assert fixed[0] < 0.05 and not light_follows_camera(mesh, shaded(False))
    exposure = torch.linspace(0.4, 1.0, 16)[:, None, None, None]  # is a constant of each view
    assert explained_deviations(mesh, shaded(False, exposure))[0] == pytest.approx(fixed[0], abs=0.03)


def test_fresnel_reflection_at_grazing_angles_does_not_count_as_moving_light():
    ball = small_scene.ball()
    dark = replace(ball, textures=TextureSet(torch.full_like(ball.textures.base_color, 0.1), 0.4, 0.0))
    images = InputImages.of(small_scene.input_views(dark, 16, 48))
    assert explained_deviations(ball.mesh, images)[0] < 0.08  # 0.18 without the Fresnel term
    assert not light_follows_camera(ball.mesh, images)


@pytest.mark.parametrize("count, cells", [(130, 24), (12, 50)])
def test_the_light_is_compared_at_a_limited_number_of_points_and_views(count, cells, monkeypatch):
    residual, shapes = light_frame._residual, []
    monkeypatch.setattr(light_frame, "_residual", lambda v, *rest: shapes.append(v.shape) or residual(v, *rest))
    images = shaded(True).resized(12).select([k % 16 for k in range(count)])
    light_follows_camera(small_scene.ball(cells=cells).mesh, images)
    assert all(points <= 4096 and views <= 64 for points, views in shapes) and len(shapes) == 3


def test_light_that_moves_with_the_camera_is_reported():
    images = shaded(True)
    views = ViewBatch(linear_to_srgb(images.color), images.mask, images.camera.c2w, images.camera.intrinsics)
    notes = refine(small_scene.ball(), views, steps=1, options=RefineOptions(16)).notes
    assert any("set light to camera (flash) or turntable" in note for note in notes)


def test_the_start_of_a_light_that_moves_with_the_camera_is_in_its_axes():
    """Cameras on a ring 45 degrees above the object see a light from above at (0, 1, 1) / sqrt(2)."""
    azimuth = torch.arange(6) * (math.pi / 3)
    eyes = torch.stack([azimuth.sin(), torch.ones(6), azimuth.cos()], -1)
    c2w = torch.stack([look_at(eye) for eye in eyes])
    light = 0.1 + 5.0 * (lat_long_directions(64)[..., 1:2] > 0.95).float().expand(-1, -1, 3)
    ball = replace(small_scene.ball(), environment=Environment(light.contiguous()))
    start = Start.of(ball, rotations=c2w[:, :3, :3]).light.exp()[..., 0]
    weight = (start > 1.0).float() * texel_solid_angles(*start.shape).to(start)[:, None]
    mean = (lat_long_directions(start.shape[0]) * weight[..., None]).sum((0, 1))
    expected = torch.tensor([0.0, 0.5**0.5, 0.5**0.5])
    assert float(normalize(mean, dim=0) @ expected) > math.cos(math.radians(3.0))  # half a texel
