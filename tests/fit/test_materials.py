"""Search of materials: the metallic and roughness of a ball of two materials with a sharp border are found."""

import math
from dataclasses import replace

import pytest
import torch

from reli3d.fit.bounce import gathered
from reli3d.fit.input_images import InputImages
from reli3d.fit.materials import FixedSurface, k_means, regression, searched, segmented
from reli3d.fit.transfer import changed
from reli3d.fit.unknowns import Start, Unknowns
from reli3d.geometry.bake import bake
from reli3d.geometry.rays import RayScene
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import surface_points
from tests.support import small_scene

VIEWS, SIZE = 8, 64
METAL, PLASTIC = (0.9, 0.6, 0.3), (0.1, 0.3, 0.5)


def windows() -> Environment:
    """Dim, with five bright patches: highlights separate roughness values, reflections metals."""
    radiance = torch.full((32, 64, 3), 0.25)
    for row, column in ((6, 5), (12, 22), (8, 40), (20, 52), (15, 58)):
        radiance[row : row + 4, column : column + 4] = 6.0
    return Environment(radiance)


def two_materials(roughness=(0.3, 0.6)):
    """Metal where x > 0, plastic elsewhere."""

    def maps(position, normal):
        metal = (position[:, :1] > 0.0).float()
        color = metal * torch.tensor(METAL) + (1.0 - metal) * torch.tensor(PLASTIC)
        rough = metal * roughness[0] + (1.0 - metal) * roughness[1]
        return torch.cat([color, rough, metal], 1)

    asset = small_scene.ball()
    found = bake(asset.mesh, small_scene.TEXELS, maps)["value"]
    textures = replace(asset.textures, base_color=found[..., :3], roughness=found[..., 3], metallic=found[..., 4])
    return replace(asset, textures=textures, environment=windows())


@pytest.fixture(scope="module")
def found():
    """The ball of one gray material, with the true surface and light, after the search."""
    images = InputImages.of(small_scene.input_views(two_materials(), VIEWS, SIZE))
    first = replace(small_scene.ball(), environment=windows())
    start, unknowns = Start.of(first), Unknowns.zero(torch.ones(2, 2, 2), VIEWS, small_scene.TEXELS)
    scene = RayScene(first.mesh.vertices, first.mesh.faces)
    received = gathered(first.mesh, images, seed=0)
    data = FixedSurface(start, first, received, images, list(range(VIEWS)))
    searched(unknowns, data, segmented(unknowns, data, scene, seed=0), scene, seed=0)
    return changed(first, unknowns)


def halves(asset):
    """Surface points of either side, without the border."""
    face = torch.arange(len(asset.mesh.faces), dtype=torch.int32)
    at = surface_points(asset.mesh, asset.textures, face, torch.full((len(face), 2), 1 / 3))
    return at[at.position[:, 0] > 0.1], at[at.position[:, 0] < -0.1]


def test_the_search_finds_metal_and_plastic(found):
    metal, plastic = halves(found)
    assert float((metal.metallic > 0.5).float().mean()) > 0.95
    assert float((plastic.metallic < 0.5).float().mean()) > 0.95
    # the grid's neighbors are 0.1 to 0.15 away
    assert float(metal.roughness.median()) == pytest.approx(0.3, abs=0.1)
    assert float(plastic.roughness.median()) == pytest.approx(0.6, abs=0.16)


def test_the_search_finds_the_base_color(found):
    for at, want in zip(halves(found), (METAL, PLASTIC), strict=True):
        error = (at.base_color.median(0).values / torch.tensor(want)).log().abs()
        assert float(error.max()) < math.log(1.2)  # the start is wrong by factors of up to 3


def test_k_means_separates_clusters():
    rng = torch.Generator().manual_seed(0)
    true = torch.tensor([[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]])
    points = true.repeat(100, 1) + 0.1 * torch.randn(300, 2, generator=rng)
    distance = torch.cdist(k_means(points, 3, rng), true).amin(0)
    assert float(distance.max()) < 0.05  # 5 standard errors of a mean of 100


def test_the_regression_recovers_an_affine_model():
    rng = torch.Generator().manual_seed(1)
    point = torch.arange(50).repeat(4)
    color = 0.4 + 0.1 * torch.rand(50, 3, generator=rng)
    constant, factor = (torch.rand(200, 3, generator=rng) for _ in range(2))
    target = constant + factor * color[point]
    error, got = regression(constant, factor, target, torch.ones(200), point, 50, (0.03, 0.9))
    wrong, _ = regression(factor, constant, target, torch.ones(200), point, 50, (0.03, 0.9))
    assert float((got - color).abs().mean()) < 0.02 and error < 0.1 * wrong  # the ridge moves colors to their median
