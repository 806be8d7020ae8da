"""Mask distance and visual hull against closed forms: half planes, discs, spheres."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from scipy.spatial import cKDTree

from reli3d import pipeline
from reli3d.geometry.camera import Camera
from reli3d.geometry.hull import hull_distance, hull_span, mask_distance, mirror_residual
from reli3d.nn.local import LocalField
from reli3d.nn.presets import SMALL
from reli3d.nn.view_features import ViewMaps


def pixel_grid(height, width, device="cpu"):
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return x.to(device), y.to(device)


def disk(size, center, radius):
    x, y = pixel_grid(size, size)
    true = radius - torch.hypot(x - center[0], y - center[1])
    return (true + 0.5).clamp(0, 1), true


def test_half_plane_is_exact_for_an_unsaturated_ramp(device):
    x, y = pixel_grid(40, 50)
    a, b = math.cos(0.7), math.sin(0.7)
    true = a * (x - 23.3) + b * (y - 19.1)
    mask = (true / 100 + 0.5).clamp(0, 1)  # linear everywhere, so bilinear interpolation has the exact contour
    got = mask_distance(mask[None].to(device))[0].cpu()
    foot_x, foot_y = x - a * true, y - b * true
    inner = (foot_x > 1) & (foot_x < 49) & (foot_y > 1) & (foot_y < 39)  # the others' foot has no contour
    # beyond 4 px only the segments at the nearest crossing are evaluated, whose ends are at most sqrt(1/2) off
    torch.testing.assert_close(got[inner], true[inner], rtol=0, atol=math.sqrt(16.5) - 4)
    near = inner & (true.abs() < 3)
    torch.testing.assert_close(got[near], true[near], rtol=0, atol=2e-5)  # float32 of coordinates up to 50


@pytest.mark.parametrize(
    "size, center, radius, hard, most",
    [
        # a coverage that saturates one pixel from the contour moves the linear crossing by at most 0.09 pixels
        (128, (63.3, 66.8), 37.2, False, 0.1),
        # beyond 16 pixels the ends of segments will do: 0.25 / 16 too far at most
        (256, (127.3, 130.8), 60.2, False, 0.1 + 0.25 / 16),
        # the staircase's corners stand half a pixel diagonal off at most
        (128, (63.3, 66.8), 37.2, True, 0.75),
    ],
)
def test_distance_to_a_disc(device, size, center, radius, hard, most):
    mask, true = disk(size, center, radius)
    mask = (true > 0).float() if hard else mask
    got = mask_distance(mask[None].to(device))[0].cpu()
    assert (got - true).abs().max() < most
    assert bool(((got > 0) == (mask >= 0.5)).all())


def test_two_blobs_and_a_hole_against_brute_force(device):
    one, _ = disk(64, (18.2, 20.4), 10.3)
    two, _ = disk(64, (44.6, 40.1), 14.7)
    hole, _ = disk(64, (46.0, 41.0), 5.5)
    mask = torch.maximum(one, two) - hole
    got = mask_distance(mask[None].to(device))[0].cpu()
    fine = torch.nn.functional.interpolate(mask[None, None].double(), scale_factor=32, mode="bilinear")[0, 0] >= 0.5
    points = []
    for axis in (0, 1):  # sign changes of the bilinear mask at 1/32 pixel
        a, b = (fine[:-1], fine[1:]) if axis == 0 else (fine[:, :-1], fine[:, 1:])
        at = (a != b).nonzero().double()
        at[:, axis] += 0.5
        points.append((at + 0.5) / 32)
    x, y = pixel_grid(64, 64)
    true = cKDTree(torch.cat(points).numpy()).query(torch.stack([y, x], -1).reshape(-1, 2).numpy())[0].reshape(64, 64)
    # segments against the bilinear mask's hyperbolas: under 0.1 px at these radii, plus the sampling of 1/32
    assert (got.abs() - torch.from_numpy(true)).abs().max() < 0.13


def test_views_without_contour_are_deep_inside_or_outside(device):
    got = mask_distance(torch.stack([torch.zeros(6, 8), torch.ones(6, 8)]).to(device))
    torch.testing.assert_close(got[0], torch.full_like(got[0], -10.0))  # diagonal of 6 x 8
    torch.testing.assert_close(got[1], torch.full_like(got[1], 10.0))
    assert mask_distance(torch.zeros(0, 6, 8)).shape == (0, 6, 8)


def sphere_views(device, n=8, distance=3.0, radius=0.5, size=256, focal=300.0):
    """Exact coverage-like masks of a sphere at the origin from ``n`` cameras around it."""
    c2w = []
    for k in range(n):
        direction = torch.tensor([math.cos(k * 2.4), 0.7 * math.sin(1.7 * k), math.sin(k * 2.4)], dtype=torch.float64)
        back = direction / direction.norm()
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), back)
        right = right / right.norm()
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :4] = torch.stack([right, torch.linalg.cross(back, right), back, back * distance], -1)
        c2w.append(pose)
    # on the axis a sphere projects to a disc of radius f tan(asin(r / d))
    outline = focal * math.tan(math.asin(radius / distance))
    mask, _ = disk(size, (size / 2, size / 2), outline)
    intrinsics = torch.tensor([focal, focal, size / 2, size / 2]).expand(n, 4)
    return mask.expand(n, size, size).to(device), Camera(torch.stack(c2w).float(), intrinsics, size, size).to(device)


def cone_distance(points, c2w, distance=3.0, radius=0.5):
    """Signed distance to the nearest cone of sight that touches the sphere, in float64, positive inside."""
    angle = math.asin(radius / distance)
    eye = c2w[:, :3, 3].double()
    axis = -c2w[:, :3, 2].double()
    away = points.double()[:, None] - eye
    along = (away * axis).sum(-1)
    across = (away - along[..., None] * axis).norm(dim=-1)
    return (along * math.tan(angle) - across).mul(math.cos(angle)).min(1).values


def test_sphere_seen_by_eight_cameras(device):
    masks, camera = sphere_views(device)
    points = (torch.rand(4000, 3, generator=torch.Generator().manual_seed(1)) * 1.4 - 0.7).to(device)
    got = hull_distance(points, mask_distance(masks), camera).cpu()
    true = cone_distance(points.cpu(), camera.c2w.cpu())
    # a pixel at depth 3 is 0.01 wide, its contour 0.1 px off; the slant of the rays stretches by up to 6 % off the axis
    near = true.abs() < 0.05
    assert near.sum() > 200
    assert (got - true)[near].abs().max() < 0.001 + 0.05 * 0.06
    assert bool((got[true > 0.002] > 0).all())
    assert bool((got[true < -0.002] < 0).all())


def test_with_far_only_points_far_outside_differ(device):
    masks, camera = sphere_views(device)
    distance = mask_distance(masks)
    points = (torch.rand(4000, 3, generator=torch.Generator().manual_seed(2)) * 3.0 - 1.5).to(device)
    whole, got = hull_distance(points, distance, camera), hull_distance(points, distance, camera, far=0.3)
    near = whole >= -0.3
    assert torch.equal(got[near], whole[near]) and bool((got[~near] < -0.3).all())
    assert int((got != whole).sum()) > 500, "views are left out"


def mirrored_rays(device):
    """Points along rays, which of them count, and planes of which some leave the ball of :func:`sphere_views`."""
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(60, 5, 3, generator=generator) * 0.8 - 0.4
    known = torch.rand(60, 5, generator=generator) > 0.4
    known[0] = False
    normal = torch.nn.functional.normalize(torch.randn(30, 3, generator=generator), dim=-1)
    offset = torch.rand(30, generator=generator) - 0.5
    return [t.to(device) for t in (points, known, normal, offset)]


def test_how_far_mirrored_rays_miss_the_hull(device):
    """Against the distance to the cones of sight in float64, with every point measured."""
    masks, camera = sphere_views(device)
    points, known, normal, offset = mirrored_rays(device)
    got = mirror_residual(points, known, normal, offset, 0.2, mask_distance(masks), camera).cpu().double()
    flat, n = points.cpu().double().reshape(-1, 3), normal.cpu().double()[:, None]
    mirrored = flat - 2.0 * ((flat * n).sum(-1) - offset.cpu().double()[:, None])[..., None] * n
    inside = cone_distance(mirrored.reshape(-1, 3), camera.c2w.cpu()).view(30, 60, 5)
    expected = (-torch.where(known.cpu(), inside, -math.inf).amax(-1)).clamp(0.0, 0.2)
    assert bool((got[:, 0] == torch.tensor(0.2).double()).all())  # a ray of which nothing is known
    shown = expected < 0.05  # as in test_sphere_seen_by_eight_cameras: farther off the axis distances stretch
    assert shown[:, 1:].sum() > 200 and int((expected == 0).sum()) > 100
    assert float((got - expected)[shown].abs().max()) < 0.001 + 0.05 * 0.06
    assert bool((got[expected > 0.19] > 0.18).all())


def test_rays_enter_and_leave_the_cones_of_sight(device):
    """Against the cones in float64, looked at every 0.001 along the ray."""
    masks, camera = sphere_views(device)
    draw = torch.Generator().manual_seed(3)
    origins = torch.nn.functional.normalize(torch.randn(300, 3, generator=draw), dim=-1) * 2.5
    target = (torch.rand(300, 3, generator=draw) - 0.5) * 1.2
    directions = (target - origins) * (0.3 + torch.rand(300, 1, generator=draw))  # of any length
    got = hull_span(origins.to(device), directions.to(device), 0.87, mask_distance(masks), camera).cpu()
    length = directions.norm(dim=-1)
    t = torch.linspace(1.5, 3.5, 2001, dtype=torch.float64) / length[:, None]
    along = origins[:, None] + directions[:, None] * t[..., None]
    true = cone_distance(along.reshape(-1, 3), camera.c2w.cpu()).reshape(300, -1)
    true[along.norm(dim=-1) > 0.87] = -1.0
    hit = true.max(1).values > 0.02  # a ray that grazes the hull may miss it
    missed = true.max(1).values < -0.01
    assert hit.sum() > 150 and missed.sum() > 20
    first = torch.stack([t[k, true[k] > 0][0] for k in hit.nonzero()[:, 0]])
    last = torch.stack([t[k, true[k] > 0][-1] for k in hit.nonzero()[:, 0]])
    # a step of the reference, one of the tracing, and the cones' error, longer where the ray meets them at a slant
    error = torch.stack([got[hit, 0] - first, got[hit, 1] - last]).abs() * length[hit]
    assert error.quantile(0.9) < 0.006 and error.max() < 0.05
    assert torch.equal(got[missed, 0], got[missed, 1])
    closest = t[missed, true[missed].argmax(1)]
    assert ((got[missed, 0] - closest).abs() * length[missed]).median() < 0.03


def test_no_view_bounds_nothing(device):
    masks, camera = sphere_views(device, n=1)
    assert hull_distance(camera.position, masks[:0], camera[:0]).item() == 1000.0


def test_object_cut_by_the_border_is_unbounded_only_there(device):
    x, y = pixel_grid(64, 64)
    mask = ((20 - (y - 32).abs()) + 0.5).clamp(0, 1)
    mask = torch.minimum(mask, (x - 9.5).clamp(0, 1))  # a bar that leaves the image on the right only
    c2w = torch.eye(4)[None].to(device)
    intrinsics = torch.tensor([[64.0, 64.0, 32.0, 32.0]], device=device)
    points = torch.tensor([[5.0, 0.0, -2.0], [-5.0, 0.0, -2.0], [0.0, 5.0, -2.0]], device=device)
    got = hull_distance(points, mask_distance(mask[None].to(device)), Camera(c2w, intrinsics, 64, 64))
    assert [bool(v > 0) for v in got] == [True, False, False]


WRONG = [
    (hull_distance, "points", torch.zeros(3)),
    (hull_distance, "distance", torch.zeros(8, 1, 5)),
    (hull_distance, "camera", Camera(torch.zeros(7, 4, 4), torch.zeros(7, 4), 16, 16)),
    (hull_distance, "camera", Camera(torch.zeros(4, 4), torch.zeros(4), 16, 16)),
    (hull_distance, "camera", Camera(torch.zeros(8, 4, 4), torch.zeros(8, 4), 16, 15)),
    (hull_distance, "camera", torch.zeros(8, 4, 4)),
    (mirror_residual, "points", torch.zeros(60, 3)),
    (mirror_residual, "known", torch.ones(60, 4, dtype=torch.bool)),
    (mirror_residual, "known", torch.ones(60, 5)),
    (mirror_residual, "offset", torch.zeros(29)),
    (mirror_residual, "most", -0.1),
    (mirror_residual, "most", math.nan),
]


@pytest.mark.parametrize("function, name, value", WRONG)
def test_wrong_input_is_named(function, name, value):
    masks, camera = sphere_views("cpu", size=16)
    inputs = {"points": torch.zeros(4, 3)}
    if function is mirror_residual:
        inputs = dict(zip(("points", "known", "normal", "offset"), mirrored_rays("cpu"), strict=True), most=0.2)
    inputs |= {"distance": mask_distance(masks), "camera": camera, name: value}
    with pytest.raises((TypeError, ValueError), match=name):
        function(**inputs)


@pytest.mark.parametrize("mask", [torch.full((1, 4, 4), 2.0), torch.full((1, 4, 4), math.nan), torch.zeros(4, 4)])
def test_wrong_mask_is_named(mask):
    with pytest.raises(ValueError, match="masks"):
        mask_distance(mask)


@pytest.mark.parametrize("radius, views", [(0.5, 8), (0.06, 3), (0.3, 1)])
def test_the_reach_is_that_of_the_points_inside(device, radius, views):
    """Also of a thin ball, and of one view's cone that runs to the end of the grid."""
    masks, camera = sphere_views(device, n=views, radius=radius)
    images = torch.cat([torch.zeros(*masks.shape, 3, device=device), mask_distance(masks)[..., None]], -1)
    maps = ViewMaps(images.new_empty(views, 1, 1, 1), images, camera)
    model = SimpleNamespace(preset=SMALL)
    axis = torch.linspace(-SMALL.radius, SMALL.radius, 81, device=device)
    grid = torch.cartesian_prod(axis, axis, axis)
    dense = float(grid[hull_distance(grid, maps.silhouette, maps.camera) > 0].abs().max())
    assert pipeline._hull_reach(LocalField(maps, model, None, None, None, None, None), 80) == dense
    empty = replace(maps, images=images - 1000.0)
    with pytest.raises(ValueError, match="masks: expected masks that overlap"):
        pipeline._hull_reach(LocalField(empty, model, None, None, None, None, None), 80)
