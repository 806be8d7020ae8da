"""The RENI++ kernel beside the torch module: a map, and single directions."""

import torch

from reli3d.nn.presets import OFFICIAL
from reli3d.nn.reni import EnvironmentDecoder, reni_frame


def parts(device):
    rng = torch.Generator().manual_seed(0)
    latent = torch.randn(1, 49, 3, generator=rng).to(device)
    torch.manual_seed(0)
    decoder = EnvironmentDecoder(OFFICIAL.reni).to(device).eval()
    return decoder, (latent, torch.eye(3, device=device)[None], torch.zeros(1, device=device))


def decode(device, height):
    """A map of ``height`` rows, with what depends on the latent alone computed each time."""
    decoder, code = parts(device)
    return lambda: decoder.light(*(p[0] for p in code)).environment(height), {"directions": 2 * height**2}


def torch_decode(device, height):
    decoder, code = parts(device)
    return torch.no_grad()(lambda: decoder(*code, height)), {"directions": 2 * height**2}


def directions(device, n):
    rng = torch.Generator().manual_seed(1)
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=rng), dim=-1).to(device)


def lookup(device, n):
    """Radiance from ``n`` random directions."""
    decoder, code = parts(device)
    light, at = decoder.light(*(p[0] for p in code)), directions(device, n)
    return lambda: light.lookup(at), {"lookups": n}


def torch_lookup(device, n):
    decoder, code = parts(device)
    at = reni_frame(directions(device, n))[None]
    return torch.no_grad()(lambda: decoder.radiance(*code, at)), {"lookups": n}


CASES = {"decode": (decode, dict(height=64)), "lookup": (lookup, dict(n=1 << 17))}
PEERS = {"decode": torch_decode, "lookup": torch_lookup}
