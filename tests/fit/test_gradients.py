"""The gradient of a whole step of a fit against central differences with the same random numbers on both sides.

Directions and densities of light samples are constants of the backward pass.  So distances, materials, exposures and
cameras are tried with samples of the light alone, which do not move with them, and the light with samples of the
cosine alone.  Visibility and viewing directions are constants too: they are computed once and reused.
"""

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from reli3d.fit import maps, shape
from reli3d.fit.input_images import InputImages
from reli3d.fit.lighting import radiance
from reli3d.fit.losses import Weights
from reli3d.fit.maps import FixedSurface
from reli3d.fit.unknowns import Start, Unknowns
from reli3d.geometry.rays import RayScene
from tests.support import small_scene
from tests.support.differences import directional_derivatives

SIZE = 40


def scene(plain: bool):
    """Data and unknowns of a ball close to that of the images; plain: images of uniform color."""
    views = small_scene.input_views(small_scene.two_colored(small_scene.ball()), 3, SIZE)
    if plain:  # the shading's gradient does not include the image gradient
        views = replace(views, images=torch.full_like(views.images, 0.5))
    images, asset = InputImages.of(views), replace(small_scene.ball(0.76), environment=small_scene.sky())
    grid = shape.Grid.around(asset.mesh.vertices, 16)
    sdf = shape.start_sdf(asset.mesh, grid)
    received = torch.rand(5, 5, 5, 3, generator=torch.Generator().manual_seed(4))
    bound = torch.full_like(sdf, -9.0)
    data = shape.ShapeData.of(Start.of(asset), sdf, bound, grid, received, images, [0, 1, 2])
    unknowns = Unknowns.zero(sdf + 0.02 * grid.cell, 3, 8)
    rng = torch.Generator().manual_seed(2)
    for values in (*unknowns.material, *unknowns.light, unknowns.exposure):
        values += 0.1 * torch.randn(values.shape, generator=rng)
    unknowns.pose += 1e-3 * torch.randn(unknowns.pose.shape, generator=rng)
    return unknowns, data


def towards(kind: str, values: list[Tensor]) -> list[Tensor]:
    """A direction of change: all entries, by similar amounts; smooth bumps; or the camera's own axis."""
    rng = torch.Generator().manual_seed(5)
    if kind == "bumps":
        coarse = torch.randn(1, 1, 6, 6, 6, generator=rng)
        return [torch.nn.functional.interpolate(coarse, v.shape, mode="trilinear")[0, 0] for v in values]
    if kind == "axis":
        return [torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]).expand_as(v) for v in values]
    return [1.0 + 0.3 * torch.randn(v.shape, generator=rng) for v in values]


NONE = dict.fromkeys(vars(Weights()), 0.0)
LIGHT, COSINE = (64, 0, 0), (0, 0, 64)
# coverage changes in small jumps, which a wide step averages; the other terms are smooth, in float32
CASES = {
    "sdf, outlines": ("sdf", {"outline": 1.0}, "all", LIGHT, False, 5e-3, 0.1),
    "sdf, agreement": ("sdf", {"agreement": 1.0}, "all", LIGHT, False, 1e-4, 0.02),
    "sdf, shading": ("sdf", {"shading": 1.0}, "bumps", LIGHT, True, 3e-4, 0.05),
    "sdf, priors": ("sdf", {"curvature": 1.0, "sdf_change": 1.0}, "all", LIGHT, False, 1e-3, 0.02),
    "material": ("material", {"shading": 1.0, "base_color": 1.0}, "all", LIGHT, True, 1e-2, 0.02),
    "light": ("light", {"shading": 1.0}, "all", COSINE, True, 1e-3, 0.02),
    "exposure": ("exposure", {"shading": 1.0}, "all", LIGHT, True, 1e-2, 0.02),
    "camera, outlines": ("pose", {"outline": 1.0}, "axis", LIGHT, False, 1e-2, 0.1),
    "camera, agreement": ("pose", {"agreement": 1.0}, "all", LIGHT, False, 1e-4, 0.02),
}


@pytest.mark.parametrize("case", CASES)
def test_the_gradient_of_a_step_matches_central_differences(case, monkeypatch):
    name, terms, kind, samples, plain, step, tolerance = CASES[case]
    weights = Weights(**{**NONE, **terms})
    monkeypatch.setattr(shape, "SHADING_SAMPLES", samples)
    unknowns, data = scene(plain)
    view_weights, kept = shape.view_weights, []
    monkeypatch.setattr(shape, "view_weights", lambda *a: (kept or kept.append(view_weights(*a)) or kept)[0])
    radiance, eyes = shape.radiance, []

    def shown(points, wo, light, **options):
        """Without shadows and with the directions to the eye kept: both move with the surface, and have no gradient."""
        return radiance(points, (eyes or eyes.append(wo) or eyes)[0], light, **{**options, "scene": None})

    monkeypatch.setattr(shape, "radiance", shown)
    values = unknowns.groups()[name]

    def loss() -> Tensor:
        return shape.shape_loss(unknowns, data, weights, progress=0.9, seed=1, independent=False)

    got, expected = directional_derivatives(loss, values, towards(kind, values), step)
    assert got == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize("terms", [{"image": 1.0}, {"bend": 1.0}], ids=["image", "prior"])
def test_the_gradient_of_the_bend_matches_central_differences(terms, monkeypatch):
    unknowns, data = scene(plain=False)
    asset, images = replace(small_scene.ball(), environment=small_scene.sky()), data.images
    scene_of_rays, none = RayScene(asset.mesh.vertices, asset.mesh.faces), torch.zeros_like(asset.mesh.vertices)
    surface = FixedSurface(data.start, asset, none, images, [0, 1, 2])
    pixels = maps.traced(surface, scene_of_rays, seed=0)
    rng = torch.Generator().manual_seed(3)
    for grid in unknowns.bend:
        grid += 0.1 * torch.randn(grid.shape, generator=rng)
    weights = Weights(**{**NONE, **terms})
    options = dict(direct=partial(radiance, samples=LIGHT, scene=None), seed=1, independent=False)

    def loss() -> Tensor:
        return maps.maps_loss(unknowns, surface, pixels, pixels.order[:400], weights, **options)

    got, expected = directional_derivatives(loss, unknowns.bend, towards("all", unknowns.bend), 1e-3)
    assert got == pytest.approx(expected, rel=0.02)  # float32 sums of 400 points
