"""Mirror planes of balls whose silhouettes are closed forms, and mirrored cameras against reflected points."""

import math
from dataclasses import replace

import pytest
import torch

from reli3d.geometry.camera import Camera, camera_rays, look_at, project
from reli3d.geometry.hull import hull_distance, mask_distance
from reli3d.geometry.symmetry import MirrorPlane, mirror_plane, upright

SIZE = 128
ROTATIONAL = [((0.0, 0.0, 0.0), 0.3), ((0.3, 0.1, 0.25), 0.14), ((-0.3, 0.1, 0.25), 0.14), ((0.0, 0.3, -0.2), 0.12)]
ODD = [((0.0, 0.0, 0.0), 0.25), ((0.4, 0.1, 0.1), 0.14), ((-0.1, 0.35, 0.3), 0.12), ((-0.2, -0.3, -0.2), 0.1)]
EYES = [(0.3, 0.9, 2.4), (2.3, 0.4, -0.8), (-1.4, 1.2, -1.7), (-2.1, 0.2, 1.2)]


def cameras(eyes=EYES, up=(0.0, 1.0, 0.0), center=(0.0, 0.0, 0.0), unit=1.0):
    """Cameras about ``center``; the world's up and unit are free."""
    up, center = torch.tensor(up), torch.tensor(center)
    turn = turned(up)
    c2w = [look_at(center + unit * turn @ torch.tensor(eye), center, up) for eye in eyes]
    return Camera.from_fov(torch.stack(c2w), 0.7, SIZE, SIZE)


def turned(up):
    """A rotation that takes +Y to ``up``."""
    side = torch.linalg.cross(up, torch.tensor([0.3, 0.2, 1.0]))
    side = side / side.norm()
    return torch.stack([side, up, torch.linalg.cross(side, up)], 1)


def distances(balls, camera, turn=None, center=(0.0, 0.0, 0.0), unit=1.0):
    """Silhouettes of balls: a ray hits one where its distance to the center is below the radius, in float64."""
    origin, direction = (t.double() for t in camera_rays(camera))
    turn = torch.eye(3) if turn is None else turn
    clear = torch.full(origin.shape[:-1], -1e9, dtype=torch.float64)
    for place, radius in balls:
        at = torch.tensor(center).double() + unit * turn.double() @ torch.tensor(place).double()
        along = ((at - origin) * direction).sum(-1, keepdim=True)
        away = (at - origin - along * direction).norm(dim=-1)
        pixel = along[..., 0] / camera.intrinsics[0, 0].double()
        clear = torch.maximum(clear, (unit * radius - away) / pixel)
    return mask_distance((clear + 0.5).clamp(0, 1).float())


def test_a_mirrored_camera_sees_the_reflected_point_at_the_mirrored_pixel():
    normal = torch.tensor([0.6, 0.0, -0.8])
    plane, camera = MirrorPlane(normal, 0.17), cameras()
    camera = replace(camera, intrinsics=camera.intrinsics + torch.tensor([0.0, 0.0, 3.0, -2.0]))
    points = 0.4 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    reflected = points - 2 * ((points @ normal) - 0.17)[:, None] * normal
    other = plane.mirrored(camera)
    here, depth = project(points, camera.c2w[:, None], camera.intrinsics[:, None])
    there, other_depth = project(reflected, other.c2w[:, None], other.intrinsics[:, None])
    # float32 of coordinates of a few meters and of some hundred pixels
    torch.testing.assert_close(there[..., 0], SIZE - here[..., 0], rtol=0, atol=1e-3)
    torch.testing.assert_close(there[..., 1], here[..., 1], rtol=0, atol=1e-3)
    torch.testing.assert_close(other_depth, depth, rtol=0, atol=1e-5)
    torch.testing.assert_close(torch.linalg.det(other.c2w[:, :3, :3]), torch.ones(4))  # still rotations


@pytest.mark.parametrize("up, center, unit", [
    ((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), 1.0),
    ((0.0, 0.0, 1.0), (0.3, -0.2, 0.1), 1.0),
    ((0.48, 0.6, -0.64), (300.0, 100.0, -200.0), 1000.0),
    ((0.0, 1.0, 0.0), (0.001, 0.0, 0.002), 0.01),
])  # fmt: skip
def test_the_plane_of_two_equal_balls_is_found_in_any_frame(up, center, unit, device):
    camera = cameras(up=up, center=center, unit=unit)
    turn = turned(torch.tensor(up))
    distance = distances(ROTATIONAL, camera, turn, center, unit)
    plane = mirror_plane(distance.to(device), camera.to(device))
    normal = plane.normal.cpu()
    expected = turn[:, 0]
    cosine = float((normal @ expected).abs())
    # a pixel of the silhouettes is 0.015 units, over the object's 0.9 units: 1 degree
    assert math.degrees(math.acos(min(cosine, 1.0))) < 1.0
    assert abs(plane.offset - float(torch.tensor(center) @ normal)) < 0.008 * unit


def test_the_plane_is_more_accurate_than_a_pixel():
    """Planes at angles between those of the search; errors that a pixel would cause: 1 degree, 0.015 units."""
    camera, angles, offsets = cameras(), [], []
    for number in range(10):
        yaw = 0.1 + 0.31 * number
        cos, sin = math.cos(yaw), math.sin(yaw)
        turn = torch.tensor([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        plane = mirror_plane(distances(ROTATIONAL, camera, turn), camera)
        angles.append(math.degrees(math.acos(min(1.0, float((plane.normal @ turn[:, 0]).abs())))))
        offsets.append(abs(plane.offset))
    assert sum(angles) / 10 < 0.6 and sum(offsets) / 10 < 0.002  # 0.40 and 0.0007 measured
    assert max(angles) < 1.4 and max(offsets) < 0.004  # 0.95 and 0.0029


def test_an_object_without_a_mirror_plane_has_none(device):
    camera = cameras()
    assert mirror_plane(distances(ODD, camera).to(device), camera.to(device)) is None


def test_one_ball_has_a_plane_through_its_center():
    camera = cameras()
    plane = mirror_plane(distances([((0.1, 0.0, 0.05), 0.4)], camera), camera)
    # the center of the visual hull is that of the ball within some pixels
    assert abs(float(plane.normal @ torch.tensor([0.1, 0.0, 0.05])) - plane.offset) < 0.03


def around(count, arc):
    """Cameras on an arc [degree] about the object."""
    angles = [math.radians(arc * (k / (count - 1) - 0.5)) for k in range(count)]
    return cameras([(2.5 * math.sin(a), 0.3 + 0.4 * (k % 2), 2.5 * math.cos(a)) for k, a in enumerate(angles)])


@pytest.mark.parametrize("count, arc", [(3, 40), (4, 60), (6, 45), (8, 60)])
def test_from_one_side_the_plane_is_ambiguous(count, arc):
    camera = around(count, arc)
    assert mirror_plane(distances(ODD, camera), camera) is None
    assert mirror_plane(distances(ROTATIONAL, camera), camera) is None


@pytest.mark.parametrize("count, arc", [(4, 270), (8, 315)])
def test_a_plane_cuts_little_of_an_object_that_has_none(count, arc):
    """Random balls: few planes are found, and the mirrored hull leaves most of each object."""
    camera, planes, rng = around(count, arc), 0, torch.Generator().manual_seed(1)
    for _ in range(8):
        balls = [
            (
                tuple((0.7 * torch.rand(3, generator=rng) - 0.35).tolist()),
                float(0.1 + 0.15 * torch.rand((), generator=rng)),
            )
            for _ in range(4)
        ]
        distance = distances(balls, camera)
        plane = mirror_plane(distance, camera)
        if plane is not None:
            planes += 1
            points = torch.rand(20000, 3, generator=rng) * 1.4 - 0.7
            inside = torch.stack([(points - torch.tensor(c)).norm(dim=1) < r for c, r in balls]).any(0)
            mirrored = points[inside] - 2 * ((points[inside] @ plane.normal) - plane.offset)[:, None] * plane.normal
            kept = hull_distance(mirrored, distance, camera) > -0.01
            assert float(kept.float().mean()) > 0.9
    assert planes <= 3


def test_few_views_and_rolled_cameras_are_ambiguous():
    camera = cameras()
    distance = distances(ROTATIONAL, camera)
    for count in (1, 2):
        assert mirror_plane(distance[:count], camera[:count]) is None
    angles = torch.tensor([0.5, -0.6, 0.7, -0.4])
    roll = torch.eye(4).repeat(4, 1, 1)
    roll[:, 0, 0] = roll[:, 1, 1] = angles.cos()
    roll[:, 1, 0], roll[:, 0, 1] = angles.sin(), -angles.sin()
    rolled = replace(camera, c2w=camera.c2w @ roll)
    assert upright(rolled) is None
    assert mirror_plane(distances(ROTATIONAL, rolled), rolled) is None


def test_upright_is_perpendicular_to_horizontal_edges():
    up = torch.tensor([0.48, 0.6, -0.64])
    torch.testing.assert_close(upright(cameras(up=tuple(up.tolist()))), up, rtol=0, atol=1e-5)
    low = cameras(eyes=[(0.0, -1.0, 2.0), (2.0, -1.0, 0.1), (-2.0, -0.5, 0.0)])  # from below
    torch.testing.assert_close(upright(low), torch.tensor([0.0, 1.0, 0.0]), rtol=0, atol=1e-5)


def test_cameras_in_one_place_are_ambiguous():
    eye = look_at((0.3, 0.9, 2.4))
    turned_on_the_spot = torch.stack([eye @ yawed(angle) for angle in (-0.6, 0.0, 0.6)])
    camera = Camera.from_fov(turned_on_the_spot, 2.2, SIZE, SIZE)
    assert mirror_plane(distances(ROTATIONAL, camera), camera) is None


def yawed(angle):
    """A turn about the camera's own Y axis."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])


def test_wrong_shapes_are_refused():
    camera = cameras()
    with pytest.raises(ValueError, match="camera: expected"):
        mirror_plane(torch.zeros(3, SIZE, SIZE), camera)
    with pytest.raises(TypeError, match="distance: expected"):
        mirror_plane(torch.zeros(4, SIZE, SIZE).double(), camera)
