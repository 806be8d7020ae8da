"""Silhouette coverage: closed forms, and a float64 reference in torch."""

import math
from pathlib import Path

import pytest
import torch
from torch.nn.functional import grid_sample, max_pool2d

import reli3d
from reli3d import pipeline
from reli3d.geometry.camera import Camera, camera_rays, look_at, project
from reli3d.geometry.cover import DEPTH, FIELD_MAX, STRIDE, cover_silhouettes
from reli3d.geometry.hull import mask_distance
from reli3d.geometry.rays import RayScene
from reli3d.geometry.surface import extract_surface
from reli3d.nn.weights import load_model
from reli3d.views.folder import load_views

RADIUS = 0.6
FREE = -10.0  # bound of a grid without silhouettes


def grid(counts, dtype=torch.float32):
    axes = [torch.linspace(-RADIUS, RADIUS, n, dtype=dtype) for n in counts]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)


def far_camera(size=128, height=0.9):
    """On +z, 200 units away: its rays are parallel to z but for 0.3 % and ``height`` units high at the origin."""
    c2w = look_at(torch.tensor([0.0, 0.0, 200.0]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    focal = size * 200.0 / height
    return Camera(c2w[None], torch.tensor([[focal, focal, size / 2, size / 2]]), size, size)


def disk(size, radius):
    """Signed distance in pixels to a centered disc, positive inside."""
    y, x = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    return (radius - torch.hypot(x - size / 2, y - size / 2))[None]


def test_an_unsure_sheet_becomes_a_surface_as_thick_as_it_is_unsure(device):
    """0.5 + (z / s)^2 has no inside; lowered to (z / s)^2 - DEPTH it is negative for |z| < s sqrt(DEPTH)."""
    points, s = grid((41, 41, 41)), 0.4
    sdf = 0.5 + (points[..., 2] / s).square()
    args = [v.to(device) for v in (sdf, torch.full_like(sdf, FREE), disk(128, 40.0), far_camera())]
    got = cover_silhouettes(*args, radius=RADIUS).cpu()
    radius = points[..., :2].norm(dim=-1)
    inner, outer = radius < (40 - STRIDE) * 0.9 / 128, radius > (40 + 2 * STRIDE) * 0.9 / 128
    expected = torch.where(sdf < FIELD_MAX, sdf - 0.5 - DEPTH, sdf)
    # a ray looks every half cell, so it may miss the lowest point by a quarter of a cell of 0.03
    torch.testing.assert_close(got[inner], expected[inner], rtol=0, atol=(0.0075 / s) ** 2 + 1e-4)
    assert torch.equal(got[outer], sdf[outer])
    mesh = extract_surface(got, radius=RADIUS)
    assert abs(float(mesh.vertices[:, 2].max()) - s * math.sqrt(DEPTH)) < 0.003  # a tenth of a cell
    beyond = float(mesh.vertices[:, :2].norm(dim=-1).max()) - 40 * 0.9 / 128
    assert 0.0 < beyond < 2 * STRIDE * 0.9 / 128  # nothing bounds it here but the next ray without a surface


def test_a_surface_that_covers_its_silhouettes_stays_as_it_is(device):
    points = grid((31, 33, 35))
    sdf = (points.norm(dim=-1) - 0.4) / 0.02
    args = [v.to(device) for v in (sdf, torch.full_like(sdf, FREE), disk(128, 0.385 * 128 / 0.9), far_camera())]
    assert torch.equal(cover_silhouettes(*args, radius=RADIUS).cpu(), sdf)


def in_float64(sdf, bound, distance, cameras):
    """Rays by ``camera_rays``, trilinear and bilinear values by ``grid_sample``, all steps of a ray at once."""
    rows, columns = (k // STRIDE for k in distance.shape[1:])
    step = RADIUS / (max(sdf.shape) - 1)  # half a cell
    points = grid(sdf.shape, torch.float64).reshape(-1, 3)
    most = torch.zeros(len(points), dtype=torch.float64)
    for v, c2w in enumerate(cameras.c2w):
        camera = Camera(c2w, cameras.intrinsics[v] / STRIDE, columns, rows)
        o, d = (r.reshape(-1, 3).double() for r in camera_rays(camera))
        ends = torch.stack([(-RADIUS - o) / d, (RADIUS - o) / d])
        near, far = ends.amin(0).amax(1).clamp(min=0.0), ends.amax(0).amin(1)
        t = near[:, None] + step * torch.arange(int(4 * RADIUS / step))
        at = (o[:, None] + t[..., None] * d[:, None]) / RADIUS
        value = grid_sample(sdf[None, None], at.flip(-1)[None, :, :, None], align_corners=True, padding_mode="border")
        least = torch.where(t < far[:, None], value[0, 0, :, :, 0], torch.inf).amin(1)
        x, y = torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="xy")
        center = (torch.stack([x, y], -1) + 0.5) * STRIDE * 2 / torch.tensor([distance.shape[2], distance.shape[1]]) - 1
        inside = grid_sample(distance[None, v : v + 1], center[None].double(), align_corners=False)[0, 0].reshape(-1)
        lacks = torch.where((inside > 1.0) & (least < FIELD_MAX), (least + DEPTH).clamp(min=0.0), 0.0)
        lacks = max_pool2d(lacks.view(1, 1, rows, columns), 3, 1, 1)
        pixel, _ = project(points.float(), c2w, cameras.intrinsics[v])
        place = pixel.double() / STRIDE * 2 / torch.tensor([columns, rows]) - 1
        value = grid_sample(lacks, place[None, :, None], align_corners=False, padding_mode="border")
        most = torch.maximum(most, torch.where((place.abs() < 1.0).all(1), value[0, 0, :, 0], 0.0))
    flat = sdf.reshape(-1)
    return torch.where(flat.abs() < FIELD_MAX, torch.maximum(flat - most, bound.reshape(-1)), flat).view_as(sdf)


def test_equals_the_float64_reference_on_a_rough_field(device):
    g = torch.Generator().manual_seed(3)
    coarse = torch.randn(1, 1, 6, 6, 6, generator=g)
    sdf = torch.nn.functional.interpolate(coarse, (25, 23, 27), mode="trilinear", align_corners=True)[0, 0] * 2 + 1.0
    bound = sdf - 2.0 * torch.rand(sdf.shape, generator=g)
    eyes = torch.tensor([[1.5, 0.4, 1.0], [-1.2, 0.3, 1.4], [0.3, -1.5, 0.8]])
    c2w = torch.stack([look_at(e, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])) for e in eyes])
    camera = Camera(c2w, torch.tensor([[70.0, 75.0, 31.0, 33.0]]).expand(3, 4).contiguous(), 64, 64)
    masks = (torch.rand(3, 8, 8, generator=g) > 0.3).float().repeat_interleave(8, 1).repeat_interleave(8, 2)
    distance = mask_distance(masks)
    args = [v.to(device) for v in (sdf, bound, distance, camera)]
    got = cover_silhouettes(*args, radius=RADIUS).cpu()
    expected = in_float64(sdf.double(), bound.double(), distance.double(), camera)
    assert float((expected != sdf).double().mean()) > 0.2
    # float32 has rays enter the cube 1e-5 of a step aside; one whose least sdf is FIELD_MAX falls to either side
    assert float(((got - expected).abs() < 2e-4).double().mean()) > 0.999


def covered_fractions(field):
    """Fraction of the pixels inside the silhouettes whose rays meet the mesh; and of the mesh's that lie inside."""
    mesh, maps = pipeline.extract(field, field.model.preset.resolution), field.maps
    scene = RayScene(mesh.vertices, mesh.faces)
    hit = torch.stack([scene.closest(*camera_rays(camera)).face >= 0 for camera in maps.camera])
    inside = maps.images[..., 3] > 0
    return float((hit & inside).sum() / inside.sum()), float((hit & inside).sum() / hit.sum())


@torch.no_grad()
@pytest.mark.parametrize("count, least", [(1, 0.95), (4, 0.975)])
def test_the_mesh_has_the_silhouettes_of_the_photographs(count, least, monkeypatch):
    """The error is at the outline, where smoothing takes a fraction of a cell: more of it bulges from one view."""
    model = load_model("small", "cpu")
    views = load_views(Path(reli3d.__file__).parent / "assets/example", views=count)
    field = pipeline.encode(model, pipeline.prepare(model, views, pipeline.normalize(views, "auto")))
    covered, exact = covered_fractions(field)
    assert covered > least and exact > 0.975
    monkeypatch.setattr(pipeline, "cover_silhouettes", lambda sdf, *args, **options: sdf)
    assert covered_fractions(field)[0] < least


def test_without_views_the_field_is_returned_unchanged(device):
    sdf = grid((5, 6, 7)).sum(-1).to(device)
    none = torch.zeros(0, 16, 16, device=device), Camera(torch.zeros(0, 4, 4), torch.zeros(0, 4), 16, 16).to(device)
    assert torch.equal(cover_silhouettes(sdf, sdf - 1.0, *none, radius=RADIUS), sdf)


def test_bad_input_is_named():
    sdf, camera = torch.zeros(4, 4, 4), far_camera(32)
    good = {"sdf": sdf, "bound": sdf, "distance": disk(32, 9.0), "camera": camera}
    for change, message in (
        ({"sdf": torch.zeros(4, 4)}, r"sdf: expected shape \(X, Y, Z\)"),
        ({"bound": torch.zeros(4, 4, 5)}, r"bound: expected shape \(4, 4, 4\)"),
        ({"distance": torch.zeros(1, 4, 40)}, r"distance: expected shape \(V, H, W\)"),
        ({"camera": camera[0]}, "camera: expected 1 views"),
        ({"camera": far_camera(30)}, "camera: expected 32 by 32 pixels, got 30 by 30"),
    ):
        with pytest.raises(ValueError, match=message):
            cover_silhouettes(**{**good, **change}, radius=1.0)
    for radius in (0.0, math.nan):
        with pytest.raises(ValueError, match="radius: expected a positive number"):
            cover_silhouettes(**good, radius=radius)
