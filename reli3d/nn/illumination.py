"""Illumination path: RENI++ latents from the views with their masks and the triplane; published parameter names."""

import torch
from torch import Tensor, nn

from reli3d.nn.presets import IlluminationSizes
from reli3d.nn.reni import rotation_from_6d
from reli3d.nn.tokenizers import ImageTokenizer
from reli3d.nn.transformer import GROUP_NORM_EPS, BasicBlock, FeedForward, attention

STRENGTH_BIAS = 1.0  # added to the predicted natural logarithm of the radiance factor


class _CrossAttention(nn.Module):
    def __init__(self, width: int, context: int, heads: int):
        super().__init__()
        self.heads = heads
        self.to_q = nn.Linear(width, width, bias=False)
        self.to_k, self.to_v = (nn.Linear(context, width, bias=False) for _ in range(2))
        self.to_out = nn.Sequential(nn.Linear(width, width))

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        return self.to_out(attention(self.to_q(x), self.to_k(context), self.to_v(context), self.heads))


class Transformer1D(nn.Module):
    """Tokens with self attention and cross attention to a context; the outer residual is the input before GroupNorm."""

    def __init__(self, sizes: IlluminationSizes):
        super().__init__()
        self.norm = nn.GroupNorm(sizes.groups, sizes.token_width, eps=GROUP_NORM_EPS)
        self.proj_in = nn.Linear(sizes.token_width, sizes.width)
        self.transformer_blocks = nn.ModuleList(
            BasicBlock(
                sizes.width,
                _CrossAttention(sizes.width, sizes.width, sizes.heads),
                _CrossAttention(sizes.width, sizes.encoder.hidden, sizes.heads),
                FeedForward(sizes.width),
            )
            for _ in range(sizes.layers)
        )
        self.proj_out = nn.Linear(sizes.width, sizes.token_width)

    def forward(self, tokens: Tensor, context: Tensor) -> Tensor:
        """tokens: ``(B, C, N)``, channels before tokens.  context: ``(B, M, K)``.  Returns ``(B, C, N)``."""
        x = self.proj_in(self.norm(tokens).transpose(1, 2))
        for block in self.transformer_blocks:
            x = block(x, context)
        return self.proj_out(x).transpose(1, 2) + tokens


class Illumination(nn.Module):
    """RENI++ latents, rotation and strength of the views."""

    def __init__(self, sizes: IlluminationSizes, latents: int, camera_width: int, plane_width: int):
        super().__init__()
        self.latents = latents
        self.encoder = ImageTokenizer(sizes.encoder, camera_width)
        self.bank = nn.ParameterDict({"embeddings": torch.zeros(sizes.tokens, sizes.token_width)})
        projection = nn.Linear(plane_width, sizes.encoder.hidden)
        self.plane_tokens = nn.ModuleDict({"output_projection": projection})
        self.transformer = Transformer1D(sizes)

    def forward(self, images: Tensor, extra: Tensor | None, camera: Tensor, planes: Tensor) -> tuple[Tensor, ...]:
        """Latents ``(B, L, 3)``, rotation ``(B, 3, 3)``, strength ``(B,)``, float32.

        images: ``(B, V, S, S, 3)`` sRGB, masked background black.  extra: ``(B, V, K, S, S)``, if the preset has a mask
        channel: the mask, or 1 where the background is visible.  camera: ``(B, V, W)``.  planes: ``(B, 3, C, P, P)``
        before upsampling.
        """
        views = self.encoder(images, camera, extra).flatten(1, 2)
        of_planes = planes.movedim(2, -1).flatten(1, 3)  # plane by plane, row by row
        context = torch.cat([views, self.plane_tokens["output_projection"](of_planes)], dim=1)
        tokens = self.bank["embeddings"].t().expand(len(images), -1, -1)
        values = self.transformer(tokens, context).float().flatten(1)[:, : 3 * self.latents + 7]
        latent, strength, rotation = values.split((3 * self.latents, 1, 6), dim=1)
        return latent.unflatten(1, (self.latents, 3)), rotation_from_6d(rotation), strength.squeeze(1) + STRENGTH_BIAS
