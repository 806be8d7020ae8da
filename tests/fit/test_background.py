"""The background of images becomes the lighting of a fit where they show it."""

import math
from dataclasses import replace

import pytest
import torch

import reli3d
from reli3d.errors import InputError
from reli3d.fit import losses
from reli3d.fit.background import MAX_SCALE, Background
from reli3d.fit.input_images import InputImages
from reli3d.fit.refine import RefineOptions, refine
from reli3d.fit.unknowns import LIGHT_ROWS, Start, Unknowns
from reli3d.geometry.camera import Camera, look_at
from reli3d.pipeline import REFINED, SURROUNDINGS
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.image import render_asset
from reli3d.render.latlong import lat_long_directions, texel_solid_angles
from reli3d.views.views import ViewBatch, Views
from tests.support import small_scene

SIZE = 48
AXES = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


def sky(d: torch.Tensor) -> torch.Tensor:
    """Radiance of unit directions, smooth, between 0.1 and 0.7, of a color that varies."""
    return 0.4 + 0.3 * torch.stack([d[..., 0], d[..., 1], -d[..., 2]], -1)


def photographs(which=range(6), shine=sky, size=SIZE) -> ViewBatch:
    """Faces of a cube around the origin as images, computed here; the middle of each is covered by an object."""
    up = [AXES[4 if k in (2, 3) else 2] for k in range(6)]
    c2w = torch.stack([look_at(-2.0 * AXES[k], torch.zeros(3), up[k]) for k in which])
    at = (torch.arange(size) + 0.5) / size * 2.0 - 1.0  # 90 degrees
    local = torch.stack([at[None, :].expand(size, size), -at[:, None].expand(size, size), -torch.ones(size, size)], -1)
    world = torch.einsum("vij,hwj->vhwi", c2w[:, :3, :3], local / local.norm(dim=-1, keepdim=True))
    mask = torch.zeros(len(c2w), size, size)
    mask[:, size * 5 // 12 : size * 7 // 12, size * 5 // 12 : size * 7 // 12] = 1.0
    images = torch.where(mask[..., None] > 0, torch.ones(()), linear_to_srgb(shine(world).clamp(0.0, 1.0)))
    return ViewBatch(images, mask, c2w, torch.tensor([[size / 2] * 4] * len(c2w)))


def start(value: float = 0.05) -> Start:
    return Start(torch.zeros(2, 2, 2, 5), torch.full((LIGHT_ROWS, 2 * LIGHT_ROWS, 3), value).log())


def over(first: Start, images: InputImages) -> Start:
    return Background.of(images).over(first)


def test_seen_directions_get_the_radiance_of_the_pixels_and_the_others_keep_the_start():
    got = over(start(), InputImages.of(photographs(range(5))))  # not towards -Z
    true, light = sky(lat_long_directions(LIGHT_ROWS)), got.light[0].exp()
    seen = got.observed[0, ..., 0]
    toward = AXES @ lat_long_directions(LIGHT_ROWS).reshape(-1, 3).T
    inside = (toward[:5].amax(0) > 0.2 + toward[5]).reshape(seen.shape)
    whole = inside & (toward.amax(0).reshape(seen.shape) < 0.9)  # the object hides the middle of the images
    assert whole.float().mean() > 0.3 and not got.clipped.any()
    # pixels of 1.9 degrees at their centers: their number in a texel of 5.6 degrees varies
    assert float(seen[whole].min()) > 0.6
    observed = (seen > 0.99) & whole
    torch.testing.assert_close(light[observed], true[observed], atol=0.02, rtol=0.0)  # 0.3 times half a texel
    hidden = (toward[5] > 0.85).reshape(seen.shape)
    assert hidden.any() and float(seen[hidden].max()) == 0.0
    torch.testing.assert_close(light[hidden], torch.full_like(light[hidden], 0.05))


def test_each_group_has_its_background():
    both = photographs([0, 1, 0, 1])
    both = replace(both, images=torch.cat([both.images[:2], linear_to_srgb(0.5 * sky_of(both)[2:])]))
    got = over(start(), InputImages.of(both, ["a", "a", "b", "b"]))
    seen = (got.observed > 0.99).all(0)[..., 0]
    assert got.light.shape[0] == 2 and seen.any()
    ratio = (got.light[0] - got.light[1])[seen].exp()
    torch.testing.assert_close(ratio, torch.full_like(ratio, 2.0), atol=0.02, rtol=0.0)


def sky_of(batch: ViewBatch) -> torch.Tensor:
    return InputImages.of(batch).color


def test_a_background_that_turns_with_the_camera_has_one_direction_in_the_axes_of_the_lighting():
    """Cameras at several azimuths that see the same image: the room of a turntable."""
    eyes = torch.tensor([[0.0, 0.0, 2.0], [2.0, 0.0, 0.0], [0.0, 0.0, -2.0]])
    c2w = torch.stack([look_at(e, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])) for e in eyes])
    one = photographs([5])  # any image
    batch = ViewBatch(one.images.repeat(3, 1, 1, 1), one.masks.repeat(3, 1, 1), c2w, one.intrinsics.repeat(3, 1))
    together, alone = (Background.of(InputImages.of(batch, "turntable").select(list(range(n)))) for n in (3, 1))
    seen = alone.observed[..., 0] > 0.99
    assert 0.05 < float(seen.float().mean()) < 0.3
    torch.testing.assert_close(together.radiance[seen], alone.radiance[seen], atol=1e-3, rtol=0.0)
    assert not bool(((together.observed > 0) & (alone.observed == 0)).any())


def test_saturated_pixels_are_a_lower_bound():
    got = over(start(7.0), InputImages.of(photographs(shine=lambda d: 3.0 * sky(d))))
    bright = (3.0 * sky(lat_long_directions(LIGHT_ROWS)) > 1.1) & (got.observed[0] > 0.99)
    assert bright.any() and bool(got.clipped[0][bright].all())
    torch.testing.assert_close(got.light[0][bright], torch.full_like(got.light[0][bright], math.log(7.0)))
    dim = (3.0 * sky(lat_long_directions(LIGHT_ROWS)) < 0.8) & (got.observed[0] > 0.99)
    assert dim.any() and not got.clipped[0][dim].any() and float(got.light[0][dim].max()) < 0.0


def test_changes_of_what_is_seen_are_penalized_per_solid_angle():
    unknowns = Unknowns.zero(torch.ones(2, 2, 2), 1, 4)
    unknowns.light[-1].fill_(0.3)
    none = start()
    assert float(losses.near_background(unknowns, none)) == 0.0
    observed = torch.zeros(1, LIGHT_ROWS, 2 * LIGHT_ROWS, 1)
    observed[:, :8] = 1.0  # above 45 degrees: (1 - cos 45°) / 2 of the sphere
    clipped = torch.zeros(1, LIGHT_ROWS, 2 * LIGHT_ROWS, 3, dtype=torch.bool)
    some = replace(none, observed=observed, clipped=clipped)
    share = (1.0 - math.cos(math.pi / 4)) / 2
    assert float(losses.near_background(unknowns, some)) == pytest.approx(0.09 * share, rel=1e-5)
    clipped[..., 1] = True  # an increase of a saturated channel costs nothing, a decrease does
    assert float(losses.near_background(unknowns, some)) == pytest.approx(0.09 * share * 2 / 3, rel=1e-5)
    unknowns.light[-1].fill_(-0.3)
    assert float(losses.near_background(unknowns, some)) == pytest.approx(0.09 * share, rel=1e-5)


def test_the_background_decides_how_bright_and_of_which_color_lighting_and_base_color_are():
    """Images give only their product; without a background the start decides."""
    true = replace(small_scene.two_colored(small_scene.ball()), environment=Environment(sky(lat_long_directions(16))))
    views = small_scene.input_views(true, 6, 28)
    first = replace(small_scene.ball(), environment=Environment(torch.full((16, 32, 3), 0.15)))
    area = texel_solid_angles(16, 32)[:, None, None].float()
    camera = Camera(views.c2w[0], views.intrinsics[0], 28, 28)
    light, base_color = [], []
    for background in (None, photographs()):
        asset = refine(first, views, steps=20, options=RefineOptions(24, surroundings=background)).asset
        mean = (asset.light.resized(16).radiance * area).sum((0, 1)) / (4.0 * math.pi)
        light.append(float((mean / 0.4).log().abs().max()))
        got, want = (render_asset(a, camera) for a in (asset, true))
        inside = (got.alpha > 0.99) & (want.alpha > 0.99)
        base_color.append(float((got.base_color - want.base_color)[inside].abs().mean()))
    # the object hides 3 % of the background; the final brightness of the lighting is chosen in steps of 5 %
    assert light[1] < 0.2 < 1.0 < light[0]
    assert base_color[1] < 0.5 * base_color[0]


def test_the_start_gets_the_mean_brightness_and_color_of_what_is_seen():
    true = Environment(sky(lat_long_directions(LIGHT_ROWS)))
    asset = replace(small_scene.ball(), environment=Environment(true.radiance * torch.tensor([0.5, 0.25, 2.0])))
    part = Background.of(InputImages.of(photographs([0, 2])))
    got = part.scaled(asset, Start.of(asset))
    factor = torch.tensor([2.0, 4.0, 0.5])
    torch.testing.assert_close(got.light.radiance, asset.light.radiance * factor, atol=0.0, rtol=0.02)
    torch.testing.assert_close(got.textures.base_color, asset.textures.base_color / factor, atol=0.0, rtol=0.02)
    far = replace(asset, environment=Environment(1e-3 * true.radiance))
    ratio = part.scaled(far, Start.of(far)).light.radiance / far.light.radiance
    torch.testing.assert_close(ratio, torch.full_like(ratio, MAX_SCALE))
    bright = replace(asset, environment=Environment(3.0 * true.radiance))  # saturated pixels say nothing of it
    part = Background.of(InputImages.of(photographs(shine=lambda d: 3.0 * sky(d))))
    got = part.scaled(bright, Start.of(bright))
    torch.testing.assert_close(got.light.radiance, bright.light.radiance, atol=0.0, rtol=0.02)
    little = replace(part, observed=0.04 * part.observed)
    assert little.scaled(asset, Start.of(asset)) is asset


def two_valued(d: torch.Tensor) -> torch.Tensor:
    return torch.where(d[..., :1] > 0.6, 0.5, 0.0).expand(d.shape)


def test_a_dark_background_with_a_lamp_scales_the_lighting_by_its_mean_radiance():
    mean = 0.5 * (1.0 - 0.6) / 2.0  # the cap's fraction of the sphere
    asset = replace(small_scene.ball(), environment=Environment(torch.full((16, 32, 3), mean)))
    part = Background.of(InputImages.of(photographs(shine=two_valued)))
    got = part.scaled(asset, Start.of(asset)).light.radiance / mean
    torch.testing.assert_close(got, torch.ones_like(got), atol=0.1, rtol=0.0)  # the object hides a part of the lamp


def test_the_observed_fraction_is_a_solid_angle():
    background = Background.of(InputImages.of(photographs([4], size=192)))
    area = texel_solid_angles(LIGHT_ROWS, 2 * LIGHT_ROWS)[:, None].float()
    got = float((background.observed[0, ..., 0] * area).sum())
    hidden = 4.0 * math.asin(1.0 / 37.0)  # a square of 1/6 of the face's side
    assert got == pytest.approx(4.0 * math.pi / 6.0 - hidden, rel=0.02)  # one of six faces of the cube


def test_a_lamp_smaller_than_a_texel_makes_a_lower_bound():
    batch = photographs([4], size=192)
    batch.images[0, 60:62, 60:62] = 1.0  # 0.9 degrees
    background = Background.of(InputImages.of(batch))
    assert 1 <= int(background.clipped[..., 0].sum()) <= 4


def test_surroundings_under_lighting_fixed_to_the_camera_are_refused():
    views = small_scene.input_views(small_scene.ball(), 3, 24)
    options = RefineOptions(16, light="camera", surroundings=views)
    with pytest.raises(ValueError, match="surroundings: expected lighting that does not move"):
        refine(small_scene.ball(), views, steps=1, options=options)


def with_background(usable: int) -> Views:
    """Three views, of which the first ones have a background."""
    batch = small_scene.input_views(small_scene.two_colored(small_scene.ball()), 3, 32)
    noise = torch.rand(3, 32, 32, 3, generator=torch.Generator().manual_seed(0))
    noise[usable:] = 0.0
    images = torch.where(batch.masks[..., None] > 0, batch.images, noise)
    return Views(tuple(images), tuple(batch.masks), batch.c2w, batch.intrinsics, ("a", "b", "c"))


def test_cut_outs_lighting_fixed_to_the_camera_and_other_words_are_refused():
    for light, usable, problem in (("object", 0, "outside the masks"), ("camera", 3, "does not move with the camera")):
        with pytest.raises(InputError, match=problem):
            reli3d.refine(small_scene.ball(), with_background(usable), steps=1, background="visible", light=light)
    with pytest.raises(InputError, match="expected masked or visible, got auto"):
        reli3d.refine(small_scene.ball(), with_background(3), steps=1, background="auto")


def test_a_refinement_reads_the_whole_images_but_for_views_without_background():
    views = with_background(2)
    whole = views.resampled(SURROUNDINGS, crop=False, linear=True)
    whole.masks[2] = 1.0
    options = RefineOptions(surroundings=whole)
    expected = refine(small_scene.ball(), views.resampled(REFINED, linear=True), steps=2, options=options).asset
    got = reli3d.refine(small_scene.ball(), views, steps=2, background="visible")
    torch.testing.assert_close(got.light.radiance, expected.light.radiance)
