"""Loss terms of the ReLi3D paper's stages; a term whose ground truth a sample lacks is absent instead of zero."""

import os
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, binary_cross_entropy

from reli3d.errors import InputError
from reli3d.train.stages.rendering import Rendering
from reli3d.train.stages.views import ObjectViews

MIN_CLIPPED_SRGB = 0.99  # sRGB; above it an input image may be clipped, so a brighter rendering is no error
SCALES = 4  # of the multi-scale gradients: 1, 2, 4, 8 pixels
MIN_OPACITY = 1e-4  # opacities are kept this far from 0 and 1: the cross-entropy of a wrong pixel is 9 at most

Perceptual = Callable[[Tensor, Tensor], Tensor]


def compared_colors(rendering: Rendering, target: ObjectViews, view: int) -> tuple[Tensor, Tensor]:
    """Rendering and target ``(H, W, 3)`` over black, display values, zero where the target is not valid."""
    observed = target.images[view] * target.masks[view][..., None]
    rendered = rendering.color
    rendered = torch.where(target.images[view] > MIN_CLIPPED_SRGB, torch.minimum(rendered, observed), rendered)
    if target.valid is not None:
        rendered, observed = (x * target.valid[view][..., None] for x in (rendered, observed))
    return rendered, observed


def gradients(rendered: Tensor, observed: Tensor) -> Tensor:
    """Mean absolute error of image gradients of ``(H, W, 3)`` at several scales: LPIPS' substitute without weights."""
    error = (rendered - observed).movedim(-1, 0)[None]
    total = error.new_zeros(())
    for _ in range(SCALES):
        total = total + error.diff(dim=2).abs().mean() + error.diff(dim=3).abs().mean()
        if min(error.shape[2:]) < 4:
            break
        error = avg_pool2d(error, 2)
    return total / SCALES


def lpips_distance() -> Perceptual:
    """LPIPS (Zhang et al. 2018) with VGG features, or InputError if anything is missing; downloads nothing."""
    try:
        import lpips
    except (ImportError, RuntimeError):  # RuntimeError: of a torchvision that was built for another torch
        problem = "expected the package lpips and the torchvision of this torch, got none; pip install lpips"
        raise InputError("--perceptual", f"{problem}, or use --perceptual gradients") from None
    weights = torch.hub.get_dir() + "/checkpoints/vgg16-397923af.pth"
    if not os.access(weights, os.R_OK):
        problem = f"expected the weights of VGG16 at {weights}, got none"
        raise InputError("--perceptual", f"{problem}; use --perceptual gradients")
    network = lpips.LPIPS(net="vgg", verbose=False).requires_grad_(False)

    def distance(rendered: Tensor, observed: Tensor) -> Tensor:
        a, b = (2.0 * x.clamp(0.0, 1.0).movedim(-1, 0)[None] - 1.0 for x in (rendered, observed))
        return network.to(rendered.device)(a, b).mean()

    return distance


def mask_error(rendering: Rendering, target: ObjectViews, view: int, *, volume: bool) -> Tensor:
    """Mean over the valid pixels: cross-entropy of a volume's opacity, squared error of a surface's coverage."""
    mask = target.masks[view]
    if volume:
        opacity = rendering.coverage.clamp(MIN_OPACITY, 1.0 - MIN_OPACITY)
        error = binary_cross_entropy(opacity, mask, reduction="none")
    else:
        error = (rendering.coverage - mask).square()
    if target.valid is None:
        return error.mean()
    return (error * target.valid[view]).sum() / target.valid[view].sum().clamp(min=1.0)


def map_terms(rendering: Rendering, target: ObjectViews, view: int) -> dict[str, Tensor]:
    """Errors of material and normal where both maps have values, weighted by the detached coverage."""
    terms = {"flat": (1.0 - rendering.bump[:, 2]).mean()} if len(rendering.bump) else {}
    if target.shown is None:
        return terms
    weight = target.shown[view] * rendering.known * rendering.coverage.detach()
    total = weight.sum()
    if float(total.detach()) < 1.0:  # nothing in common yet
        return terms
    if target.material is not None:
        error = (rendering.material - target.material[view]).square().mean(-1)
        terms["material"] = (error * weight).sum() / total
    if target.normal is not None:
        cosine = (rendering.normal * target.normal[view]).sum(-1)
        terms["normal"] = ((1.0 - cosine) * weight).sum() / total
    return terms


def light_terms(latent: Tensor, rotation: Tensor, strength: Tensor, radiance: Tensor, target: ObjectViews) -> dict:
    """``latent``: squared error of rotated latents and strength; else ``neutral``: saturation of ``radiance``."""
    if target.latent is None or target.strength is None:
        mean = radiance.mean(-1, keepdim=True)
        return {"neutral": (radiance - mean).abs().mean() / mean.detach().mean().clamp(min=1e-3)}
    turned = latent @ rotation.T
    difference = torch.cat([(turned - target.latent).reshape(-1), (strength - target.strength).reshape(1)])
    return {"latent": difference.square().mean()}
