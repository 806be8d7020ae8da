"""Selection of the parts of a fit: correct parts of a known scene are kept."""

from dataclasses import replace

import pytest
import torch

from reli3d.fit.choice import Fitted, Parts, ViewRenderer, chosen, view_errors
from reli3d.fit.input_images import InputImages
from reli3d.fit.transfer import changed
from reli3d.fit.unknowns import LIGHT_ROWS, Start, Unknowns
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import surface_points
from reli3d.views.views import Views
from tests.support import small_scene

VIEWS, USED, HELD = 5, [0, 1, 3, 4], [2]
EVEN = Environment(torch.full((16, 32, 3), 0.5))


@pytest.fixture(scope="module")
def true():
    return small_scene.two_colored(small_scene.ball())


@pytest.fixture(scope="module")
def images(true):
    return InputImages.of(small_scene.input_views(true, VIEWS, 48))


def fitted(first, images, *, light=None, base_color=0.0, surface=None) -> Fitted:
    """A fit with this light, this change of the base color's logits, and this surface."""
    start, unknowns = Start.of(first), Unknowns.zero(torch.ones(2, 2, 2), VIEWS, small_scene.TEXELS)
    if light is not None:
        unknowns.light[-1][0] = light.resized(LIGHT_ROWS).radiance.log() - start.light
    unknowns.material[0][..., :3] = base_color
    moved = first if surface is None else replace(surface, environment=first.environment)
    return Fitted(first, moved, torch.zeros_like(moved.mesh.vertices), start, unknowns, images)


def error_of(asset, images):
    """A ball receives nothing from itself."""
    return view_errors(asset, torch.zeros_like(asset.mesh.vertices), images)


def choice(fit, images):
    return chosen(fit, USED, HELD, error_of(fit.first, images))


def test_a_right_light_is_kept_without_a_wrong_material(true, images):
    first = replace(true, environment=EVEN)
    fit = fitted(first, images, light=true.light, base_color=torch.tensor([3.0, -3.0, 3.0]))
    asset, parts, errors = choice(fit, images)
    assert parts == Parts(0.0, 0.0, 1.0)
    assert torch.equal(asset.textures.base_color, first.textures.base_color)
    assert float(errors.mean()) < 0.5 * float(error_of(first, images).mean())
    assert chosen(fit, USED[:3], HELD, error_of(first, images))[1] == Parts(0.0, 0.0, 0.5)  # half of it with few views


def test_a_right_surface_is_kept_without_a_wrong_light(true, images):
    first = replace(small_scene.two_colored(small_scene.ball(squeeze=0.9)), environment=true.light)
    glare = Environment(64.0 * true.light.radiance)
    asset, parts, errors = choice(fitted(first, images, light=glare, surface=true), images)
    assert (parts.surface, parts.light) == (1.0, 0.0)
    assert asset.mesh is true.mesh and torch.equal(asset.light.radiance, true.light.radiance)


def test_a_surface_alone_may_lose_a_little(true, images, monkeypatch):
    first = replace(small_scene.two_colored(small_scene.ball(squeeze=0.9)), environment=true.light)
    fit = fitted(first, images, light=Environment(64.0 * true.light.radiance), surface=true)
    errors = choice(fit, images)[2]
    monkeypatch.setattr("reli3d.fit.choice.CANDIDATES", ((0.0, 0.0),))
    # by how many dB the start is better in the used and in the held-out views, and whether the surface is kept
    for used, held, kept in (
        *((0.09, -0.4, True), (-0.1, 0.28, True), (0.04, 0.04, True)),
        *((0.12, -0.8, False), (-0.4, 0.4, False)),
        *((0.06, 0.06, False), (0.09, 0.0, False)),  # 0.06 and 0.07 of all five
    ):
        before = errors.clone()
        before[USED] *= 10.0 ** (-used / 10.0)
        before[HELD] *= 10.0 ** (-held / 10.0)
        asset, parts, _ = chosen(fit, USED, HELD, before)
        assert parts == (Parts(1.0, 0.0, 0.0) if kept else Parts(0.0, 0.0, 0.0)), (used, held)
        assert kept or asset is first


def test_the_light_is_scaled_to_match_the_images(true, images):
    first = replace(true, environment=EVEN)
    dark = Environment(0.8 * true.light.radiance)
    asset, parts, errors = choice(fitted(first, images, light=dark), images)
    ratio = asset.light.radiance.mean() / true.light.radiance.mean()
    assert parts.light == 1.0 and float(ratio) == pytest.approx(1.0, abs=0.06)  # scales differ by 5 %


def test_a_fit_that_improves_only_input_views_is_not_kept(true, images):
    """The held-out view decides where the views that were used gain."""
    first = replace(true, environment=EVEN)
    fit = fitted(first, images, light=true.light)
    before = error_of(first, images)
    before[HELD] = 1e-8  # nothing is as good as that
    assert chosen(fit, USED, HELD, before)[0] is first
    assert chosen(fit, USED, [], before)[1].light == 1.0


def test_errors_ignore_what_is_beyond_a_photograph(true):
    views = small_scene.input_views(true, VIEWS, 48)
    images, masks = (tuple(v[:, :34] for v in values) for values in (views.images, views.masks))
    cut = Views(images, masks, views.c2w, views.intrinsics, tuple("abcde")).resampled(48, linear=True)
    errors = error_of(true, InputImages.of(cut)) / error_of(true, InputImages.of(views))
    assert float(errors.max()) < 4.0  # resampled again and enlarged


def test_vertex_colors_are_baked_once(true, images):
    colors = 0.5 + 0.4 * true.mesh.vertices
    first = replace(true, mesh=replace(true.mesh, colors=colors))
    renderer = ViewRenderer(first, torch.zeros_like(colors), images)
    baked = changed(first, Unknowns.zero(torch.ones(2, 2, 2), VIEWS, small_scene.TEXELS))
    errors = [renderer.errors(renderer.lit(asset)) for asset in (first, baked)]
    torch.testing.assert_close(*errors, rtol=0.02, atol=0.0)  # texels blend at the rims of charts
    torch.testing.assert_close(error_of(baked, images), errors[1])


def test_renderings_include_interreflection_and_the_scale_applies_to_direct_light(true, images):
    received = torch.full_like(true.mesh.vertices, 0.3)
    renderer = ViewRenderer(true, received, images)
    lit = renderer.lit(true)
    direct = ViewRenderer(true, 0.0 * received, images).lit(true)
    for (light, bounced), (alone, nothing), (_, face, bary, _) in zip(lit, direct, renderer.rays, strict=True):
        at = surface_points(true.mesh, true.textures, face, bary)
        assert torch.equal(light, alone) and not nothing.any()
        torch.testing.assert_close(bounced, at.base_color * (1.0 - at.metallic[:, None]) * 0.3)
    half = [(0.5 * light, bounced) for light, bounced in lit]
    for target, (light, bounced), (hit, *_) in zip(renderer.target, lit, renderer.rays, strict=True):
        target.fill_(1.0)
        target[hit] = linear_to_srgb((light + bounced).clamp(0.0, 1.0))
    assert float(renderer.errors(lit).max()) == 0.0
    assert float(renderer.errors(half, 2.0).max()) < 1e-10  # halved and doubled: rounding
    assert float(renderer.errors(direct).min()) > 1e-3
