"""Which cameras see a point, against a ball whose answer is known in closed form."""

import pytest
import torch
import trimesh
from torch.nn.functional import normalize

from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.rays import RayScene
from reli3d.geometry.visibility import MIN_COSINE, visible_from
from tests.support.meshes import mesh_from

SIZE, FOCAL = 64, 90.0


def rig(device, width=SIZE, height=SIZE):
    eyes = torch.tensor([[0.0, 0.0, 3.0], [2.5, 1.0, 0.0], [0.0, 3.0, 0.5]])
    c2w = torch.stack([look_at(e, torch.zeros(3), torch.tensor([0.1, 1.0, 0.0])) for e in eyes])
    intrinsics = torch.tensor([FOCAL, FOCAL, SIZE / 2, SIZE / 2]).expand(3, 4).contiguous()
    return Camera(c2w, intrinsics, width, height).to(device)


def points(device, n=3000):
    return normalize(torch.randn(n, 3, generator=torch.Generator().manual_seed(0)), dim=-1).to(device)


def closed_form(p, n, camera):
    """Facing and in the image; a convex body has no other occluder.  Also how near a point is to changing."""
    c2w = camera.c2w
    away = c2w[None, :, :3, 3].double() - p[:, None].double()
    cosine = (normalize(away, dim=-1) * n[:, None].double()).sum(-1)
    local = torch.einsum("nvk,vkj->nvj", -away, c2w[:, :3, :3].double())
    k = camera.intrinsics.double()
    x, y = k[:, 2] - k[:, 0] * local[..., 0] / local[..., 2], k[:, 3] + k[:, 1] * local[..., 1] / local[..., 2]
    inside = (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height) & (local[..., 2] < 0)
    near = torch.stack([x, y, camera.width - x, camera.height - y]).abs().amin(0)
    return (cosine > MIN_COSINE) & inside, ((cosine - MIN_COSINE).abs() < 0.03) | (near < 1e-3)


@pytest.mark.parametrize("backend", ["embree", "warp"])
@pytest.mark.parametrize("size", [(SIZE, SIZE), (SIZE // 2, SIZE // 2), (SIZE, SIZE // 2)])
def test_a_ball_is_seen_where_it_faces_the_camera_within_the_image(device, backend, size):
    if backend == "embree" and device.type != "cpu":
        pytest.skip("Embree runs on the CPU")
    # 1.001: the facets of the ball, 4e-4 deep, stay below the points; a ray that grazes less than 0.05 + 0.03 leaves it
    scene = RayScene(mesh_from(trimesh.creation.icosphere(5), device), backend=backend)
    camera, p = rig(device, *size), points(device)
    got = visible_from(scene, p * 1.001, p, camera)
    expected, unsure = closed_form(p * 1.001, p, camera)
    assert got.dtype == torch.bool and got.shape == expected.shape
    assert torch.equal(got[~unsure], expected[~unsure])
    assert unsure.float().mean() < 0.05 and 0.05 < expected.float().mean() < 0.6


def test_occluders_hide(device):
    """A plate between ball and first camera occludes the points behind it from that camera only."""
    camera = rig(device)
    plate = torch.tensor([[-4.0, -4.0, 2.0], [4.0, -4.0, 2.0], [4.0, 4.0, 2.0], [-4.0, 4.0, 2.0]], device=device)
    scene = RayScene(plate, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32, device=device))
    p = points(device, 500)
    got, expected = visible_from(scene, p, p, camera), closed_form(p, p, camera)[0]
    assert not got[:, 0].any() and expected[:, 0].any()
    behind = p[:, 2] < 0.4  # rays to the other cameras stay below the plate
    assert torch.equal(got[behind, 1:], expected[behind, 1:])


@pytest.mark.parametrize("fraction", [0.0, 0.1, 1.0])
def test_inactive_pairs_are_false_and_the_others_unchanged(device, fraction):
    camera, p = rig(device), points(device)
    # below some of the points: all answers occur
    scene = RayScene(mesh_from(trimesh.creation.icosphere(3), device))
    every = visible_from(scene, p, p, camera)
    active = (torch.rand(every.shape, generator=torch.Generator().manual_seed(1)) < fraction).to(device)
    got = visible_from(scene, p, p, camera, active)
    assert got.is_contiguous() and torch.equal(got, every & active)
    assert not fraction or 0.1 < got[active].float().mean() < 0.9


@pytest.mark.parametrize("scale", [2.0**-12, 2.0**12])
def test_visibility_does_not_depend_on_the_scale(device, scale):
    """Two balls that hide each other; the scale is a power of two, so that all numbers but the offset scale exactly."""
    balls = [trimesh.creation.icosphere(3).apply_translation([0.6 * k, 0, 0]).apply_scale(0.5) for k in (-1, 1)]
    both, camera = trimesh.util.concatenate(balls), rig(device)
    mesh, normal = mesh_from(both, device), torch.tensor(both.vertex_normals, dtype=torch.float32, device=device)
    c2w = camera.c2w.clone()
    c2w[:, :3, 3] *= scale
    index = torch.arange(0, len(mesh.vertices), 3)
    found = []
    for factor, cameras in ((1.0, camera), (scale, Camera(c2w, camera.intrinsics, SIZE, SIZE))):
        vertices = factor * mesh.vertices
        found.append(visible_from(RayScene(vertices, mesh.faces), vertices[index], normal[index], cameras))
    assert torch.equal(*found) and 0.1 < float(found[0].float().mean()) < 0.9


def test_wrong_inputs_are_reported(device):
    camera = rig(device)
    scene = RayScene(torch.zeros(0, 3, device=device), torch.zeros(0, 3, dtype=torch.int32, device=device))
    p = points(device, 4)
    assert visible_from(scene, p[:0], p[:0], camera).shape == (0, 3)
    with pytest.raises(ValueError, match="normal: expected shape"):
        visible_from(scene, p, p[:, :2], camera)
    for shape in ((4, 2), (3, 3), (4, 1, 3)):
        with pytest.raises(ValueError, match="active: expected shape"):
            visible_from(scene, p, p, camera, torch.ones(shape, dtype=torch.bool, device=device))
    with pytest.raises(TypeError, match="active: expected torch.bool"):
        visible_from(scene, p, p, camera, torch.ones(4, 3, device=device))
