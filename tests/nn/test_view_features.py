"""Lookup of points in views: the fused kernels against torch, order invariance and gradients."""

import pytest
import torch
from torch.nn.functional import grid_sample, normalize

from reli3d.geometry.camera import Camera, look_at, project
from reli3d.geometry.projection import gather_views
from reli3d.kernels import view_features as kernels
from reli3d.nn.view_features import ViewFeatures, ViewMaps
from reli3d.nn.view_lookup import pool_views, summarize_views
from tests.support import reference

SIZE, GRID, WIDTH = 24, 4, 6


def rig(views: int, device: torch.device) -> ViewMaps:
    g = torch.Generator().manual_seed(views)
    eyes = normalize(torch.randn(views, 3, generator=g), dim=-1) * 2.5
    c2w = torch.stack([look_at(e, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])) for e in eyes])
    images = torch.rand(views, SIZE, SIZE, 4, generator=g)
    images[..., 3] = images[..., 3] * 12 - 4
    tokens = torch.randn(views, GRID, GRID, WIDTH, generator=g)
    intrinsics = torch.tensor([30.0, 28.0, 11.0, 13.0]).expand(views, 4).contiguous()
    return ViewMaps(tokens.to(device), images.to(device), Camera(c2w, intrinsics, SIZE, SIZE).to(device))


def surface(n: int, views: int, device: torch.device, on_surface: bool = True):
    """Points, visibility and normals; the latter two are None of points in free space."""
    g = torch.Generator().manual_seed(n)
    points = torch.rand(n, 3, generator=g) * 1.6 - 0.8
    visible = (torch.rand(n, views, generator=g) < 0.5).float()
    normal = normalize(torch.randn(n, 3, generator=g), dim=-1)
    return points.to(device), *((visible.to(device), normal.to(device)) if on_surface else (None, None))


def unlit(maps: ViewMaps, points, visible, normal):
    """Reference in float64 torch, view by view."""
    rows = []
    for v in range(len(maps.images)):
        camera, points64 = maps.camera[v], points.double()
        c2w = camera.c2w.double()
        xy, depth = project(points64.float(), camera.c2w, camera.intrinsics)
        grid = (xy / SIZE * 2 - 1).double()[None, None]
        image = grid_sample(
            maps.images[v].double().permute(2, 0, 1)[None], grid, align_corners=False, padding_mode="border"
        )
        rgb, silhouette = image[0, :3, 0].T, image[0, 3:, 0].T
        inside = ((xy > 0) & (xy < SIZE)).all(-1, keepdim=True).double() * (depth[:, None] > 0)
        seen, facing, view_weight = torch.zeros_like(silhouette), torch.ones_like(silhouette), inside
        if visible is not None:
            seen = visible[:, v : v + 1].double() * 2 - 1
            facing = (normalize(c2w[:3, 3] - points64, dim=-1) * normal.double()).sum(-1, keepdim=True).clamp(min=0)
            view_weight = inside * (float(kernels.HIDDEN_WEIGHT) + visible[:, v : v + 1].double() * facing**2)
        edge = silhouette / (float(kernels.EDGE_WIDTH) * SIZE)
        view_weight = view_weight * edge.clamp(float(kernels.MIN_EDGE_WEIGHT), 1) + float(kernels.MIN_WEIGHT)
        distance = (silhouette / SIZE).clamp(-0.15, 0.15) / 0.15
        offset = depth[:, None].double() - (c2w[:3, 3] * c2w[:3, 2]).sum()
        rows.append(torch.cat([rgb, distance, offset, inside, seen, facing, edge.clamp(-1, 1), view_weight], -1))
    rows = torch.stack(rows, 1)
    own, view_weight = rows[..., :9], rows[..., 9]
    weight = view_weight / view_weight.sum(1, keepdim=True)
    color = (own[..., :3] * weight[..., None]).sum(1)
    spread = ((own[..., :3] - color[:, None]) ** 2 * weight[..., None]).sum(1).mean(-1, keepdim=True).sqrt()
    summary = color, spread, own[..., 3].amin(1)[:, None], view_weight.amax(1)[:, None], points.double()
    return own, weight, torch.cat(summary, -1)


def test_gathered_values_and_gradients_equal_their_float64_reference(device):
    """Clamped at the border, any channels; gradients of points compared by row, as those of image and pixels cancel."""
    g, n = torch.Generator().manual_seed(3), 20_000
    maps, points = torch.rand(3, 24, 20, 5, generator=g), torch.rand(n, 3, generator=g) * 1.6 - 0.8
    poses = rig(3, device).camera
    camera = Camera(poses.c2w, poses.intrinsics, 20, 24)
    ins = [v.to(device).requires_grad_() for v in (maps, points)]
    values, pixels = gather_views(*ins, camera)
    finer, shown = gather_views(*ins, camera.scaled(2))  # the maps show the same image in half of its resolution
    assert torch.equal(finer, values) and torch.equal(shown, pixels)
    doubles, rows = [v.double().requires_grad_() for v in (maps, points)], []
    for v in range(3):
        c2w, intrinsics = poses.c2w[v].cpu().double(), poses.intrinsics[v].cpu().double()
        local = (doubles[1] - c2w[:3, 3]) @ c2w[:3, :3]
        fx, fy, cx, cy = intrinsics
        x, y = fx * local[:, 0] / -local[:, 2] + cx, fy * local[:, 1] / local[:, 2] + cy
        grid = torch.stack([x / 20 * 2 - 1, y / 24 * 2 - 1], -1)[None, None]
        image = grid_sample(doubles[0][v].permute(2, 0, 1)[None], grid, align_corners=False, padding_mode="border")
        rows.append(torch.cat([image[0, :, 0].T, torch.stack([x, y, -local[:, 2]], -1)], -1))
    got, expected = torch.cat([values, pixels], -1), torch.stack(rows, 1)
    assert reference.fraction_within(got, expected) >= 0.999
    weight = torch.rand(expected.shape, generator=g)  # of one sign: sums that cancel have no digits left
    grads = torch.autograd.grad((got * weight.to(device)).sum(), ins)
    expected_grads = torch.autograd.grad((expected * weight.double()).sum(), doubles)
    assert reference.fraction_within(grads[0], expected_grads[0]) >= 0.999
    assert reference.rows_within(grads[1], expected_grads[1]) >= 0.999


def test_wrong_arguments_are_named(device):
    maps = rig(2, device)
    points, visible, _ = surface(8, 2, device)
    with pytest.raises(ValueError, match="expected both or none"):
        summarize_views(maps.images, maps.camera, points, visible, None)
    tokens, own = torch.zeros(2, GRID, GRID, 12, device=device), torch.zeros(9, 12, device=device)
    with pytest.raises(ValueError, match="tokens: expected .* H a multiple of 8, got .2, 4, 4, 12."):
        pool_views(maps.images, tokens, own, maps.camera, points, None, None)


@pytest.mark.parametrize("views", [1, 3, 16])
@pytest.mark.parametrize("on_surface", [False, True])
def test_the_kernel_matches_torch_and_the_fused_pass_the_differentiable_one(device, views, on_surface):
    torch.manual_seed(0)
    maps, module = rig(views, device), ViewFeatures(WIDTH).to(device)
    of_points = surface(700, views, device, on_surface)
    for g, w in zip(summarize_views(maps.images, maps.camera, *of_points), unlit(maps, *of_points), strict=True):
        # projection in float32: errors of 1e-5 pixel on values that change by up to 12 per pixel; 0.2 % of them are
        # divided by EDGE_WIDTH * SIZE
        torch.testing.assert_close(g.double(), w, rtol=1e-4, atol=5e-4)
    slow = module(maps, *of_points)
    with torch.no_grad():
        assert all(torch.equal(a, b) for a, b in zip(module(maps, *of_points), slow, strict=True))
    for a, b in zip(module.fused(maps, *of_points), slow, strict=True):
        # float32 sums of 25 products in another order, and the kernel's SiLU, 4e-7 off
        torch.testing.assert_close(a, b, rtol=1e-5, atol=3e-6)


def test_the_layer_saturates_as_silu_does(device):
    """Far beyond where the rational tanh is cut off, and around zero."""
    maps = rig(2, device)
    points, _, _ = surface(64, 2, device)
    for value in (-80.0, -9.0, -1.0, 0.0, 1e-3, 2.0, 9.0, 80.0):
        tokens = torch.full((2, GRID, GRID, 8), value, device=device)
        layer = torch.zeros(9, 8, device=device)
        pooled, _ = pool_views(maps.images, tokens, layer, maps.camera, points, None, None)
        expected = torch.nn.functional.silu(torch.tensor(value, dtype=torch.float64)).item()
        assert pooled.cpu().double().sub(expected).abs().max() < 5e-7 * max(1.0, abs(value))  # bilinear weights: 2 ulp
