"""Inputs of a user: numpy arrays and other integers if the conversion is lossless, lists, numbers; assets moved,
shown and saved."""

import numpy as np
import pytest
import torch
from PIL import Image

import reli3d
from reli3d.geometry.bake import bake
from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.geometry.surface import CubeWeights, extract_surface
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.image import render_asset
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import Samples, ShadeOptions, shade
from tests.support.scenes import ball, textures

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)


@pytest.mark.parametrize("kind", ["int64", "int32", "int16", "uint8", "uint32"])
def test_faces_of_any_integers_and_numpy_arrays_are_taken(kind):
    faces = np.array([[0, 1, 2]], dtype=kind)
    mesh = Mesh(VERTICES, faces)
    assert mesh.faces.dtype == torch.int32 and mesh.vertices.dtype == torch.float32
    scene = RayScene(VERTICES, faces)
    assert int(scene.closest(torch.tensor([0.2, 0.2, 1.0]), torch.tensor([0.0, 0.0, -1.0])).face) == 0
    if kind in ("int64", "int32", "int16", "uint8"):
        assert torch.equal(Mesh(torch.from_numpy(VERTICES), torch.from_numpy(faces)).faces, mesh.faces)
    frozen = VERTICES.copy()
    frozen.flags.writeable = False  # as trimesh gives them
    assert torch.equal(Mesh(frozen, faces[:, ::-1]).faces, torch.tensor([[2, 1, 0]], dtype=torch.int32))


def test_what_would_lose_digits_is_refused():
    one = np.array([[0, 1, 2]])
    for vertices, faces, error in (
        (VERTICES.astype(np.float64), one, TypeError),
        (VERTICES, one.astype(np.float32), TypeError),
        (VERTICES, one + 2**32, TypeError),
        (VERTICES, one + 1, ValueError),
        (VERTICES.tolist(), one, TypeError),
        (VERTICES.astype(np.complex64), one, TypeError),
        (VERTICES, one > 0, TypeError),
    ):
        for taker in (Mesh, RayScene):
            with pytest.raises(error, match="(vertices|faces): expected"):
                taker(vertices, faces)


def test_a_grid_from_numpy_gives_the_same_surface():
    sdf = np.random.default_rng(0).normal(size=(5, 6, 7)).astype(np.float32)
    alpha = np.ones((4 * 5 * 6, 8), np.float32)
    a = extract_surface(sdf, radius=1.0, weights=CubeWeights(alpha=alpha))
    b = extract_surface(torch.from_numpy(sdf), radius=1.0)
    assert torch.equal(a.vertices, b.vertices) and torch.equal(a.faces, b.faces)


def test_look_at_takes_lists_and_has_defaults(device):
    expected = look_at(*(torch.tensor(v, device=device) for v in ([1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])))
    ulp = 0.0 if device.type == "cpu" else 2.5e-7  # of numbers up to 3, whose sums CUDA rounds in another order
    torch.testing.assert_close(expected.cpu(), look_at([1, 2, 3]), rtol=0, atol=ulp)
    assert torch.equal(expected, look_at(torch.tensor([1.0, 2.0, 3.0], device=device), (0, 0, 0), [0, 1, 0]))
    with pytest.raises(ValueError, match="up: expected"):
        look_at([0, 1, 0])


def test_a_texture_set_has_named_maps(device):
    base = torch.rand(4, 4, 3, device=device)
    maps = TextureSet(base, 0.25, torch.full((4, 4, 1), 0.75, device=device))
    assert maps.roughness.shape == maps.metallic.shape == (4, 4)
    assert float(maps.roughness[1, 2]) == 0.25 and float(maps.metallic[3, 0]) == 0.75
    assert torch.equal(maps.normal, torch.tensor([0.5, 0.5, 1.0], device=device).expand(4, 4, 3))
    for change, error in (
        (dict(roughness=base), ValueError),
        (dict(metallic="metal"), TypeError),
        (dict(normal=base[:2]), ValueError),
        (dict(base_color=base[:, :2]), ValueError),
        (dict(base_color=base[0]), ValueError),
        (dict(base_color=0.5), TypeError),
    ):
        with pytest.raises(error, match=f"{next(iter(change))}: expected"):
            TextureSet(**{"base_color": base, "roughness": 0.5, "metallic": 0.5, **change})


def test_an_asset_moves_detaches_and_prints_a_summary(device):
    asset = ball(torch.device("cpu"))
    maps = asset.textures
    leaf = maps.base_color.clone().requires_grad_()
    asset = Asset(asset.mesh, TextureSet(leaf, maps.roughness, maps.metallic), Environment(torch.ones(4, 8, 3)))
    moved = asset.to(device)
    on = {
        v.device.type
        for part in (moved.mesh, moved.textures, moved.environment)
        for v in vars(part).values()
        if isinstance(v, torch.Tensor)
    }
    assert on == {torch.device(device).type}
    assert moved.textures.base_color.requires_grad and not moved.detach().textures.base_color.requires_grad
    assert repr(asset) == "Asset(642 vertices, 1280 faces, 4 x 4 texels, environment 4 x 8, cpu)"
    assert repr(Asset(asset.mesh)) == "Asset(642 vertices, 1280 faces, no textures, no environment, cpu)"
    assert repr(asset.textures) == "TextureSet(4 x 4 texels, cpu)"
    pose = look_at([0.0, 0.0, 3.0]).requires_grad_()
    camera = Camera.from_fov(pose, 0.7, 8, 8).to(device)
    assert camera.c2w.device.type == camera.intrinsics.device.type == torch.device(device).type
    assert camera.c2w.requires_grad and not camera.detach().c2w.requires_grad
    light = asset.environment
    assert light.to("cpu") is light and not Environment(light.radiance.requires_grad_()).detach().radiance.requires_grad


def test_an_image_is_written_as_it_is_displayed(tmp_path, device):
    asset = Asset(ball(device).mesh, textures(4, device))
    camera = Camera.from_fov(look_at([0.0, 0.0, 2.0]), 0.8, 16, 16).to(device)
    options = ShadeOptions(samples=Samples(light=4, bsdf=4, cosine=4))
    image = render_asset(asset, camera, Environment.constant(torch.ones(3, device=device)), options=options)
    reli3d.write_image(tmp_path / "a.png", image.rgba.cpu())
    got = torch.from_numpy(np.asarray(Image.open(tmp_path / "a.png")).copy()).float() / 255.0
    assert 0 < int((got[..., 3] == 1.0).sum()) < got[..., 3].numel()  # without subpixels alpha is 0 or 1
    torch.testing.assert_close(got, image.display().cpu(), rtol=0, atol=0.5 / 255 + 1e-5)  # 8 bits
    darker = image.display(exposure=-1.0, transparent=False).cpu()
    torch.testing.assert_close(darker, linear_to_srgb(0.5 * image.radiance).clamp(0, 1).cpu())


def test_points_take_numbers_of_any_kind_and_numpy_arrays():
    position = np.random.default_rng(0).random((5, 3), dtype=np.float32)
    normal = np.array([0.0, 0.0, 1.0], np.float32)
    expected = SurfacePoints(*map(torch.from_numpy, (position, normal, normal)), torch.full((5, 3), 0.5), 0.25, 0.0)
    for gray in (0.5, np.float32(0.5), torch.tensor(0.5), torch.tensor([0.5]), np.array([[0.5]], np.float32)):
        got = SurfacePoints(position, normal, normal, gray, np.float32(0.25), torch.tensor([0.0]))
        assert all(torch.equal(getattr(got, f), getattr(expected, f)) for f in vars(expected))
    light = Environment(torch.ones(4, 8, 3))
    assert torch.equal(shade(expected, normal, light), shade(expected, torch.from_numpy(normal), light))
    mesh = ball(torch.device("cpu")).mesh
    hits = RayScene(mesh.vertices, mesh.faces).closest(position + np.float32(3.0), -position - np.float32(3.0))
    assert bool((hits.face >= 0).all())
    with pytest.raises(TypeError, match="position: expected torch.float32, got torch.float64"):
        SurfacePoints(position.astype(np.float64), normal, normal, 0.5, 0.5, 0.5)


def test_a_wrong_kind_is_a_type_error_that_names_the_argument():
    asset = ball(torch.device("cpu"))
    camera = Camera.from_fov(look_at([0.0, 0.0, 3.0]), 0.7, 8, 8)
    light = Environment(torch.ones(4, 8, 3))
    for name, call in (
        ("views", lambda: reli3d.reconstruct("photos")),
        ("c2w", lambda: Camera.from_fov(None, 0.7, 8, 8)),
        ("asset", lambda: render_asset(asset.mesh, camera, light)),
        ("camera", lambda: render_asset(asset, look_at([0.0, 0.0, 3.0]), light)),
        ("environment", lambda: render_asset(asset, camera, torch.ones(4, 8, 3))),
        ("mesh", lambda: Asset(1, 2)),
        ("textures", lambda: Asset(asset.mesh, 2)),
        ("mesh", lambda: bake(asset, 64, None)),
        ("samples", lambda: ShadeOptions(samples=3)),
    ):
        with pytest.raises(TypeError, match=f"^{name}: expected"):
            call()
    with pytest.raises(TypeError, match="int"):
        reli3d.read_glb(0)  # no file descriptor is read
