"""The network as one module: views in; a triplane that can be queried at points and an environment out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from reli3d._bridge import check
from reli3d.geometry.triplane import sample_triplane
from reli3d.nn import tokenizers
from reli3d.nn.blocks import linear_of
from reli3d.nn.heads import HEADS, Heads, WeightMerger, truncated_exp
from reli3d.nn.illumination import Illumination
from reli3d.nn.initialize import initialize
from reli3d.nn.presets import Preset
from reli3d.nn.reni import EnvironmentDecoder, reni_frame
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

    On the meta device it allocates nothing.  The trunk computes in its parameters' dtype, the rest in float32.
    """

    def __init__(self, preset: Preset):
        super().__init__()
        self.preset = preset
        width = preset.encoder.hidden
        self.camera = tokenizers.CameraEmbedder(preset.camera_width)
        self.encoder = tokenizers.ImageTokenizer(preset.encoder, preset.camera_width)
        self.bank = tokenizers.TriplaneBank(width, preset.plane_size)
        self.backbone = TwoStreamTransformer(preset.backbone, width)
        self.upsampler = tokenizers.PixelShuffleUpsampler(preset.upsampler, width)
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
        size, lead = self.preset.image_size, tuple(images.shape[:2])
        check("images", images, shape=("B", "V", size, size, 3), like=self.camera.linear.weight)
        check("masks", masks, shape=(*lead, size, size), like=images)
        check("c2w", c2w, shape=(*lead, 4, 4), like=images)
        check("intrinsics", intrinsics, shape=(*lead, 4), like=images)
        if 0 in lead:
            raise ValueError(f"images: expected at least one object and one view, got {lead}")
        camera = self.camera(tokenizers.camera_vector(c2w, intrinsics, images.shape[2]))
        extra = lambda sizes, mask: mask.unsqueeze(2).to(self.dtype) if sizes.mask_channel else None
        composite = torch.lerp(torch.full_like(images, BACKGROUND), images, masks.unsqueeze(-1))
        tokens = self.encoder(composite, camera, extra(self.preset.encoder, masks))
        planes = self.bank.planes(self.backbone(self.bank.tokens(), tokens))
        shown = masks
        if background_visible is not None:
            shown = torch.where(background_visible[:, None, None, None], torch.ones_like(masks), masks)
        with_mask = extra(self.preset.illumination.encoder, shown)
        light = self.illumination(images * shown.unsqueeze(-1), with_mask, camera, planes)
        triplane = self.upsampler(planes).float().movedim(2, -1).contiguous().movedim(-1, 2)  # as sample_triplane reads
        return Code(triplane, tokenizers.patch_grid(tokens), *light)

    def decode_environment(self, code: Code, height: int | None = None) -> Tensor:
        """Linear radiance ``(B, H, 2H, 3)``, upper edge +Y, horizontal center +X; default height the preset's."""
        return self.environment(code.latent, code.rotation, code.strength, height)

    def radiance(self, code: Code, directions: Tensor) -> Tensor:
        """Linear radiance ``(B, N, 3)`` from world directions ``(B or 1, N, 3)``, unit, y up; differentiable."""
        return self.environment.radiance(code.latent, code.rotation, code.strength, reni_frame(directions))

    def query(self, code: Code, points: Tensor, heads: Sequence[str] = tuple(HEADS)) -> dict[str, Tensor]:
        """Values of the named heads at points of the model's cube, ``{name: (B, N, outputs)}``, float32.

        points: ``(B, N, 3)``, inside plus or minus the preset's radius; features fade to zero outside.  Values as
        :func:`reli3d.nn.heads.activate` describes them, roughness perceptual, normals in the frame of
        :mod:`reli3d.render.bump`.  Gradients reach the triplane, the points and the heads.
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
