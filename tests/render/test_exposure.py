"""Photographs beside an asset in its own light: a white mirror-like ball under constant light shows that light."""

import pytest
import torch

from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.camera import Camera, look_at
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.exposure import photograph_ratio
from tests.support.scenes import ball, textures

SIZE = (160, 224)


@pytest.fixture
def scene(device):
    """A white metal ball of roughness 0.2 in light of 0.4, three cameras, and which pixels show nothing but it."""
    plain = ball(device)
    light = Environment.constant(torch.full((3,), 0.4, device=device))
    asset = Asset(plain.mesh, textures(4, device, (1.0, 1.0, 1.0), roughness=0.2, metallic=1.0), light)
    eyes = torch.tensor([[0.0, 0.3, 2.5], [2.0, 1.0, 0.4], [-1.5, 0.8, -1.2]], device=device)
    c2w = look_at(eyes, torch.zeros(3, device=device), torch.tensor([0.0, 1.0, 0.0], device=device))
    camera = Camera.from_fov(c2w, 0.7, SIZE[1], SIZE[0])
    return asset, camera, torch.ones(3, *SIZE, dtype=torch.bool, device=device)


def photographs(device, *radiance):
    """Of three cameras, in one linear colour."""
    return linear_to_srgb(torch.tensor(radiance, device=device)).expand(3, *SIZE, 3).contiguous()


def ratio(asset, images, inside, camera):
    return float(photograph_ratio(asset, images, inside, camera, RayScene(asset.mesh.vertices, asset.mesh.faces)))


@pytest.mark.parametrize("factor", [0.25, 1.0, 2.0])
def test_the_factor_between_light_and_photograph_is_found(device, scene, factor):
    asset, camera, inside = scene
    images = photographs(device, 0.4 * factor, 0.4 * factor, 0.4 * factor)
    # single scattering loses under 1 % at this roughness, rays over the facets of the ball's rim 1 % more, BLACK 0.3 %
    assert ratio(asset, images, inside, camera) == pytest.approx(factor, rel=0.02)


def test_pixels_that_are_cut_off_or_outside_do_not_count(device, scene):
    asset, camera, inside = scene
    images = photographs(device, 0.4, 0.4, 0.4)
    plain = ratio(asset, images, inside, camera)
    images[0] = 1.0  # overexposed
    images[1, :, :100] = 0.0
    inside[1, :, :100] = False
    assert ratio(asset, images, inside, camera) == pytest.approx(plain, rel=0.01)
    inside[1] = True
    assert ratio(asset, images, inside, camera) < 0.9 * plain


def test_pixels_and_rays_meet(device, scene):
    """A photograph that is bright in one half only: the mean is that of the half of the ball it shows."""
    asset, camera, inside = scene
    images = photographs(device, 0.0, 0.0, 0.0)
    images[:, :, : SIZE[1] // 2] = linear_to_srgb(torch.tensor(0.4)).item()
    assert ratio(asset, images, inside, camera) == pytest.approx(0.5, abs=0.02)  # the grid is symmetric


def test_where_nothing_is_seen_nothing_changes(device, scene):
    asset, camera, inside = scene
    images = photographs(device, 0.1, 0.1, 0.1)
    assert ratio(asset, images, torch.zeros_like(inside), camera) == 1.0
