"""Cameras and whole images: geometry, textures and their frame, resolve, background, gradients."""

import math
from dataclasses import fields, replace

import pytest
import torch

from reli3d.geometry.camera import Camera, box_of, camera_rays, look_at, project
from reli3d.geometry.hits import interpolate
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import sample_texture, surface_points
from reli3d.render.image import render_asset, render_lights
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import ShadeOptions, shade
from tests.support.scenes import ball, eye, textures


def square(device, normals=True):
    """Unit square facing +Z, its texture upright: u along +X, v = 0 at the top."""
    v = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], device=device)
    uv = torch.tensor([[0.0, 1], [1, 1], [1, 0], [0, 0]], device=device)
    n = torch.tensor([[0.0, 0, 1]], device=device).expand(4, 3).contiguous() if normals else None
    return Mesh(v, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32, device=device), n, uv)


def test_rays_and_projection_are_inverse(device):
    camera = Camera(eye(device, 1.0, 0.7, 2.0), torch.tensor([50.0, 60.0, 17.0, 21.0], device=device), 40, 30)
    origins, directions = camera_rays(camera)
    assert origins.shape == directions.shape == (30, 40, 3)
    pixels, depth = project(origins + 3.0 * directions, camera.c2w, camera.intrinsics)
    ys, xs = torch.meshgrid(torch.arange(30) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    torch.testing.assert_close(pixels.cpu(), torch.stack([xs, ys], -1), rtol=0, atol=2e-4)
    cos = (directions * -camera.c2w[:3, 2]).sum(-1)
    torch.testing.assert_close(depth, 3.0 * cos, rtol=1e-5, atol=0)
    center, _ = project(torch.zeros(3, device=device), camera.c2w, camera.intrinsics)
    torch.testing.assert_close(center.cpu(), torch.tensor([17.0, 21.0]), rtol=0, atol=1e-4)  # looks at the origin
    with pytest.raises(ValueError, match=r"intrinsics: expected shape \(..., 4\)"):
        Camera(torch.zeros(8, 4, 4), torch.zeros(8, 3), 4, 4)
    with pytest.raises(ValueError, match="c2w: expected"):
        Camera(torch.zeros(7, 4, 4), torch.zeros(8, 4), 4, 4)
    with pytest.raises(ValueError, match="up: expected"):
        look_at(*(torch.tensor([0.0, k, 0.0], device=device) for k in (1.0, 0.0, 1.0)))


@pytest.mark.parametrize("explicit", [True, False])
def test_normal_map_points_right_and_up_as_in_gltf(device, explicit):
    """Red bends the normal towards u (right), green towards the top of the texture."""
    mesh = square(device)
    if explicit:
        mesh = replace(mesh, tangents=torch.tensor([[1.0, 0, 0, 1]], device=device).expand(4, 4).contiguous())
    face, bary = torch.tensor([0, 1], dtype=torch.int32, device=device), torch.full((2, 2), 0.3, device=device)
    s = math.sqrt(0.5)
    for expected in ((s, 0.0, s), (0.0, s, s)):
        color = [0.5 + v / 2 for v in expected]
        points = surface_points(mesh, textures(4, device, normal=color), face, bary)
        torch.testing.assert_close(points.normal.cpu(), torch.tensor([expected, expected]), rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="face: expected hits only"):
        surface_points(mesh, None, face - 1, bary)


def test_texture_on_a_square_is_upright_and_resolved(device):
    rendering = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0)).to(device)
    asset = Asset(square(device), replace(textures(8, device), base_color=rendering))
    camera = Camera(eye(device, 0.0, 0.0, 4.0), torch.tensor([16.0, 16.0, 4.0, 4.0], device=device), 8, 8)
    env = Environment.constant(torch.ones(3, device=device))
    image = render_asset(asset, camera, env)

    torch.testing.assert_close(image.base_color, rendering, rtol=0, atol=1e-4)  # one texel a pixel
    assert float(image.alpha.min()) == 1.0
    torch.testing.assert_close(image.depth, torch.full_like(image.depth, 4.0), rtol=1e-5, atol=0)
    wide = Camera(camera.c2w, torch.tensor([16.0, 16.0, 6.0, 4.0], device=device), 12, 8)
    fine = render_asset(asset, wide, env, supersampling=3, background="environment")
    assert fine.alpha[:, :2].sum() == 0 and torch.isinf(fine.depth[:, 0]).all()
    torch.testing.assert_close(fine.radiance[:, 0], torch.ones(8, 3, device=device), rtol=1e-5, atol=0)
    assert float(render_asset(asset, wide, env).radiance[:, 0].abs().max()) == 0.0


@pytest.fixture
def rays(monkeypatch):
    """The number of rays of each call of ``RayScene.closest``."""
    counts, closest = [], RayScene.closest
    monkeypatch.setattr(RayScene, "closest", lambda self, o, *rest: counts.append(len(o)) or closest(self, o, *rest))
    return counts


def test_bands_bound_the_rays_in_memory_and_supersampling_keeps_the_mean(device, rays, monkeypatch):
    asset, env = ball(device), Environment(torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(1)).to(device))
    camera = Camera.from_fov(eye(device, 0.5, 1.0, 2.0), 0.8, 40, 40)
    whole = render_asset(asset, camera, env)
    rays.clear()
    with monkeypatch.context() as patch:
        patch.setattr("reli3d.render.image.BAND_RAYS", 200)
        banded = render_asset(asset, camera, env)
    assert len(rays) == 8 and max(rays) <= 200  # five rows of 40 pixels at a time
    torch.testing.assert_close(banded.radiance, whole.radiance, rtol=1e-4, atol=1e-4)  # ray origins round differently
    fine = render_asset(asset, camera, env, supersampling=3)
    inside = whole.alpha > 0
    assert abs(fine.radiance.mean() / whole.radiance.mean() - 1) < 0.03  # 40 pixels of silhouette in 500
    assert float((fine.normal.norm(dim=-1)[inside & (fine.alpha > 0)] - 1).abs().max()) < 1e-5


@pytest.mark.parametrize("background", ["transparent", "environment"])
def test_several_lights_give_the_bits_of_one_light_each_and_trace_the_camera_once(device, background, rays):
    asset, camera = Asset(square(device), textures(8, device)), Camera.from_fov(eye(device, 0.4, 0.7, 3.0), 0.9, 40, 32)
    rng = torch.Generator().manual_seed(3)
    lights = [Environment(torch.rand(8, 16, 3, generator=rng).to(device)) for _ in range(2)]
    options = dict(options=ShadeOptions(samples=(4, 2, 1)), supersampling=2, background=background)
    alone = [render_asset(asset, camera, light, **options) for light in lights]
    rays.clear()
    together = render_lights(asset, camera, lights, **options)
    assert len(rays) == 1
    for one, other in zip(alone, together, strict=True):
        for field in fields(one):
            assert torch.equal(getattr(one, field.name), getattr(other, field.name)), field.name
    assert not torch.equal(together[0].radiance, together[1].radiance)


def test_box_of_points_holds_their_pixels_and_is_no_larger_than_it_must_be(device):
    rng = torch.Generator().manual_seed(5)
    for _ in range(50):
        points = (torch.randn(20, 3, generator=rng) * 0.3).to(device)
        camera = Camera.from_fov(look_at(torch.randn(3, generator=rng).to(device) * 2.0 + 0.5), 0.7, 60, 40)
        pixels, depth = project(points, camera.c2w, camera.intrinsics)
        x0, y0, x1, y1 = box_of(points, camera)
        assert 0 <= x0 < x1 <= 60 and 0 <= y0 < y1 <= 40
        if float(depth.min()) <= 0.0:
            assert (x0, y0, x1, y1) == (0, 0, 60, 40)
        elif float(depth.min()) > 0.1 * float((points - camera.position).norm(dim=-1).max()):
            for axis, (low, high, count) in enumerate(((x0, x1, 60), (y0, y1, 40))):
                inside = pixels[:, axis].clamp(0, count)
                assert low <= float(inside.min()) and float(inside.max()) <= high
                least, most = float(pixels[:, axis].min()), float(pixels[:, axis].max())
                assert low >= min(least - 2.0, count - 1) and high <= max(most + 2.0, low + 1)
    assert box_of(points[:0], camera) == (0, 0, 60, 40)


def test_rays_that_miss_the_asset_are_skipped_without_effect_on_the_image(device, rays, monkeypatch):
    """A box on the border, one next to the image and the whole image, the eye within the asset's reach."""
    asset, env = ball(device), Environment(torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(2)).to(device))
    for place in ((0.3, 1.0, 4.0), (0.4, 0.1, 1.01)):
        for cx in (7.25, 24.0, 400.0):
            camera = Camera(eye(device, *place), torch.tensor([40.0, 44.0, cx, 20.3], device=device), 48, 32)
            rays.clear()
            boxed = render_asset(asset, camera, env, supersampling=2)
            if place[2] > 2.0:
                assert sum(rays) < 0.7 * 4 * 48 * 32
            with monkeypatch.context() as patch:
                patch.setattr("reli3d.render.image.box_of", lambda _, camera: (0, 0, camera.width, camera.height))
                whole = render_asset(asset, camera, env, supersampling=2)
            for field in fields(whole):
                assert torch.equal(getattr(boxed, field.name), getattr(whole, field.name)), (place, cx, field.name)


def test_an_asset_without_textures_may_be_out_of_sight(device):
    asset, env = replace(ball(device), textures=None), Environment(torch.ones(8, 16, 3, device=device))
    camera = Camera(eye(device, 0.3, 1.0, 4.0), torch.tensor([40.0, 40.0, 900.0, 12.0], device=device), 24, 24)
    image = render_asset(asset, camera, env)
    assert not bool(image.alpha.any()) and bool(image.radiance.isfinite().all())


def test_image_gradient_reaches_textures_and_light(device):
    asset = ball(device)
    names = "base_color", "roughness", "metallic", "normal"
    maps = [getattr(asset.textures, name).clone().requires_grad_() for name in names]
    light = torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(1)).to(device).requires_grad_()
    camera = Camera.from_fov(eye(device, 0.0, 0.5, 2.0), 0.8, 24, 24)
    image = render_asset(Asset(asset.mesh, TextureSet(*maps)), camera, Environment(light))
    grads = torch.autograd.grad(image.radiance.sum(), [*maps, light])
    assert all(bool(torch.isfinite(g).all()) and float(g.abs().max()) > 0 for g in grads)
    # a larger base color and more light are brighter
    assert float(grads[0].min()) >= 0.0 and float(grads[4].min()) >= 0.0


def test_bad_input_is_named(device):
    asset, camera = ball(device), Camera.from_fov(eye(device, 0.0, 0.5, 2.0), 0.8, 4, 4)
    light, vertices, faces = Environment.constant(torch.ones(3, device=device)), asset.mesh.vertices, asset.mesh.faces
    bary, outside = torch.zeros(1, 2, device=device), torch.tensor([len(faces)], dtype=torch.int32, device=device)
    for call, message in (
        (lambda: render_asset(asset, camera), "environment: expected"),
        (lambda: render_asset(asset, camera, light, background="pink"), "background: expected"),
        (lambda: render_asset(asset, camera, light, supersampling=0), "supersampling: expected"),
        (lambda: look_at(vertices[0], vertices[0]), "eye, target: expected different points"),
        (lambda: interpolate(vertices, faces, outside, bary), "face: expected"),
        (lambda: sample_texture(asset.textures.normal, bary * math.nan), "uv: expected"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    points = SurfacePoints(vertices, vertices, vertices, 0.5, 0.5, 0.0)
    for call in (
        lambda: render_asset(asset, camera, light, scene=asset.mesh),
        lambda: shade(points, vertices, light, scene=asset.mesh),
    ):
        with pytest.raises(TypeError, match="scene: expected RayScene, got Mesh"):
            call()


def test_parts_shadow_each_other_and_keep_their_base_color(device):
    floor = square(device)
    flat = floor.vertices[:, [0, 2, 1]] * torch.tensor([2.0, 1.0, -2.0], device=device)
    floor = Mesh(flat + torch.tensor([0, -0.6, 0], device=device), floor.faces, None, floor.uv)
    parts = [ball(device, (0.9, 0.05, 0.05)), Asset(floor, textures(4, device, (0.05, 0.05, 0.9)))]
    camera = Camera.from_fov(eye(device, 0.0, 2.0, 3.0), 0.9, 48, 48)
    image = render_asset(parts, camera, Environment.constant(torch.ones(3, device=device)))
    assert image.base_color[24, 24, 0] > 10 * image.base_color[24, 24, 2]
    below = image.position[..., 1] < -0.59
    assert bool(below.any()) and bool((image.base_color[below][:, 2] > 10 * image.base_color[below][:, 0]).all())
    alone = render_asset(parts[1:], camera, Environment.constant(torch.ones(3, device=device)))
    near = below & (image.position.norm(dim=-1) < 0.9)
    assert float(image.radiance[near].mean()) < 0.9 * float(alone.radiance[near].mean())
