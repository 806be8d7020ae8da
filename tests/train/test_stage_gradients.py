"""The gradient of each stage's whole loss on one object against central differences.

The random numbers are the same on both sides.  Points of materials, frames of bumps and densities of samples are
detached by design: light samples where the material moves, cosine samples alone where the light does, even materials
and flat bumps where the geometry does.  Colors at outlines jump from pixel to pixel, and a normal is not evaluated at
the moved surface: the gradient of a surface agrees to 15 percent.
"""

from dataclasses import replace

import pytest
import torch

from reli3d.train.stages import step as stage_step
from reli3d.train.stages.config import StageConfig, Weights
from reli3d.train.stages.losses import gradients
from reli3d.train.stages.step import object_losses, total
from reli3d.train.stages.surface import render_surface, surface
from reli3d.train.stages.views import Samples, draw
from tests.support.differences import directional_derivatives
from tests.support.stages import ball_model, camera, flatten, write_samples

VOLUME = StageConfig("volume", "volume", 24, lobes=16, grid=8, samples_along=32)
GAUSSIANS = StageConfig("gaussians", "gaussians", 24, lobes=16)
NONE = dict.fromkeys(vars(Weights()), 0.0)
OUTLINE = replace(GAUSSIANS, weights=Weights(**{**NONE, "mask": 10.0, "deviation": 0.5, "sign": 0.2, "spread": 0.1}))
# the pixels whose maps are compared follow the surface without a gradient; with one, a surface could flee its material
MOVING = replace(GAUSSIANS, weights=replace(Weights(), material=0.0, normal=0.0))
NORMALS = replace(VOLUME, weights=Weights(**{**NONE, "normal": 4.0}))
LIGHT = StageConfig("monte_carlo", "monte_carlo", 24, samples=(32, 0, 0))
COSINE = replace(LIGHT, samples=(0, 0, 32))
MATERIAL = ("heads.base_color", "heads.roughness", "heads.metallic")
LATENT = ("illumination.bank", "illumination.transformer")
SHAPE = ("heads.density", "heads.deformation", "heads.flexicubes", "merger")
CASES = {  # stage, what moves, step, tolerance
    "volume, material": (VOLUME, MATERIAL, 3e-3, 0.01),
    "volume, light": (VOLUME, LATENT, 1e-3, 0.01),
    "volume, shape": (VOLUME, SHAPE, 1e-3, 0.03),
    "volume, normals": (NORMALS, SHAPE, 1e-3, 0.03),
    "gaussians, material": (GAUSSIANS, MATERIAL, 3e-3, 0.01),
    "gaussians, light": (GAUSSIANS, LATENT, 1e-3, 0.01),
    "gaussians, shape": (MOVING, SHAPE, 1e-2, 0.15),
    "gaussians, outline and regularizers": (OUTLINE, SHAPE, 1e-3, 0.01),
    "monte carlo, material": (LIGHT, MATERIAL, 3e-3, 0.01),
    "monte carlo, light": (COSINE, LATENT, 1e-3, 0.01),
}


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    source = Samples(write_samples(tmp_path_factory.mktemp("gradients"), seeds=(3,)))
    drawn = draw([source], (0, 0), inputs=2, targets=1, background=0.5, input_size=32, target_size=24, patch=0)
    lit = replace(drawn.inputs, latent=0.3 * torch.ones(9, 3), strength=torch.tensor(0.2))
    return replace(drawn, inputs=lit)


@pytest.mark.parametrize("case", CASES)
def test_the_whole_loss_has_the_gradient_of_central_differences(case, one, monkeypatch):
    stage, names, size, tolerance = CASES[case]
    model = ball_model()
    flatten(model)
    for head in MATERIAL if names is SHAPE else ():
        model.heads[head.removeprefix("heads.")][-1].weight.data.zero_()
    if names is SHAPE:
        grid = stage_step.occupied  # the choice of cells is not differentiated
        full = []
        monkeypatch.setattr(stage_step, "occupied", lambda *a: (full or full.append(grid(*a)) or full)[0])
    moved = [p for name, p in model.named_parameters() if name.startswith(names)]
    rng = torch.Generator().manual_seed(4)  # a direction in which no derivative nearly vanishes
    sizes = [max(0.02, float(p.detach().square().mean().sqrt())) for p in moved]
    directions = [torch.randn(p.shape, generator=rng) * s for p, s in zip(moved, sizes, strict=True)]

    def loss() -> torch.Tensor:
        return total(object_losses(model, one, stage, gradients), stage)

    got, expected = directional_derivatives(loss, moved, directions, size)
    assert got == pytest.approx(expected, rel=tolerance)


def test_all_terms_are_in_the_gradient(one):
    """Every weight of the paper changes the total of some stage: no term is computed and forgotten."""
    model = ball_model()
    requested = set()
    for stage in (VOLUME, GAUSSIANS):
        for drawn in (one, replace(one, inputs=replace(one.inputs, latent=None, strength=None))):
            requested |= set(object_losses(model, drawn, stage, gradients))
    assert requested == set(vars(Weights()))


def test_the_normals_of_the_mesh_have_a_gradient_in_the_image(one):
    """The shading normal of a flat bump is that of the mesh; so is its shading."""
    model = ball_model()
    flatten(model)
    code = stage_step.encode(model, one)
    with torch.no_grad():
        found = surface(model, code, 16)
    generator = torch.Generator().manual_seed(2)
    normals, direction = found.mesh.normals.clone(), torch.randn(found.mesh.normals.shape, generator=generator)

    def lit(points, wo, scene):
        return 0.5 + 0.25 * points.normal

    def shown(normals: torch.Tensor) -> torch.Tensor:
        bent = replace(found, mesh=replace(found.mesh, normals=normals))
        rendering = render_surface(model, code, bent, camera(24), lit)
        return (rendering.color * noise).sum() + (rendering.normal * noise.flip(0)).sum()

    noise = torch.randn(24, 24, 3, generator=generator)
    got, expected = directional_derivatives(lambda: shown(normals), [normals], [direction], 1e-2)
    # float32 sums of 576 pixels; the curvature of a normalization over a step of 1e-2 is 1e-4
    assert got == pytest.approx(expected, rel=0.01)
