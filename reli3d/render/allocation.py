"""Allocates samples to the strategies of direct lighting by variances estimated in a pilot run."""

from dataclasses import dataclass, replace
from itertools import permutations

import torch
from torch import Tensor

from reli3d._bridge import full_precision, launch
from reli3d.geometry.rays import RayScene
from reli3d.kernels import allocation as kernels
from reli3d.render import shading
from reli3d.render.environment import Environment
from reli3d.render.points import SurfacePoints
from reli3d.render.shading import DEFAULT, Samples, ShadeOptions, shade, shaded_arrays

FIRST_PASS_POINTS = 16384  # with one sample of each strategy; the points of the pilot are drawn from these
PILOT_SAMPLES = 24576  # in total; an image of 512 x 512, half of it covered, takes 8.4 million
PILOT_POINTS = 256  # so at least 32 samples of each strategy per point
TRIAL_POINTS = 1024  # with repetition, at which a mixture is compared with a single strategy
MAX_SINGLE_RATIO = 2.0  # of the variance of a single strategy to that of the mixture, above which it is not compared
MIXTURE_RATIO = 0.9  # of the variances in the trial, whose noise is 7 %, below which the mixture is preferred
MIN_RELATIVE_RADIANCE = 0.1  # of the mean radiance: floor of the denominator of relative variances
BLOCK_VALUES = 1 << 17  # samples times candidates evaluated at once: arrays of 1 MB


@dataclass(frozen=True)
class SamplePlan:
    """Sample counts for :func:`reli3d.render.shading.shade` with ``antithetic="none"``, and the expected variance.

    samples: counts of light, BSDF and cosine samples.  variance: variance of the radiance with independent samples,
    summed over the channels and averaged over the points; relative to the squared radiance if the plan is ``relative``.
    """

    samples: tuple[int, int, int]
    variance: float


@torch.no_grad()
@full_precision
def plan_samples(
    points: SurfacePoints,
    wo: Tensor,
    environment: Environment,
    *,
    total: int = 64,
    scene: RayScene | None = None,
    options: ShadeOptions = DEFAULT,
    relative: bool = False,
) -> SamplePlan:
    """Divides ``total`` samples among the three strategies to minimize the variance at ``points``.

    points (at least one), wo, environment, scene: as in :func:`reli3d.render.shading.shade`.  options: only ``seed``,
    ``sequence``, ``alpha`` and ``diffuse_model`` are used.  relative: False minimizes the variances summed over all
    points; True first divides each variance by the squared radiance.  Variances are estimated in a pilot run of
    PILOT_SAMPLES samples.  Use plans for images, not for optimization: a plan may omit a strategy that gradients need.

    No gradient.  Deterministic for a given seed.  Raises TypeError for a wrong dtype; ValueError for a wrong shape,
    device, count or choice, or for non-finite values.
    """
    values = [v.detach() for v in shaded_arrays(points, wo, environment, scene, options)]
    if len(points) == 0:
        raise ValueError("position: expected at least one point, got none")
    if int(total) != total or total < 1:
        raise ValueError(f"total: expected a count of at least 1, got {total}")
    rows, weights = _pilot_points(values, environment, scene, options)
    values = [v[rows] for v in values]
    drawn = _draw(values, environment, PILOT_SAMPLES // (3 * len(rows)), scene, options)
    if relative:
        radiance = drawn[0].sum(1).mean(1)
        weights = weights / (radiance.square() + (MIN_RELATIVE_RADIANCE * (weights @ radiance)) ** 2).clamp(min=1e-30)
    counts = _splits(int(total)).to(weights.device)
    variance = _variances(*drawn, weights, counts)
    moves = counts.new_tensor(list(permutations((1, -1, 0))))
    finer = counts[variance.argmin()] + moves * max(1, int(total) // 16)
    finer = finer[(finer >= 0.0).all(1)]
    counts, variance = torch.cat([counts, finer]), torch.cat([variance, _variances(*drawn, weights, finer)])
    alone = (counts > 0.0).sum(1) == 1
    best, single = int(variance.argmin()), int(torch.where(alone, variance, torch.inf).argmin())
    if best != single and float(variance[single]) < MAX_SINGLE_RATIO * float(variance[best]):
        measured = [_measured_variance(values, weights, environment, counts[k], scene, options) for k in (best, single)]
        best = best if measured[0] < MIXTURE_RATIO * measured[1] else single
    return SamplePlan(Samples(*counts[best].int().tolist()), float(variance[best]))


def spread_rows(n: int, count: int, seed: int) -> Tensor:
    """Stratified int64 row indices: one random row from each of ``count`` equal intervals of ``n`` rows."""
    return (_spread(count, seed) * n).long().clamp(max=n - 1)


def _spread(count: int, seed: int) -> Tensor:
    """One random number in each of ``count`` equal parts of [0, 1), float64."""
    jitter = torch.rand(count, dtype=torch.float64, generator=torch.Generator().manual_seed(int(seed)), device="cpu")
    return (torch.arange(count, dtype=torch.float32, device="cpu") + jitter) / count


def _pilot_points(values: list[Tensor], environment, scene, options: ShadeOptions) -> tuple[Tensor, Tensor]:
    """Rows of the pilot's points and their weights in the mean over all points, both ``(P,)``."""
    n, device, seed = len(values[0]), values[0].device, options.seed
    if n <= PILOT_POINTS:
        even = torch.full((n,), 1.0 / n, dtype=torch.float64, device=device)
        return torch.arange(n, device=device, dtype=torch.int64), even
    rows = spread_rows(n, min(n, FIRST_PASS_POINTS), seed).to(device)
    first = _draw([v[rows] for v in values], environment, 1, scene, replace(options, seed=seed + 1))
    square = first[0].square().sum((1, 2))
    chance = 0.5 / len(rows) + 0.5 * square / square.sum().clamp(min=1e-30)
    edges = chance.cumsum(0)
    chosen = torch.searchsorted(edges, _spread(PILOT_POINTS, seed + 2).to(device) * edges[-1]).clamp(max=len(rows) - 1)
    return rows[chosen], edges[-1] / (chance[chosen] * (len(rows) * PILOT_POINTS))


def _draw(
    values: list[Tensor], environment: Environment, each: int, scene: RayScene | None, options: ShadeOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """``each`` samples of every strategy at P points, S per point, float64.

    Returns values and densities over q, both ``(P, S, 3)``, and the densities normalized so that a strategy's samples,
    with its own below the horizon, have weight 1; then a constant integrand has variance 0.
    """
    n, count, device = len(values[0]), 3 * each, values[0].device
    own = ShadeOptions(samples=(each,) * 3, seed=options.seed, antithetic="none", diffuse_model=options.diffuse_model)
    plan, offsets = shading.sampling_plan(own, scene)
    light = shading.struct_of_light(environment.radiance.contiguous(), environment.cdf, offsets.to(device))
    pixels = torch.arange(n, dtype=torch.int32, device=device)
    points = shading.struct_of_points([v.contiguous() for v in values], pixels, values[0].new_empty(0, 3, 3))
    ins = [points, light, plan]
    origins, directions, value, density = (
        torch.empty(n, count, 3, device=device, dtype=torch.float32) for _ in range(4)
    )
    launch(kernels.pilot_kernel, n, [*ins, origins, directions, value, density], device, slice_min=8)
    if scene is not None and scene.faces.shape[0]:
        value[scene.occluded(origins, directions)] = 0.0
    if not bool(torch.isfinite(value).all()):
        raise ValueError("points: expected finite positions, directions, materials and radiance, got NaN or infinity")
    density = density.double()
    lost = (density == 0.0).all(2).unflatten(1, (3, each)).double().mean(2)
    return value.double(), density, density / (density.sum(1) + lost)[:, None]


def _measured_variance(
    values: list[Tensor], weights: Tensor, environment, counts: Tensor, scene, options: ShadeOptions
) -> float:
    """Measured variance of :func:`reli3d.render.shading.shade` with ``counts``, weighted mean over the points."""
    runs = TRIAL_POINTS // len(weights)
    position, normal, ng, wo, *material = (v.repeat(runs, *[1] * (v.ndim - 1)) for v in values)
    samples = Samples(*counts.int().tolist())
    options = replace(options, samples=samples, antithetic="none", alpha="linear", heuristic="balance", clamp=None)
    drawn = shade(SurfacePoints(position, ng, normal, *material), wo, environment, scene=scene, options=options)
    return float(weights @ drawn.double().unflatten(0, (runs, -1)).var(0).sum(1))


def _splits(total: int) -> Tensor:
    """``total`` split into three counts by eighths (by ones below 8), ``(C, 3)`` float64, C at most 45."""
    steps = min(total, 8)
    edges = [(total * a // steps, total * b // steps) for a in range(steps + 1) for b in range(a, steps + 1)]
    return torch.tensor([(a, b - a, total - b) for a, b in edges], dtype=torch.float64, device="cpu")


def _variances(value: Tensor, density: Tensor, weight: Tensor, weights: Tensor, counts: Tensor) -> Tensor:
    """Predicted variance for each of ``counts (C, 3)``, mean over points by ``weights (P,)``, from :func:`_draw`."""
    points, samples = value.shape[:2]
    total = torch.zeros(len(counts), dtype=torch.float64, device=counts.device)
    size = max(1, BLOCK_VALUES // (samples * len(counts)))
    for first in range(0, points, size):
        v, p, w = (a[first : first + size] for a in (value, density, weight))
        inverse = 1.0 / (counts @ p.mT).clamp(min=1e-30)  # (P, C, S): the pilot's q over the candidate's
        square = (counts @ (w * v.square().sum(2, keepdim=True)).mT * inverse.square()).sum(2)
        mean = (inverse @ (w[..., None] * v[:, :, None]).flatten(2)).unflatten(2, (3, 3))  # strategy, channel
        total += weights[first : first + size] @ (square - (counts * mean.square().sum(3)).sum(2))
    return total
