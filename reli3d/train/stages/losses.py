"""What a stage makes small.  One function a term; :class:`~reli3d.train.stages.config.Weights` has their weights.

A term whose truth a sample does not have is left out of the result: it is not zero, it is not asked.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, binary_cross_entropy

from reli3d._bridge import present
from reli3d.errors import InputError
from reli3d.train.stages.picture import Picture
from reli3d.train.stages.views import ObjectViews

WHITE = 0.99  # sRGB; a brighter photograph may be cut off, so a brighter render is no error
SCALES = 4  # of the multi-scale gradients: 1, 2, 4, 8 pixels
SURE = 1e-4  # opacities are kept this far from 0 and 1: the cross-entropy of a wrong pixel is 9 at most

Perceptual = Callable[[Tensor, Tensor], Tensor]


def shown_colors(picture: Picture, target: ObjectViews, view: int) -> tuple[Tensor, Tensor]:
    """Render and photograph ``(H, W, 3)`` over black, display values, where the photograph has pixels."""
    want = target.images[view] * target.masks[view][..., None]
    got = picture.color
    got = torch.where(target.images[view] > WHITE, torch.minimum(got, want), got)
    if target.valid is not None:
        got, want = (x * target.valid[view][..., None] for x in (got, want))
    return got, want


def gradients(got: Tensor, want: Tensor) -> Tensor:
    """Mean absolute difference of neighbors' differences of ``(H, W, 3)`` at several scales.

    It stands in for LPIPS where that has no weights: like it, it asks for edges in their place and forgives what is
    even; it knows nothing of what pictures mean.
    """
    error = (got - want).movedim(-1, 0)[None]
    total = error.new_zeros(())
    for scale in range(SCALES):
        if scale:
            if min(error.shape[2:]) < 4:
                break
            error = avg_pool2d(error, 2)
        total = total + error.diff(dim=2).abs().mean() + error.diff(dim=3).abs().mean()
    return total / SCALES


def lpips_distance() -> Perceptual:
    """LPIPS (Zhang and others 2018) with VGG features, from the package ``lpips``.

    Raises ValueError where the package or the weights of VGG are not on this machine: nothing is downloaded.
    """
    try:
        import lpips
    except ImportError:
        raise InputError(
            "--perceptual", "expected the package lpips for lpips, got none; pip install lpips, or take gradients"
        ) from None
    weights = torch.hub.get_dir() + "/checkpoints/vgg16-397923af.pth"
    try:
        with open(weights, "rb"):
            pass
    except OSError:
        raise InputError(
            "--perceptual", f"expected the weights of VGG16 at {weights} for lpips, got none; take gradients"
        ) from None
    network = lpips.LPIPS(net="vgg", verbose=False).requires_grad_(False)

    def distance(got: Tensor, want: Tensor) -> Tensor:
        a, b = (2.0 * x.clamp(0.0, 1.0).movedim(-1, 0)[None] - 1.0 for x in (got, want))
        return network.to(got.device)(a, b).mean()

    return distance


def perceptual(name: str) -> Perceptual:
    """The distance of pictures that a run names."""
    return lpips_distance() if name == "lpips" else gradients


def opacity_entropy(picture: Picture, target: ObjectViews, view: int) -> Tensor:
    """Cross-entropy of opacity and mask, mean over the photograph's pixels."""
    cover = picture.cover.clamp(SURE, 1.0 - SURE)
    entropy = binary_cross_entropy(cover, target.masks[view], reduction="none")
    return _mean(entropy, target, view)


def cover_error(picture: Picture, target: ObjectViews, view: int) -> Tensor:
    """Mean square difference of antialiased coverage and mask."""
    return _mean((picture.cover - target.masks[view]).square(), target, view)


def _mean(values: Tensor, target: ObjectViews, view: int) -> Tensor:
    if target.valid is None:
        return values.mean()
    return (values * target.valid[view]).sum() / target.valid[view].sum().clamp(min=1.0)


def map_terms(picture: Picture, target: ObjectViews, view: int) -> dict[str, Tensor]:
    """Errors of the maps where both the truth and the object's own are known, weighed by its coverage.

    The weight has no gradient: a wrong material is no reason to become transparent.
    """
    terms = {"flat": (1.0 - picture.bump[:, 2]).mean()} if len(picture.bump) else {}
    if target.shown is None:
        return terms
    weight = target.shown[view] * picture.known * picture.cover.detach()
    total = weight.sum()
    if float(total.detach()) < 1.0:  # nothing in common yet
        return terms
    if target.material is not None:
        error = (picture.material - target.material[view]).square().mean(-1)
        terms["material"] = (error * weight).sum() / total
    if target.normal is not None:
        cosine = (picture.normal * target.normal[view]).sum(-1)
        terms["normal"] = ((1.0 - cosine) * weight).sum() / total
    return terms


def light_terms(latent: Tensor, rotation: Tensor, strength: Tensor, radiance: Tensor, target: ObjectViews) -> dict:
    """Of the light: latents as they are decoded, turned by the predicted rotation, and the strength; without their
    truth the color of the light.

    latent: ``(L, 3)``.  rotation: ``(3, 3)``.  strength: ``()``.  radiance: ``(K, 3)`` spread evenly over the sphere.
    The prior is equivariant to turns, so latents and a rotation are one and the same light as the turned latents.
    """
    if target.latent is None or target.strength is None:
        mean = radiance.mean(-1, keepdim=True)
        return {"neutral": (radiance - mean).abs().mean() / mean.detach().mean().clamp(min=1e-3)}
    turned = latent @ rotation.T
    difference = torch.cat(
        [(turned - target.latent).reshape(-1), (strength - present("strength", target.strength)).reshape(1)]
    )
    return {"latent": difference.square().mean()}
