"""Photographs made anew: the same as the path traced ones where nothing casts a shadow, and nothing else changes."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch.nn import functional

from reli3d.errors import InputError
from reli3d.geometry.camera import Camera, camera_rays
from reli3d.render.color import srgb_to_linear
from reli3d.render.latlong import lat_long_directions, quarter_turn
from reli3d.synthetic.maps import training_maps
from reli3d.synthetic.samples import synthesize
from reli3d.train import batches
from reli3d.train.relight import Finish, draw_flash, draw_light, relight_views
from tests.support import reference
from tests.support.stages import WHITE, write_maps
from tests.support.surfaces import Ball


def finish(position):
    """Rough on the one side and glossy metal on the other."""
    right = (position[:, 0] > 0).float()
    color = torch.stack([0.7 - 0.4 * right, 0.3 + 0.2 * right, 0.2 + 0.5 * right], -1)
    return color, 0.8 - 0.4 * right, right


@pytest.fixture(scope="module")
def sky():
    """The same all around, so that the yaw of a sample does not matter: bright above, warm below."""
    y = lat_long_directions(32)[..., 1:2]
    below = 0.4 * (-y).clamp(min=0) * torch.tensor([1.0, 0.6, 0.3])
    return (0.3 + 2.0 * y.clamp(min=0) ** 2) * torch.tensor([0.8, 1.0, 1.2]) + below


@pytest.fixture(scope="module")
def sample(sky):
    return synthesize(Ball(finish, 5, 0.5), sky, np.random.default_rng(2), size=96, views=3)


@pytest.fixture
def drawn(sample, tmp_path, monkeypatch):
    """Loads two views of the stored sample, with constants of ``batches`` replaced."""
    save_file(sample, tmp_path / "0.safetensors")

    def load(lights=None, **constants):
        for name, value in constants.items():
            monkeypatch.setattr(batches, name, value)
        return batches.load_sample(tmp_path / "0.safetensors", 2, 64, np.random.default_rng(5), lights=lights)

    return load


def maps_of(sample):
    images, material = (sample[name].float() / 255 for name in ("images", "view_material"))
    camera = Camera(sample["c2w"], sample["intrinsics"], 96, 96)
    return images, material, sample["view_normal"].float() / 127, sample["view_depth"] > 0, camera


def test_the_same_light_gives_the_same_photographs(sample, sky):
    """A ball has no self-shadowing, so the path traced images, with shadow rays, are the reference."""
    images, *maps = maps_of(sample)
    got, light = relight_views(images, *maps, sky, np.random.default_rng(3))
    ratio = float(sample["environment"].float().mean() / light.mean())  # the exposures differ
    linear = lambda x: torch.where(x < 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    expected, got_linear = linear(images[..., :3]), linear(got[..., :3]) * ratio
    bright = (expected < 0.95).all(-1) & (got[..., :3] < 0.97).all(-1) & maps[2]  # neither is cut off
    assert int(bright.sum()) > 3000
    # means over the pixels: noise of 22 samples falls away, 8 bits of three maps err by 1 % at most
    for select in (bright, bright & (maps[0][..., 4] > 0.9), bright & (maps[0][..., 4] < 0.1)):
        torch.testing.assert_close(got_linear[select].mean(0), expected[select].mean(0), rtol=0.02, atol=0)
    assert float((got_linear - expected)[bright].abs().mean()) < 0.05  # the noise, 0.032 measured
    assert torch.equal(got[..., 3], images[..., 3])
    stored = quarter_turn(sample["environment"].float(), -1)
    torch.testing.assert_close(light * ratio, stored, rtol=2e-3, atol=1e-3)  # float16


def test_a_flash_lights_pixels_from_the_camera(sample, sky):
    """The reference's BSDF for light from the camera: of a flash that outshines the sky, and of one half as bright."""
    images, material, normal, valid, camera = maps_of(sample)

    def lit(flash):
        got, light = relight_views(images, material, normal, valid, camera, sky, np.random.default_rng(3), flash)
        return got[..., :3], (srgb_to_linear(got[..., :3]) * (sky.mean() / light.mean())).double()

    cosine = (functional.normalize(normal, dim=-1) * -camera_rays(camera)[1]).sum(-1).clamp(1e-3, 1.0)
    local = torch.stack([(1 - cosine**2).sqrt(), torch.zeros_like(cosine), cosine], -1).double()
    base, rough, metal = material.double().split([3, 1, 1], -1)
    bsdf = reference.eval_bsdf(local, local, srgb_to_linear(base), rough[..., 0] ** 2, metal[..., 0], "published")
    expected = bsdf * cosine[..., None]

    shown, radiance = lit(1e4)
    inner = valid & (images[..., 3] == 1.0) & (shown < 0.97).all(-1) & (cosine > 0.3)  # 8 bits of normals err by 0.004
    relative = radiance[inner] / expected[inner]
    error = (relative / relative.median() - 1).abs()
    assert int(inner.sum()) > 3000 and float(error.quantile(0.98)) < 0.01  # 0.003 measured, of the sky

    (plain_shown, plain), (half_shown, half) = lit(0.0), lit(0.5)
    added = expected * (0.5 * plain[valid].mean() / expected[valid].mean())
    whole = inner & (plain_shown < 0.97).all(-1) & (half_shown < 0.97).all(-1)
    ratio = float((half - plain)[whole].mean() / added[whole].mean())
    assert ratio == pytest.approx(1.0, abs=0.01)  # the plain image is clipped in a few pixels


def test_some_samples_are_relit_with_a_flash(drawn, sky):
    ratios = np.array([draw_flash(np.random.default_rng(k)) for k in range(2000)])
    used = ratios[ratios > 0]
    assert 236 < len(used) < 364  # 0.15 of 2000, 4 standard deviations
    assert 0.5 <= used.min() < 0.6 and 7.0 < used.max() <= 8.0
    flashes = (lambda rng: 0.0), (lambda rng: 4.0)
    dark, flashed = (drawn(sky[None], RELIGHT_PROBABILITY=1.0, draw_flash=flash).images for flash in flashes)
    assert not torch.equal(dark, flashed)


def test_a_finish_is_the_same_for_pixels_and_points():
    finish, material = Finish(1.5, 0.5, 0.1, None), torch.rand(40, 5, generator=torch.Generator().manual_seed(0))
    got = finish.apply(material)
    torch.testing.assert_close(got[:, :3], material[:, :3] ** 1.5)
    torch.testing.assert_close(got[:, 3], (0.5 * material[:, 3] + 0.1).clamp(0.03, 1.0))
    assert torch.equal(got[:, 4], material[:, 4])
    assert torch.equal(finish.apply(material.view(5, 8, 5)).view(40, 5), got)
    assert float(Finish(1.0, 1.0, 0.0, 1.0).apply(material)[:, 4].min()) == 1.0
    drawn = [Finish.draw(np.random.default_rng(k)) for k in range(200)]
    same = sum(f.gamma == 1.0 for f in drawn)
    assert 34 < same < 86 and any(f.metallic == 1.0 for f in drawn)  # 0.3 of 200, 4 standard deviations


def test_samples_are_relit_where_lights_are_given(drawn, sky):
    lights = sky[None]
    never, unlit = drawn(lights, RELIGHT_PROBABILITY=0.0), drawn()
    stored, always, again = drawn(RELIGHT_PROBABILITY=1.0), drawn(lights), drawn(lights)
    assert torch.equal(stored.images, unlit.images)  # without lights none are drawn
    assert float((never.view_depth - stored.view_depth).abs().max()) < 3.0  # another turn, the same object
    assert torch.equal(always.images, again.images) and torch.equal(always.light, again.light)
    assert not torch.equal(always.light, stored.light)
    assert all(bool(torch.isfinite(v.float()).all()) for v in vars(always).values())


def test_a_tone_curve_is_one_exponent_of_all_pixels(drawn):
    plain, curved = (drawn(MAX_NOISE=0.0, TONE_PROBABILITY=probability).images for probability in (0.0, 1.0))
    exponent = (curved.log() / plain.log())[(plain > 0.05) & (plain < 0.95)]
    assert abs(float(exponent.mean()) - 1.0) > 0.01 and float(exponent.std()) < 1e-4


def test_lights_are_drawn_from_the_maps_that_training_may_see(tmp_path):
    maps = np.random.default_rng(0).random((12, 64, 128, 3)).astype(np.float32)
    lights = training_maps(write_maps(tmp_path, maps))
    assert len(lights) == 10 and torch.equal(lights[0], quarter_turn(torch.from_numpy(maps[0]), -1))
    drawn = draw_light(lights, np.random.default_rng(1))
    assert drawn.shape == (64, 128, 3) and float(drawn.min()) > 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_a_map_whose_radiance_is_not_light_is_refused(value, tmp_path):
    maps = WHITE.copy()
    maps[2, 3, 4, 1] = value
    with pytest.raises(InputError, match="env: expected finite radiance of at least 0, got others in m02"):
        training_maps(write_maps(tmp_path, maps))
