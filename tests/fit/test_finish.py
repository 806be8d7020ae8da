"""Roughness and metallic as a function of base color: patterns finer than the grids over space."""

import math
from dataclasses import replace

import torch

from reli3d.fit.bounce import gathered
from reli3d.fit.budget import Budget, Part
from reli3d.fit.input_images import InputImages
from reli3d.fit.losses import Weights
from reli3d.fit.maps import FixedSurface, fit_maps
from reli3d.fit.transfer import changed
from reli3d.fit.unknowns import Start, Unknowns, changed_logits, material_logits
from reli3d.geometry.bake import bake, rasterize_texels
from reli3d.render.asset import TextureSet
from tests.support import small_scene

VIEWS, SIZE, STEPS, TEXELS = 12, 96, 120, 256


def test_glossy_and_rough_stripes_are_separated_by_base_color():
    """Stripes of half the spacing of the finest grid of roughness over space."""
    ball = small_scene.ball()

    def maps(position, normal):
        red = (torch.sin(8 * math.pi * position[:, 1:2]) > 0).float()
        color = red * torch.tensor([0.6, 0.1, 0.05]) + (1 - red) * torch.tensor([0.1, 0.3, 0.15])
        return {"color": color, "roughness": 0.7 - 0.45 * red}

    truth = bake(ball.mesh, TEXELS, maps)
    true = replace(ball, textures=TextureSet(truth["color"], truth["roughness"], 0.0), environment=small_scene.lamps())
    images = InputImages.of(small_scene.input_views(true, VIEWS, SIZE))
    start = replace(true, textures=replace(true.textures, roughness=torch.full_like(true.textures.roughness, 0.45)))
    unknowns = Unknowns.zero(torch.ones(2, 2, 2), VIEWS, TEXELS)
    data = FixedSurface(Start.of(start), start, gathered(start.mesh, images, seed=0), images, list(range(VIEWS)))
    fit_maps(unknowns, data, Weights(), Budget(steps=STEPS), Part("maps", 1.0), seed=0)
    found, valid = changed(start, unknowns).textures.roughness, rasterize_texels(ball.mesh, TEXELS).valid
    red = truth["roughness"].view(valid.shape) < 0.5
    means = [float(found.view(valid.shape)[valid & side].mean()) for side in (red, ~red)]
    assert means[1] - means[0] > 0.2


def test_points_of_one_color_change_alike_and_the_color_gets_no_gradient_from_it():
    unknowns, rng = Unknowns.zero(torch.ones(2, 2, 2), 1, 8), torch.Generator().manual_seed(1)
    unknowns.finish += torch.randn(unknowns.finish.shape, generator=rng)
    position = 2.0 * torch.rand(50, 3, generator=rng) - 1.0
    logits = torch.randn(2, 5, generator=rng).repeat(25, 1)
    detail = torch.zeros(50, 3, requires_grad=True)
    after = changed_logits(unknowns, logits, position, detail)
    assert torch.equal(after[:, :3], logits[:, :3])
    change = (after - logits)[:, 3:].detach()
    assert torch.allclose(change[::2], change[:1]) and torch.allclose(change[1::2], change[1:2])
    assert float((change[0] - change[1]).abs().min()) > 0.05
    (gradient,) = torch.autograd.grad(after.sum(), detail)
    assert torch.equal(gradient, torch.ones_like(detail))


def test_half_of_the_changes_is_half_way_to_the_fitted_finish():
    """The grid is looked up at the fitted color, not at the color half way to it."""
    ball = small_scene.ball()
    unknowns = Unknowns.zero(torch.ones(2, 2, 2), 1, 8)
    unknowns.material[0][..., :3] = 3.0
    unknowns.finish[-1, ..., 0] = 2.0  # of bright colors
    half, full = (material_logits(small_scene.centers(changed(ball, unknowns, weight))) for weight in (0.5, 1.0))
    start = material_logits(small_scene.centers(ball))
    assert float((full - start)[:, 3].min()) > 1.0
    assert torch.allclose(half - start, 0.5 * (full - start), atol=0.02)  # linear interpolation between texels
