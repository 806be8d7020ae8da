"""Sizes and switches of the networks, as plain numbers.

``official`` has the sizes of the published checkpoint (1.574 billion parameters); where the paper and its release
differ the release is followed, so that its weights load.  ``tiny`` is the same network with 0.6 million parameters:
its training runs on two cores and shows that the stages work.  ``small`` is the default, a network of convolutions
whose weights are in the package.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from dataclasses import dataclass

MOST = 8192  # of any number of a preset in a file: several times what a network of this kind has
DEEP, MOST_LAYERS = ("layers", "blocks", "basic_blocks", "experts", "convolutions", "smoothing"), 64


@dataclass(frozen=True)
class EncoderSizes:
    """An image tokenizer of the DINOv2 form whose norms are modulated by the camera."""

    hidden: int
    layers: int
    heads: int
    patch: int  # pixels; a remainder of image size / patch is cut off at the right and below
    grid: int  # side of the stored position grid; resampled for another number of patches
    mask_channel: bool  # the mask as input channel after RGB

    @property
    def channels(self) -> int:
        return 3 + int(self.mask_channel)


@dataclass(frozen=True)
class BackboneSizes:
    """The two-stream transformer; its width is also the width of encoder and triplane bank."""

    heads: int
    latents: int  # learned latent tokens, beside the hero view's own
    blocks: int
    basic_blocks: int  # in each block
    experts: int  # 0: none
    experts_from: int  # first block, from 0, whose basic blocks mix experts
    groups: int  # of the GroupNorm over the triplane bank


@dataclass(frozen=True)
class UpsamplerSizes:
    convolutions: int
    scale: int
    channels: int  # of the triplane that is sampled


@dataclass(frozen=True)
class IlluminationSizes:
    encoder: EncoderSizes
    tokens: int  # tokens * token_width numbers come out, of which latents*3 + 1 + 6 are read
    token_width: int
    width: int
    heads: int
    layers: int
    groups: int


@dataclass(frozen=True)
class ReniSizes:
    """The RENI++ decoder; 49 latent vectors, 128 wide, 6 layers are the published file's sizes."""

    latents: int
    width: int
    layers: int
    heads: int
    height: int  # rows of the map that the network itself decodes


@dataclass(frozen=True)
class PyramidSizes:
    """The 2D U-Net of a view, :mod:`reli3d.nn.pyramid`."""

    widths: tuple[int, ...]  # channels at 1/2, 1/4, ... of the image
    features: int  # that leave it
    reading: int  # the finest levels, which read the picture at their own resolution and predict


@dataclass(frozen=True)
class VolumeSizes:
    """The 3D U-Net over pooled views, :mod:`reli3d.nn.volume`."""

    side: int  # grid points
    radius: float  # half side of the grid's cube, model units
    widths: tuple[int, ...]  # channels at 1, 1/2, ... of the grid
    features: int  # that leave it


@dataclass(frozen=True)
class LightMapSizes:
    """The U-Net on the sphere of directions, :mod:`reli3d.nn.light_map`."""

    height: int  # rows of the map
    widths: tuple[int, ...]


@dataclass(frozen=True)
class LocalPreset:
    """A network of convolutions over images and space, :mod:`reli3d.nn.local`."""

    name: str
    image_size: int
    pyramid: PyramidSizes
    volume: VolumeSizes
    light: LightMapSizes
    view_width: int  # pooled features of the views at a point
    head_width: int
    resolution: int  # cubes along each side of the surface grid
    radius: float = 0.87  # half side of the model's cube
    softness: float = 0.02  # model units from occupancy 1/2 to 0.73: unit of the level
    offset_one_view: float = 0.0  # of the surface, in units of the level, outward; see reli3d.train.calibrate
    offset_many_views: float = 0.0  # the same in the limit of many views; in between by the inverse of their number
    smoothing: int = 8  # iterations of Taubin smoothing of the extracted surface


@dataclass(frozen=True)
class Preset:
    name: str
    image_size: int  # square network input, pixels
    camera_width: int  # of the camera embedding
    encoder: EncoderSizes
    plane_size: int  # side of the triplane of tokens
    backbone: BackboneSizes
    upsampler: UpsamplerSizes
    head_width: int
    illumination: IlluminationSizes
    reni: ReniSizes
    resolution: int  # cubes along each side of the surface grid
    radius: float = 0.87  # half side of the model's cube
    density_threshold: float = 10.0  # the surface is where exp(raw + density_bias) has this value
    density_bias: float = -1.0
    roughness_is_alpha: bool = False  # the roughness head predicts the GGX width; query() returns its square root
    published_input: bool = False  # views prepared as by the release: JPEG, not cropped, poses as stored unless asked
    reads_background: bool = False  # the illumination path was trained with visible backgrounds too
    tone_mapping: bool = False  # carry the published tone-mapping constants, which nothing here reads


def to_json(preset: Preset | LocalPreset) -> str:
    """A preset as text, which :func:`from_json` reads."""
    return json.dumps(dataclasses.asdict(preset), sort_keys=True)


def from_json(text: str) -> Preset | LocalPreset:
    """The preset that :func:`to_json` wrote.  Raises ValueError for anything else."""
    try:
        values = json.loads(text)
        return _build(LocalPreset if "pyramid" in values else Preset, values)
    except (ValueError, AttributeError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"preset: expected the JSON of a preset, got {error}") from None


def _build(kind, values: dict):
    """``kind(**values)``, nested dataclasses from nested dictionaries; TypeError for a value of another type."""
    fields = typing.get_type_hints(kind)
    built = {}
    for key, value in values.items():
        if key not in fields:
            raise TypeError(f"no field {key}; it is of another version")
        expected = fields[key]
        if dataclasses.is_dataclass(expected):
            built[key] = _build(expected, value)
        elif typing.get_origin(expected) is tuple:  # JSON has lists
            if not isinstance(value, list) or not all(type(v) is int and 0 < v <= MOST for v in value):
                raise TypeError(f"{key} = {value!r}")
            built[key] = tuple(value)
        elif isinstance(value, bool) == (expected is bool) and isinstance(value, expected):
            built[key] = value
            if isinstance(value, float) and not abs(value) <= MOST:
                raise ValueError(f"{key} = {value!r}")
            if isinstance(value, int) and not 0 <= value <= (MOST_LAYERS if key in DEEP else MOST):
                raise ValueError(f"{key} = {value!r}")
        else:
            raise TypeError(f"{key} = {value!r}")
    return kind(**built)


OFFICIAL = Preset(
    name="official",
    image_size=512,
    camera_width=1024,
    encoder=EncoderSizes(hidden=1024, layers=24, heads=16, patch=14, grid=37, mask_channel=False),
    plane_size=96,
    backbone=BackboneSizes(heads=16, latents=1792, blocks=4, basic_blocks=3, experts=8, experts_from=2, groups=32),
    upsampler=UpsamplerSizes(convolutions=4, scale=4, channels=40),
    head_width=64,
    illumination=IlluminationSizes(
        encoder=EncoderSizes(hidden=384, layers=12, heads=6, patch=14, grid=37, mask_channel=True),
        tokens=78,
        token_width=256,
        width=1024,
        heads=16,
        layers=4,
        groups=16,
    ),
    reni=ReniSizes(latents=49, width=128, layers=6, heads=8, height=64),
    resolution=80,
    roughness_is_alpha=True,
    published_input=True,
    reads_background=True,
    tone_mapping=True,
)

TINY = Preset(
    name="tiny",
    image_size=64,
    camera_width=64,
    encoder=EncoderSizes(hidden=64, layers=2, heads=2, patch=8, grid=8, mask_channel=True),
    plane_size=12,
    backbone=BackboneSizes(heads=2, latents=32, blocks=1, basic_blocks=1, experts=0, experts_from=0, groups=8),
    upsampler=UpsamplerSizes(convolutions=2, scale=4, channels=16),
    head_width=32,
    illumination=IlluminationSizes(
        encoder=EncoderSizes(hidden=32, layers=1, heads=2, patch=8, grid=8, mask_channel=True),
        tokens=16,
        token_width=16,
        width=32,
        heads=2,
        layers=1,
        groups=4,
    ),
    reni=ReniSizes(latents=9, width=32, layers=2, heads=4, height=16),
    resolution=24,
    reads_background=True,
)

SMALL = LocalPreset(
    name="small",
    image_size=256,
    pyramid=PyramidSizes(widths=(16, 48, 96, 160, 256), features=24, reading=3),
    volume=VolumeSizes(side=40, radius=0.56, widths=(16, 56, 96, 128), features=24),
    light=LightMapSizes(height=32, widths=(32, 64, 96, 128)),
    view_width=40,
    head_width=64,
    resolution=96,
)
