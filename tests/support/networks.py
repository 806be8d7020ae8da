"""Sizes of networks that run in seconds, views to give them, and the published parameters of some."""

from dataclasses import replace

import numpy as np
import torch

from reli3d.nn import presets
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import OFFICIAL, SMALL, BackboneSizes, EncoderSizes, IlluminationSizes, UpsamplerSizes
from reli3d.nn.reni import EnvironmentDecoder
from reli3d.nn.weights import published_state, read_manifest, read_tensors

TINY = replace(  # the sizes of the golden tiny_system
    OFFICIAL,
    name="tiny",
    image_size=76,
    camera_width=32,
    encoder=EncoderSizes(hidden=32, layers=2, heads=4, patch=14, grid=7, mask_channel=False),
    plane_size=8,
    backbone=BackboneSizes(heads=4, latents=10, blocks=3, basic_blocks=1, experts=2, experts_from=2, groups=8),
    upsampler=UpsamplerSizes(convolutions=4, scale=4, channels=40),
    illumination=IlluminationSizes(
        encoder=EncoderSizes(hidden=24, layers=1, heads=2, patch=14, grid=7, mask_channel=True),
        tokens=78,
        token_width=16,
        width=32,
        heads=4,
        layers=1,
        groups=4,
    ),
    resolution=16,
)
NANO = replace(  # the paper's network at sizes that run in milliseconds, without what only the release does
    TINY,
    name="nano",
    image_size=32,
    encoder=EncoderSizes(hidden=32, layers=1, heads=2, patch=8, grid=4, mask_channel=True),
    plane_size=4,
    backbone=BackboneSizes(heads=2, latents=8, blocks=1, basic_blocks=1, experts=0, experts_from=0, groups=4),
    upsampler=UpsamplerSizes(convolutions=2, scale=4, channels=24),
    illumination=replace(
        TINY.illumination,
        encoder=EncoderSizes(hidden=16, layers=1, heads=2, patch=8, grid=4, mask_channel=True),
        heads=2,
    ),
    reni=replace(OFFICIAL.reni, height=4),
    roughness_is_alpha=False,
    published_input=False,
    reads_background=False,
)


LOCAL = replace(  # the network of convolutions
    SMALL,
    image_size=64,
    pyramid=presets.PyramidSizes((8, 8, 16), 8, 2),
    volume=presets.VolumeSizes(12, 0.56, (8, 16), 8),
    light=presets.LightMapSizes(16, (8, 16, 16)),
    view_width=24,
    head_width=16,
)


def views(objects, count, size, seed=0):
    """Random images from cameras at distance 2 on circles about the vertical, all looking at the origin."""
    generator = torch.Generator().manual_seed(seed)
    angle = torch.rand(objects, count, generator=generator) * 6.28
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    c, s = angle.cos(), angle.sin()
    c2w = torch.stack([c, zero, s, 2 * s, zero, one, zero, zero, -s, zero, c, 2 * c, zero, zero, zero, one], dim=-1)
    intrinsics = torch.tensor([1.2 * size, 1.2 * size, size / 2, size / 2]).expand(objects, count, 4)
    images = torch.rand(objects, count, size, size, 3, generator=generator)
    masks = (torch.rand(objects, count, size, size, generator=generator) > 0.5).float()
    return images, masks, c2w.unflatten(-1, (4, 4)), intrinsics


def published_reni(goldens) -> dict[str, torch.Tensor]:
    """Parameters of the published RENI++ field."""
    manifest = read_manifest(goldens.parent / "reni++L49.safetensors")
    return read_tensors(manifest, {name: torch.float32 for name in manifest.tensors})


def published_decoder(goldens) -> EnvironmentDecoder:
    decoder = EnvironmentDecoder(OFFICIAL.reni)
    decoder.field.load_state_dict(published_reni(goldens))
    return decoder.eval()


def golden_tiny(goldens) -> tuple[Reconstructor, dict[str, torch.Tensor]]:
    """The system ``TINY`` with the golden's parameters, and the golden's values."""
    with np.load(goldens / "tiny_system.npz") as file:
        values = {k: torch.from_numpy(file[k]) for k in file.files}
    model = Reconstructor(TINY).eval()
    state = published_state({k[len("param.") :]: v for k, v in values.items() if k.startswith("param.")}, "golden")
    state |= {"environment.field." + k: v for k, v in published_reni(goldens).items()}
    state["environment.sample_directions"] = model.environment.sample_directions
    model.load_state_dict(state, strict=True)
    return model, values
