from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from reli3d.geometry.camera import project
from reli3d.geometry.hull import mask_distance
from reli3d.pipeline import refine
from reli3d.render.color import srgb_to_linear
from reli3d.views.similarity import Similarity
from reli3d.views.views import MASK_EDGE, Views, mask_box
from tests.support import small_scene
from tests.support.rigs import sphere_views


def ramp_views(width: int = 90, height: int = 70, box=(20, 12, 50, 60)) -> Views:
    """One view whose red and green are its pixel coordinates over 100, mask a rectangle."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    image = torch.stack([x / 100, y / 100, torch.full_like(x, 0.5)], -1)
    mask = torch.zeros(height, width)
    mask[box[1] : box[3], box[0] : box[2]] = 1.0
    k = torch.tensor([[100.0, 110.0, 41.3, 37.7]])
    return Views((image,), (mask,), torch.eye(4)[None], k, ("ramp",))


@pytest.mark.parametrize("crop, size", [(True, 32), (True, 100), (False, 32), (False, 40)])
def test_intrinsics_follow_the_pixels(crop, size):
    """The color under a projected point encodes its pixel in the original: there the original camera must see it."""
    views = ramp_views()
    batch = views.resampled(size, crop=crop)
    across = (torch.rand(200, 2, generator=torch.Generator().manual_seed(2)) - 0.5) * 0.3
    points = torch.cat([across, -torch.ones(200, 1)], 1)
    before, _ = project(points, views.c2w[0], views.intrinsics[0])
    after, _ = project(points, batch.c2w[0], batch.intrinsics[0])
    inside = ((after > 2) & (after < size - 2)).all(-1) & ((before > 4) & (before < torch.tensor([86.0, 66.0]))).all(-1)
    assert int(inside.sum()) > 50
    grid = (after[inside] / size * 2 - 1)[None, None]
    pixels = batch.images[0].permute(2, 0, 1)[None]
    found = torch.nn.functional.grid_sample(pixels, grid, align_corners=False)[0, :2, 0].T * 100
    # a triangle sampled at whole pixels is off center by up to 0.045 pixels; half a pixel would be a wrong convention
    torch.testing.assert_close(found, before[inside], rtol=0, atol=0.05)


def test_a_crop_is_square_centered_on_the_mask_and_padded():
    batch = ramp_views().resampled(64, crop=True, padding=0.08)
    x0, y0, x1, y1 = mask_box(batch.masks[0])
    assert abs((x0 + x1) / 2 - 32) <= 1
    assert abs((y0 + y1) / 2 - 32) <= 1
    assert abs((y1 - y0) - 64 / 1.16) <= 2  # the longer side plus 8 % on each side; a pixel of blur at each end
    assert float(batch.intrinsics[0, 0] / batch.intrinsics[0, 1]) == pytest.approx(100 / 110, rel=1e-6)


def test_a_crop_over_the_border_has_no_mask_and_the_edge_color():
    batch = ramp_views(box=(0, 5, 20, 65)).resampled(70, crop=True)  # 60 high: reaches 20 pixels over the left border
    left = batch.masks[0][:, :20]
    assert float(left.max()) == 0.0
    row = batch.images[0][35, :, 0]
    torch.testing.assert_close(row[:20], torch.full((20,), 0.005), rtol=0, atol=1e-4)  # the first column's color
    assert float(row[30]) > 0.02


def board(count: int) -> Views:
    """A checkerboard of single pixels."""
    checker = (torch.arange(count)[:, None] + torch.arange(count)) % 2
    image = checker[..., None].expand(-1, -1, 3).float()
    return Views((image,), (torch.ones(count, count),), torch.eye(4)[None], torch.ones(1, 4), ("c",))


def test_small_pixels_do_not_alias_and_linear_averages_are_those_of_light():
    image = board(128).resampled(16, crop=False).images[0]
    # a triangle filter over 16 pixels leaves 1/64 of a checkerboard; the border, where it is cut, a little more
    assert float((image - 0.5).abs().max()) < 0.02
    mean = board(64).resampled(8, crop=False, linear=True).images
    torch.testing.assert_close(srgb_to_linear(mean)[:, 2:-2, 2:-2], torch.full((1, 4, 4, 3), 0.5), rtol=0, atol=0.02)


def test_the_mask_keeps_its_area():
    views = sphere_views()
    batch = views.resampled(48, crop=False)
    for mask, small in zip(views.masks, batch.masks):
        assert float(small.mean()) == pytest.approx(float(mask.mean()), rel=5e-3)  # weights are cut at borders only


def test_a_similarity_moves_cameras_and_points_together():
    views = sphere_views(count=3)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]
    turn = turn * torch.sign(torch.linalg.det(turn))
    similarity = Similarity(2.5, turn, torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64))
    moved = views.transformed(similarity)
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    before, depth = project(points, views.c2w[:, None], views.intrinsics[:, None])
    after, moved_depth = project(similarity.apply(points), moved.c2w[:, None], moved.intrinsics[:, None])
    torch.testing.assert_close(after, before, rtol=0, atol=1e-3)  # float32 coordinates of some units, focal 160
    torch.testing.assert_close(moved_depth, 2.5 * depth, rtol=1e-5, atol=0)
    back = moved.transformed(similarity.inverse())
    torch.testing.assert_close(back.c2w, views.c2w, rtol=0, atol=2e-6)  # float32 rounding, twice, of values up to 10
    rotation = moved.c2w[:, :3, :3]
    torch.testing.assert_close(rotation.transpose(1, 2) @ rotation, torch.eye(3).expand(3, 3, 3))


def test_selection():
    views = sphere_views(count=4)
    assert views.select(2).names == ("0.png", "1.png")
    swapped = views.select([3, 0])
    assert swapped.names == ("3.png", "0.png")
    assert torch.equal(swapped.c2w, views.c2w[[3, 0]])
    for wrong in (0, 5, [], [4], [-1]):
        with pytest.raises(ValueError, match="which: expected"):
            views.select(wrong)


def test_views_are_checked():
    v = sphere_views(count=2)
    for error, words, change in (
        (ValueError, "c2w: expected shape", {"c2w": v.c2w[:1]}),
        (ValueError, "intrinsics: expected shape", {"intrinsics": v.intrinsics[:1]}),
        (ValueError, "masks, names", {"masks": v.masks[:1]}),
        (ValueError, r"masks\[1\]", {"masks": (v.masks[0], v.masks[1][:-1])}),
        (ValueError, r"images\[0\]: expected shape", {"images": (v.images[0][:0], v.images[1])}),
        (TypeError, r"images\[0\]", {"images": (v.images[0].double(), v.images[1])}),
        (ValueError, "at least one view", {"images": ()}),
    ):
        with pytest.raises(error, match=words):
            replace(v, **change)
    with pytest.raises(ValueError, match="size"):
        v.resampled(0)
    with pytest.raises(ValueError, match="empty mask"):
        replace(v, masks=(v.masks[0] * MASK_EDGE, v.masks[1])).resampled(32)


def test_cut_off_views_are_left_out_of_a_refinement_while_three_remain(monkeypatch):
    views = sphere_views(count=9, size=(64, 64))
    cut_off = (torch.ones_like(views.masks[0]), *views.masks[1:])
    fitted, asset = [], small_scene.ball()
    result = SimpleNamespace(asset=asset, changed=False)
    monkeypatch.setattr(
        "reli3d.fit.refine.refine", lambda asset, batch, options, **_: fitted.append((batch, options)) or result
    )
    refine(asset, replace(views, masks=cut_off), steps=1, light=list(range(9)))
    refine(asset, replace(views, masks=cut_off).select(3), steps=1)  # two others
    assert [len(batch) for batch, _ in fitted] == [8, 3] and fitted[0][1].light == list(range(1, 9))
    assert torch.equal(fitted[0][0].c2w, views.c2w[1:]) and torch.equal(fitted[1][0].c2w, views.c2w[:3])


def test_wrong_arguments_of_a_refinement_are_refused_before_images_are_resampled(monkeypatch):
    views, asset = sphere_views(count=3, size=(64, 64)), small_scene.ball()
    monkeypatch.delattr(Views, "resampled")
    with pytest.raises(TypeError, match="asset: expected Asset, got list"):
        refine([asset], views, steps=1)
    with pytest.raises(TypeError, match="views: expected Views, got ViewBatch"):
        refine(asset, small_scene.input_views(asset, 3, 16), steps=1)
    with pytest.raises(ValueError, match="seconds, steps: expected one of the two"):
        refine(asset, views)


def test_the_silhouette_of_a_cut_off_object_continues_beyond_the_image():
    """A disk of radius 40 around the lower edge's middle: the half below the image is not cut away."""
    x, y = torch.meshgrid(torch.arange(160) + 0.5, torch.arange(100) + 0.5, indexing="xy")
    mask = ((x - 80) ** 2 + (y - 100) ** 2 < 40**2).float()
    views = Views((torch.zeros(100, 160, 3),), (mask,), torch.eye(4)[None], torch.tensor([[90.0, 90, 80, 50]]), ("a",))
    batch = views.resampled(93)  # one pixel each
    assert float(batch.masks[0].sum()) == pytest.approx(float(mask.sum()), rel=0.01)
    beyond = batch.silhouettes[0] - batch.masks[0]
    assert float(beyond.sum()) > 80 and float(mask_distance(batch.silhouettes)[0][beyond > 0.5].min()) > 0
    whole = replace(views, masks=(mask.roll(-50, 0),)).resampled(93)
    assert torch.equal(whole.masks, whole.silhouettes)
