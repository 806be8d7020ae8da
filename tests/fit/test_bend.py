"""Bent shading normals: they absorb errors that would be baked into the base color; only a regularized bend is kept."""

import math
from dataclasses import replace

import pytest
import torch

from reli3d.fit import maps
from reli3d.fit.budget import Budget, Part
from reli3d.fit.input_images import InputImages
from reli3d.fit.losses import Weights
from reli3d.fit.maps import FixedSurface
from reli3d.fit.transfer import changed
from reli3d.fit.unknowns import MAX_BEND, Start, Unknowns, bent, unit
from reli3d.geometry.bake import rasterize_texels
from reli3d.geometry.hits import interpolate
from reli3d.render.gbuffer import surface_points
from tests.support import small_scene

VIEWS, SIZE = 6, 36


@pytest.fixture(scope="module")
def start():
    """A gray ball under the true light."""
    return replace(small_scene.ball(), environment=small_scene.sky())


@pytest.fixture(scope="module")
def images(start):
    """Of the same ball with waves in its normal map."""
    size = small_scene.TEXELS
    row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    waves = torch.stack([(0.3 * column).sin(), (0.3 * row).sin(), 2.0 * torch.ones(size, size)], -1)
    normal = 0.5 + 0.5 * torch.nn.functional.normalize(waves, dim=-1)
    wavy = replace(start, textures=replace(start.textures, normal=normal))
    return InputImages.of(small_scene.input_views(wavy, VIEWS, SIZE))


def unchanged() -> Unknowns:
    return Unknowns.zero(torch.ones(2, 2, 2), VIEWS, small_scene.TEXELS)


def fitted(start, images, weights: Weights, steps: int = 24, unknowns: Unknowns | None = None) -> Unknowns:
    unknowns = unknowns or unchanged()
    data = FixedSurface(Start.of(start), start, torch.zeros_like(start.mesh.vertices), images, list(range(VIEWS)))
    maps.fit_maps(unknowns, data, weights, Budget(steps=steps), Part("maps", 1.0), seed=0)
    return unknowns


def patches(asset) -> float:
    """Standard deviation of the logarithm of the base color over the faces."""
    return float(small_scene.centers(asset).base_color.log().std(0).mean())


def test_waves_of_the_normals_are_baked_into_the_base_color_less(start, images):
    # the true base color is uniform; the large weights disable the bend
    options = Weights(palette=0.0), Weights(palette=0.0, free_bend=1e6, bend=1e6)
    free, unbent = (patches(changed(start, fitted(start, images, weights))) for weights in options)
    assert free < 0.9 * unbent


def test_the_bend_is_written_into_the_normal_map(start):
    unknowns = unchanged()
    unknowns.bend[0] += torch.tensor([0.3, 0.0, 0.0])
    asset = changed(start, unknowns)
    found = rasterize_texels(asset.mesh, small_scene.TEXELS)
    face, bary = found.face[found.valid], found.bary[found.valid]
    position = interpolate(start.mesh.vertices, start.mesh.faces, face, bary)
    plain = unit(interpolate(start.mesh.normals, start.mesh.faces, face, bary))
    got = surface_points(asset.mesh, asset.textures, face, bary).normal
    length = 0.3 / math.sqrt(1.0 + (0.3 / MAX_BEND) ** 2)
    expected = torch.nn.functional.normalize(plain + torch.tensor([length, 0.0, 0.0]), dim=-1)
    assert torch.allclose(bent(unknowns, position, plain)[0], expected, atol=1e-6)
    assert float((got - expected).norm(dim=1).median()) < 0.01  # 8 bits hold a direction to 0.004


def test_no_bend_turns_a_normal_away():
    # a normal turned to the dark side would explain a black base color
    unknowns = unchanged()
    unknowns.bend[0] += torch.tensor([1e3, 0.0, 0.0])
    normal = torch.nn.functional.normalize(torch.randn(100, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    turned = bent(unknowns, torch.zeros(100, 3), normal)[0]
    assert float((turned * normal).sum(1).min()) > math.cos(math.asin(MAX_BEND)) - 1e-6


def after_each_step(monkeypatch, act) -> None:
    """Calls ``act(budget, step)`` after each step of a fit."""
    record = Budget.record

    def recording(self, name, step, loss):
        record(self, name, step, loss)
        act(self, step)

    monkeypatch.setattr(Budget, "record", recording)


def test_an_interrupted_fit_keeps_no_free_bend(start, images, monkeypatch):
    after_each_step(monkeypatch, lambda budget, step: setattr(budget, "interrupted", step == 5))
    unknowns = fitted(start, images, Weights())
    assert unknowns.material[0].abs().max() > 0.0
    assert all(float(grid.abs().max()) == 0.0 for grid in unknowns.bend)


def test_the_material_is_frozen_while_the_kept_bend_is_fitted(start, images, monkeypatch):
    unknowns, seen = unchanged(), []
    after_each_step(monkeypatch, lambda *_: seen.append((unknowns.material[0].clone(), unknowns.light[0].clone())))
    fitted(start, images, Weights(), 20, unknowns)
    first = int(maps.MATERIAL_UNTIL * 20)
    assert not torch.equal(seen[first - 2][0], seen[first - 1][0])
    assert torch.equal(seen[first][0], seen[-1][0]) and not torch.equal(seen[first][1], seen[-1][1])
    assert all(float(grid.abs().max()) > 0.0 for grid in unknowns.bend)
