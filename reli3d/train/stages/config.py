"""Configuration of the training stages of the ReLi3D paper (its sections B and C).

Held-out views are compared with renderings of the predicted object: volume rendering, then its surface under spherical
Gaussians, last by Monte Carlo integration with shadows.  Comments mark values that the paper does not give.
"""

from dataclasses import dataclass, field

from reli3d.errors import InputError

RENDERERS = ("volume", "gaussians", "monte_carlo")


@dataclass(frozen=True)
class Weights:
    """Weights of the terms of :mod:`reli3d.train.stages.losses`; from the paper unless noted."""

    image: float = 10.0  # mean squared difference of display values
    perceptual: float = 2.0  # LPIPS, or its substitute
    mask: float = 10.0  # cross-entropy of the volume's opacity; of a surface: mean squared difference, not in the paper
    material: float = 10.0  # mean squared difference of base color, roughness, metallic
    normal: float = 4.0  # one minus the cosine
    flat: float = 0.05  # deviation of bump-mapped normals from the surface normal
    latent: float = 0.1  # mean squared difference of RENI++ latents
    neutral: float = 0.02  # saturation of the lighting, if its latents are not known
    deviation: float = 0.5  # from FlexiCubes' example: distances of a dual vertex from its edge crossings
    sign: float = 0.2  # from FlexiCubes' example: entropy of sign changes
    spread: float = 0.1  # from FlexiCubes' example: deviation of the weights from 1


@dataclass(frozen=True)
class StageConfig:
    """Configuration of one stage; the paper's are in :data:`PAPER`."""

    name: str
    renderer: str  # volume, gaussians or monte_carlo
    image_size: int  # of the target views, pixels
    patch: int = 0  # side of the random square of a target view that is rendered, pixels; 0: the whole view
    targets: int = 1  # target views per object and step; not given in the paper
    lobes: int = 128  # spherical Gaussians of the environment
    resolution: int = 0  # cubes along each side of the FlexiCubes grid; 0: the preset's
    grid: int = 16  # cells along each side of the volume's occupancy grid
    samples_along: int = 64  # samples of a ray across the model's cube
    samples: tuple[int, int, int] = (20, 40, 4)  # light, visible-normal and cosine samples; 0: strategy not used
    shadows: bool = True  # of monte_carlo
    batch: int = 4  # default of the training loop, as are steps and rate
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
        StageConfig("volume", "volume", 512, patch=128, grid=64, samples_along=256, batch=64),  # patch: not given
        StageConfig("gaussians128", "gaussians", 128, lobes=128, batch=192),
        StageConfig("gaussians256", "gaussians", 256, lobes=256, batch=192),
        StageConfig("gaussians512", "gaussians", 512, lobes=512, batch=192),
        StageConfig("monte_carlo", "monte_carlo", 512, batch=32),
    )
}
TINY = {  # for `tiny`: from scratch, at 40 times the learning rate of a pretrained encoder
    s.name: s
    for s in (
        StageConfig("volume", "volume", 32, patch=24, lobes=32, grid=10, samples_along=32, steps=1500, rate=2e-3),
        StageConfig("gaussians", "gaussians", 48, lobes=48, steps=1000, rate=1e-3),
        StageConfig("surface", "gaussians", 64, lobes=64, steps=500, rate=5e-4),
        # four target views: half of the gradient's noise is between views; a step takes 1.8 times as long
        StageConfig("monte_carlo", "monte_carlo", 48, targets=4, samples=(6, 8, 2), steps=350, rate=1e-3),
    )
}
