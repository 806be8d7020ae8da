"""Which parts of a fit are taken: those that are right, by pictures of a scene that is known."""

from dataclasses import replace

import pytest
import torch

from reli3d.fit.choice import Fitted, Parts, Pictures, chosen, picture_error
from reli3d.fit.photographs import Photographs
from reli3d.fit.unknowns import LIGHT_ROWS, Start, Unknowns
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import surface_points
from tests.support import small_scene

VIEWS, USED, HELD = 5, [0, 1, 3, 4], [2]
EVEN = Environment(torch.full((16, 32, 3), 0.5))


@pytest.fixture(scope="module")
def true():
    return small_scene.painted(small_scene.ball())


@pytest.fixture(scope="module")
def photographs(true):
    return Photographs.of(small_scene.photographs(true, VIEWS, 48))


def fitted(first, photographs, *, light=None, paint=0.0, surface=None) -> Fitted:
    """A fit that ended with this light, this change of the paint's logits, and this surface."""
    start, unknowns = Start.of(first), Unknowns.zero(torch.ones(2, 2, 2), VIEWS, small_scene.TEXELS)
    if light is not None:
        unknowns.light[-1] = light.resized(LIGHT_ROWS).radiance.log() - start.light
    unknowns.material[0][..., :3] = paint
    moved = first if surface is None else replace(surface, environment=first.environment)
    return Fitted(first, moved, torch.zeros_like(moved.mesh.vertices), start, unknowns, photographs)


def error_of(asset, photographs):
    """A ball receives nothing from itself."""
    return picture_error(asset, torch.zeros_like(asset.mesh.vertices), photographs)


def choice(fit, photographs):
    return chosen(fit, USED, HELD, error_of(fit.first, photographs))


def test_a_right_light_is_taken_without_the_wrong_paint_beside_it(true, photographs):
    first = replace(true, environment=EVEN)
    wrong = torch.tensor([3.0, -3.0, 3.0])
    asset, parts, errors = choice(fitted(first, photographs, light=true.light, paint=wrong), photographs)
    assert parts == Parts(0.0, 0.0, 1.0)
    assert torch.equal(asset.textures.base_color, first.textures.base_color)
    assert float(errors.mean()) < 0.5 * float(error_of(first, photographs).mean())


def test_of_few_views_half_of_the_light_is_taken(true, photographs):
    first = replace(true, environment=EVEN)
    fit = fitted(first, photographs, light=true.light, paint=torch.tensor([3.0, -3.0, 3.0]))
    _, parts, _ = chosen(fit, USED[:3], HELD, error_of(first, photographs))
    assert parts == Parts(0.0, 0.0, 0.5)


def test_a_right_surface_is_taken_without_the_wrong_light_beside_it(true, photographs):
    first = replace(small_scene.painted(small_scene.ball(squeeze=0.9)), environment=true.light)
    glare = Environment(64.0 * true.light.radiance)
    asset, parts, errors = choice(fitted(first, photographs, light=glare, surface=true), photographs)
    assert (parts.surface, parts.light) == (1.0, 0.0)
    assert asset.mesh is true.mesh and torch.equal(asset.light.radiance, true.light.radiance)


def test_a_surface_alone_may_lose_a_little_of_the_held_out_view(true, photographs):
    first = replace(small_scene.painted(small_scene.ball(squeeze=0.9)), environment=true.light)
    fit = fitted(first, photographs, light=Environment(64.0 * true.light.radiance), surface=true)
    before = error_of(first, photographs)
    _, _, errors = chosen(fit, USED, HELD, before)
    before[HELD] = errors[HELD] * 10.0**-0.02  # 0.2 dB better than the new surface
    assert chosen(fit, USED, HELD, before)[1] == Parts(1.0, 0.0, 0.0)
    before[HELD] = errors[HELD] * 10.0**-0.04
    assert chosen(fit, USED, HELD, before)[0] is first


def test_a_surface_alone_may_lose_very_little_of_all_views_together(true, photographs):
    first = replace(small_scene.painted(small_scene.ball(squeeze=0.9)), environment=true.light)
    fit = fitted(first, photographs, light=Environment(64.0 * true.light.radiance), surface=true)
    _, _, errors = chosen(fit, USED, HELD, error_of(first, photographs))

    def taken(used: float, held: float) -> bool:
        """Where the start is better by so many dB."""
        before = errors.clone()
        before[USED] *= 10.0 ** (-used / 10.0)
        before[HELD] *= 10.0 ** (-held / 10.0)
        return chosen(fit, USED, HELD, before)[1] == Parts(1.0, 0.0, 0.0)

    assert taken(0.09, -0.4)  # 0 of all five, about
    assert not taken(0.12, -0.8)
    assert taken(-0.1, 0.28)
    assert taken(0.04, 0.04)
    assert not taken(0.06, 0.06)
    assert not taken(0.09, 0.0)  # 0.07 of all five


def test_the_light_gets_the_strength_that_the_photographs_show(true, photographs):
    first = replace(true, environment=EVEN)
    dark = Environment(0.8 * true.light.radiance)
    asset, parts, errors = choice(fitted(first, photographs, light=dark), photographs)
    ratio = asset.light.radiance.mean() / true.light.radiance.mean()
    assert parts.light == 1.0 and float(ratio) == pytest.approx(1.0, abs=0.06)  # strengths are 5 % apart


def test_a_fit_of_input_views_alone_is_not_taken(true, photographs):
    """The held-out view decides where the views that were used gain."""
    first = replace(true, environment=EVEN)
    fit = fitted(first, photographs, light=true.light)
    before = error_of(first, photographs)
    before[HELD] = 1e-8  # nothing is as good as that
    assert chosen(fit, USED, HELD, before)[0] is first
    assert chosen(fit, USED, [], before)[1].light == 1.0


def test_pictures_have_what_the_surface_receives_and_the_strength_is_of_the_light_alone(true, photographs):
    received = torch.full_like(true.mesh.vertices, 0.3)
    pictures = Pictures(true, received, photographs)
    lit = pictures.lit(true)
    direct = Pictures(true, 0.0 * received, photographs).lit(true)
    for (light, bounced), (alone, nothing), (_, face, bary, _) in zip(lit, direct, pictures.rays, strict=True):
        at = surface_points(true.mesh, true.textures, face, bary)
        assert torch.equal(light, alone) and not nothing.any()
        torch.testing.assert_close(bounced, at.base_color * (1.0 - at.metallic[:, None]) * 0.3)
    half = [(0.5 * light, bounced) for light, bounced in lit]
    for wanted, (light, bounced), (seen, *_) in zip(pictures.wanted, lit, pictures.rays, strict=True):
        wanted.fill_(1.0)
        wanted[seen] = linear_to_srgb((light + bounced).clamp(0.0, 1.0))
    assert float(pictures.errors(lit).max()) == 0.0
    assert float(pictures.errors(half, 2.0).max()) < 1e-10  # halved and doubled: rounding
    assert float(pictures.errors(direct).min()) > 1e-3
