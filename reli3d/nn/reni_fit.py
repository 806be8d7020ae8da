"""RENI++ latents of a given map, by gradient descent through the frozen decoder."""

import math

import torch
from torch import Tensor

from reli3d.nn.reni import EnvironmentDecoder, reni_frame
from reli3d.render.latlong import lat_long_directions

FLOOR = 1e-2  # of the geometric mean: added to radiances before their logarithm
RATES = 0.1, 1e-3  # learning rate of Adam at the start and the end
# of the terms; the latents had a normal prior in training
WEIGHTS = {"radiance": 1.0, "color": 0.3, "latents": 1e-4}


def terms(log_radiance: Tensor, target: Tensor, latent: Tensor) -> dict[str, Tensor]:
    """Terms of the loss for ``log_radiance`` and the radiance ``target``, to which FLOOR is added, ``(..., 3)``."""
    floored = torch.logaddexp(log_radiance, log_radiance.new_tensor(math.log(FLOOR)))
    return {
        "radiance": (floored - target.log()).abs().mean(),
        "color": 1.0 - torch.nn.functional.cosine_similarity(log_radiance.exp() + FLOOR, target, dim=-1).mean(),
        "latents": latent.square().mean(),
    }


def fit_latent(
    decoder: EnvironmentDecoder, radiance: Tensor, *, steps: int = 500, rays: int = 512, seed: int = 0
) -> tuple[Tensor, Tensor, float]:
    """Latents ``(L, 3)`` and strength ``()`` of the decoded map that approximates ``radiance``, and the error.

    The error is the mean over the sphere of |log radiance - log map|; the latents absorb any rotation.
    radiance: ``(H, 2H, 3)`` linear, nonnegative, in the layout of :mod:`reli3d.render.latlong`, on the decoder's
    device; H at least 8.  steps: of Adam, each on ``rays`` texels sampled uniformly over the sphere.  The cosine of the
    colors emphasizes light sources.  The decoder is not changed.  Raises TypeError unless float32, ValueError for
    another shape and for a map that is not finite, negative or black.  Source: Gardner et al. 2023, RENI++, section 4.
    """
    if radiance.dtype != torch.float32:
        raise TypeError(f"radiance: expected torch.float32, got {radiance.dtype}")
    height = radiance.shape[0] if radiance.ndim == 3 else 0
    if height < 8 or radiance.shape != (height, 2 * height, 3):
        raise ValueError(f"radiance: expected (H, 2H, 3) with H at least 8, got {tuple(radiance.shape)}")
    if radiance.device != decoder.sample_directions.device:
        raise ValueError(f"radiance: expected device {decoder.sample_directions.device}, got {radiance.device}")
    if not bool(radiance.isfinite().all()) or bool((radiance < 0).any()) or not bool(radiance.any()):
        raise ValueError("radiance: expected finite light of at least 0, got NaN, infinity, negative or black")
    directions = reni_frame(lat_long_directions(height, device=radiance.device)).reshape(-1, 3)
    rows = torch.sin((torch.arange(height, device=radiance.device, dtype=torch.float32) + 0.5) * math.pi / height)
    target, weight = radiance.detach().reshape(-1, 3), rows.repeat_interleave(2 * height)  # up to a factor, solid angle
    shade = target.mean(-1)
    mean = (((shade + 1e-4 * shade.mean()).log() * weight).sum() / weight.sum()).exp()
    target, floor = target / mean, radiance.new_tensor(math.log(FLOOR))
    generator = torch.Generator().manual_seed(seed)
    start = 0.1 * torch.randn(decoder.latents, 3, generator=generator, dtype=torch.float32, device="cpu")
    latent = start.to(radiance.device).requires_grad_()
    strength = torch.zeros((), device=radiance.device, requires_grad=True, dtype=torch.float32)
    optimizer = torch.optim.Adam([latent, strength], lr=RATES[0])

    def logarithm(directions: Tensor) -> Tensor:
        return decoder.field(latent[None], directions[None])[0] + strength

    with torch.enable_grad():
        for step in range(steps):
            rate = RATES[1] + (RATES[0] - RATES[1]) * 0.5 * (1.0 + math.cos(math.pi * step / steps))
            optimizer.param_groups[0]["lr"] = rate
            pick = torch.multinomial(weight.cpu(), rays, replacement=True, generator=generator).to(radiance.device)
            found = terms(logarithm(directions[pick]), target[pick] + FLOOR, latent)
            loss = found["radiance"] + WEIGHTS["color"] * found["color"] + WEIGHTS["latents"] * found["latents"]
            latent.grad, strength.grad = torch.autograd.grad(loss, (latent, strength))
            optimizer.step()
    with torch.no_grad():
        difference = (torch.logaddexp(logarithm(directions), floor) - (target + FLOOR).log()).abs().mean(-1)
        error = float((difference * weight).sum() / weight.sum())
        return latent.detach(), strength.detach() + mean.log(), error
