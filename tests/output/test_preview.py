"""The contact sheet of a reconstruction: novel views show the whole object, tiles have the right content."""

import math
from dataclasses import replace

import pytest
import torch

from reli3d.geometry.camera import Camera, project
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.output import preview
from reli3d.render.asset import Asset
from reli3d.render.image import render_asset
from reli3d.render.lights import sky
from reli3d.render.shading import ShadeOptions
from reli3d.views.views import Views
from tests.support.rigs import rig
from tests.support.scenes import ball_mesh, textures


@pytest.fixture(scope="module")
def asset() -> Asset:
    ball = ball_mesh(3, 0.5)
    moved = Mesh(ball.vertices * torch.tensor([1.0, 0.4, 0.7]) + 2.0, ball.faces, ball.normals, ball.uv, ball.tangents)
    return Asset(moved, textures(4, "cpu", (0.6, 0.03, 0.01)), sky(32))


@pytest.mark.parametrize("azimuths, least", [((0, 90, 180, 270), 40.0), ((0,), 55.0), ((-20, -10, 0, 10, 20), 38.0)])
def test_unseen_views_are_far_from_those_taken_and_show_all(asset, azimuths, least):
    cameras = rig(*[(a, 15.0, 3.0) for a in azimuths], target=(2.0, 2.0, 2.0))
    unseen = preview.unseen_cameras(asset.mesh, cameras)
    assert len(unseen) == 4
    to = torch.nn.functional.normalize(torch.stack([c.c2w[:3, 3] for c in unseen]) - 2.0, dim=-1)
    given = torch.nn.functional.normalize(cameras[:, :3, 3] - 2.0, dim=-1)
    angle = torch.rad2deg(torch.acos((to @ given.T).clamp(-1, 1)))
    assert float(angle.min()) > least, angle.amin(1)  # 15 degrees between places
    assert float((to @ to.T - 2 * torch.eye(4)).max()) < math.cos(math.radians(29.0))  # and from each other
    for camera in unseen:
        pixels, depth = project(asset.mesh.vertices, camera.c2w, camera.intrinsics)
        assert bool((pixels > 0).all() and (pixels < preview.TILE_PIXELS).all() and (depth > 0).all())


def test_the_sheet_holds_the_inputs_unseen_views_maps_and_a_small_light(asset):
    cameras = rig((0, 15, 3), (90, 15, 3), target=(2.0, 2.0, 2.0))
    blue = torch.tensor([0.0, 0.0, 1.0]).expand(64, 64, 3).contiguous()
    intrinsics = torch.tensor([[120.0, 120.0, 32.0, 32.0]] * 2)
    views = Views((blue,) * 2, (torch.ones(64, 64),) * 2, cameras, intrinsics, ("a", "b"))
    sheet = torch.from_numpy(preview.preview(asset, views)().copy())
    tile, row = preview.TILE_PIXELS, preview.TILE_PIXELS + preview.TITLE
    assert tile >= 256 and sheet.shape == (4 * row + preview.TITLE + tile // 2, 4 * tile, 3)
    middle = [[sheet[r * row + row // 2, c * tile + tile // 2].tolist() for c in range(4)] for r in range(4)]
    assert middle[0][:2] == [[0, 0, 255]] * 2 and middle[0][2] == [255] * 3  # two photographs, then nothing
    for light in (1, 2):
        assert all(r > 2 * b for r, _, b in middle[light])  # the red ball
    assert middle[1] != middle[2]
    assert middle[3][1][0] == middle[3][1][1] and middle[3][2][0] == 0  # gray roughness, no metal
    light = sheet[4 * row + preview.TITLE :, :tile]
    blue, red = (light[: tile // 8, :, k].float().mean() for k in (2, 0))
    assert float(blue) > 1.3 * float(red)  # a sky above


def test_the_filter_takes_noise_and_leaves_edges(asset):
    """Against 500 samples a subpixel; a checkered ball, so that blur of the base color shows; a quarter of the tile."""
    checks = torch.where(((torch.arange(32)[:, None] // 4 + torch.arange(32) // 4) % 2 == 0)[..., None], 0.8, 0.1)
    maps = replace(textures(32, "cpu"), base_color=checks.expand(-1, -1, 3).contiguous())
    checkered = replace(asset, textures=maps)
    scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
    tile = preview.unseen_cameras(asset.mesh, rig((0, 15, 3), target=(2.0, 2.0, 2.0)))[0]
    camera = Camera(tile.c2w, tile.intrinsics, tile.width // 2, tile.height // 2)
    options = (ShadeOptions(samples=samples) for samples in (preview.SUBPIXEL_SAMPLES, (400, 80, 20)))
    few, many = (render_asset(checkered, camera, options=o, supersampling=2, scene=scene) for o in options)
    (smooth,) = preview._denoised(few)
    before, after = ((x - many.radiance).square().mean() for x in (few.radiance, smooth))
    assert float(after) < 0.15 * float(before)  # 0.06; a box of the same size, unguided, has 0.34
    assert float((smooth.mean() / few.radiance.mean() - 1).abs()) < 0.01
    assert bool((smooth[few.alpha == 0] == 0).all())
