"""Modules of the network against inputs, parameters and outputs of the published model's modules."""

import numpy as np
import pytest
import torch

from reli3d.geometry.triplane import sample_triplane
from reli3d.nn import transformer
from reli3d.nn.heads import HEADS, Heads, WeightMerger
from reli3d.nn.illumination import Illumination, Transformer1D
from reli3d.nn.presets import BackboneSizes, EncoderSizes, IlluminationSizes, UpsamplerSizes
from reli3d.nn.published import our_key
from reli3d.nn.reni import rotation_from_6d
from reli3d.nn.tokenizers import (
    CameraEmbedder,
    ImageTokenizer,
    PixelShuffleUpsampler,
    camera_vector,
    patch_grid,
    resample_positions,
)
from reli3d.nn.transformer import TwoStreamTransformer

SHALLOW = dict(rtol=1e-5, atol=1e-5)  # one to four float32 layers with sums of at most a few hundred terms
# blocks of attention and norms; the goldens differ by about 1e-5 of the largest value
DEEP = dict(rtol=1e-4, atol=2e-5)


class Golden:
    """One golden file: tensors by name, and the parameters of its module under our names."""

    def __init__(self, path):
        with np.load(path) as file:
            self.values = {k: torch.from_numpy(file[k]) for k in file.files if file[k].dtype.kind in "fi"}

    def __getitem__(self, name):
        return self.values[name]

    def load(self, module, published, ours, part=""):
        """Fill ``module``: the file's ``param.<part>*``, whose full published name starts with ``published``."""
        parameters = {k[len("param.") :]: v for k, v in self.values.items() if k.startswith("param." + part)}
        named = {our_key(published + k): v for k, v in parameters.items()}
        module.load_state_dict({k[len(ours) :]: v for k, v in named.items()}, strict=True)
        return module.eval()


@pytest.fixture
def golden(goldens):
    return lambda name: Golden(goldens / f"{name}.npz")


def assert_relative(got, expected, bound):
    """Largest difference over the largest value, the measure in which the goldens state their agreement."""
    error = (got - expected).abs().max() / expected.abs().max()
    assert error < bound, f"relative error {error:.2e}, bound {bound:.0e}"


def test_camera_vector_holds_both_matrices_row_by_row():
    c2w = torch.arange(16.0).reshape(1, 1, 4, 4)
    vector = camera_vector(c2w, torch.tensor([[[512.0, 256.0, 250.0, 260.0]]]), 500)[0, 0]
    expected = [1.024, 0, 0.5, 0, 0.512, 0.52, 0, 0, 1]
    torch.testing.assert_close(vector, torch.cat([torch.arange(16.0), torch.tensor(expected)]))


DINO = EncoderSizes(hidden=48, layers=2, heads=3, patch=14, grid=7, mask_channel=False)
STREAMS = BackboneSizes(heads=4, latents=12, blocks=3, basic_blocks=2, experts=3, experts_from=1, groups=8)


def illumination_sizes(**changes):
    encoder = EncoderSizes(hidden=24, layers=2, heads=2, patch=14, grid=7, mask_channel=True)
    values = dict(encoder=encoder, tokens=78, token_width=32, width=32, heads=4, layers=2, groups=4)
    return IlluminationSizes(**{**values, **changes})


def two_streams(g):
    return g.load(TwoStreamTransformer(STREAMS, 32), "backbone.", "backbone.")


CASES = {  # module, fronts of its published and our names, inputs, shape of the output
    "camera_embedder": (lambda: CameraEmbedder(64), "preprocessor.1.", "camera.", lambda g: [numbers_of(g)]),
    "dinov2_tokenizer_small": (
        lambda: ImageTokenizer(DINO, 48), "tokenizer.0.", "encoder.", lambda g: [g["image"], g["camera_embedding"]],
    ),
    "transformer1d_small": (
        lambda: Transformer1D(illumination_sizes(layers=3)), "postprocessor.1.backbone.", "illumination.transformer.",
        lambda g: [g["input"], g["cross"]],
    ),
    "pixel_shuffle_small": (
        lambda: PixelShuffleUpsampler(UpsamplerSizes(convolutions=4, scale=4, channels=5), 16),
        "postprocessor.0.", "upsampler.", lambda g: [g["triplane"]],
    ),
}  # fmt: skip


def numbers_of(g):
    return torch.cat([g["c2w"].flatten(-2), g["intrinsics_normed"].flatten(-2)], dim=-1)


@pytest.mark.parametrize("name", CASES)
@torch.no_grad()
def test_modules_match_published(golden, name):
    g, (make, published, ours, inputs) = golden(name), CASES[name]
    bound = 1e-6 if name == "camera_embedder" else 1e-5  # one affine map of 25 numbers
    assert_relative(g.load(make(), published, ours)(*inputs(g)), g["out"], bound)


def test_patches_are_between_the_class_and_the_camera():
    tokens = torch.arange(2 * 27.0).view(1, 2, 27, 1)
    assert patch_grid(tokens).shape == (1, 2, 5, 5, 1)
    assert patch_grid(tokens)[0, 1, 2, 3] == tokens[0, 1, 1 + 2 * 5 + 3]


@torch.no_grad()
def test_position_resampling_uses_the_published_factor(golden):
    g = golden("dinov2_pos_resample_512")
    torch.testing.assert_close(resample_positions(g["position_embeddings"], 36, 36), g["out"], **SHALLOW)
    assert resample_positions(g["position_embeddings"], 37, 37) is g["position_embeddings"]


@torch.no_grad()
def test_two_streams_match_published_also_in_chunks(golden, monkeypatch):
    g = golden("two_stream_small")
    module, logits = two_streams(g), []
    router = module.main_blocks[1].transformer_block[0].ff.routing_network
    router.register_forward_hook(lambda _module, _inputs, output: logits.append(output))
    assert_relative(module(g["input"].squeeze(1), g["cross"]), g["out"].squeeze(1), 1e-5)
    assert_relative(logits[0], g["router_logits_block1_basic0"], 1e-5)
    monkeypatch.setattr(transformer, "CHUNK_NUMBERS", 5 * 2 * 4 * 32)  # five tokens of 32 numbers at a time
    monkeypatch.setattr(transformer, "CONFLICT", 32)
    assert_relative(module(g["input"].squeeze(1), g["cross"]), g["out"].squeeze(1), 1e-5)


@torch.no_grad()
def test_illumination_path_matches_published(golden):
    g = golden("env_postprocessor_small")
    module = g.load(Illumination(illumination_sizes(groups=16), 49, 40, 16), "postprocessor.1.", "illumination.")
    images, mask = g["image"] * g["mask"], g["mask"].movedim(-1, 2)
    latent, rotation, strength = module(images, mask, g["camera_embedding"], g["triplane_raw"])
    assert_relative(latent, g["reni_latent"], 1e-5)
    torch.testing.assert_close(rotation, g["rotation"], **DEEP)
    torch.testing.assert_close(strength, g["strength"].squeeze(1), **DEEP)


def test_rotations_match_published_and_return(golden):
    g = golden("rotation_6d")
    torch.testing.assert_close(rotation_from_6d(g["d6"]), g["matrix"], **SHALLOW)
    torch.testing.assert_close(rotation_from_6d(torch.zeros(1, 6)), g["zeros_out"])
    matrix = rotation_from_6d(g["d6"].double())
    torch.testing.assert_close(matrix @ matrix.mT, torch.eye(3, dtype=torch.float64).expand(16, 3, 3))
    assert (torch.linalg.det(matrix) > 0).all()


PUBLISHED_HEADS = {
    "density": "density_raw",
    "base_color": "basecolor",
    "normal": "surface-normal",
    "deformation": "vertex-offset",
    "flexicubes": "flexicubes-weight",
}


def published_heads(g):
    return g.load(Heads(120, 64), "object_representation.", "heads.", "net.heads.")


@torch.no_grad()
def test_heads_match_published(golden):
    g = golden("object_representation_heads")
    heads = published_heads(g)
    for features in (g["features"], sample_triplane(g["triplane"], g["positions"] / 0.87)):
        for name, value in heads(features, list(HEADS)).items():
            shift = -1.0 if name == "density" else 0.0  # the published raw density has its bias added
            torch.testing.assert_close(value + shift, g["out." + PUBLISHED_HEADS.get(name, name)], **SHALLOW)
    with pytest.raises(ValueError, match="heads: expected some of density"):
        heads(g["features"], ["color"])


@torch.no_grad()
def test_merged_cube_weights_match_published(golden):
    """The first 64 cubes of a 16^3 grid lie along z, then y: their corners are gathered here, index by index."""
    g, h = golden("object_representation_mesh16"), golden("object_representation_heads")
    heads = published_heads(h)
    merger = h.load(WeightMerger(64), "object_representation.", "merger.", "indices_merging_mlp.")
    axis = torch.linspace(-1.0, 1.0, 17)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(1, -1, 3)
    values = heads(sample_triplane(g["triplane"], points), ["flexicubes", "deformation", "density"])
    torch.testing.assert_close(values["deformation"][0], g["vertex_offset"], **DEEP)
    torch.testing.assert_close((values["density"][0, :, 0] - 1.0).exp(), g["density_grid"], **DEEP)
    grid = values["flexicubes"].reshape(17, 17, 17, 16)
    steps = [(k & 1, k >> 1 & 1, k >> 2) for k in range(8)]
    corners = torch.stack([torch.stack([grid[x, c // 16 + y, c % 16 + z] for x, y, z in steps]) for c in range(64)])
    assert_relative(merger.merged(corners), g["weight21_first64"], 1e-5)
    weights = merger(corners)
    assert weights.beta.shape == (64, 12) and weights.alpha.shape == (64, 8) and weights.gamma.shape == (64,)


@torch.no_grad()
def test_cube_weights_are_bounded_around_neutral():
    """Closed form: the MLP is made to return 0.1 times its last bias for every cube."""
    merger = WeightMerger(8)
    for value, beta, gamma in ((0.0, 1.0, 0.5), (10.0, 1.380797, 0.615529), (-1e4, 0.5, 0.25), (1e4, 1.5, 0.75)):
        for layer in (merger.mlp[0], merger.mlp[2], merger.mlp[4]):
            torch.nn.init.zeros_(layer.weight)
            torch.nn.init.constant_(layer.bias, value)
        weights = merger(torch.zeros(2, 3, 8, 16))
        torch.testing.assert_close(weights.beta, torch.full((2, 3, 12), beta), **SHALLOW)
        torch.testing.assert_close(weights.alpha, torch.full((2, 3, 8), beta), **SHALLOW)
        torch.testing.assert_close(weights.gamma, torch.full((2, 3), gamma), **SHALLOW)


def test_a_shared_bank_has_the_values_of_its_copies_and_their_gradients_added_up(golden):
    """The stem and the first keys and values are computed once for a batch; float64 copies are the reference."""
    g = golden("two_stream_small")
    module = two_streams(g)
    bank, views = g["input"][:1].squeeze(1).requires_grad_(), g["cross"]
    got = module(bank, views)
    (shared,) = torch.autograd.grad(got.square().sum(), bank)
    copies = bank.detach().double().repeat(2, 1, 1).requires_grad_()
    expected = module.double()(copies, views.double())
    assert_relative(got.double(), expected, 1e-5)
    (separate,) = torch.autograd.grad(expected.square().sum(), copies)
    assert_relative(shared.double(), separate.sum(0, keepdim=True), 1e-4)  # float32 backward through three blocks
