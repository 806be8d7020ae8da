"""The whole network: a tiny system of the published code end to end, and the promises of the presets."""

import pytest
import torch

from reli3d.nn.heads import truncated_exp
from reli3d.nn.model import Reconstructor
from reli3d.render.latlong import quarter_turn
from tests.support.networks import NANO, golden_tiny, views


@pytest.fixture
def tiny(goldens):
    """The golden's intrinsics are a random 3x3 matrix, which no camera has: the 25 numbers are set directly."""
    model, g = golden_tiny(goldens)
    numbers = torch.cat([g["c2w"].flatten(-2), g["intrinsics_normed"].flatten(-2)], dim=-1)
    model.camera.register_forward_pre_hook(lambda module, inputs: numbers)
    return model, g, (g["image"], g["mask"].squeeze(-1), g["c2w"], torch.ones(1, 2, 4))


@pytest.fixture(scope="module")
def nano():
    torch.manual_seed(0)
    return Reconstructor(NANO).eval()


@torch.no_grad()
def test_tiny_system_matches_published_end_to_end(tiny):
    model, g, inputs = tiny
    raw, embedded = [], []
    model.camera.register_forward_hook(lambda module, inputs, output: embedded.append(output))
    model.upsampler.register_forward_pre_hook(lambda module, inputs: raw.append(inputs[0]))
    code = model.encode(*inputs)

    def close(got, expected):  # float32 through all blocks; the bound is the required one, measured about 1e-6
        assert (got - expected).abs().max() < 1e-4 * expected.abs().max()

    close(embedded[0], g["camera_embedding"])
    close(raw[0], g["triplane_raw"])
    close(code.triplane[:, :, :8], g["triplane_first8ch"])
    close(code.triplane.mean(dim=(-2, -1)), g["triplane_channel_mean"])
    close(code.triplane.std(dim=(-2, -1)), g["triplane_channel_std"])
    close(code.latent, g["reni_latent"])
    close(code.strength, g["strength"][:, 0])
    close(code.rotation, g["rotation"])
    environment = model.decode_environment(code)
    assert environment.shape == (1, 64, 128, 3)
    published = quarter_turn(environment[0], 1)[None]
    torch.testing.assert_close(published[:, ::2, ::2], g["env_map"], rtol=1e-4, atol=1e-6)


@torch.no_grad()
def test_background_is_hidden_unless_requested(nano):
    images, masks, c2w, intrinsics = views(2, 2, 32)
    repainted = torch.where(masks[..., None] > 0, images, torch.rand_like(images))
    unlit = nano.encode(images, masks, c2w, intrinsics)
    hidden = nano.encode(repainted, masks, c2w, intrinsics)
    torch.testing.assert_close(unlit.latent, hidden.latent, rtol=0, atol=0)
    torch.testing.assert_close(unlit.triplane, hidden.triplane, rtol=0, atol=0)
    shown = nano.encode(repainted, masks, c2w, intrinsics, background_visible=torch.tensor([True, False]))
    assert (shown.latent[0] - unlit.latent[0]).abs().max() > 1e-4
    torch.testing.assert_close(shown.latent[1], unlit.latent[1])


@torch.no_grad()
def test_order_of_further_views_does_not_matter_and_the_reference_view_does(nano):
    inputs = views(1, 3, 32)
    unlit = nano.encode(*inputs).triplane
    torch.testing.assert_close(nano.encode(*(t[:, [0, 2, 1]] for t in inputs)).triplane, unlit, rtol=1e-4, atol=1e-6)
    assert (nano.encode(*(t[:, [1, 0, 2]] for t in inputs)).triplane - unlit).abs().max() > 1e-5


@torch.no_grad()
def test_a_batch_is_its_objects(nano):
    inputs = views(2, 2, 32)
    both = nano.encode(*inputs)
    for b in range(2):
        alone = nano.encode(*(t[b : b + 1] for t in inputs))
        torch.testing.assert_close(both.triplane[b : b + 1], alone.triplane, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(both.latent[b : b + 1], alone.latent, rtol=1e-4, atol=1e-6)


@torch.no_grad()
def test_the_field_starts_outside(nano):
    points = torch.rand(1, 500, 3) * 1.7 - 0.85
    density = nano.query(nano.encode(*views(1, 2, 32)), points, ["density"])["density"]
    assert (nano.sdf(density) > 0).all()
    assert nano.surface_density == pytest.approx(3.302585, abs=1e-6)  # 1 + ln 10
    assert abs(float(nano.sdf(torch.tensor(nano.surface_density)))) < 1e-5


def test_truncated_exp_bounds_its_gradient_only():
    x = torch.tensor([0.0, 14.0, 20.0], requires_grad=True)
    y = truncated_exp(x)
    torch.testing.assert_close(y, x.exp())
    (derivative,) = torch.autograd.grad(y.sum(), x)
    torch.testing.assert_close(derivative, torch.tensor([0.0, 14.0, 15.0]).exp())


def test_inputs_that_do_not_belong_together_are_named(nano):
    names, inputs = ("images", "masks", "c2w", "intrinsics"), views(1, 2, 32)
    for name, change, kind, message in (
        ("images", lambda t: t[:, :, :16], ValueError, r"shape \(B, V, 32, 32, 3\), got \(1, 2, 16, 32, 3\)"),
        ("images", lambda t: t[0], ValueError, r"shape \(B, V, 32, 32, 3\), got \(2, 32, 32, 3\)"),
        ("masks", lambda t: t[:, :1], ValueError, r"shape \(1, 2, 32, 32\), got \(1, 1, 32, 32\)"),
        ("c2w", torch.Tensor.double, TypeError, "torch.float32, got torch.float64"),
    ):
        with pytest.raises(kind, match=f"{name}: expected {message}"):
            nano.encode(*(change(t) if n == name else t for n, t in zip(names, inputs, strict=True)))


@torch.no_grad()
def test_tiny_system_in_bfloat16_stays_near_the_published(tiny):
    model, g, inputs = tiny
    code = model.to_compute(torch.bfloat16).encode(*inputs)
    error = (code.triplane[:, :, :8] - g["triplane_first8ch"]).norm() / g["triplane_first8ch"].norm()
    latent = (code.latent - g["reni_latent"]).norm() / g["reni_latent"].norm()
    # bfloat16 keeps 8 bits (0.002 relative to nearest); tens of roundings in a row, measured 0.015 and 0.013
    assert error < 0.04 and latent < 0.04
