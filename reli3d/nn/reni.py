"""RENI++: a decoder of natural illumination, equivariant to rotation about the vertical axis.

Source: Gardner, Egger and Smith 2023, "RENI++", arXiv 2311.09361, in the form and with the parameter names of the file
published with ReLi3D.  An environment is a set of latent 3-vectors; rotating them about the vertical rotates the map.
The decoder uses a z-up frame, D = (z, x, y) of the y-up world direction (x, y, z), and float32.  The published maps
have -Z at the horizontal center and +X right of it; those here are of :mod:`reli3d.render.latlong`.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from reli3d.nn.heads import truncated_exp
from reli3d.nn.presets import ReniSizes
from reli3d.render.latlong import lat_long_directions, quarter_turn

FREQUENCIES = (1.0, 4.0)  # of the positional encoding, without a factor of pi
VN_EPS = 1.0e-6  # floor of the published vector-neuron ReLU
NORM2_MIN = 1.0e-20  # squared length: keeps the gradient of the square root finite at a zero latent


def reni_frame(directions: Tensor) -> Tensor:
    """World directions ``(..., 3)``, y up, in the decoder's z-up frame."""
    return directions.roll(1, dims=-1)


class _VnInvariant(nn.Module):
    """Two rotation invariants of a 2D vector p: <p, out_o> of a small vector-neuron network.

    Every channel of it is a multiple of p: with alpha = W a, beta = U a and n = |p| the result is alpha n^2, minus the
    component along k = beta p (not its unit vector, as published) where alpha and beta differ in sign.
    """

    def __init__(self):
        super().__init__()
        # torch.eye on the meta device, on which weights.load builds, imports torch's compiler (2 seconds)
        relu = [(name, torch.zeros(2, 2).fill_diagonal_(1.0)) for name in ("W", "U")]  # of a dict the names were sorted
        self.mlp = nn.ModuleList([nn.ParameterDict({"weight": torch.ones(2, 1)}), nn.ParameterDict(relu)])

    def forward(self, p: Tensor) -> Tensor:
        """``(..., 2)`` to ``(..., 2)``."""
        a = self.mlp[0]["weight"][:, 0]
        alpha, beta = self.mlp[1]["W"] @ a, self.mlp[1]["U"] @ a
        n2 = p.square().sum(-1, keepdim=True)
        k = beta.abs() * n2.clamp_min(NORM2_MIN).sqrt()
        cut = 1.0 - k.square() / k.clamp_min(VN_EPS)
        return alpha * n2 * torch.where(alpha * beta >= 0.0, torch.ones_like(cut), cut)


class _DecoderLayer(nn.Module):
    """Attention of a ray to one token, whose softmax is 1, and an MLP; query and key exist only for the checkpoint."""

    def __init__(self, width: int, condition: int):
        super().__init__()
        inputs = {"query": width, "key": condition, "value": condition, "fc_out": width}
        self.mha = nn.ModuleDict({name: nn.Linear(size, width) for name, size in inputs.items()})
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.fc = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        x = self.norm1(x + self.mha["fc_out"](self.mha["value"](condition)))
        return self.norm2(x + self.fc(x))


class _Decoder(nn.Module):
    def __init__(self, sizes: ReniSizes):
        super().__init__()
        features = (1 + 2 * len(FREQUENCIES)) * (sizes.latents + 2)
        self.residual_projection = nn.Linear(features, sizes.width)
        self.layers = nn.ModuleList(_DecoderLayer(sizes.width, 3 * sizes.latents) for _ in range(sizes.layers))
        self.fc = nn.Linear(sizes.width, 3)

    def forward(self, features: Tensor, condition: Tensor) -> Tensor:
        s = (features.unsqueeze(-1) * features.new_tensor(FREQUENCIES)).flatten(-2)  # frequencies vary fastest
        x = self.residual_projection(torch.cat([s.sin(), (s + 0.5 * math.pi).sin(), features], dim=-1))
        for layer in self.layers:
            x = layer(x, condition)
        return self.fc(x)


class ReniField(nn.Module):
    """Radiance of latent vectors in given directions."""

    def __init__(self, sizes: ReniSizes):
        super().__init__()
        self.vn_proj_in = nn.ModuleList([nn.Identity(), nn.ParameterDict({"weight": torch.ones(1, 1)})])
        self.vn_invar = _VnInvariant()
        self.network = _Decoder(sizes)

    def conditioning(self, latent: Tensor) -> Tensor:
        """``(B, L, 3)`` to ``(B, 3 L)``: for each latent two invariants of its horizontal part, then its height."""
        invariants = self.vn_invar(self.vn_proj_in[1]["weight"][0, 0] * latent[..., :2])
        return torch.cat([invariants, latent[..., 2:]], dim=-1).flatten(-2)

    @staticmethod
    def directional(latent: Tensor, directions: Tensor) -> Tensor:
        """``(B, L, 3)`` and ``(B or 1, N, 3)`` to ``(B, N, L + 2)``: horizontal products, height, horizontal length."""
        horizontal = directions[..., :2]
        length = horizontal.square().sum(-1, keepdim=True).clamp_min(NORM2_MIN).sqrt()
        rest = torch.cat([directions[..., 2:], length], dim=-1).expand(len(latent), -1, -1)
        return torch.cat([horizontal @ latent[..., :2].transpose(1, 2), rest], dim=-1)

    def forward(self, latent: Tensor, directions: Tensor) -> Tensor:
        """Log radiance ``(B, N, 3)`` of ``(B, L, 3)`` in ``(B or 1, N, 3)`` of the decoder's frame; differentiable."""
        return self.network(self.directional(latent, directions), self.conditioning(latent).unsqueeze(1))


class EnvironmentDecoder(nn.Module):
    """Environment map from latents, their rotation and a strength."""

    sample_directions: Tensor  # (H * 2H, 3), in the order of the published map, as its checkpoint has them

    def __init__(self, sizes: ReniSizes):
        super().__init__()
        self.height, self.latents = sizes.height, sizes.latents
        self.field = ReniField(sizes)
        directions = torch.empty(2 * sizes.height**2, 3)
        if directions.device.type != "meta":
            directions = quarter_turn(reni_frame(lat_long_directions(sizes.height)), 1).flatten(0, 1)
        self.register_buffer("sample_directions", directions)

    def forward(self, latent: Tensor, rotation: Tensor, strength: Tensor, height: int | None = None) -> Tensor:
        """Linear radiance ``(B, H, 2H, 3)``, upper edge +Y, horizontal center +X; arguments as in ``Code``."""
        height = height or self.height
        directions = reni_frame(lat_long_directions(height, device=latent.device)).reshape(1, -1, 3)
        radiance = self.radiance(latent, rotation, strength, directions)
        return radiance.unflatten(1, (height, 2 * height))

    def radiance(self, latent: Tensor, rotation: Tensor, strength: Tensor, directions: Tensor) -> Tensor:
        """Linear radiance ``(B, N, 3)`` in directions ``(B or 1, N, 3)`` of the decoder's frame, :func:`reni_frame`."""
        with torch.autocast(latent.device.type, enabled=False):
            turned = latent.float() @ rotation.float().transpose(1, 2)
            log_radiance = self.field(turned, directions.float())
            return truncated_exp(log_radiance) * truncated_exp(strength.float())[:, None, None]


def rotation_from_6d(d: Tensor) -> Tensor:
    """Rotations ``(..., 3, 3)`` from two columns ``(..., 6)``, orthonormalized (Zhou et al. 2019, arXiv 1812.07035)."""
    eps = 1.0e-7 if d.dtype != torch.float64 else 1.0e-8  # the published floors
    a, b = d[..., :3], d[..., 3:]
    x = functional.normalize(a, dim=-1, eps=eps)
    y = functional.normalize(b - (x * b).sum(-1, keepdim=True) * x, dim=-1, eps=eps)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)
