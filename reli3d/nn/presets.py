"""Sizes and switches of the networks, as plain numbers.

``official`` has the sizes of the published checkpoint (1.574 billion parameters), also where the paper differs.
``tiny`` is the same network with 0.6 million parameters, which two cores can train.  ``small`` is the default, a
network of convolutions whose weights are in the package.
"""

import dataclasses
import json
import math
import typing
from dataclasses import dataclass

CALIBRATED_VIEWS = 4  # largest number of views at which surface offsets are calibrated
OFFSET_VIEWS = 8  # number of views from which the surface offset is constant: 8 and 16 have the same best value
MAX_SIZE, MAX_LAYERS, MAX_LEVELS = 8192, 64, 8  # several times the values of the presets
LAYERS = ("layers", "blocks", "basic_blocks", "convolutions")
LIMITS = {  # inclusive; all other integers lie in 1 to MAX_SIZE
    **dict.fromkeys(LAYERS, (1, MAX_LAYERS)),
    **dict.fromkeys(("experts", "experts_from", "smoothing"), (0, MAX_LAYERS)),
    "tokens": (2, MAX_SIZE),
    "view_width": (10, MAX_SIZE),  # nine of them are the numbers of summarize_views
    "side": (4, 256),
    "height": (4, 512),
    "resolution": (4, 512),
    "image_size": (8, 4096),
    "radius": (1e-3, 1e3),
    "softness": (1e-5, 1e3),
    "density_threshold": (1e-5, 1e5),
    "density_bias": (-100.0, 100.0),
    "offset_one_view": (-1e3, 1e3),
    "offset_many_views": (-1e3, 1e3),
}


class _Checked:
    """Base of dataclasses whose fields are checked when one is made: ValueError, ``field: expected X, got Y``."""

    def __post_init__(self):
        for name, kind in typing.get_type_hints(type(self)).items():
            value, (low, high) = getattr(self, name), LIMITS.get(name, (1, MAX_SIZE))
            if kind in (int, float):
                expected = f"{'an integer' if kind is int else 'a number'} from {low:g} to {high:g}"
                holds = type(value) in (int, kind) and low <= value <= high
            elif typing.get_origin(kind) is tuple:  # widths, normalized over groups of eight channels
                expected = f"1 to {MAX_LEVELS} widths, each 2 to 15 or a multiple of 8 up to {MAX_SIZE}"
                holds = isinstance(value, tuple) and 1 <= len(value) <= MAX_LEVELS
                holds = holds and all(
                    type(v) is int and (2 <= v < 16 or 16 <= v <= MAX_SIZE and v % 8 == 0) for v in value
                )
            else:
                expected, holds = kind.__name__, isinstance(value, kind)
            _expect(holds, name, expected, value)


def _expect(holds: bool, name: str, expected: str, value) -> None:
    if not holds:
        raise ValueError(f"{name}: expected {expected}, got {repr(value)[:60]}")


def _divides(name: str, parts: int, whole: str, size: int) -> None:
    _expect(size % parts == 0, name, f"a divisor of {whole}, {size}", parts)


@dataclass(frozen=True)
class EncoderSizes(_Checked):
    """An image tokenizer of the DINOv2 form whose norms are modulated by the camera."""

    hidden: int
    layers: int
    heads: int
    patch: int  # pixels; a remainder of image size / patch is cut off at the right and below
    grid: int  # side of the stored position grid; resampled for another number of patches
    mask_channel: bool  # the mask as input channel after RGB

    def __post_init__(self):
        super().__post_init__()
        _divides("heads", self.heads, "hidden", self.hidden)

    @property
    def channels(self) -> int:
        return 3 + int(self.mask_channel)


@dataclass(frozen=True)
class BackboneSizes(_Checked):
    """The two-stream transformer; its width is also the width of encoder and triplane bank."""

    heads: int
    latents: int  # learned latent tokens, in addition to the tokens of the reference view
    blocks: int
    basic_blocks: int  # in each block
    experts: int  # 0: none
    experts_from: int  # first block, from 0, whose basic blocks mix experts
    groups: int  # of the GroupNorm over the triplane bank


@dataclass(frozen=True)
class UpsamplerSizes(_Checked):
    convolutions: int
    scale: int
    channels: int  # of the triplane that is sampled


@dataclass(frozen=True)
class IlluminationSizes(_Checked):
    encoder: EncoderSizes
    tokens: int  # output tokens; of tokens * token_width values latents * 3 + 1 + 6 are used
    token_width: int
    width: int
    heads: int
    layers: int
    groups: int

    def __post_init__(self):
        super().__post_init__()
        _divides("heads", self.heads, "width", self.width)
        _divides("groups", self.groups, "token_width", self.token_width)


@dataclass(frozen=True)
class ReniSizes(_Checked):
    """The RENI++ decoder; 49 latent vectors, 128 wide, 6 layers are the published file's sizes."""

    latents: int
    width: int
    layers: int
    heads: int
    height: int  # rows of the map that the network itself decodes

    def __post_init__(self):
        super().__post_init__()
        _expect(self.height % 2 == 0, "height", "an even number, as maps turn by a quarter", self.height)


@dataclass(frozen=True)
class PyramidSizes(_Checked):
    """The 2D U-Net of a view, :mod:`reli3d.nn.pyramid`."""

    widths: tuple[int, ...]  # channels at 1/2, 1/4, ... of the image
    features: int  # that leave it
    reading: int  # the finest levels, which read the image at their own resolution and predict

    def __post_init__(self):
        super().__post_init__()
        _expect(len(self.widths) >= 3, "widths", "3 or more levels", self.widths)
        _expect(self.reading < len(self.widths), "reading", f"fewer than the {len(self.widths)} levels", self.reading)


@dataclass(frozen=True)
class VolumeSizes(_Checked):
    """The 3D U-Net over pooled views, :mod:`reli3d.nn.volume`."""

    side: int  # grid points
    radius: float  # half side of the grid's cube, model units
    widths: tuple[int, ...]  # channels at 1, 1/2, ... of the grid
    features: int  # that leave it


@dataclass(frozen=True)
class LightMapSizes(_Checked):
    """The U-Net on the sphere of directions, :mod:`reli3d.nn.light_map`."""

    height: int  # rows of the map
    widths: tuple[int, ...]

    def __post_init__(self):
        super().__post_init__()
        coarsest = 2 ** (len(self.widths) - 1)
        _expect(self.height % coarsest == 0, "height", f"a multiple of {coarsest}, as there are levels", self.height)


@dataclass(frozen=True)
class LocalPreset(_Checked):
    """A network of convolutions over images and space, :mod:`reli3d.nn.local`."""

    name: str
    image_size: int
    pyramid: PyramidSizes
    volume: VolumeSizes
    light: LightMapSizes
    view_width: int  # pooled features of the views at a point
    head_width: int
    resolution: int  # cubes along each side of the FlexiCubes grid
    radius: float = 0.87  # half side of the model's cube
    softness: float = 0.02  # unit of the signed distance: occupancy is sigmoid(-distance / softness)
    offset_one_view: float = 0.0  # outward offset of the surface, in units of softness; see reli3d.train.calibrate
    offset_many_views: float = 0.0  # the same for 1 / V = 0; with V views linear in 1 / min(V, OFFSET_VIEWS)
    cost_volume: bool = False  # whether depths of pixels are refined by comparing the views
    smoothing: int = 8  # iterations of Taubin smoothing of the extracted surface

    def __post_init__(self):
        super().__post_init__()
        coarsest = 2 ** len(self.pyramid.widths)
        expected = f"a multiple of {coarsest}, as there are levels of pyramid"
        _expect(self.image_size % coarsest == 0, "image_size", expected, self.image_size)


@dataclass(frozen=True)
class Preset(_Checked):
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
    resolution: int  # cubes along each side of the FlexiCubes grid
    radius: float = 0.87  # half side of the model's cube
    density_threshold: float = 10.0  # the surface is where exp(raw + density_bias) has this value
    density_bias: float = -1.0
    roughness_is_alpha: bool = False  # the roughness head predicts the GGX width; query() returns its square root
    published_input: bool = False  # views prepared as in the release: JPEG, not cropped, poses as stored by default
    reads_background: bool = False  # the illumination path was trained with visible backgrounds too

    def __post_init__(self):
        super().__post_init__()
        light = self.illumination
        _divides("backbone.heads", self.backbone.heads, "encoder.hidden", self.encoder.hidden)
        _divides("backbone.groups", self.backbone.groups, "encoder.hidden", self.encoder.hidden)
        for name, patch in (("encoder.patch", self.encoder.patch), ("illumination.encoder.patch", light.encoder.patch)):
            _expect(patch <= self.image_size, name, f"at most image_size, {self.image_size}", patch)
        numbers, needed = light.tokens * light.token_width, 3 * self.reni.latents + 7
        enough = f"{math.ceil(needed / light.token_width)} or more for reni.latents of {self.reni.latents}"
        _expect(numbers >= needed, "illumination.tokens", enough, light.tokens)


def to_json(preset: Preset | LocalPreset) -> str:
    """A preset as text, which :func:`from_json` reads."""
    return json.dumps(dataclasses.asdict(preset), sort_keys=True)


def from_json(text: str) -> Preset | LocalPreset:
    """The preset that :func:`to_json` wrote.  Raises ValueError, one line that names the field, for anything else."""
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"preset: expected the JSON of a preset, got {error}") from None
    local = isinstance(values, dict) and "pyramid" in values
    if local and isinstance(values["pyramid"], dict) and values["pyramid"].get("material_bins") == 1:
        del values["pyramid"]["material_bins"]  # in files of development versions after 0.3
    return _build(LocalPreset if local else Preset, values, "preset")


def _build(kind, values, path: str):
    """``kind(**values)``, nested dataclasses from nested dictionaries."""
    _expect(isinstance(values, dict), path, "fields and values", values)
    kinds, built = typing.get_type_hints(kind), {}
    needed = {f.name for f in dataclasses.fields(kind) if f.default is dataclasses.MISSING}
    for name in sorted(needed - values.keys()):
        raise ValueError(f"{path}.{name}: expected a value, got none")
    for name, value in values.items():
        if name not in kinds:
            raise ValueError(f"{path}.{name[:60]}: not a field of this version; convert or train the weights again")
        if dataclasses.is_dataclass(kinds[name]):
            value = _build(kinds[name], value, f"{path}.{name}")
        built[name] = tuple(value) if isinstance(value, list) else value  # JSON has no tuples
    try:
        return kind(**built)
    except ValueError as error:
        raise ValueError(f"{path}.{error}") from None


OFFICIAL_LIGHT = EncoderSizes(hidden=384, layers=12, heads=6, patch=14, grid=37, mask_channel=True)
TINY_LIGHT = EncoderSizes(hidden=32, layers=1, heads=2, patch=8, grid=8, mask_channel=True)

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
        OFFICIAL_LIGHT, tokens=78, token_width=256, width=1024, heads=16, layers=4, groups=16
    ),
    reni=ReniSizes(latents=49, width=128, layers=6, heads=8, height=64),
    resolution=80,
    roughness_is_alpha=True,
    published_input=True,
    reads_background=True,
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
    illumination=IlluminationSizes(TINY_LIGHT, tokens=16, token_width=16, width=32, heads=2, layers=1, groups=4),
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
    cost_volume=True,
)
