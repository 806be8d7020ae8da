"""Training of the 2D U-Net alone: images of any size, several objects, levels that are added."""

import dataclasses

import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d, interpolate

from reli3d.cli.data import main as data
from reli3d.cli.train import main
from reli3d.geometry.camera import Camera
from reli3d.geometry.hull import hull_distance
from reli3d.nn.local import LocalReconstructor
from reli3d.nn.presets import SMALL
from reli3d.nn.pyramid import ImagePyramid
from reli3d.train import pixels
from reli3d.train.batches import TrainingViews, load_sample
from reli3d.train.checkpoint import load_average
from reli3d.train.loop import train
from reli3d.train.losses import PIXEL_TERMS, losses, pixel_losses
from reli3d.train.pixels import Group, draw_group, predict_pixels, read_views_reduced
from reli3d.train.small import PixelStage
from tests.support.stages import rendered_sample, write_maps


@pytest.fixture(scope="module")
def files(folder):
    return sorted(folder.glob("*.safetensors"))


def learned(finest: int = 0) -> LocalReconstructor:
    """A network whose last layers are not zero."""
    torch.manual_seed(0)
    model = LocalReconstructor(SMALL)
    for head in model.pyramid.says.values():
        torch.nn.init.normal_(head[1].weight, std=0.3)
    return pixels.reduced_model(model, finest) if finest else model


def test_images_of_the_full_size_are_those_of_a_sample(files):
    got = read_views_reduced(files[0], 1)
    expected = load_sample(files[0], 6, 64, np.random.default_rng(0), augment=False)
    for field in dataclasses.fields(TrainingViews):
        a, b = getattr(got, field.name), getattr(expected, field.name)
        torch.testing.assert_close(a, b, rtol=0, atol=1e-5, msg=field.name)


@pytest.mark.parametrize("factor", [2, 4])
def test_small_images_show_the_same_object(files, factor):
    """Points of the true surface lie in all silhouettes, and the maps of small images are means of the finer ones."""
    small, fine = read_views_reduced(files[0], factor), read_views_reduced(files[0], 1)
    size = fine.masks.shape[1] // factor
    assert small.images.shape[1:] == (size, size, 3) and small.view_normal.shape[1:] == (size // 2, size // 2, 3)
    sample = load_sample(files[0], 1, 2048, np.random.default_rng(0), augment=False)
    camera = Camera(small.c2w, small.intrinsics, size, size)
    pixel = 3.0 / float(small.intrinsics[:, 0].min())  # world size of a pixel at the farthest camera, about 3 away
    assert float(hull_distance(sample.surface[:, 0].contiguous(), small.silhouette, camera).min()) > -pixel
    valid = small.view_valid & (avg_pool2d(fine.view_valid.float()[:, None], factor)[:, 0] == 1)
    assert int(valid.sum()) > 100
    mean = avg_pool2d(fine.view_depth[:, None], factor)[:, 0]
    torch.testing.assert_close(small.view_depth[valid], mean[valid], rtol=0, atol=1e-5)


def test_mirrored_images_are_those_of_the_mirrored_object(files):
    views = read_views_reduced(files[0], 2)
    sample = load_sample(files[0], 1, 2048, np.random.default_rng(0), augment=False)
    for seed in range(20):
        got = pixels.augmented(views, np.random.default_rng(seed))
        side = "left" if float((got.c2w[:, :3, 3].sum(0) - views.c2w[:, :3, 3].sum(0)).abs()[0]) > 1e-3 else "right"
        points = sample.surface[:, 0] * torch.tensor([-1.0 if side == "left" else 1.0, 1.0, 1.0])
        camera = Camera(got.c2w, got.intrinsics, *got.masks.shape[:0:-1])
        assert float(torch.linalg.det(got.c2w[:, :3, :3]).min()) == pytest.approx(1.0, abs=1e-4)
        assert float(hull_distance(points.contiguous(), got.silhouette, camera).min()) > -0.03  # two pixels
        toward = got.c2w[:, None, None, :3, 3] / got.c2w[:, None, None, :3, 3].norm(dim=-1, keepdim=True)
        facing = (got.view_normal * toward).sum(-1)[got.view_valid]
        assert float((facing > -0.3).float().mean()) > 0.99  # visible points face the camera; normals are bumped
        if side == "left":
            return
    raise AssertionError("expected a mirrored object among 20")


@pytest.mark.parametrize("finest", [0, 1, 2])
def test_objects_side_by_side_are_read_as_each_alone(files, finest):
    model = learned(finest)
    objects = [read_views_reduced(f, 1 << finest).of_views(slice(0, n)) for f, n in zip(files, (3, 2), strict=True)]
    with torch.no_grad():
        both, _ = predict_pixels(model, Group.of(objects))
        first = 0
        for one in objects:
            alone, _ = predict_pixels(model, Group.of([one]))
            for field in dataclasses.fields(alone):
                part = getattr(both, field.name)[first : first + len(one.masks)]
                # float32 convolutions of another batch
                torch.testing.assert_close(part, getattr(alone, field.name), rtol=0, atol=2e-3, msg=field.name)
            first += len(one.masks)


@pytest.mark.parametrize("finest", [1, 2])
def test_a_finer_level_begins_by_adding_nothing(finest):
    torch.manual_seed(0)
    coarse = ImagePyramid(SMALL.pyramid, finest)
    for head in coarse.says.values():
        torch.nn.init.normal_(head[1].weight)
    fine = ImagePyramid(SMALL.pyramid, finest - 1)
    fine.load_state_dict(coarse.state_dict(), strict=False)
    x = torch.rand(2, 9, 64, 64)
    with torch.no_grad():
        _, small = coarse._convolved(avg_pool2d(x, 2), [2])
        _, got = fine._convolved(x, [2])
    expected = interpolate(small, scale_factor=2, mode="bilinear", align_corners=False)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-4)
    assert float(expected.std()) > 0.1


def test_pixels_alone_are_evaluated_as_with_the_rest(files):
    model = learned()
    sample = load_sample(files[0], 3, 512, np.random.default_rng(0), augment=False)
    whole = losses(model, sample)
    alone = pixel_losses(model, Group.of([read_views_reduced(files[0], 1).of_views(slice(0, 3))]))
    assert set(alone) == set(PIXEL_TERMS) < set(whole)
    for name, value in alone.items():
        torch.testing.assert_close(value, whole[name], rtol=1e-4, atol=1e-6, msg=name)


def test_an_object_without_a_whole_pixel_has_no_terms(files):
    """A thin object in a small image: the others are evaluated as without it.  Alone, it has its other terms."""
    model = learned(2)
    objects = [read_views_reduced(f, 4).of_views(slice(0, 2)) for f in files]
    empty = dataclasses.replace(objects[1], view_valid=torch.zeros_like(objects[1].view_valid))
    both, alone = (pixel_losses(model, Group.of(parts)) for parts in ([objects[0], empty], objects[:1]))
    for name, value in alone.items():
        torch.testing.assert_close(both[name], value, rtol=1e-3, atol=1e-5, msg=name)
    sample = load_sample(files[1], 1, 64, np.random.default_rng(0), augment=False)
    terms = losses(learned(), dataclasses.replace(sample, view_valid=torch.zeros_like(sample.view_valid)))
    assert not set(terms) & set(PIXEL_TERMS) and all(bool(value.isfinite()) for value in terms.values())


def test_every_view_of_a_drawn_object_is_read_once(files):
    cache = pixels.ViewCache(2)
    group = draw_group(files, [(1, k) for k in range(3)], cache, max_views=4)
    assert sum(group.counts) == len(group.views.masks) == 18 and max(group.counts) <= 4
    again = draw_group(files, [(1, k) for k in range(3)], cache, max_views=4)
    assert again.counts == group.counts and torch.equal(again.views.images, group.views.images)
    other = draw_group(files, [(2, k) for k in range(3)], cache, max_views=4)
    assert not torch.equal(other.views.c2w, group.views.c2w)


def test_levels_are_trained_one_after_the_other(folder, tmp_path, capsys):
    """From images of 64 pixels to the whole network by the command; each stage keeps the weights of the one before."""
    start = ["--steps", "1", "--batch", "1", "--rate", "1e-9"]
    assert main([str(folder), str(tmp_path / "64"), "--stage", "pixels", "--image-size", "64", *start]) == 0
    assert main([str(folder), str(tmp_path / "64"), "--export", str(tmp_path / "net.safetensors")]) == 2
    assert not (tmp_path / "net.safetensors").exists()
    capsys.readouterr()
    finer = ["--stage", "pixels", "--image-size", "128"]
    for other, expected in ((finer, "the same parameters, got one of others"), ([], "stage small, got one of pixels")):
        assert main([str(folder), str(tmp_path / "64"), *other, *start]) == 2
        remedy = "name another output folder, and this file by --weights"
        assert f"expected a checkpoint of {expected}; {remedy}" in capsys.readouterr().err
    from_64, from_128 = (["--weights", str(tmp_path / name / "state.pt")] for name in ("64", "128"))
    assert main([str(folder), str(tmp_path / "128"), "--stage", "pixels", "--image-size", "128", *from_64, *start]) == 0
    assert main([str(folder), str(tmp_path / "all"), *from_128, *start]) == 0
    small, middle, whole = (
        torch.load(tmp_path / name / "state.pt", weights_only=True)["average"] for name in ("64", "128", "all")
    )
    assert "pyramid.reads.1.0.weight" not in small and "pyramid.reads.0.0.weight" not in middle
    assert set(small) - set(middle) == set() and set(middle) < set(whole)
    for fewer, more in ((small, middle), (middle, whole)):
        assert all(float((more[k] - v).abs().max()) < 1e-6 for k, v in fewer.items())
    del small["pyramid.shared.weight"]
    with pytest.raises(ValueError, match="pyramid.shared.weight"):
        load_average(tmp_path, LocalReconstructor(SMALL), {"average": small}, pixels.missing_parameters(SMALL, small))


def test_training_of_pixels_teaches_the_2d_u_net_alone(folder, tmp_path):
    for side, finest in ((256, 0), (64, 2)):
        model = learned(finest)
        before = {k: v.clone() for k, v in model.state_dict().items()}
        stage = PixelStage(model, [folder])
        out = tmp_path / str(side)
        train(stage, stage.options(str(out), steps=3, batch=1, warmup=1, save_every=1))  # more often than log_every
        assert len((out / "log.jsonl").read_text().splitlines()) == 4  # options and steps
        changed = {k for k, v in model.state_dict().items() if not torch.equal(v, before[k])}
        assert changed == {k for k in before if pixels.is_pixel_parameter(k)} and len(changed) > 20


def test_samples_of_views_alone_teach_the_2d_u_net_and_nothing_else(tmp_path, capsys):
    light = np.random.default_rng(0).random((6, 8, 16, 3), dtype=np.float32)
    maps = write_maps(tmp_path, light)
    expected = ["--maps", str(maps), "--count", "2", "--views", "3", "--size", "64", "--workers", "1"]
    assert data(["render", str(tmp_path / "views"), "--views-only", *expected]) == 0
    for seed in range(2):
        path = rendered_sample(tmp_path / "whole", maps, views=3, size=64, seed=seed)
        views, whole = read_views_reduced(tmp_path / "views" / path.name, 1), read_views_reduced(path, 1)
        assert torch.equal(views.c2w, whole.c2w)
        both = views.view_valid & whole.view_valid
        assert float(both.sum() / whole.view_valid.sum()) > 0.9
        # one ray of four: pixels differ by noise and by detail below a pixel, not by a shift
        assert float((views.view_depth - whole.view_depth)[both].abs().mean()) < 0.005
        one, other = (avg_pool2d(v.images.permute(0, 3, 1, 2), 8) for v in (views, whole))
        assert float((one - other).abs().mean()) < 0.03
    few = ["--steps", "1", "--batch", "1"]
    assert main([str(tmp_path / "views"), str(tmp_path / "run"), "--stage", "pixels", "--image-size", "64", *few]) == 0
    assert main([str(tmp_path / "views"), str(tmp_path / "other"), *few]) == 2
    assert "points: expected F16" in capsys.readouterr().err
