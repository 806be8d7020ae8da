"""Images to tokens: a vision transformer in the DINOv2 form with camera-modulated norms; triplane tokens to planes.

Sources: DINOv2 (Oquab et al. 2023, arXiv 2304.07193); adaptive layer norm as in DiT (Peebles and Xie 2023, arXiv
2212.09748); pixel shuffle (Shi et al. 2016, arXiv 1609.05158).  Parameter names are the published checkpoint's.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.nn.presets import EncoderSizes, UpsamplerSizes
from reli3d.nn.transformer import attention, by_tokens

IMAGE_MEAN = (0.485, 0.456, 0.406)  # of ImageNet in sRGB, as DINOv2 was trained
IMAGE_STD = (0.229, 0.224, 0.225)
NORM_EPS = 1.0e-6
# The published network passes (patches + 0.1) / grid as scale factor, to guard the floor in the size computation; the
# sampling positions then use this factor and not patches / grid.
RESAMPLE_OFFSET = 0.1


def camera_vector(c2w: Tensor, intrinsics: Tensor, size: int) -> Tensor:
    """The 25 numbers of a view: camera-to-world row by row, then the 3x3 intrinsics divided by the image size.

    c2w: ``(..., 4, 4)``.  intrinsics: ``(..., 4)`` fx, fy, cx, cy in pixels of an image of ``size`` by ``size``.
    """
    fx, fy, cx, cy = (intrinsics / size).unbind(-1)
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    normalized = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one], dim=-1)
    return torch.cat([c2w.flatten(-2), normalized], dim=-1)


class CameraEmbedder(nn.Module):
    """One affine map of the 25 camera numbers, :func:`camera_vector`."""

    def __init__(self, width: int):
        super().__init__()
        self.linear = nn.Linear(25, width)

    def forward(self, vector: Tensor) -> Tensor:
        """``(..., 25)`` to ``(..., width)``."""
        return self.linear(vector)


class Modulation(nn.Module):
    """``x * (1 + scale) + shift`` with scale and shift one affine map of ``SiLU(condition)``."""

    def __init__(self, hidden: int):
        super().__init__()
        self.linear2 = nn.Linear(hidden, 2 * hidden)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """x: ``(N, T, C)``, condition: ``(N, C)``."""
        scale, shift = self.linear2(functional.silu(condition)).unsqueeze(1).chunk(2, dim=-1)
        return torch.addcmul(shift, x, 1.0 + scale)


class _SelfAttention(nn.Module):
    def __init__(self, hidden: int, heads: int):
        super().__init__()
        self.heads = heads
        self.attention = nn.ModuleDict({name: nn.Linear(hidden, hidden) for name in ("query", "key", "value")})
        self.output = nn.ModuleDict({"dense": nn.Linear(hidden, hidden)})

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = (linear(x) for linear in self.attention.values())
        return self.output["dense"](attention(q, k, v, self.heads))


class _Mlp(nn.Module):
    def __init__(self, hidden: int):
        super().__init__()
        self.fc1 = nn.Linear(hidden, 4 * hidden)
        self.fc2 = nn.Linear(4 * hidden, hidden)

    def forward(self, x: Tensor) -> Tensor:
        return by_tokens(lambda part: self.fc2(functional.gelu(self.fc1(part))), x, self.fc1.out_features)


class EncoderLayer(nn.Module):
    """Pre-norm attention and MLP, both norms modulated by the camera."""

    def __init__(self, hidden: int, heads: int):
        super().__init__()
        self.norm1 = nn.LayerNorm(hidden, eps=NORM_EPS)
        self.norm1_modulation = Modulation(hidden)
        self.attention = _SelfAttention(hidden, heads)
        self.layer_scale1 = nn.ParameterDict({"lambda1": torch.ones(hidden)})
        self.norm2 = nn.LayerNorm(hidden, eps=NORM_EPS)
        self.norm2_modulation = Modulation(hidden)
        self.mlp = _Mlp(hidden)
        self.layer_scale2 = nn.ParameterDict({"lambda1": torch.ones(hidden)})

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        h = self.norm1_modulation(self.norm1(x), condition)
        x = torch.addcmul(x, self.layer_scale1["lambda1"], self.attention(h))
        h = self.norm2_modulation(self.norm2(x), condition)
        return torch.addcmul(x, self.layer_scale2["lambda1"], self.mlp(h))


class _Embeddings(nn.Module):
    def __init__(self, sizes: EncoderSizes):
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, sizes.hidden))
        self.position_embeddings = nn.Parameter(torch.zeros(1, 1 + sizes.grid**2, sizes.hidden))
        self.register_buffer("mask_token", torch.zeros(1, sizes.hidden))  # of the pretraining; stored, never read
        projection = nn.Conv2d(sizes.channels, sizes.hidden, sizes.patch, stride=sizes.patch)
        self.patch_embeddings = nn.ModuleDict({"projection": projection})

    def forward(self, pixels: Tensor) -> Tensor:
        patches = self.patch_embeddings["projection"](pixels)
        tokens = torch.cat([self.cls_token.expand(len(pixels), -1, -1), patches.flatten(2).transpose(1, 2)], dim=1)
        return tokens + resample_positions(self.position_embeddings, patches.shape[-2], patches.shape[-1])


class _VisionTransformer(nn.Module):
    def __init__(self, sizes: EncoderSizes):
        super().__init__()
        self.embeddings = _Embeddings(sizes)
        layers = nn.ModuleList(EncoderLayer(sizes.hidden, sizes.heads) for _ in range(sizes.layers))
        self.encoder = nn.ModuleDict({"layer": layers})
        self.layernorm = nn.LayerNorm(sizes.hidden, eps=NORM_EPS)


def resample_positions(stored: Tensor, rows: int, columns: int) -> Tensor:
    """Position embeddings ``(1, 1 + rows*columns, C)`` of a grid of patches from the stored ``(1, 1 + G*G, C)``.

    The class position stays; the grid is resampled bicubically at positions ``(i + 0.5) G / (rows + 0.1) - 0.5``.
    """
    side = math.isqrt(stored.shape[1] - 1)
    if (rows, columns) == (side, side):
        return stored
    grid = stored[:, 1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
    factor = ((rows + RESAMPLE_OFFSET) / side, (columns + RESAMPLE_OFFSET) / side)
    grid = functional.interpolate(grid.float(), scale_factor=factor, mode="bicubic", align_corners=False)
    return torch.cat([stored[:, :1], grid.to(stored.dtype).flatten(2).transpose(1, 2)], dim=1)


class ImageTokenizer(nn.Module):
    """Tokens of each view: class, patches, and its camera embedding as the last one."""

    def __init__(self, sizes: EncoderSizes, camera_width: int):
        super().__init__()
        self.model = _VisionTransformer(sizes)
        self.modulation_projection = (
            nn.Identity() if camera_width == sizes.hidden else nn.Linear(camera_width, sizes.hidden)
        )

    def forward(self, images: Tensor, camera: Tensor, extra: Tensor | None = None) -> Tensor:
        """Tokens ``(B, V, 1 + patches + 1, hidden)`` of sRGB ``(B, V, S, S, 3)``; extra: channels after RGB."""
        dtype = self.model.embeddings.cls_token.dtype
        mean, std = images.new_tensor(IMAGE_MEAN), images.new_tensor(IMAGE_STD)
        pixels = ((images - mean) / std).movedim(-1, 2)
        if extra is not None:
            pixels = torch.cat([pixels, extra.to(pixels.dtype)], dim=2)
        condition = self.modulation_projection(camera.to(dtype))
        x = self.model.embeddings(pixels.flatten(0, 1).to(dtype))
        for layer in self.model.encoder["layer"].children():
            x = layer(x, condition.flatten(0, 1))
        x = self.model.layernorm(x).unflatten(0, images.shape[:2])
        return torch.cat([x, condition.unsqueeze(2)], dim=2)


def patch_grid(tokens: Tensor) -> Tensor:
    """The patch tokens of :class:`ImageTokenizer` ``(B, V, 1 + P*P + 1, C)`` as an image ``(B, V, P, P, C)``."""
    side = math.isqrt(tokens.shape[2] - 2)
    return tokens[:, :, 1:-1].unflatten(2, (side, side))


class TriplaneBank(nn.Module):
    """Learned embeddings of every triplane texel, ``(3, C, S, S)``; planes XY, XZ, YZ."""

    def __init__(self, width: int, size: int):
        super().__init__()
        self.embeddings = nn.Parameter(torch.zeros(3, width, size, size))

    def tokens(self) -> Tensor:
        """``(1, C, 3*S*S)``: channels before tokens, index ``(plane * S + row) * S + column``."""
        return self.embeddings.transpose(0, 1).flatten(1).unsqueeze(0)

    def planes(self, tokens: Tensor) -> Tensor:
        """``(B, C, 3*S*S)`` back to ``(B, 3, C, S, S)``."""
        return tokens.unflatten(2, (3, *self.embeddings.shape[2:])).transpose(1, 2)


class PixelShuffleUpsampler(nn.Module):
    """3x3 convolutions with ReLU between them; pixel (y*s + i, x*s + j) of channel c is channel (c*s + i)*s + j."""

    def __init__(self, sizes: UpsamplerSizes, width: int):
        super().__init__()
        layers = []
        for _ in range(sizes.convolutions - 1):
            layers += [nn.Conv2d(width, width, 3, padding=1), nn.ReLU()]
        layers += [nn.Conv2d(width, sizes.channels * sizes.scale**2, 3, padding=1), nn.PixelShuffle(sizes.scale)]
        self.upsample = nn.Sequential(*layers)

    def forward(self, planes: Tensor) -> Tensor:
        """``(B, 3, C, S, S)`` to ``(B, 3, channels, scale*S, scale*S)``."""
        return self.upsample(planes.flatten(0, 1)).unflatten(0, planes.shape[:2])
