"""Two-stream transformer of the paper's release: triplane tokens and latents attend to each other alternately."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.nn.presets import BackboneSizes

GROUP_NORM_EPS = 1.0e-6
FEED_FORWARD_RATIO = 4
# Widest intermediate on a CPU: 28 MiB in float32.  A tenth faster than 64 MiB at 1024 wide: it stays
# in the cache, and below 32 MiB glibc hands the same pages out again instead of fresh ones.
CHUNK_NUMBERS = 7 << 20
CONFLICT = 1024  # floats: rows of heads at a multiple of this distance map to the same cache sets


def by_tokens(function: Callable[[Tensor], Tensor], x: Tensor, inner: int) -> Tensor:
    """``function(x)`` of independent tokens ``(..., C)`` with intermediates of width ``inner``; in chunks on a CPU."""
    rows = max(1, CHUNK_NUMBERS // inner)
    if x.device.type != "cpu" or x.shape[:-1].numel() <= rows:
        return function(x)
    return torch.cat([function(part) for part in x.flatten(0, -2).split(rows)]).unflatten(0, x.shape[:-1])


def attention(q: Tensor, k: Tensor, v: Tensor, heads: int) -> Tensor:
    """Multi-head attention ``(B, N, C)`` over keys and values ``(B, M, C)``; a batch of 1 on either side is shared."""
    batch, conflict = max(len(q), len(k)), k.device.type == "cpu" and k.shape[-1] % CONFLICT == 0
    q, k, v = (x.unflatten(-1, (heads, -1)).transpose(1, 2) for x in (q, k, v))
    if conflict:  # copying head by head makes the attention about 1.2 times faster
        k, v = k.contiguous(), v.contiguous()
    q, k, v = (x.expand(batch, -1, -1, -1) for x in (q, k, v))
    return functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


class Attention(nn.Module):
    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.wq, self.wk, self.wv = (nn.Linear(width, width, bias=False) for _ in range(3))
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        """x: ``(B, N, C)`` gives the queries, context: ``(B, M, C)`` keys and values."""
        return self.proj(attention(self.wq(x), self.wk(context), self.wv(context), self.heads))


class _GatedGelu(nn.Module):
    def __init__(self, width: int, inner: int):
        super().__init__()
        self.proj = nn.Linear(width, 2 * inner)

    def forward(self, x: Tensor) -> Tensor:
        value, gate = self.proj(x).chunk(2, dim=-1)
        return value * functional.gelu(gate)


class FeedForward(nn.Module):
    """GEGLU feed-forward (Shazeer 2020, arXiv 2002.05202)."""

    def __init__(self, width: int):
        super().__init__()
        self.inner = FEED_FORWARD_RATIO * width
        self.net = nn.Sequential(_GatedGelu(width, self.inner), nn.Identity(), nn.Linear(self.inner, width))

    def forward(self, x: Tensor) -> Tensor:
        return by_tokens(self.net, x, 2 * self.inner)


class Experts(nn.Module):
    """Half the sum of a shared feed-forward layer and of softly weighted experts; all experts process all tokens."""

    def __init__(self, width: int, count: int):
        super().__init__()
        self.shared_expert = FeedForward(width)
        self.experts = nn.ModuleList(FeedForward(width) for _ in range(count))
        self.routing_network = nn.Linear(width, count)

    def forward(self, x: Tensor) -> Tensor:
        weight = self.routing_network(x).softmax(dim=-1)
        y = self.shared_expert(x)
        for k, expert in enumerate(self.experts):
            y = torch.addcmul(y, weight[..., k, None], expert(x))
        return 0.5 * y


class BasicBlock(nn.Module):
    """Tokens: self attention, cross attention to a context, which enters without a norm, feed-forward."""

    def __init__(self, width: int, attn1: nn.Module, attn2: nn.Module, feed_forward: nn.Module):
        super().__init__()
        self.norm1, self.norm2, self.norm3 = (nn.LayerNorm(width) for _ in range(3))
        self.attn1, self.attn2, self.ff = attn1, attn2, feed_forward

    def forward(self, z: Tensor, context: Tensor) -> Tensor:
        h = self.norm1(z)
        z = z + self.attn1(h, h)
        z = z + self.attn2(self.norm2(z), context)
        return z + self.ff(self.norm3(z))


class FuseBlock(nn.Module):
    """One stream reads the other, which enters without a norm."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.attn = Attention(width, heads)
        self.norm_z1, self.norm_z2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.ff = FeedForward(width)

    def forward(self, z: Tensor, context: Tensor) -> Tensor:
        z = z + self.attn(self.norm_z1(z), context)
        return z + self.ff(self.norm_z2(z))


class MainBlock(nn.Module):
    """Latents read the triplane, think, and are read by the triplane."""

    def __init__(self, width: int, heads: int, basic_blocks: int, experts: int):
        super().__init__()
        self.fuse_block_in = FuseBlock(width, heads)
        feed_forward = lambda: Experts(width, experts) if experts else FeedForward(width)
        self.transformer_block = nn.ModuleList(
            BasicBlock(width, Attention(width, heads), Attention(width, heads), feed_forward())
            for _ in range(basic_blocks)
        )
        self.fuse_block_out = FuseBlock(width, heads)

    def forward(self, latents: Tensor, planes: Tensor, views: Tensor) -> tuple[Tensor, Tensor]:
        latents = self.fuse_block_in(latents, planes)
        for block in self.transformer_block:
            latents = block(latents, views)
        return latents, self.fuse_block_out(planes, latents)


class TwoStreamTransformer(nn.Module):
    """Triplane tokens from the learned bank and the views' tokens."""

    def __init__(self, sizes: BackboneSizes, width: int):
        super().__init__()
        self.latent_init = nn.Parameter(torch.zeros(1, sizes.latents, width))
        self.norm_triplane = nn.GroupNorm(sizes.groups, width, eps=GROUP_NORM_EPS)
        self.norm_image, self.norm_latent = nn.LayerNorm(width), nn.LayerNorm(width)
        self.proj_triplane, self.proj_image, self.proj_latent = (nn.Linear(width, width) for _ in range(3))
        self.main_blocks = nn.ModuleList(
            MainBlock(width, sizes.heads, sizes.basic_blocks, sizes.experts if i >= sizes.experts_from else 0)
            for i in range(sizes.blocks)
        )
        self.proj_out = nn.Linear(width, width)

    def forward(self, bank: Tensor, views: Tensor) -> Tensor:
        """``(B, C, N)`` from the bank ``(B or 1, C, N)``, channels before tokens, and ``(B, V, T, C)``, hero first."""
        planes = self.proj_triplane(self.norm_triplane(bank).transpose(1, 2))
        hero = self.proj_image(self.norm_image(views[:, 0]))
        latents = self.proj_latent(self.norm_latent(self.latent_init)).expand(len(views), -1, -1)
        latents = torch.cat([hero, latents], dim=1)
        context = views.flatten(1, 2)
        for block in self.main_blocks:
            latents, planes = block(latents, planes, context)
        return self.proj_out(planes).transpose(1, 2) + bank
