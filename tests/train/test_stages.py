"""Stages of the paper's training: sampling, validation images, requested terms."""

import math
from dataclasses import replace

import pytest
import torch

from reli3d.geometry.camera import Camera, camera_rays
from reli3d.render.color import linear_to_srgb
from reli3d.render.gaussians import shade_gaussians
from reli3d.train.stages.config import PAPER, StageConfig, Weights
from reli3d.train.stages.config import TINY as TINY_STAGES
from reli3d.train.stages.losses import compared_colors, gradients, light_terms, lpips_distance
from reli3d.train.stages.rendering import Rendering, display, lobes
from reli3d.train.stages.step import encode, object_losses, renderings, total
from reli3d.train.stages.surface import render_surface, surface
from reli3d.train.stages.views import Samples, draw
from reli3d.train.stages.volume import occupied, render_volume
from tests.support.stages import RADIUS, ball_model, camera, flatten

VOLUME = StageConfig("volume", "volume", 24, patch=16, lobes=32, grid=8, samples_along=48)
GAUSSIANS = StageConfig("gaussians", "gaussians", 24, lobes=32)
MONTE_CARLO = StageConfig("monte_carlo", "monte_carlo", 24, samples=(6, 6, 2))
SIZES = dict(inputs=2, targets=1, background=0.5, input_size=32, target_size=24, patch=0)


@pytest.fixture(scope="module")
def source(small_samples):
    return Samples(small_samples)


@pytest.fixture(scope="module")
def one(source):
    return draw([source], (0, 0), **SIZES)


def test_the_papers_numbers():
    weights = vars(Weights())
    paper = dict(image=10, perceptual=2, mask=10, material=10, normal=4, flat=0.05, latent=0.1, neutral=0.02)
    assert {name: weights[name] for name in paper} == paper
    assert [s.batch for s in PAPER.values()] == [64, 192, 192, 192, 32]
    assert {s.rate for s in PAPER.values()} == {5e-5} and {s.steps for s in PAPER.values()} == {60_000}
    assert PAPER["monte_carlo"].samples == (20, 40, 4) and PAPER["monte_carlo"].shadows
    assert all(name == stage.name for stages in (PAPER, TINY_STAGES) for name, stage in stages.items())


def test_a_draw_is_a_function_of_its_seed_and_compares_unread_views(source):
    counts, shown, heroes = set(), set(), set()
    for step in range(24):
        a, b = (draw([source], (1, step), **SIZES) for _ in range(2))
        assert torch.equal(a.inputs.images, b.inputs.images) and torch.equal(a.targets.images, b.targets.images)
        assert a.seed == b.seed and len(a.targets) == 1
        for eye in a.inputs.c2w[:, :3, 3]:
            assert not torch.equal(eye, a.targets.c2w[0, :3, 3])
        counts.add(len(a.inputs)), shown.add(a.background_visible)
        heroes.add(tuple(a.inputs.c2w[0, :3, 3].tolist()))
    assert counts == {1, 2} and shown == {True, False}
    assert len(heroes) == 8  # any of the four views of both objects is the hero sometimes


def test_a_window_looks_through_the_same_pixels(one):
    part = one.targets.window(5, 3, 8)
    whole, cut = (camera_rays(Camera(v.c2w[0], v.intrinsics[0], *v.images.shape[1:3]))[1] for v in (one.targets, part))
    torch.testing.assert_close(cut, whole[3:11, 5:13], rtol=0, atol=1e-6)
    assert torch.equal(part.images[0], one.targets.images[0, 3:11, 5:13])


def test_display_values_continue_beyond_white():
    radiance = torch.tensor([0.1, 0.9, 1.0, 1.5, 3.0], requires_grad=True)
    shown = display(radiance)
    torch.testing.assert_close(shown[:3], linear_to_srgb(radiance[:3]))
    (gradient,) = torch.autograd.grad(shown.sum(), radiance)
    assert float(gradient.min()) > 0.4 and bool((shown.diff() > 0).all())


def test_even_lobes_keep_constant_light_and_the_total():
    model = ball_model()
    code = torch.nn.Module()
    code.latent = torch.zeros(1, 9, 3)
    model.radiance = lambda code, directions: torch.full((1, directions.shape[1], 3), 0.7)
    light = lobes(model, code, 64)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    radiance = torch.exp(light.sharpness * (directions @ light.axis.T - 1.0)) @ light.amplitude
    off = (radiance / 0.7 - 1.0).abs()
    # lobes of this width ripple by some per cent; at the two poles the spiral's spacing is uneven
    assert float((off < 0.05).float().mean()) > 0.9 and float(off.max()) < 0.2
    assert float(radiance.mean()) == pytest.approx(0.7, rel=0.01)


@pytest.mark.parametrize("stage", [VOLUME, GAUSSIANS], ids=lambda s: s.name)
@torch.no_grad()
def test_a_ball_is_shown_as_a_ball(stage, one):
    """Against the ball itself: opacity by quadrature, or its disc; normals; materials."""
    model, view = ball_model(), camera(48)
    flatten(model)
    model.heads["density"][-1].weight.data.zero_()
    model.steep = 30.0 if stage is VOLUME else 12.0
    code = encode(model, one)
    origins, directions = camera_rays(view)
    along = (origins * directions).sum(-1)
    miss = origins.square().sum(-1) - along**2  # squared distance of a ray from the center
    core = miss < RADIUS**2 - 0.1
    if stage is VOLUME:
        rendering = render_volume(model, code, view, lobes(model, code, 16), occupied(model, code, stage), stage, 0)
        t = torch.linspace(-0.87, 0.87, 1001)
        far = (miss[..., None] + t * t).sqrt()
        depth = 10.0 * (model.steep * (RADIUS - far)).exp().sum(-1) * (t[1] - t[0])
        # a step of 0.036 and a gradient of 30: single rays err by a fraction of a step, their mean does not
        assert float((rendering.coverage - (1.0 - (-depth).exp())).abs().mean()) < 0.02
        assert float((rendering.coverage - (1.0 - (-depth).exp())).mean()) == pytest.approx(0.0, abs=0.005)
    else:
        found = surface(model, code, 24)
        light = lobes(model, code, 16)
        rendering = render_surface(model, code, found, view, lambda p, wo, scene: shade_gaussians(p, wo, light))
        area = float(rendering.coverage.sum() / (miss < RADIUS**2).sum())
        # the iso-surface is curved, so a crossing on a cube of 0.07 lies inside
        assert area == pytest.approx(1.0, abs=0.05)
    nearest = (along + (RADIUS**2 - miss).clamp(min=0).sqrt())[..., None]
    true = torch.nn.functional.normalize(origins - nearest * directions, dim=-1)
    cosine = (rendering.normal * true).sum(-1)[core]
    assert float(cosine.mean()) > (0.97 if stage is VOLUME else 0.995)
    assert float(rendering.coverage[core].min()) > 0.95
    base = rendering.material[core][:, :3]
    assert 0.2 < float(base.mean()) < 0.8  # the head starts near one half


def test_terms_without_ground_truth_are_not_computed(one):
    model = ball_model()
    bare = replace(one.targets, material=None, normal=None, shown=None)
    known = object_losses(model, replace(one, targets=one.targets), GAUSSIANS, gradients)
    less = object_losses(model, replace(one, targets=bare), GAUSSIANS, gradients)
    assert set(known) - set(less) == {"material", "normal"}
    assert "neutral" in known and "latent" not in known  # these samples have no latents
    lit = replace(one.inputs, latent=torch.zeros(9, 3), strength=torch.zeros(()))
    assert "latent" in object_losses(model, replace(one, inputs=lit), GAUSSIANS, gradients)


def test_pixels_outside_the_photograph_have_no_weight(one):
    valid = torch.ones_like(one.targets.masks)
    valid[:, :, :10] = 0.0
    part = replace(one.targets, valid=valid)
    noise = replace(part, images=torch.where(valid[..., None] > 0, part.images, torch.rand_like(part.images)))
    model = ball_model()
    a, b = (object_losses(model, replace(one, targets=t), VOLUME, gradients) for t in (part, noise))
    for name in ("image", "perceptual", "mask"):
        assert float(a[name]) == float(b[name])


def test_clipped_pixels_may_be_brighter(one):
    views = replace(one.targets, images=torch.ones_like(one.targets.images), masks=torch.ones_like(one.targets.masks))
    color = torch.full((24, 24, 3), 1.7)
    got, expected = compared_colors(Rendering(color, color[..., 0], color[..., 0], color, color, color[0]), views, 0)
    assert torch.equal(got, expected)


def test_the_multi_scale_gradients_ignore_constant_regions_and_penalize_edges():
    rendering = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    assert float(gradients(rendering + 0.2, rendering)) < 1e-6
    assert float(gradients(rendering.roll(3, 1), rendering)) > 0.1


def test_latents_are_compared_as_the_decoder_gets_them(one):
    """Latents under a turn against the turned latents: their difference is nothing."""
    latent = torch.randn(9, 3, generator=torch.Generator().manual_seed(0))
    c, s = math.cos(0.7), math.sin(0.7)
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    none = torch.zeros(())
    views = replace(one.inputs, latent=latent @ turn.T, strength=none)
    assert float(light_terms(latent, turn, none, torch.ones(4, 3), views)["latent"]) < 1e-12
    off = light_terms(latent, turn, none + 0.7, torch.ones(4, 3), views)["latent"]
    assert float(off) == pytest.approx(0.49 / 28, rel=1e-4)  # 27 numbers and the strength


def test_light_without_color_is_neutral(one):
    bare = replace(one.inputs, latent=None)
    gray = torch.rand(50, 1, generator=torch.Generator().manual_seed(0)).expand(50, 3)
    eye, none = torch.eye(3), torch.zeros(())
    assert float(light_terms(torch.zeros(9, 3), eye, none, gray, bare)["neutral"]) < 1e-6
    red = torch.tensor([[1.5, 0.75, 0.75]])  # mean 1; off by 0.5, 0.25, 0.25
    assert float(light_terms(torch.zeros(9, 3), eye, none, red, bare)["neutral"]) == pytest.approx(1 / 3, rel=1e-5)


def test_lpips_without_its_weights_is_refused_in_one_line(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(ValueError, match="^--perceptual: expected .*, got none; "):
        lpips_distance()


@pytest.mark.parametrize("stage", [VOLUME, GAUSSIANS, MONTE_CARLO], ids=lambda s: s.name)
def test_every_stage_reaches_the_whole_network(stage, one):
    model = ball_model()
    lit = replace(one.inputs, latent=torch.zeros(9, 3), strength=torch.zeros(()))
    torch.manual_seed(1)
    for name, p in model.named_parameters():  # layers that start at zero would block the gradients of earlier ones
        if "modulation" in name or "normal" in name:
            torch.nn.init.normal_(p, std=0.02)
    terms = object_losses(model, replace(one, inputs=lit), stage, gradients)
    assert all(bool(torch.isfinite(v)) for v in terms.values())
    total(terms, stage).backward()
    if stage is not VOLUME:
        assert bool((model.merger.mlp[-1].weight.grad != 0).any(1).all())  # gamma, the last row, included
    surface_only = () if stage is not VOLUME else ("heads.deformation", "heads.flexicubes", "merger")
    # one key and one vector: these parameters of the published decoder have no effect, or none at the start
    unread = ("mha.query", "mha.key", "vn_invar.mlp.1.U")
    for name, p in model.named_parameters():
        if name.startswith(surface_only) and surface_only or any(u in name for u in unread):
            continue
        assert p.grad is not None and bool(torch.isfinite(p.grad).all()), name
        assert float(p.grad.abs().max()) > 0 or "norm_latent" in name, name


def test_a_field_of_one_sign_is_pulled_across_zero(one):
    model = ball_model()
    model.steep = 0.0
    with torch.no_grad():
        model.heads["density"][-1].bias -= 4.0
    code = encode(model, one)
    shown, terms = renderings(model, code, one, GAUSSIANS)
    assert shown == [] and float(terms["sign"]) > 0.5
    (gradient,) = torch.autograd.grad(terms["sign"], model.heads["density"][-1].bias, retain_graph=True)
    assert bool(torch.isfinite(gradient).all())


COUNTS = "samples: expected three counts of at least 0, one above 0"


@pytest.mark.parametrize(
    "wrong, message",
    [({"renderer": "mesh"}, ".*expected .*"), ({"patch": 25}, ".*expected .*")]
    + [({"samples": samples}, COUNTS) for samples in ((0, 0, 0), (4, -1, 2), (4, 4))],
)
def test_a_stage_refuses_invalid_options(wrong, message):
    with pytest.raises(ValueError, match=f"^{message}, got "):
        replace(MONTE_CARLO if "samples" in wrong else GAUSSIANS, **wrong)
