"""The published network's inputs against the release's own tensors, and the options of the user."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from reli3d.views import published_views as module
from reli3d.views.folder import load_views
from reli3d.views.published_views import background_shown, hero_first, jpeg_round_trip, placement_notes, published_views
from reli3d.views.similarity import Similarity
from reli3d.views.views import Views
from tests.support.rigs import sphere_views

# bilinear weights and the division by 255 in float32, summed in another order: 2 units in the last place of 1
ROUNDING = 2.5e-7


def small_views(count: int = 3) -> Views:
    rng = torch.Generator().manual_seed(4)
    images = tuple(torch.rand(20, 30, 3, generator=rng) for _ in range(count))
    return replace(sphere_views(count=count, size=(30, 20)), images=images)


def test_a_render_is_prepared_as_published(goldens, shared_data):
    golden = np.load(goldens / "mapper_Camera_01.npz")
    batch = published_views(load_views(shared_data / "captures" / "Camera_01"), 512)
    masks = np.unpackbits(golden["mask_packed"][0], axis=-1)
    assert np.array_equal(batch.masks.numpy(), masks)
    images = batch.images.numpy()
    assert np.abs(images[:, ::16, ::16] - golden["image_stride16"][0]).max() < ROUNDING
    assert np.abs(images[0, 256] - golden["image_view0_row256"]).max() < ROUNDING
    assert np.abs(images.mean((1, 2), dtype=np.float64) - golden["image_mean"][0]).max() < 1e-6  # a float32 mean
    gray = torch.lerp(torch.full_like(batch.images, 0.5), batch.images, batch.masks[..., None]).numpy()
    assert np.abs(gray[:, ::16, ::16] - golden["image_bg_stride16"][0]).max() < ROUNDING
    assert np.abs(batch.c2w.numpy() - golden["c2w"][0]).max() < 1e-6  # reading makes rotations orthonormal again
    matrix = golden["intrinsics"][0]
    np.testing.assert_allclose(batch.intrinsics.numpy(), matrix[:, [0, 1, 0, 1], [0, 1, 2, 2]], rtol=1e-6)


def test_a_capture_is_prepared_as_published(goldens, shared_data):
    golden = load_file(goldens / "mapper_UCO3D_217-72983-41010.safetensors")
    views = load_views(shared_data / "captures" / "UCO3D_217-72983-41010", every=True).select(2)
    assert np.abs(views.c2w.numpy() - golden["in.c2w"]).max() < 1e-6
    batch = published_views(views, 512)

    def blocks(x):
        return x.reshape(2, 64, 8, 64, 8, -1).double().mean((2, 4)).numpy()

    assert np.abs(blocks(batch.images) - golden["out.image_cond_64"]).max() < ROUNDING
    assert np.array_equal(blocks(batch.masks).astype(np.float32), golden["out.opacity_cond_64"])
    assert np.abs(batch.images[:, 256].numpy() - golden["out.image_cond_row256"]).max() < ROUNDING
    matrix = golden["out.intrinsics_cond"][0]
    np.testing.assert_allclose(batch.intrinsics.numpy(), matrix[:, [0, 1, 0, 1], [0, 1, 2, 2]], rtol=1e-6)


def test_jpeg_keeps_flat_color_and_halves_the_resolution_of_chroma():
    flat = torch.tensor([120.0, 60, 200]).expand(32, 32, 3) / 255
    assert (jpeg_round_trip(flat) - flat).abs().max() <= 2.5 / 255  # YCbCr and back, in 8 bits
    checker = torch.zeros(32, 32, 3)
    checker[::2, ::2, 0] = checker[1::2, 1::2, 0] = 1.0
    back = jpeg_round_trip(checker)
    assert back[8:24, 8:24, 1].max() > 0.1  # a red checkerboard of single pixels leaks into green under 4:2:0
    assert torch.equal((back * 255).round() / 255, back)


def test_shapes_cameras_and_errors():
    views = small_views()
    batch = published_views(views, 16)
    assert batch.images.shape == (3, 16, 16, 3) and set(batch.masks.unique().tolist()) == {0.0, 1.0}
    torch.testing.assert_close(batch.intrinsics, views.intrinsics * torch.tensor([16 / 30, 16 / 20] * 2))
    with pytest.raises(ValueError, match="size: expected at least 1"):
        published_views(views, 0)


def test_the_hero_comes_first_and_the_rest_keeps_its_order():
    views = small_views(4)
    assert hero_first(views, 0) is views
    assert hero_first(views, 2).names == ("2.png", "0.png", "1.png", "3.png")
    for wrong in (4, -1, True, "last"):
        with pytest.raises(ValueError, match="hero: expected 0 to 3 with 4 views"):
            hero_first(views, wrong)


def test_the_background_is_shown_where_there_is_one():
    views = small_views(2)
    flat = torch.where(views.masks[0][..., None] > 0, views.images[0], torch.tensor(0.25))
    cut = replace(views, images=(views.images[0], flat))
    assert background_shown(views, "auto", readable=True)
    assert not background_shown(views, "auto", readable=False)
    assert not background_shown(cut, "auto", readable=True)  # one view without is enough
    assert background_shown(cut, "visible", readable=True) and not background_shown(views, "masked", readable=True)
    with pytest.raises(ValueError, match="background: expected masked or auto, .* got visible"):
        background_shown(views, "visible", readable=False)
    with pytest.raises(ValueError, match="background: expected auto, masked, visible, got black"):
        background_shown(views, "black", readable=True)


def test_an_object_off_the_cube_is_noted():
    views = load_views(Path(module.__file__).parents[1] / "assets" / "example")
    assert placement_notes(views) == ()
    away = Similarity(4.0, torch.eye(3, dtype=torch.float64), torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64))
    (note,) = placement_notes(views.transformed(away))
    assert "--normalize auto" in note
