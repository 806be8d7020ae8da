"""Training: samples are consistent, losses reach the network, a run resumes where it stopped."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from reli3d.cli.train import main
from reli3d.errors import InputError
from reli3d.geometry.camera import Camera, project
from reli3d.geometry.hull import hull_distance
from reli3d.nn.local import LocalReconstructor
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import OFFICIAL, SMALL, TINY
from reli3d.nn.weights import load_model
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.latlong import lat_long_directions
from reli3d.train import checkpoint, small
from reli3d.train import losses as loss_terms
from reli3d.train.batches import draw_samples, load_sample, random_turn
from reli3d.train.light_prior import LightPriorStage
from reli3d.train.loop import parameter_groups, progress, rate_at, train
from reli3d.train.losses import encode_sample, excess_entropy, losses, pattern_loss, perturbed
from reli3d.train.pixels import is_pixel_parameter
from reli3d.train.small import FAST_RATE, PixelStage, SmallOptions, SmallStage
from reli3d.train.stage import Options
from reli3d.train.stages.latents import load_prior


def drawn(folder, seeds, *, points, max_views):
    return draw_samples(sorted(folder.glob("*.safetensors")), [(s,) for s in seeds], points=points, max_views=max_views)


@pytest.fixture(scope="module")
def samples(folder):
    return drawn(folder, (1, 2), points=512, max_views=2)


def test_the_field_and_a_gradient_on_cuda_are_those_of_the_cpu(folder):
    if not torch.cuda.is_available():
        pytest.skip("needs CUDA")
    file, found = sorted(folder.glob("*.safetensors"))[0], []
    for place in (torch.device("cpu"), torch.device("cuda")):
        stored = load_sample(file, 2, 256, np.random.default_rng(0), augment=False, device=place)
        model = load_model("small").to(place).train().requires_grad_(True)
        assert stored.images.device.type == stored.light.device.type == place.type
        field = encode_sample(model, stored)
        field.free_sdf(stored.points).square().mean().backward()
        found.append((field.log_light.detach().cpu(), model.volume.out.weight.grad.cpu()))
    for got, expected in zip(*found, strict=True):
        assert float((got - expected).norm() / expected.norm()) < 0.01  # TF32: 10 bits of the mantissa


def test_signed_distance_is_zero_on_the_surface_and_positive_outside_the_hull(samples):
    for s in samples:
        camera = Camera(s.c2w, s.intrinsics, *s.silhouette.shape[:0:-1])
        outside = hull_distance(s.points.contiguous(), s.silhouette, camera) < -0.05
        assert bool(outside.any()) and bool((s.distance[outside] > 0).all())


def test_augmented_maps_agree_with_the_points(folder):
    """Turned, mirrored or not: a seen surface point projects to a pixel of its own depth, normal and material."""
    for s in drawn(folder, range(6), points=4096, max_views=2):
        position, _, bumped = s.surface.unbind(1)
        scale = s.view_depth.shape[1] / s.images.shape[1]
        for v in range(len(s.c2w)):
            assert torch.linalg.det(s.c2w[v, :3, :3]) == pytest.approx(1.0, abs=1e-5)
            xy, depth = project(position, s.c2w[v], s.intrinsics[v])
            x, y = (xy * scale).long().clamp(0, s.view_depth.shape[1] - 1).unbind(-1)
            own = (s.visible[:, v] > 0) & s.view_valid[v, y, x]
            assert int(own.sum()) > 100
            y, x = y[own], x[own]
            eye_depth = depth[own] - (s.c2w[v, :3, 3] * s.c2w[v, :3, 2]).sum()
            # within a pixel of two the surface may recede by a few pixels' width, 0.01 each
            assert float((s.view_depth[v, y, x] - eye_depth).abs().median()) < 0.02
            assert float((s.view_normal[v, y, x] * bumped[own]).sum(-1).median()) > 0.95
            difference = (s.view_material[v, y, x] - s.material[own]).abs().median(0).values
            assert float(difference.max()) < 0.03  # patterns are finer than a pixel in places: the median is not


def test_random_turns_are_rotations_with_four_up_axes():
    turns = torch.stack([random_turn(np.random.default_rng(seed)) for seed in range(200)])
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand(200, 3, 3), rtol=0, atol=1e-6)  # float32
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(200), rtol=0, atol=1e-5)  # the same
    ups = {tuple(up.round().int().tolist()) for up in turns[:, :, 1]}
    assert ups == {(0, 1, 0), (0, 0, 1), (1, 0, 0), (0, -1, 0)}


def test_a_turn_carries_light_and_surface_together(folder):
    """+X is bright: whatever the turn or mirror, surface that faces the bright side is brighter."""
    for s in drawn(folder, range(6), points=2048, max_views=1):
        bright = s.light_directions[s.light.sum(-1).argmax()]
        valid = s.view_valid[0]
        shade = torch.nn.functional.avg_pool2d(s.images[0].mean(-1)[None, None], 2)[0, 0][valid]
        cosine = s.view_normal[0][valid] @ bright
        if int((cosine > 0.3).sum()) > 30 and int((cosine < -0.3).sum()) > 30:
            assert float(shade[cosine > 0.3].median()) > float(shade[cosine < -0.3].median())


def test_the_pattern_loss_forgives_exposure_and_nothing_else():
    target = torch.rand(500, 3) * 0.6 + 0.1
    darker = linear_to_srgb(srgb_to_linear(target) * torch.tensor([0.3, 0.7, 0.5]))
    assert float(pattern_loss(darker, target)) < 1e-9
    unrelated = (target.flip(0) - target).square().mean()  # about twice the variance, 0.06; the best factors are near 1
    got = pattern_loss(target.flip(0), target).expm1() * loss_terms.PATTERN_FLOOR
    torch.testing.assert_close(got, unrelated, rtol=0.5, atol=0)


def test_half_an_error_counts_as_much_on_a_plain_object_as_on_a_patterned_one():
    for amount in (0.1, 0.2):  # of stripes without a factor, on gray
        stripes = amount * torch.tensor([1.0, -1.0]).repeat(250)[:, None].expand(-1, 3)
        gray = torch.full((500, 3), 0.5)
        whole, half = (float(pattern_loss(gray + k * stripes, gray)) for k in (1.0, 0.5))
        assert 0.7 * math.log(4.0) < whole - half < 1.1 * math.log(4.0), amount  # PLAIN takes a quarter at 0.1


def test_the_excess_entropy_is_least_at_the_target_and_pulls_from_black_and_white():
    target = torch.rand(500, 3)
    assert float(excess_entropy(target, target)) == 0.0
    assert float(excess_entropy((target + 0.01).clamp(max=1.0), target)) > 0.0
    logit = torch.tensor([-9.0, 9.0]).repeat(3, 1).T.requires_grad_()
    excess_entropy(logit.sigmoid(), torch.full((2, 3), 0.5)).backward()
    # the derivative of the cross-entropy by the logit is the difference of the colors, by the mean over 6 numbers
    torch.testing.assert_close(logit.grad, torch.tensor([-0.5, 0.5]).repeat(3, 1).T / 6, rtol=1e-3, atol=0)


def test_a_batch_is_a_function_of_seed_step_and_places_however_it_is_shared(folder):
    stage = SmallStage(LocalReconstructor(SMALL), [folder], SmallOptions(2, 256), seed=7)
    whole = stage.batch(2, range(4))
    torch.manual_seed(0)
    shared = [stage.batch(2, range(rank, 4, 2)) for rank in range(2)]
    for place in range(4):
        for field in dataclasses.fields(whole[place]):
            again = getattr(shared[place % 2][place // 2], field.name)
            assert torch.equal(getattr(whole[place], field.name), again), field.name
    assert not torch.equal(whole[0].points, stage.batch(3, range(1))[0].points)


def test_every_parameter_gets_a_gradient(samples):
    torch.manual_seed(0)
    model = LocalReconstructor(SMALL)
    for _ in range(2):  # the last layers start at zero, so earlier layers learn from the second step on
        terms = losses(model, samples[0])
        assert all(bool(torch.isfinite(v)) for v in terms.values())
        model.zero_grad()
        sum(terms.values()).backward()
        with torch.no_grad():
            for p in model.parameters():
                p -= 1e-3 * p.grad
    for name, p in model.named_parameters():
        assert bool(torch.isfinite(p.grad).all()) and float(p.grad.abs().max()) > 0, name


def test_every_parameter_is_in_one_group_and_some_learn_faster():
    model = LocalReconstructor(SMALL)
    groups = parameter_groups(SmallStage(model, []), 0.02)
    times = {id(p): (group["times"], group["weight_decay"]) for group in groups for p in group["params"]}
    assert len(times) == sum(len(group["params"]) for group in groups) == len(list(model.parameters()))
    heads = (head[-1] for head in (*model.pyramid.says.values(), model.color, model.surface))
    fast = {id(p) for part in (*heads, model.light.out, model.cost_volume) for p in part.parameters()}
    for p in model.parameters():
        assert times[id(p)] == (FAST_RATE if id(p) in fast else 1.0, 0.02 if p.ndim > 1 else 0.0)
    slow = {id(p) for name, p in model.named_parameters() if is_pixel_parameter(name)}
    assert {id(p) for group in parameter_groups(PixelStage(model, []), 0.02) for p in group["params"]} == slow
    for group in parameter_groups(SmallStage(model, [], SmallOptions(pyramid_rate=0.1)), 0.02):
        for p in group["params"]:
            assert group["times"] == pytest.approx(times[id(p)][0] * (0.1 if id(p) in slow else 1.0))


def test_training_learns_logs_and_resumes(folder, tmp_path):
    torch.manual_seed(0)
    stage = SmallStage(LocalReconstructor(SMALL), [folder], SmallOptions(1, 256), seed=3)
    options = stage.options(str(tmp_path), steps=12, batch=1, warmup=5, seed=3)
    (sample,) = drawn(folder, (3,), points=256, max_views=1)
    before = losses(stage.model, sample)
    train(stage, options)
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert rows[0]["config"]["stage"] == "small" and rows[-1]["step"] == 12 and set(loss_terms.WEIGHTS) < set(rows[-1])
    after = losses(stage.model, sample)
    whole = [float(sum(loss_terms.WEIGHTS[k] * v for k, v in terms.items())) for terms in (before, after)]
    assert whole[1] < 0.7 * whole[0]  # 12 steps on two objects
    again = SmallStage(LocalReconstructor(SMALL), [folder], SmallOptions(1, 256), seed=3)
    train(again, dataclasses.replace(options, steps=13))
    assert checkpoint.load(tmp_path / "state.pt")["step"] == 13


def test_the_image_of_a_run_shows_a_sample_from_one_and_from_four_views(folder, monkeypatch):
    monkeypatch.setattr(small, "VALIDATION_OBJECTS", 1)
    monkeypatch.setattr("reli3d.output.preview.TILE_PIXELS", 64)
    stage = SmallStage(load_model("small", "cpu"), [folder], validation=folder)
    image = stage.validation(stage.model.state_dict())
    one, four = np.split(image, 2, axis=1)
    assert image.dtype == np.uint8 and one.shape == (*four.shape[:2], 3)
    tile = one.shape[1] // 4
    assert np.array_equal(one[:tile], four[:tile]) and not np.array_equal(one, four)  # both begin with the input views
    assert SmallStage(stage.model, [folder]).validation(stage.model.state_dict()) is None


def test_a_checkpoint_of_version_0_2_gives_its_weights_and_resumes(folder, tmp_path):
    """Those files hold model, optimizer, average, step and seconds alone."""
    stage = SmallStage(LocalReconstructor(SMALL), [folder], SmallOptions(1, 64))
    train(stage, stage.options(str(tmp_path), steps=1, batch=1))
    path = tmp_path / "state.pt"
    state = torch.load(path, weights_only=True)
    torch.save({k: state[k] for k in ("model", "optimizer", "average", "step", "seconds")}, path)
    then = step_from(folder, tmp_path / "next", str(path))
    assert all(float((then[k] - v).abs().max()) < 1e-6 for k, v in state["average"].items())
    train(stage, stage.options(str(tmp_path), steps=2, batch=1))
    assert checkpoint.load(path)["step"] == 2


def test_convolutions_in_bfloat16_change_the_losses_by_their_rounding(samples):
    """Eight bits of mantissa, a relative error of 2^-9 each; sums over layers and pixels keep mean losses to 1 %."""
    model = load_model("small", "cpu").requires_grad_(True)
    found = []
    for dtype in (torch.float32, torch.bfloat16):
        model.to_compute(dtype)
        model.zero_grad()
        torch.manual_seed(1)  # points go astray at random
        of_samples = [losses(model, sample) for sample in samples]
        terms = {name: (of_samples[0][name] + of_samples[1][name]) / 2 for name in of_samples[0]}
        sum(terms.values()).backward()
        found.append((terms, torch.cat([p.grad.flatten() for p in model.parameters()])))
    assert all(p.dtype == torch.float32 for p in model.parameters())
    for name, value in found[0][0].items():
        # light_scale is the mean of differences of logarithms, which may lie near zero
        near = 0.01 if name == "light_scale" else 0.0
        assert float(found[1][0][name]) == pytest.approx(float(value), rel=0.01, abs=near), name
        assert not torch.equal(found[1][0][name], value), name
    assert float(torch.nn.functional.cosine_similarity(found[0][1], found[1][1], 0)) > 0.999


def step_from(folder, out, weights):
    """Values after one step that is too short to be seen, from ``weights``."""
    assert main([str(folder), str(out), "--weights", weights, "--steps", "1", "--batch", "1", "--rate", "1e-9"]) == 0
    return torch.load(out / "state.pt", weights_only=True)["model"]


def test_training_may_begin_with_the_weights_of_the_package_alone(folder, tmp_path):
    shipped, then = load_model("small", "cpu").state_dict(), step_from(folder, tmp_path / "run", "small")
    assert all(float((then[k] - v).abs().max()) < 1e-6 for k, v in shipped.items())


def test_the_rate_warms_up_and_ends_low():
    options = Options("", steps=1000, warmup=100)
    assert rate_at(options, 0, 0.0) == pytest.approx(options.rate / 100)
    assert rate_at(options, 999, progress(options, 999, 0)) < 0.03 * options.rate
    assert progress(dataclasses.replace(options, minutes=10.0), 1, 600.0) == 1.0


def test_the_light_prior_fits_a_map_and_is_loaded(tmp_path):
    torch.manual_seed(0)
    up = 0.3 + 2.0 * lat_long_directions(64)[None, ..., 1:2].clamp(min=0).expand(2, -1, -1, 3)
    np.savez(tmp_path / "maps.npz", env=up.numpy(), names=["a", "b"])
    stage = LightPriorStage(OFFICIAL, tmp_path / "maps.npz", added=0)
    train(stage, stage.options(str(tmp_path), steps=60, batch=1, warmup=1))
    with torch.no_grad():
        field = stage.model.decoder.field(stage.model.latents, stage.directions[None])
    error, spread = ((v - stage.texels.log()).abs().mean() for v in (field, stage.texels.log().mean()))
    assert float(error) < 0.5 * float(spread)  # 60 steps are enough to know up from down
    model = Reconstructor(TINY)
    with pytest.raises(InputError, match="state.pt"):  # of preset official
        load_prior(model, tmp_path / "state.pt")
    stage = LightPriorStage(TINY, tmp_path / "maps.npz", added=3)
    train(stage, stage.options(str(tmp_path / "tiny"), steps=1))
    load_prior(model, tmp_path / "tiny" / "state.pt")
    average = checkpoint.load(tmp_path / "tiny" / "state.pt")["average"]
    assert torch.equal(model.environment.field.network.fc.weight, average["decoder.field.network.fc.weight"])
    assert not any(p.requires_grad for p in model.environment.parameters())


def test_points_go_astray_along_their_normals_as_far_as_stated():
    """Over many draws the mean squares are a third of the greatest deviation's: its fraction is uniform in [0, 1]."""
    torch.manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(256, 3), dim=-1)
    position = torch.rand(256, 3) - 0.5
    moved, angle = [], []
    for _ in range(400):
        p, n = perturbed(position, normal)
        away = p - position
        assert float((away - (away * normal).sum(-1, keepdim=True) * normal).abs().max()) < 1e-6  # float32 of unit size
        assert float((n.norm(dim=-1) - 1).abs().max()) < 1e-6
        moved.append(away.square().sum(-1).mean())
        angle.append((n - normal).square().sum(-1).mean())
    # the mean of 400 squares of uniform numbers is known to 4.5 % (standard error 0.30 / sqrt(400) of 1/3): four of it
    assert abs(float(torch.stack(moved).mean()) / (loss_terms.MAX_PERTURBATION[0] ** 2 / 3) - 1) < 0.18
    # chords of small angles
    assert abs(float(torch.stack(angle).mean()) / (loss_terms.MAX_PERTURBATION[1] ** 2 / 3) - 1) < 0.18
