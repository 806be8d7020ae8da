"""How many samples each strategy of direct light should get: counts chosen for the scene from a pilot's variances."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from reli3d._bridge import launch
from reli3d.geometry.rays import RayScene
from reli3d.kernels import allocation as kernels
from reli3d.render.environment import Environment
from reli3d.render.material import choice
from reli3d.render.shading import check_hits, sampling_plan

PILOT_SAMPLES = 24576  # in all; an image of 512 x 512, half of it covered, takes 8.4 million
PILOT_POINTS = 256  # so at least 32 samples of each strategy for each of them
PREFER_ONE = 0.9  # of the best strategy's variance: a mixture has to promise less.  Even points, of which the estimate
# knows nothing, serve one strategy better than few points of each: up to 6 % of the variance where nothing was to gain
BLOCK = 1 << 17  # samples times candidates evaluated at once: arrays of 1 MB


@dataclass(frozen=True)
class SamplePlan:
    """Counts ``samples`` for :func:`reli3d.render.shading.shade` with ``antithetic=False``, and what they should give.

    variance: of a point's radiance with independent samples, summed over the channels, mean over the pilot's points.
    """

    samples: tuple[int, int, int]
    variance: float


@torch.no_grad()
def plan_samples(
    position: Tensor,
    normal: Tensor,
    ng: Tensor,
    wo: Tensor,
    base_color: Tensor,
    roughness: Tensor,
    metallic: Tensor,
    environment: Environment,
    *,
    total: int = 64,
    scene: RayScene | None = None,
    seed: int = 0,
    alpha: str = "squared",
    paint: str = "conserving",
) -> SamplePlan:
    """Counts of the three strategies, ``total`` together, with the least variance for these points under this light.

    The points, environment, scene, alpha and paint are those of :func:`reli3d.render.shading.shade`; N is at least 1.
    One plan is made for all points: the one with the least sum of their variances, and of the channels', so the
    brightest points weigh most.  Other materials or another light want another plan.

    A pilot takes 24576 samples, a third from each strategy, spread over at most 256 of the points.  With counts n_k,
    densities p_k and q = sum n_k p_k the balance heuristic has the variance ``int f^2 / q - sum n_k (int f p_k /
    q)^2`` (Veach and Guibas 1995; Sbert et al. 2016, Variance Analysis of Multi-sample and One-sample Multiple
    Importance Sampling).  The pilot's samples over the pilot's own q estimate both integrals for any n_k, as He and
    Owen 2014 (Optimal mixture weights in multiple importance sampling) do for mixtures.  So what one strategy would
    meet once in a thousand runs, a small sun in a broad lobe, another has drawn, and no candidate looks better than it
    is.  Compared are splits by eighths, and by sixteenths about the best; one strategy alone is taken where no mixture
    promises a tenth less.  Visible normals are taken to be independent: pairs (``antithetic``) help slopes in a
    normal, hardly ever the value (docs/renderer.md).  A gradient to texels where the map is black needs a strategy
    that reaches them: not the environment table alone.

    No gradient.  The result depends on the inputs and ``seed`` alone.  Raises TypeError for a wrong dtype, ValueError
    for a shape, device, count, choice or a value that is not finite.
    """
    n = check_hits(position, normal, ng, wo, base_color, roughness, metallic, environment)
    if n == 0:
        raise ValueError("position: expected at least one point, got none")
    if int(total) != total or total < 1:
        raise ValueError(f"total: expected a count of at least 1, got {total}")
    if scene is not None and scene.device != position.device:
        raise ValueError(f"scene: expected device {position.device}, got {scene.device}")
    width = roughness * roughness if choice("alpha", alpha, ("squared", "linear")) == 0 else roughness
    points = min(n, PILOT_POINTS)
    rows = spread_rows(n, points, seed).to(position.device)
    values = [v[rows].contiguous() for v in (position, normal, ng, wo, base_color, width, metallic)]
    pilot = _draw(values, environment, PILOT_SAMPLES // (3 * points), scene, seed, paint)
    counts = _splits(int(total)).to(position.device)
    variance = _variances(*pilot, counts)
    finer = counts[variance.argmin()] + _MOVES.to(counts) * max(1, int(total) // 16)
    finer = finer[(finer >= 0.0).all(1)]
    counts, variance = torch.cat([counts, finer]), torch.cat([variance, _variances(*pilot, finer)])
    if not bool(torch.isfinite(variance).all()):
        raise ValueError("points: expected finite positions, directions, materials and light, got NaN or infinity")
    alone = (counts > 0.0).sum(1) == 1
    best, single = int(variance.argmin()), int(torch.where(alone, variance, torch.inf).argmin())
    if not float(variance[best]) < PREFER_ONE * float(variance[single]):
        best = single
    return SamplePlan(tuple(int(k) for k in counts[best]), float(variance[best]))


def spread_rows(n: int, count: int, seed: int) -> Tensor:
    """One row of each of ``count`` equal stretches of ``n`` rows, at random within it; int64."""
    jitter = torch.rand(count, dtype=torch.float64, generator=torch.Generator().manual_seed(int(seed)))
    return ((torch.arange(count) + jitter) * (n / count)).long().clamp(max=n - 1)


def _draw(
    values: list[Tensor], environment: Environment, each: int, scene, seed: int, paint: str
) -> tuple[Tensor, ...]:
    """``each`` samples of every strategy for P points, S for each point, float64.

    Values over q ``(P, S, 3)``; densities over q ``(P, S, 3)``; these scaled to weights with which each strategy's
    samples, and those of its own that are lost below the horizon, have mass 1: so an integrand without variance shows
    none.
    """
    n, count, device, samples = len(values[0]), 3 * each, values[0].device, (each, each, each)
    plan, offsets = sampling_plan(samples, seed, False, "balance", "halton", paint, None, scene)
    table = environment.table
    light = [(environment.radiance.contiguous(), wp.vec3), *table.sampler, (table.density, wp.float32)]
    ins = [*zip(values, [wp.vec3] * 5 + [wp.float32] * 2), *light, (offsets.to(device), wp.vec2), plan]
    origins, directions, value, density = (torch.empty(n, count, 3, device=device) for _ in range(4))
    outs = [(v, wp.vec3) for v in (origins, directions, value, density)]
    launch(kernels.pilot_kernel, n, [*ins, *outs], device, slice_min=8)
    if scene is not None and scene.faces.shape[0]:
        value[scene.occluded(origins, directions)] = 0.0
    density = density.double()
    lost = (density == 0.0).all(2).unflatten(1, (3, each)).double().mean(2)
    return value.double(), density, density / (density.sum(1) + lost)[:, None]


def _splits(total: int) -> Tensor:
    """``total`` split into three counts by eighths (by ones below 8), ``(C, 3)`` float64, C at most 45."""
    steps = min(total, 8)
    edges = [(total * a // steps, total * b // steps) for a in range(steps + 1) for b in range(a, steps + 1)]
    return torch.tensor([(a, b - a, total - b) for a, b in edges], dtype=torch.float64)


_MOVES = torch.tensor([[1, -1, 0], [-1, 1, 0], [1, 0, -1], [-1, 0, 1], [0, 1, -1], [0, -1, 1]])


def _variances(value: Tensor, density: Tensor, weight: Tensor, counts: Tensor) -> Tensor:
    """Variance of a point, mean over the points, for each of ``counts (C, 3)``; the others from :func:`_draw`."""
    points, samples = value.shape[:2]
    total = torch.zeros(len(counts), dtype=torch.float64, device=counts.device)
    size = max(1, BLOCK // (samples * len(counts)))
    for first in range(0, points, size):
        v, p, w = (a[first : first + size] for a in (value, density, weight))
        inverse = 1.0 / (counts @ p.mT).clamp(min=1e-30)  # (P, C, S): the pilot's q over the candidate's
        square = (counts @ (w * v.square().sum(2, keepdim=True)).mT * inverse.square()).sum(2)
        mean = (inverse @ (w[..., None] * v[:, :, None]).flatten(2)).unflatten(2, (3, 3))  # strategy, channel
        total += (square - (counts * mean.square().sum(3)).sum(2)).sum(0)
    return total / points
