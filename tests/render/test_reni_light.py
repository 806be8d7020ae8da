"""The light of a RENI++ latent: the kernel beside the torch module, shading that asks it, latents fitted to a map."""

import math

import numpy as np
import pytest
import torch

from reli3d.geometry.rays import RayScene
from reli3d.nn.presets import OFFICIAL
from reli3d.nn.reni import EnvironmentDecoder, map_directions, reni_frame
from reli3d.nn.reni_fit import fit_latent
from reli3d.nn.weights import read_manifest, read_tensors
from reli3d.render.environment import Environment
from reli3d.render.material import PAINTS
from reli3d.render.shading import ShadeOptions, shade, shade_light
from tests.support.surfaces import at, points

# Six norms and an exponential in float32.  The torch module itself is 4e-6 from float64; measured here 5e-6.
CLOSE = dict(rtol=1e-5, atol=0.0)


@pytest.fixture(params=["random", "published"])
def decoder(request, device):
    if request.param == "random":
        torch.manual_seed(0)
        return EnvironmentDecoder(OFFICIAL.reni).to(device).eval()
    path = request.getfixturevalue("goldens").parent / "reni++L49.safetensors"
    decoder, manifest = EnvironmentDecoder(OFFICIAL.reni), read_manifest(path)
    decoder.field.load_state_dict(read_tensors(manifest, {name: torch.float32 for name in manifest.tensors}))
    return decoder.eval().to(device)


def code(seed, device, spread=1.0):
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator))[0]
    latent = spread * torch.randn(49, 3, generator=generator)
    return latent.to(device), rotation.to(device), torch.tensor(0.3, device=device)


@torch.no_grad()
@pytest.mark.parametrize("seed, height", [(0, 64), (1, 5), (2, 33)])
def test_the_kernel_gives_the_module_s_map_at_any_size(decoder, seed, height):
    parts = code(seed, decoder.sample_directions.device)
    got = decoder.light(*parts).environment(height).radiance
    wanted = decoder(*(p[None] for p in parts), height)[0]
    torch.testing.assert_close(got, wanted, rtol=2e-5, atol=0.0)  # both round
    latent, rotation, strength = (p.double() for p in parts)
    directions = reni_frame(map_directions(height, got.device)).reshape(1, -1, 3).double()
    truth = decoder.double().field((latent @ rotation.T)[None], directions).exp() * strength.exp()
    torch.testing.assert_close(got.double().reshape(1, -1, 3), truth, **CLOSE)


@torch.no_grad()
@pytest.mark.parametrize("decoder", ["published"], indirect=True)
def test_the_kernel_gives_the_published_maps(goldens, decoder):
    with np.load(goldens / "reni_decoder.npz") as file:
        g = {k: torch.from_numpy(file[k]).to(decoder.sample_directions.device) for k in file.files}
    for k in range(len(g["latent"])):
        got = decoder.light(g["latent"][k], g["rotation"][k], g["strength"][k]).environment(64).radiance
        torch.testing.assert_close(got, g["env_map"][k], rtol=1e-4, atol=1e-6)  # the bound of the module's own test


@torch.no_grad()
def test_directions_of_any_shape_and_the_poles(decoder):
    device = decoder.sample_directions.device
    parts = code(3, device)
    light = decoder.light(*parts)
    directions = map_directions(12, device)
    torch.testing.assert_close(light.lookup(directions), light.environment(12).radiance, **CLOSE)
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).to(device)
    wanted = decoder.radiance(*(p[None] for p in parts), reni_frame(axes)[None])[0]
    torch.testing.assert_close(light.lookup(axes), wanted, **CLOSE)
    assert light.lookup(directions[:0]).shape == (0, 24, 3)
    assert decoder.light(0 * parts[0], *parts[1:]).environment(4).radiance.isfinite().all()


def test_wrong_arguments_are_named(decoder):
    device = decoder.sample_directions.device
    latent, rotation, strength = code(0, device)
    with pytest.raises(ValueError, match=r"latent: expected shape \(49, 3\), got \(1, 49, 3\)"):
        decoder.light(latent[None], rotation, strength)
    light = decoder.light(latent.requires_grad_(), rotation, strength)
    assert not light.environment(2).radiance.requires_grad
    with pytest.raises(ValueError, match="height: expected at least 1, got 0"):
        light.environment(0)
    with pytest.raises(ValueError, match=r"directions: expected shape \(..., 3\)"):
        light.lookup(torch.zeros(4, 2, device=device))
    with pytest.raises(TypeError, match="directions: expected torch.float32"):
        light.lookup(torch.zeros(4, 3, device=device, dtype=torch.float64))


def surfaces(n, device):
    normal, wo = points(n)
    generator = torch.Generator().manual_seed(2)
    rest = torch.rand(n, 3, generator=generator), torch.rand(n, generator=generator), torch.rand(n, generator=generator)
    return [t.to(device) for t in (torch.rand(n, 3, generator=generator) - 0.5, normal, normal, wo, *rest)]


@pytest.mark.parametrize("backend", [None, "warp", "auto"])
def test_shading_that_asks_a_map_is_shading_by_the_map(device, backend):
    """The same samples; one adds them in its kernel, the other in torch.

    Not those of seed 5: one of them is 2e-6 of a texel beside a border, where the density is either side's.
    """
    generator = torch.Generator().manual_seed(4)
    light = Environment(torch.rand(16, 32, 3, generator=generator).to(device) * 3.0)
    scene = None
    if backend:
        triangle = torch.tensor([[-2.0, 0.7, -2.0], [2.0, 0.7, -2.0], [0.0, 0.7, 3.0]], device=device)
        scene = RayScene(triangle, torch.tensor([[0, 1, 2]], dtype=torch.int32, device=device), backend=backend)
    args = surfaces(500, device)
    for paint in PAINTS:
        got, wanted = (
            shade_light(*at(*args), light, light, scene=scene, options=ShadeOptions(seed=6, paint=paint)),
            shade(*at(*args), light, scene=scene, options=ShadeOptions(seed=6, paint=paint)),
        )
        torch.testing.assert_close(got, wanted, rtol=1e-4, atol=1e-5)  # 64 numbers in another order
    if backend:
        assert (
            wanted - shade(*at(*args), light, options=ShadeOptions(seed=6, paint=paint))
        ).abs().max() > 0.1  # the triangle is in the way


def test_shading_by_a_latent_is_shading_by_its_fine_map(device):
    torch.manual_seed(0)
    decoder = EnvironmentDecoder(OFFICIAL.reni).to(device).eval()
    light = decoder.light(*code(6, device, 0.3))
    args, coarse = surfaces(300, device), light.environment(16)
    got = shade_light(*at(*args), light, coarse, options=ShadeOptions(seed=1))
    fine = shade_light(*at(*args), light.environment(256), coarse, options=ShadeOptions(seed=1))  # the same directions
    torch.testing.assert_close(got, fine, rtol=5e-3, atol=1e-3 * float(fine.mean()))  # bilinear over 0.7 degrees
    rough = shade_light(*at(*args), coarse, coarse, options=ShadeOptions(seed=1))
    assert (rough - fine).abs().mean() > 4 * (got - fine).abs().mean()  # a stored map of 16 rows shows


@pytest.mark.parametrize("height", [20, pytest.param(32, marks=pytest.mark.slow)])
def test_a_decoded_map_is_found_again(decoder, height):
    device = decoder.sample_directions.device
    latent, _, _ = code(7, device)
    with torch.no_grad():
        radiance = decoder(
            latent[None], torch.eye(3, device=device)[None], torch.full((1,), 2.0, device=device), height
        )
    before = [p.clone() for p in decoder.parameters()]
    fit = fit_latent(decoder, radiance[0], steps=120)
    spread = float((radiance.log() - radiance.log().mean()).abs().mean())
    assert fit.error < 0.3 * spread  # 120 steps of the 500
    with torch.no_grad():
        again = decoder(fit.latent[None], fit.rotation[None], fit.strength[None], height)
    rows = torch.sin((torch.arange(height, device=device) + 0.5) * math.pi / height)[:, None, None]
    measured = float(((again.log() - radiance.log()).abs() * rows).mean() / rows.mean())
    assert measured < 1.3 * fit.error  # what it says, but for the floor of the logarithm
    twice = fit_latent(decoder, 2.0 * radiance[0], steps=120)
    torch.testing.assert_close(
        twice.strength - fit.strength, torch.tensor(math.log(2.0), device=device), rtol=0, atol=1e-3
    )
    assert all(torch.equal(a, b) and b.grad is None for a, b in zip(before, decoder.parameters(), strict=True))


def test_maps_that_cannot_be_fitted_are_named():
    torch.manual_seed(0)
    decoder = EnvironmentDecoder(OFFICIAL.reni).eval()
    for radiance, message in [
        (torch.ones(8, 15, 3), r"expected \(H, 2H, 3\) with H at least 8, got \(8, 15, 3\)"),
        (torch.ones(4, 8, 3), "H at least 8"),
        (torch.zeros(8, 16, 3), "got NaN, infinity, negative or black"),
        (torch.full((8, 16, 3), math.nan), "got NaN, infinity, negative or black"),
        (-torch.ones(8, 16, 3), "got NaN, infinity, negative or black"),
    ]:
        with pytest.raises(ValueError, match="radiance: .*" + message):
            fit_latent(decoder, radiance)
    with pytest.raises(TypeError, match="radiance: expected torch.float32"):
        fit_latent(decoder, torch.ones(8, 16, 3, dtype=torch.float64))
