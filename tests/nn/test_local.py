"""The network of convolutions: its parts know where things are, and what must not matter does not."""

import dataclasses
import math

import pytest
import torch
from torch.nn.functional import avg_pool2d, normalize
from torch.utils.flop_counter import FlopCounterMode

from reli3d.geometry.camera import Camera, image_plane, look_at, project
from reli3d.geometry.hull import mask_distance
from reli3d.geometry.symmetry import MirrorPlane
from reli3d.nn.light_map import LightMap, splat
from reli3d.nn.local import LocalReconstructor, PixelMaps, mean_logit
from reli3d.nn.presets import SMALL, LightMapSizes, VolumeSizes
from reli3d.nn.pyramid import pixel_hull_depths, pixel_positions
from reli3d.nn.view_features import ViewMaps, ahead_of_surface
from reli3d.nn.volume import FeatureVolume
from reli3d.render.latlong import lat_long_texels
from tests.support.networks import LOCAL as TINY

SIZE = TINY.image_size


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    model = LocalReconstructor(TINY)
    with torch.no_grad():  # away from the initial zeros, so that every path contributes
        for parameter in model.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return model.eval()


def sphere(count: int, seed: int = 0):
    """Views of a ball of radius 0.4 whose color is a function of the normal: images, masks, c2w, intrinsics."""
    generator = torch.Generator().manual_seed(seed)
    eye = normalize(torch.randn(count, 3, generator=generator), dim=-1) * 2.2
    c2w = look_at(eye, torch.zeros(count, 3), torch.tensor([0.0, 1.0, 0.0]))
    intrinsics = torch.tensor([SIZE * 1.9, SIZE * 1.9, SIZE / 2, SIZE / 2]).expand(count, 4).contiguous()
    pixel = (torch.arange(SIZE) + 0.5 - SIZE / 2) / (SIZE * 1.9)
    y, x = torch.meshgrid(-pixel, pixel, indexing="ij")
    local = normalize(torch.stack([x, y, -torch.ones_like(x)], -1), dim=-1)
    d = torch.einsum("vij,xyj->vxyi", c2w[:, :3, :3], local)
    o = eye[:, None, None]
    b = (o * d).sum(-1)
    root = b * b - (2.2**2 - 0.4**2)
    point = o + d * (-b - root.clamp(min=0).sqrt())[..., None]
    normal = normalize(point, dim=-1)
    images = torch.where(root[..., None] > 0, 0.5 + 0.3 * normal, torch.full_like(normal, 0.2))
    return images, (root > 0).float(), c2w, intrinsics


def encoded(model, images, masks, c2w, intrinsics, *, inference=False):
    detail = torch.cat([images, mask_distance(masks)[..., None]], -1).contiguous()
    return model.encode(images, masks, c2w, intrinsics, detail, intrinsics, inference=inference)


def surface_of_ball(n: int = 200):
    normal = normalize(torch.randn(n, 3, generator=torch.Generator().manual_seed(5)), dim=-1)
    return 0.4 * normal, normal


@torch.no_grad()
def evaluated(field):
    position, normal = surface_of_ball()
    eyes = field.maps.camera.position
    visible = ((eyes[None] - position[:, None]) * normal[:, None]).sum(-1).gt(0).float()
    field = field.with_shading(position, normal, visible)
    material = field.material(position, normal, visible)
    return field.free_sdf(1.2 * position), material, field.radiance_map()


@pytest.mark.parametrize("views", [1, 2, 5, 16])
def test_any_number_of_views_in_any_order(model, views):
    inputs = sphere(views)
    sdf, material, light = evaluated(encoded(model, *inputs))
    assert sdf.shape == (200,) and material.base_color.shape == (200, 3) and light.shape == (16, 32, 3)
    assert all(bool(torch.isfinite(v).all()) for v in (sdf, light, *vars(material).values()))
    order = torch.randperm(views, generator=torch.Generator().manual_seed(1))
    other, other_material, other_light = evaluated(encoded(model, *(t[order] for t in inputs)))
    # sums over the views in another order, behind a dozen layers: float32 rounding, amplified
    torch.testing.assert_close(other, sdf, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(other_light, light, rtol=2e-3, atol=1e-3)
    for a, b in zip(vars(other_material).values(), vars(material).values(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("views", "offset"), [(1, 1.0), (2, 0.4), (4, 0.1), (8, -0.05), (9, -0.05)])
@torch.no_grad()
def test_the_surface_offset_falls_with_the_number_of_views_up_to_eight(model, monkeypatch, views, offset):
    """Linear in 1 / V; beyond eight views it does not fall further."""
    points, before = surface_of_ball()[0], encoded(model, *sphere(views)).free_sdf(surface_of_ball()[0])
    monkeypatch.setattr(model, "preset", dataclasses.replace(TINY, offset_one_view=1.0, offset_many_views=-0.2))
    after = encoded(model, *sphere(views)).free_sdf(points)
    torch.testing.assert_close(before - after, torch.full_like(before, offset), atol=1e-5, rtol=0)  # float32 rounding


@torch.no_grad()
def test_mirror_images_have_the_mirrored_maps(model):
    """The 2D U-Net does not read them; normals and points that they show are the photographs' ones, mirrored."""
    images, masks, c2w, intrinsics = sphere(3)
    intrinsics = intrinsics + torch.tensor([0.0, 0.0, 1.5, -0.5])  # principal point off the image center
    plane = MirrorPlane(normalize(torch.tensor([2.0, 0.3, 1.0]), dim=0), 0.07)
    other = plane.mirrored(Camera(c2w, intrinsics, SIZE, SIZE))
    views = [torch.cat([t, t.flip(2)]) for t in (images, masks)]
    poses = [torch.cat([c2w, other.c2w]), torch.cat([intrinsics, other.intrinsics])]
    detail = torch.cat([views[0], mask_distance(views[1])[..., None]], -1).contiguous()
    read = model.read_pixels(*views, *poses, detail, poses[1], mirrored=3)
    features, pixels, camera = read
    assert torch.equal(features[3:], features[:3].flip(2))
    depth = pixels.depth[..., 0] + (camera.c2w[:, :3, 3] * camera.c2w[:, :3, 2]).sum(-1)[:, None, None]
    x, y = image_plane(camera)
    local = torch.stack([x, y, -torch.ones_like(x)], -1) * depth[..., None]
    point = torch.einsum("vij,vxyj->vxyi", camera.c2w[:, :3, :3], local) + camera.c2w[:, None, None, :3, 3]
    for values, offset in ((pixels.normal, 0.0), (point, plane.offset)):
        expected = values - 2.0 * ((values @ plane.normal) - offset)[..., None] * plane.normal
        torch.testing.assert_close(values[3:], expected[:3].flip(2), rtol=0, atol=1e-5)  # rounding of the rotations
    assert pixels.gain.std() > 0.01 and pixels.normal.std() > 0.1


def test_a_turn_of_the_world_turns_the_light(model):
    """By a multiple of the coarsest texel's width (four columns of 32)."""
    images, masks, c2w, intrinsics = sphere(3)
    field = encoded(model, images, masks, c2w, intrinsics)
    c, s = math.cos(2 * math.pi * 4 / 32), math.sin(2 * math.pi * 4 / 32)
    turned = torch.block_diag(torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]]), torch.ones(1, 1)) @ c2w
    with torch.no_grad():
        other = encoded(model, images, masks, turned, intrinsics).log_light
        expected = torch.roll(field.log_light, -4, 2)  # from +X, the center, towards -Z, which is to the left
        wrong = torch.roll(field.log_light, 4, 2)
        assert float((wrong - expected).abs().mean()) > 0.01
        torch.testing.assert_close(other, expected, rtol=0, atol=1e-4)  # float32 through the U-Net


def test_a_splat_is_the_adjoint_of_bilinear_lookup():
    """Of ``grid_sample`` with columns that wrap and rows that are clamped, summed weights against its gradient."""
    torch.manual_seed(1)
    directions, weight, values = normalize(torch.randn(400, 3), dim=-1), torch.rand(400), torch.randn(400)
    mean, total = splat(values[:, None], weight, lat_long_texels(directions, 16), 16)
    x, y, z = directions.double().unbind(-1)
    u, v = torch.atan2(z, x) / (2 * math.pi) + 0.5, y.acos() / math.pi
    image = torch.zeros(2, 1, 16, 34, dtype=torch.float64, requires_grad=True)  # a column more at both sides
    at = torch.stack([(u * 32 + 1) / 34 * 2 - 1, v * 2 - 1], -1)[None, None].expand(2, -1, -1, -1)
    looked_up = torch.nn.functional.grid_sample(image, at, padding_mode="border", align_corners=False)[:, 0, 0]
    (grad,) = torch.autograd.grad((looked_up * torch.stack([weight, weight * values])).sum(), image)
    expected = grad[:, 0, :, 1:33]
    expected[..., 0] += grad[:, 0, :, 33]
    expected[..., -1] += grad[:, 0, :, 0]
    torch.testing.assert_close(total[0].double().expm1(), expected[0], rtol=0, atol=1e-4)  # angles are float32
    torch.testing.assert_close((mean[0] * total[0].expm1()).double(), expected[1], rtol=0, atol=1e-4)  # the same


def test_a_mirror_shows_the_light_where_it_reflects_it():
    """The U-Net's input of a glossy pixel is around the mirror direction."""
    torch.manual_seed(0)
    light, seen = LightMap(LightMapSizes(16, (8, 16))), []
    light.first.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0][0]))
    normal = torch.tensor([[0.0, math.cos(0.7), math.sin(0.7)]])  # the mirror direction is at the angle 1.4
    wo = torch.tensor([[0.0, 1.0, 0.0]])
    with torch.no_grad():
        light(torch.ones(1, 3), torch.full((1, 3), 0.5), torch.ones(1), normal, wo)
    for weight, angle in ((seen[0][6], 1.4), (seen[0][10], 0.7)):  # each after its means: at the mirror, at the normal
        row = 16 * angle / math.pi - 0.5  # of texel centers
        expected = torch.zeros(16, 32)
        expected[int(row), [0, 31]] = (1 - row % 1) / 2  # the view from +Y goes towards +Z, where the map wraps
        expected[int(row) + 1, [0, 31]] = (row % 1) / 2
        got = weight.expm1() / weight.expm1().sum()
        torch.testing.assert_close(got, expected, rtol=0, atol=1e-5)  # float32 angles


def test_pixels_start_as_observed():
    """Of zeros: the normal looks at the camera, nothing is added to the color."""
    _, _, c2w, intrinsics = sphere(4)
    camera = Camera(c2w, intrinsics / 2, 32, 32)
    maps = PixelMaps.of(torch.zeros(4, 32, 32, 12), torch.zeros(4, 16, 16, 2), camera, torch.tensor(0.0))
    center = maps.normal[:, 15:17, 15:17].mean((1, 2))
    torch.testing.assert_close(normalize(center, dim=-1), c2w[:, :3, 2], rtol=0, atol=1e-3)  # +Z of a camera looks back
    assert float(maps.shift.abs().max()) == 0.0 and float(maps.gain.min()) == pytest.approx(0.8808, abs=1e-4)
    assert float(maps.chroma.min()) == float(maps.chroma.max()) == 1.0


def test_base_color_does_not_follow_the_exposure():
    """Adding a constant to all color logits leaves the base color; hue and contrast remain."""
    _, _, c2w, intrinsics = sphere(4)
    camera, span = Camera(c2w, intrinsics / 2, 32, 32), torch.zeros(4, 16, 16, 2)
    raw = torch.randn(4, 32, 32, 12, generator=torch.Generator().manual_seed(0))
    color = 0.2 + 0.6 * torch.rand(4, 32, 32, 3, generator=torch.Generator().manual_seed(1))
    mask = (torch.rand(4, 32, 32, 1, generator=torch.Generator().manual_seed(2)) > 0.5).float()
    brighter = (color.logit() + 1.0).sigmoid()
    assert float(mean_logit(brighter, mask)) == pytest.approx(float(mean_logit(color, mask)) + 1.0, abs=1e-5)
    one, two = (PixelMaps.of(raw, span, camera, mean_logit(c, mask)).base_logit(c) for c in (color, brighter))
    torch.testing.assert_close(one, two, rtol=0, atol=1e-4)  # float32 logits
    maps = PixelMaps.of(0 * raw, span, camera, mean_logit(color, mask))
    gray = color.logit().mean(-1, keepdim=True)
    expected = color.logit() - gray + 0.8808 * (gray - mean_logit(color, mask))
    torch.testing.assert_close(maps.base_logit(color), expected, rtol=0, atol=1e-3)  # the gain has four digits here


def test_pixels_know_their_place():
    """A point of the plane that faces the camera projects to the pixel that has the point's coordinates."""
    eye, target = torch.tensor([[0.7, 1.1, 2.0]]), torch.tensor([[0.1, -0.2, 0.3]])
    c2w = look_at(eye, target, torch.tensor([0.0, 1.0, 0.0]))
    intrinsics = torch.tensor([[SIZE * 1.7, SIZE * 1.9, SIZE / 2 + 3, SIZE / 2 - 5]])
    place = pixel_positions(Camera(c2w, intrinsics, SIZE, SIZE))
    expected = place[0, 10, 40]
    point = expected[0] * c2w[0, :3, 0] + expected[1] * c2w[0, :3, 1]
    xy, _ = project(point[None], c2w[0], intrinsics[0])
    torch.testing.assert_close(xy, torch.tensor([[40.5, 10.5]]), rtol=0, atol=1e-3)


def test_pixels_know_where_their_rays_meet_the_hull():
    """Many views of a ball of radius 0.4: the hull is the ball, but for the angles between the views."""
    _, masks, c2w, intrinsics = sphere(16)
    camera = Camera(c2w, intrinsics, *masks.shape[:0:-1])
    seen = avg_pool2d(masks[:, None], 4)[:, 0]
    span = pixel_hull_depths(mask_distance(masks), camera, seen, camera.resized(*seen.shape[:0:-1]))
    middle = slice(seen.shape[1] // 2 - 1, seen.shape[1] // 2 + 1)
    enter, leave = span[:, middle, middle].mean((1, 2)).unbind(-1)
    assert float(enter.max()) < -0.38 and float(enter.median()) > -0.5  # before the ball, not far
    assert float(leave.min()) > 0.38 and float(leave.median()) < 0.5
    assert float(span[seen <= 0.1].abs().max()) == 0.0


def test_the_view_that_sees_a_point_has_the_weight(model):
    """A point that one view sees and another does not has the first one's color, not the mean of both."""
    images, masks, c2w, intrinsics = sphere(2, seed=3)
    images[0], images[1] = 0.8, 0.2
    field = encoded(model, images, masks, c2w, intrinsics)
    unlit = torch.zeros(2, 32, 32, 12)
    camera = Camera(c2w, intrinsics / 2, 32, 32)
    mean = torch.tensor(0.0)
    field = dataclasses.replace(field, pixels=PixelMaps.of(unlit, torch.zeros(2, 16, 16, 2), camera, mean))
    position = 0.4 * normalize(c2w[:, :3, 3], dim=-1)  # the nearest point to each camera
    visible = torch.eye(2)
    with torch.no_grad():
        logit = field.fused(position, normalize(position, dim=-1), visible).logit
    gain, white, black = 0.8808, math.log(0.8 / 0.2), math.log(0.2 / 0.8)
    # the hidden view keeps a weight of 0.02 squared
    torch.testing.assert_close(logit, gain * torch.tensor([[white], [black]]).expand(2, 3), rtol=0, atol=0.01)


def test_inference_by_fused_kernels_in_blocks_of_points_gives_what_training_gives(model):
    position, normal = surface_of_ball(9000)  # blocks have 8192
    visible = (torch.rand(9000, 5, generator=torch.Generator().manual_seed(2)) > 0.5).float()
    field, trained = (encoded(model, *sphere(5), inference=fast) for fast in (True, False))
    got, expected = field.fused(position, normal, visible), trained.fused(position, normal, visible)
    assert expected.logit.requires_grad and not got.logit.requires_grad
    # sums of five float32 terms in another order; logits of up to 4, and exp of the confidence
    torch.testing.assert_close(got.logit, expected.logit.detach(), rtol=0, atol=2e-5)
    torch.testing.assert_close(got.normal, expected.normal.detach(), rtol=0, atol=2e-5)
    torch.testing.assert_close(got.numbers[:, :9], expected.numbers[:, :9].detach(), rtol=0, atol=5e-5)
    # the root of a difference of squares: 1e-3 where the views agree
    torch.testing.assert_close(got.numbers[:, 9], expected.numbers[:, 9].detach(), rtol=1e-3, atol=1e-3)
    field, trained = (f.with_shading(position, normal, visible) for f in (field, trained))
    blocks, whole = (f.material(position, normal, visible) for f in (field, trained))
    heads = field.heads(position, normal, visible)
    later = field.material_from_heads(heads, position, normal, visible)
    assert all(torch.equal(a, b) for a, b in zip(vars(later).values(), vars(blocks).values(), strict=True))
    # the fused pass sums in another order, behind a dozen layers
    torch.testing.assert_close(blocks.base_color, whole.base_color.detach(), rtol=0, atol=1e-4)
    torch.testing.assert_close(blocks.normal, whole.normal.detach(), rtol=0, atol=1e-3)
    torch.testing.assert_close(field.sdf(position), trained.sdf(position).detach(), rtol=0, atol=2e-3)


def test_the_volume_is_read_where_it_was_written():
    volume = FeatureVolume(VolumeSizes(12, 0.56, (8, 16), 8), 8)
    axis = torch.linspace(-0.56, 0.56, 12)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)  # the coordinates themselves as features
    points = torch.rand(500, 3) * 1.1 - 0.55
    torch.testing.assert_close(volume.sample(grid, points), points, rtol=0, atol=1e-6)


def test_points_know_whether_they_lie_before_a_surface():
    """A plane at depth 0 and two cameras on the Z axis: in front of it +, behind it -, outside its coverage 0."""
    c2w = look_at(torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 3.0]]), torch.zeros(2, 3), torch.tensor([0.0, 1.0, 0.0]))
    intrinsics = torch.tensor([[SIZE * 1.2, SIZE * 1.2, SIZE / 2, SIZE / 2]]).expand(2, 4).contiguous()
    maps = ViewMaps(torch.zeros(2, 16, 16, 8), torch.zeros(2, SIZE, SIZE, 4), Camera(c2w, intrinsics, SIZE, SIZE))
    surface = torch.zeros(2, 32, 32, 3)
    surface[0, ..., 2] = 1.0  # the second camera shows nothing
    surface.requires_grad_()
    points = torch.tensor([[0.0, 0.0, 0.03], [0.1, 0.0, -0.03], [0.1, 0.1, 0.5]])
    got = ahead_of_surface(surface, maps, points)
    expected = torch.tensor([math.tanh(0.6), math.tanh(-0.6), math.tanh(10.0)])
    torch.testing.assert_close(got[:, 0], expected, rtol=0, atol=1e-4)
    torch.testing.assert_close(got[:, 1], expected, rtol=0, atol=1e-4)
    assert torch.equal(got[:, 3], torch.full((3,), 0.5))
    got[0, 0].backward()
    assert float(surface.grad[0, ..., 0].sum()) > 0 and float(surface.grad[1].abs().max()) == 0.0
    assert torch.equal(ahead_of_surface(torch.zeros(2, 32, 32, 3), maps, points)[:, 1:], torch.zeros(3, 3))
    uncertain, widening = surface.detach().clone(), torch.tensor(4.0, requires_grad=True)
    uncertain[0, ..., 1] = 0.06  # near = sqrt(0.05^2 + 4 * 0.06^2) = 0.13, far = sqrt(0.2^2 + 4 * 0.06^2)
    got = ahead_of_surface(uncertain, maps, points, widening)
    for column, scale in ((1, 0.13), (2, 0.05440**0.5)):
        expected = (torch.tensor([0.03, -0.03, 0.5]) / scale).tanh()
        torch.testing.assert_close(got[:, column], expected, rtol=0, atol=1e-4)
    got[0, 0].backward()
    assert float(widening.grad) < 0


@torch.no_grad()
def test_small_keeps_its_promises():
    """At most 30 GFLOP for 4 views, at most 60 MB in float16."""
    torch.manual_seed(0)
    model = LocalReconstructor(SMALL).eval()
    assert 2 * sum(p.numel() for p in model.parameters()) < 60e6
    size = SMALL.image_size
    images = torch.rand(4, size, size, 3)
    _, _, c2w, intrinsics = sphere(4)
    masks = torch.ones(4, size, size)  # the hull is the whole volume: the most work there can be
    with FlopCounterMode(display=False) as counter:
        field = encoded(model, images, masks, c2w, intrinsics * (size / SIZE))
    assert counter.get_total_flops() < 30e9
    assert bool(field.volume.isfinite().all()) and bool(field.log_light.isfinite().all())
