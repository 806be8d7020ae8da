"""Sizes, counts and weights of the stages of the paper's training.  All of them are stored with a run.

The paper's section B and C in short: images of views that were not input are compared with renders of the predicted
object, first of its volume, then of its surface under spherical Gaussians at rising resolution, last of its surface by
Monte Carlo integration with shadows.  Where the paper leaves a number open the comment says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from reli3d.errors import InputError

RENDERERS = ("volume", "gaussians", "monte_carlo")


@dataclass(frozen=True)
class Weights:
    """Of the terms of :mod:`reli3d.train.stages.losses`; the paper's unless said otherwise."""

    image: float = 10.0  # mean square difference of display values
    perceptual: float = 2.0  # LPIPS, or what stands in for it
    mask: float = 10.0  # cross-entropy of the volume's opacity; of a surface: mean square difference, not in the paper
    material: float = 10.0  # mean square difference of base color, roughness, metallic
    normal: float = 4.0  # one minus the cosine
    flat: float = 0.05  # bump normals off the surface's own
    latent: float = 0.1  # mean square difference of RENI++ latents
    neutral: float = 0.02  # color of the light, where its latents are not known
    deviation: float = 0.5  # FlexiCubes' own example: distances of a dual vertex from its crossings
    sign: float = 0.2  # the same: sign changes that nothing asks for
    spread: float = 0.1  # the same: weights away from 1


@dataclass(frozen=True)
class StageConfig:
    """Numbers of one stage.  The paper's are in :data:`PAPER`."""

    name: str
    renderer: str  # volume, gaussians or monte_carlo
    image_size: int  # of the target views, pixels
    patch: int = 0  # side of the square of a target view that is rendered; 0: all of it
    targets: int = 1  # views that are compared, an object and step; open in the paper
    lobes: int = 128  # spherical Gaussians of the light
    resolution: int = 0  # cubes along each side of the surface grid; 0: the preset's
    grid: int = 16  # cells along each side of the volume's occupancy grid
    samples_along: int = 64  # samples of a ray across the model's cube
    samples: tuple[int, int, int] = (20, 40, 4)  # by the light, by visible normals, by the cosine; 0: without it
    shadows: bool = True  # of monte_carlo
    batch: int = 4  # these three: defaults of the loop's options
    steps: int = 60_000
    rate: float = 5e-5
    weights: Weights = field(default_factory=Weights)

    def __post_init__(self):
        if self.renderer not in RENDERERS:
            raise InputError("renderer", f"expected {', '.join(RENDERERS)}, got {self.renderer!r}")
        if not 0 <= self.patch <= self.image_size:
            raise InputError("patch", f"expected 0 to image_size {self.image_size}, got {self.patch}")
        if len(self.samples) != 3 or min(self.samples) < 0 or sum(self.samples) == 0:
            raise InputError("samples", f"expected three counts of at least 0, one above 0, got {self.samples}")


PAPER = {  # for `official`: batch sizes, resolutions and rate of the paper; lobes follow the resolution
    s.name: s
    for s in (
        StageConfig("volume", "volume", 512, patch=128, grid=64, samples_along=256, batch=64),  # patch: open
        StageConfig("gaussians128", "gaussians", 128, lobes=128, batch=192),
        StageConfig("gaussians256", "gaussians", 256, lobes=256, batch=192),
        StageConfig("gaussians512", "gaussians", 512, lobes=512, batch=192),
        StageConfig("monte_carlo", "monte_carlo", 512, batch=32),
    )
}
TINY = {  # for `tiny`: a network from scratch takes forty times the rate of one with a pretrained encoder
    s.name: s
    for s in (
        StageConfig("volume", "volume", 32, patch=24, lobes=32, grid=10, samples_along=32, steps=1500, rate=2e-3),
        StageConfig("gaussians", "gaussians", 48, lobes=48, steps=1000, rate=1e-3),
        StageConfig("surface", "gaussians", 64, lobes=64, steps=500, rate=5e-4),
        # four views an object: half of the gradient's noise is between views; a step takes 1.8 times as long
        StageConfig("monte_carlo", "monte_carlo", 48, targets=4, samples=(6, 8, 2), steps=350, rate=1e-3),
    )
}
