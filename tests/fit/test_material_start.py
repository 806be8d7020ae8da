"""The maps of glossy dielectrics are not fitted from a rough and half metallic start; those of metals are."""

from dataclasses import replace

import pytest
import torch

from reli3d.fit import material_start
from reli3d.fit.bounce import gathered
from reli3d.fit.budget import Budget
from reli3d.fit.input_images import InputImages
from reli3d.fit.losses import Weights
from reli3d.fit.maps import FixedSurface
from reli3d.fit.material_start import best_material_start
from reli3d.fit.unknowns import Start, Unknowns
from reli3d.render.environment import Environment
from tests.support import small_scene

VIEWS, SIZE, STEPS = 12, 24, 400


def lamps() -> Environment:
    radiance = 0.3 * small_scene.sky().radiance
    for row, column in ((3, 5), (5, 18), (8, 27)):
        radiance[row, column] = 40.0
    return Environment(radiance)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_a_glossy_dielectric_is_found_and_a_metal_is_not_taken_for_one(metallic):
    true = small_scene.two_colored(small_scene.ball())
    true = replace(true, environment=lamps(), textures=replace(true.textures, roughness=0.25, metallic=metallic))
    images = InputImages.of(small_scene.input_views(true, VIEWS, SIZE))
    textures = replace(true.textures, roughness=0.7, metallic=0.5)
    start = replace(true, environment=small_scene.ball().environment, textures=textures)
    unknowns = Unknowns.zero(torch.ones(2, 2, 2), VIEWS, small_scene.TEXELS)
    used, held = [v for v in range(VIEWS) if v % 6], [0, 6]
    data = FixedSurface(Start.of(start), start, gathered(start.mesh, images, seed=0), images, used)
    _, best = best_material_start(unknowns, data, held, Weights(), Budget(steps=STEPS), seed=0)
    assert (float(best.asset.textures.metallic.mean()) < 0.1) == (metallic == 0.0)


@pytest.mark.parametrize("held", [[0], []])
def test_without_pixels_inside_the_masks_the_start_is_kept(held):
    first = small_scene.ball()
    views = small_scene.input_views(first, 2, 8)
    images = InputImages.of(replace(views, masks=torch.zeros_like(views.masks)))
    unknowns = Unknowns.zero(torch.ones(2, 2, 2), 2, small_scene.TEXELS)
    data = FixedSurface(Start.of(first), first, gathered(first.mesh, images, seed=0), images, [1])
    assert best_material_start(unknowns, data, held, Weights(), Budget(steps=STEPS), seed=0) == (unknowns, data)


@pytest.mark.parametrize(
    "errors, metallic",
    [
        ((1.0, 0.98, 1.1), 0.5),
        ((1.0, 0.95, 1.1), 0.95),
        ((1.0, 1.06, 1.04), 0.05),
        ((1.0, 1.03, 1.04), 0.5),
        ((1.0, 1.2, 1.06), 0.5),
    ],
)
def test_the_start_is_left_for_a_better_metal_or_an_equal_dielectric(monkeypatch, errors, metallic):
    first = small_scene.ball()
    first = replace(first, textures=replace(first.textures, metallic=0.5))
    images = InputImages.of(small_scene.input_views(first, 2, 8))
    unknowns = Unknowns.zero(torch.ones(2, 2, 2), 2, small_scene.TEXELS)
    data = FixedSurface(Start.of(first), first, gathered(first.mesh, images, seed=0), images, [0])
    found = iter(e / 2 for e in errors for _ in range(2))  # of fitted and of held-out views
    monkeypatch.setattr(material_start, "image_error", lambda *_: next(found))
    _, best = best_material_start(unknowns, data, [1], Weights(), Budget(steps=STEPS), seed=0)
    assert float(best.asset.textures.metallic.mean()) == pytest.approx(metallic)
