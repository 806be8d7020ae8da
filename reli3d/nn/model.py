"""The network as one module: views in; a triplane that can be queried at points and an environment out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from reli3d.geometry.triplane import sample_triplane
from reli3d.nn.blocks import linear_of
from reli3d.nn.heads import HEADS, Heads, WeightMerger, truncated_exp
from reli3d.nn.illumination import Illumination
from reli3d.nn.initialize import initialize
from reli3d.nn.presets import Preset
from reli3d.nn.reni import EnvironmentDecoder, reni_frame
from reli3d.nn.tokenizers import (
    CameraEmbedder,
    ImageTokenizer,
    PixelShuffleUpsampler,
    TriplaneBank,
    camera_vector,
    patch_grid,
)
from reli3d.nn.transformer import TwoStreamTransformer

BACKGROUND = 0.5  # gray behind the object in the object encoder's images, sRGB


@dataclass(frozen=True)
class Code:
    """Encoding of B objects."""

    triplane: Tensor  # (B, 3, C, H, W) float32; planes XY, XZ, YZ, the first coordinate along W
    view_tokens: Tensor  # (B, V, P, P, D) the encoder's patch tokens, in the trunk's dtype
    latent: Tensor  # (B, L, 3) RENI++ latents
    rotation: Tensor  # (B, 3, 3) turns the latents
    strength: Tensor  # (B,) natural logarithm of the radiance factor


class Reconstructor(nn.Module):
    """The ReLi3D network with the sizes of ``preset``, its parameters ready for training from scratch.

    Built under ``torch.device("meta")`` it allocates nothing.  The trunk computes in its parameters' dtype (see
    :meth:`to_compute`); heads, environment decoder and every output are float32.
    """

    def __init__(self, preset: Preset):
        super().__init__()
        self.preset = preset
        width = preset.encoder.hidden
        self.camera = CameraEmbedder(preset.camera_width)
        self.encoder = ImageTokenizer(preset.encoder, preset.camera_width)
        self.bank = TriplaneBank(width, preset.plane_size)
        self.backbone = TwoStreamTransformer(preset.backbone, width)
        self.upsampler = PixelShuffleUpsampler(preset.upsampler, width)
        self.illumination = Illumination(preset.illumination, preset.reni.latents, preset.camera_width, width)
        self.environment = EnvironmentDecoder(preset.reni)
        self.heads = Heads(3 * preset.upsampler.channels, preset.head_width)
        self.merger = WeightMerger(preset.head_width)
        if self.device.type != "meta":  # no values to initialize, and torch would import its compiler
            initialize(self)

    @property
    def device(self) -> torch.device:
        return self.camera.linear.weight.device

    @property
    def dtype(self) -> torch.dtype:
        """Of the trunk's parameters, in which it computes."""
        return self.bank.embeddings.dtype

    def to_compute(self, dtype: torch.dtype) -> "Reconstructor":
        """Cast the trunk (encoders, transformers, upsampler) to ``dtype``, in place; the rest stays float32."""
        for part in (self.encoder, self.bank, self.backbone, self.upsampler, self.illumination):
            part.to(dtype)
        return self

    def encode(
        self,
        images: Tensor,
        masks: Tensor,
        c2w: Tensor,
        intrinsics: Tensor,
        *,
        background_visible: Tensor | None = None,
    ) -> Code:
        """Encodes posed views of B objects, each in the model's frame; the first view is the reference view.

        images: ``(B, V, S, S, 3)`` sRGB in [0, 1], not multiplied by the mask, S the preset's image size.
        masks: ``(B, V, S, S)`` in [0, 1].  c2w: ``(B, V, 4, 4)`` OpenGL axes.  intrinsics: ``(B, V, 4)`` fx, fy, cx, cy
        in pixels of the S by S image.  background_visible: ``(B,)`` bool, whether the illumination path may look at the
        background of an object's views; default none may, as published.

        Gradients reach every parameter on the way and the inputs.  Raises TypeError unless float32, ValueError on
        shapes that do not belong together and on another device than the parameters'.
        """
        check_views(images, masks, c2w, intrinsics, self.preset.image_size, self.device)
        camera = self.camera(camera_vector(c2w, intrinsics, images.shape[2]))
        dtype = self.dtype
        sizes, light = self.preset.encoder, self.preset.illumination.encoder

        def extra(encoder, mask):
            return mask.unsqueeze(2).to(dtype) if encoder.mask_channel else None

        composite = torch.lerp(torch.full_like(images, BACKGROUND), images, masks.unsqueeze(-1))
        tokens = self.encoder(composite, camera, extra(sizes, masks))
        planes = self.bank.planes(self.backbone(self.bank.tokens(), tokens))
        shown = masks
        if background_visible is not None:
            shown = torch.where(background_visible[:, None, None, None], torch.ones_like(masks), masks)
        lit = images * shown.unsqueeze(-1)
        latent, rotation, strength = self.illumination(lit, extra(light, shown), camera, planes)
        triplane = self.upsampler(planes).float().movedim(2, -1).contiguous().movedim(-1, 2)  # as sample_triplane reads
        return Code(triplane, patch_grid(tokens), latent, rotation, strength)

    def decode_environment(self, code: Code, height: int | None = None) -> Tensor:
        """Linear radiance ``(B, H, 2H, 3)``, upper edge +Y, horizontal center +X; default height the preset's."""
        return self.environment(code.latent, code.rotation, code.strength, height)

    def radiance(self, code: Code, directions: Tensor) -> Tensor:
        """Linear radiance ``(B, N, 3)`` from world directions ``(B or 1, N, 3)``, unit, y up.

        Gradients reach the latents, the rotation, the strength, the decoder and the directions.
        """
        return self.environment.radiance(code.latent, code.rotation, code.strength, reni_frame(directions))

    def query(self, code: Code, points: Tensor, heads: Sequence[str] = tuple(HEADS)) -> dict[str, Tensor]:
        """Values of the named heads at points of the model's cube, ``{name: (B, N, outputs)}``, float32.

        points: ``(B, N, 3)``, inside plus or minus the preset's radius; features fade to zero outside.  ``density`` is
        the raw value, see :meth:`sdf`; ``base_color`` is sRGB-encoded; ``roughness`` is perceptual; ``normal`` is
        unit in the frame of :mod:`reli3d.render.bump`; ``deformation`` and ``flexicubes`` are raw, see
        :mod:`reli3d.nn.heads`.  Gradients reach the triplane, the points and the heads.
        """
        with torch.autocast(points.device.type, enabled=False):
            values = self.heads(sample_triplane(code.triplane, points / self.preset.radius), heads)
            if self.preset.roughness_is_alpha and "roughness" in values:
                values["roughness"] = values["roughness"].sqrt()
        return values

    @torch.no_grad()
    def grid_density(self, code: Code, axis: Tensor) -> Tensor:
        """The ``density`` of :meth:`query` at the points ``(axis[i], axis[j], axis[k])`` of one object, ``(n, n, n)``.

        axis: ``(n,)``, model units.  A plane of features has ``n * n`` different points, and the head's first layer is
        linear: it is done on the three planes' points and added up.  Values differ from :meth:`query`'s by rounding.
        """
        with torch.autocast(axis.device.type, enabled=False):
            n, channels, at = len(axis), code.triplane.shape[2], axis / self.preset.radius
            a, b = (c.reshape(-1) for c in torch.meshgrid(at, at, indexing="ij"))
            xy, xz, _ = sample_triplane(code.triplane, torch.stack([a, b, b], -1)[None])[0].split(channels, -1)
            yz = sample_triplane(code.triplane, torch.stack([b, a, b], -1)[None])[0][:, 2 * channels :]
            first = linear_of(self.heads["density"], 0)
            of_xy, of_xz, of_yz = (
                torch.mm(f, w.T).view(n, n, -1)
                for w, f in zip(first.weight.split(channels, 1), (xy, xz, yz), strict=True)
            )
            of_xy += first.bias
            rest = nn.Sequential(*list(self.heads["density"].children())[1:])
            return torch.stack([rest(of_xy[i, :, None] + of_xz[i] + of_yz)[..., 0] for i in range(n)])

    def sdf(self, density: Tensor) -> Tensor:
        """Signed field values from the raw output of the ``density`` head: negative inside, zero on the surface."""
        return self.preset.density_threshold - self.density(density)

    def density(self, raw: Tensor) -> Tensor:
        """Density per model unit from the raw output of the ``density`` head."""
        return truncated_exp(raw + self.preset.density_bias)

    @property
    def surface_density(self) -> float:
        """Raw density on the surface: :meth:`sdf` is zero there."""
        return math.log(self.preset.density_threshold) - self.preset.density_bias


def check_views(
    images: Tensor, masks: Tensor, c2w: Tensor, intrinsics: Tensor, size: int, device: torch.device
) -> None:
    """Raise TypeError or ValueError, ``name: expected X, got Y``, where the inputs are not what ``encode`` needs."""
    tails = {"images": (size, size, 3), "masks": (size, size), "c2w": (4, 4), "intrinsics": (4,)}
    lead = images.shape[:2]
    for (name, tail), value in zip(tails.items(), (images, masks, c2w, intrinsics), strict=True):
        if value.dtype != torch.float32:
            raise TypeError(f"{name}: expected torch.float32, got {value.dtype}")
        if value.shape[2:] != tail or value.shape[:2] != lead or 0 in value.shape:
            front = tuple(lead) if name != "images" and len(lead) == 2 else ("B", "V")
            expected = ", ".join(map(str, (*front, *tail)))
            raise ValueError(f"{name}: expected shape ({expected}), got {tuple(value.shape)}")
        if value.device != device:
            raise ValueError(f"{name}: expected device {device}, got {value.device}")
