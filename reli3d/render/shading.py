"""Direct lighting of surface points by multiple importance sampling, with optional shadow rays.

The gradient of one rendering's squared residual is biased, because value and derivative share the same noise; for an
unbiased gradient, multiply the residuals of two renderings with different seeds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from reli3d import _bridge
from reli3d._bridge import check, empty, expect, launch, present, struct_of, view
from reli3d.geometry import embree
from reli3d.geometry.rays import RayScene
from reli3d.kernels import shade as kernels
from reli3d.kernels import shade_rays as halves
from reli3d.render.environment import Environment, EnvironmentCDF
from reli3d.render.material import DIFFUSE_MODELS, choice
from reli3d.render.points import SurfacePoints, check_values, nan_where_not_finite, of_rows
from reli3d.render.sampling import halton

CHOICES = {
    "antithetic": ("none", "opposite", "mirrored"),
    "heuristic": ("balance", "power"),
    "sequence": ("halton", "random"),
    "alpha": ("squared", "linear"),
    "diffuse_model": DIFFUSE_MODELS,
}
CHUNK_RAYS = 65536  # shadow rays of a chunk and their values take 2.6 MB a thread: near the cache, far above call costs
GROUP_RAYS = 64  # of neighboring hits, traced together: so packets of 16 are full where a hit has fewer


class Samples(NamedTuple):
    """Sample counts per point and strategy; the defaults follow the ReLi3D paper.

    light: importance sampling of the environment.  bsdf: GGX visible normals, including the partners of antithetic
    pairs; the last of an odd count has none.  cosine: cosine-weighted hemisphere.

    >>> options = reli3d.ShadeOptions(samples=reli3d.Samples(light=8, bsdf=16, cosine=2))
    >>> image = reli3d.render_asset(asset, camera, light, options=options)
    """

    light: int = 20
    bsdf: int = 40
    cosine: int = 4


@dataclass(frozen=True, kw_only=True)
class ShadeOptions:
    """Options of :func:`shade`: sampling and material model; raises ValueError or TypeError.

    samples: :class:`Samples`, or three counts, 0 for none.  seed: random seed; change it in every optimization step.
    The squared residual of one noisy image is biased; multiply the residuals of two seeds.  antithetic: pairs of VNDF
    samples: ``opposite`` (see :func:`reli3d.antithetic`), ``mirrored`` (ReLi3D), ``none``.  heuristic: ``balance`` or
    ``power``.  sequence: ``halton`` with a Cranley-Patterson rotation per point and strategy, or ``random``.  alpha:
    GGX alpha from roughness, ``squared`` or, as in ReLi3D, ``linear``.  diffuse_model: see :func:`reli3d.eval_bsdf`.
    clamp: limit per channel of a sample's contribution, MIS weight included.  check_inputs: ValueError for unnormalized
    directions, materials outside [0, 1], non-finite values.

    >>> fast = reli3d.ShadeOptions(samples=(4, 4, 2), seed=1)
    >>> image = reli3d.render_asset(asset, camera, light, options=fast)
    """

    samples: Samples | tuple[int, int, int] = Samples()
    seed: int = 0
    antithetic: str = "opposite"
    heuristic: str = "balance"
    sequence: str = "halton"
    alpha: str = "squared"
    diffuse_model: str = "conserving"
    clamp: float | None = None
    check_inputs: bool = False

    def __post_init__(self):
        expect("samples", self.samples, Sequence)
        if len(self.samples) != 3 or any(int(k) != k or k < 0 for k in self.samples):
            raise ValueError(f"samples: expected three counts of at least 0, got {tuple(self.samples)}")
        object.__setattr__(self, "samples", Samples(*map(int, self.samples)))
        expect("seed", self.seed, Integral)
        for name, allowed in CHOICES.items():
            choice(name, getattr(self, name), allowed)
        if self.clamp is not None and not self.clamp > 0.0:
            raise ValueError(f"clamp: expected a positive number or None, got {self.clamp}")

    def width(self, roughness: Tensor) -> Tensor:
        """GGX width of a perceptual roughness."""
        return roughness * roughness if self.alpha == "squared" else roughness


DEFAULT = ShadeOptions()


def shade(
    points: SurfacePoints,
    wo: Tensor,
    environment: Environment,
    *,
    scene: RayScene | None = None,
    options: ShadeOptions = DEFAULT,
    pixels: Tensor | None = None,
    rotations: Tensor | None = None,
) -> Tensor:
    """Reflected radiance ``(N, 3)`` of surface points towards ``wo`` under ``environment``; linear Rec. 709.

    wo: ``(N, 3)`` or ``(3,)`` unit, to the camera.  Surfaces are two-sided; shading normals that face away from ``wo``
    are adjusted.  scene: occluders; None: no shadows.  pixels: ``(N,)`` int32, seeds with ``options.seed`` each point's
    samples; None: the row number.  rotations: ``(N, 3, 3)``, from the environment's axes to those of the points; None:
    the same axes.  Non-finite inputs give NaN.

    First derivatives (detached sampling) reach normal (the tangential component: optimize ``normalize(x)``),
    base_color, roughness, metallic and the environment's texels.  Bitwise reproducible.  Raises TypeError or
    ValueError.  Source: Veach and Guibas 1995.

    >>> points = reli3d.SurfacePoints(position, normal, normal, base_color=0.8, roughness=0.4, metallic=0.0)
    >>> radiance = reli3d.shade(points, wo, reli3d.Environment.constant(torch.ones(3)))
    """
    position, *axes, base_color, width, metallic = shaded_arrays(points, wo, environment, scene, options)
    plan, offsets = sampling_plan(options, scene)
    n, device = len(points), points.position.device
    if rotations is None:
        rotations = position.new_empty(0, 3, 3)
    else:  # the samples are drawn in the environment's frame
        check("rotations", rotations, shape=(n, 3, 3), like=position)
        rotations = rotations.detach().contiguous()
        axes = [(v[..., None] * rotations).sum(1) for v in axes]  # not a product of matrices: autocast would round it
    job = _Job(plan, sum(options.samples), scene, environment.cdf, offsets.to(device), rotations)
    values = position, *axes, base_color, width, metallic
    if pixels is None:
        pixels = torch.arange(n, dtype=torch.int32, device=device)
    check("pixels", pixels, shape=(n,), like=points.position, dtype=torch.int32)
    return _Shade.apply(job, *(v.contiguous() for v in (*values, environment.radiance, pixels)))


@dataclass(frozen=True)
class _Job:
    """Arguments of a call that are not differentiable."""

    plan: kernels.Plan
    count: int
    scene: RayScene | None
    cdf: EnvironmentCDF
    offsets: Tensor
    rotations: Tensor


class _Shade(torch.autograd.Function):
    """Own backward: the samples are detached, and Warp's adjoint would differentiate through their drawing."""

    @staticmethod
    def forward(ctx, job: _Job, *tensors: Tensor) -> Tensor:
        n, device = tensors[0].shape[0], tensors[0].device
        words = -(-job.count // 32) if any(ctx.needs_input_grad[1:]) else 0  # a bit for each sample that is lit
        visible, out = torch.zeros(n, words, dtype=torch.int32, device=device), empty((n,), wp.vec3, device)
        ins = _inputs(tensors, job)
        if job.scene is not None and job.scene.backend == "embree" and job.scene.faces.shape[0]:
            _shade_embree(n, ins, job, out, visible)
        else:
            mesh = job.scene.mesh_id if job.scene is not None else 0
            launch(kernels.shade_kernel, n, [*ins, job.plan, mesh, int(mesh != 0), out, visible], device)
        out += nan_where_not_finite(tensors[:7])
        ctx.job = job
        ctx.save_for_backward(*tensors, visible)
        return out

    @staticmethod
    @_bridge.once_differentiable
    def backward(ctx, g_out: Tensor):
        from reli3d.kernels import shade_adjoint as adjoint  # lazily: an image needs no gradient

        *tensors, visible = ctx.saved_tensors
        n, device, needed = g_out.shape[0], g_out.device, ctx.needs_input_grad[1:]
        least = _bridge.slice_of_accumulators(n, _bridge.SLICE_MIN, tensors[7].numel() if needed[7] else 0)
        least = least if device.type == "cpu" else n + 1  # on CUDA one launch for all
        # gradients that are not needed have no rows, and the kernel skips them
        g_normal, g_base, g_alpha, g_metallic, texels = (
            torch.zeros_like(tensors[k] if needed[k] else tensors[k][:0]) for k in (1, 4, 5, 6, 7)
        )
        g_radiance = texels.repeat(len(_bridge.slices(n, least)), 1, 1, 1)  # of each slice
        ins = [*_inputs(tensors, ctx.job), ctx.job.plan, visible, g_out.contiguous()]
        outs = [g_normal, g_base, g_alpha, g_metallic]

        def work(k, start, length):
            args = [start, *ins, *outs, g_radiance[k]]
            launch(adjoint.shade_adjoint_kernel, length, args, device, slice_min=length)  # stays in its thread

        if ctx.job.count:
            _bridge.over_slices(n, work, slice_min=least)
        grads = [None, g_normal, None, None, g_base, g_alpha, g_metallic, g_radiance.sum(0), None]
        return None, *(g if w else None for g, w in zip(grads, needed, strict=True))


def _inputs(tensors: Sequence[Tensor], job: _Job) -> list:
    """Points and environment as the kernels take them."""
    *values, radiance, pixels = tensors
    return [struct_of_points(values, pixels, job.rotations), struct_of_light(radiance, job.cdf, job.offsets)]


def struct_of_points(values: Sequence[Tensor], pixels: Tensor, rotation: Tensor) -> kernels.Points:
    """Contiguous arrays in the order of :func:`shaded_arrays`, the seed index and the rotation of each point."""
    names = ("position", "normal", "ng", "wo", "base_color", "alpha", "metallic")
    return struct_of(kernels.Points, **dict(zip(names, values, strict=True)), pixel=pixels, rotation=rotation)


def struct_of_light(radiance: Tensor, cdf: EnvironmentCDF, offsets: Tensor) -> kernels.Light:
    """Contiguous texels, their sampling CDF, and the low-discrepancy points, not yet rotated."""
    return struct_of(kernels.Light, radiance=radiance, **vars(cdf), points=offsets)


def _shade_embree(n: int, ins: list, job: _Job, out: Tensor, visible: Tensor) -> None:
    """Shades chunks of hits: one kernel generates shadow rays and values, another traces them by Embree and sums."""
    count, tracer = job.count, (embree.query("rtcOccluded16"), present("scene", job.scene).embree_scene)
    if count == 0:
        out.zero_()
        return
    size = max(1, CHUNK_RAYS // count)
    group = max(1, GROUP_RAYS // count)
    # views once for all chunks: a third of the cost of a chunk without its rays
    outs = [view(out, wp.vec3), view(visible, wp.int32)]

    def work(_, start, length):
        buffers = [torch.empty(min(size, length) * count, 3, dtype=torch.float32, device="cpu") for _ in range(3)]
        far = torch.empty(min(size, length) * count, dtype=torch.float32, device="cpu")
        origins, directions, values, t_max = *(view(v, wp.vec3) for v in buffers), view(far, wp.float32)
        for first in range(start, start + length, size):
            hits = min(size, start + length - first)
            args = [first, *ins, job.plan, origins, directions, t_max, values]
            launch(halves.shade_rays_kernel, hits, args, out.device)
            args = [first, hits, group, count, *tracer, origins, directions, values, t_max, *outs]
            launch(halves.accumulate_kernel, -(-hits // group), args, out.device)

    if n:
        _bridge.over_slices(n, work)


def shaded_arrays(
    points: SurfacePoints, wo: Tensor, environment: Environment, scene: RayScene | None, options: ShadeOptions
) -> tuple[Tensor, ...]:
    """The seven point arrays in kernel argument order, checked, with GGX width instead of roughness."""
    expect("points", points, SurfacePoints)
    expect("environment", environment, Environment)
    expect("options", options, ShadeOptions)
    position = points.position
    check("environment.radiance", environment.radiance, like=position)
    if scene is not None:
        expect("scene", scene, RayScene)
    if scene is not None and scene.device != position.device:
        raise ValueError(f"scene: expected device {position.device}, got {scene.device}")
    wo, width = of_rows("wo", wo, position, 3), options.width(points.roughness)
    if options.check_inputs:
        check_values(points, wo)
    return position, points.normal, points.ng, wo, points.base_color, width, points.metallic


def sampling_plan(options: ShadeOptions, scene: RayScene | None) -> tuple[kernels.Plan, Tensor]:
    """``options`` as a kernel struct, and the low-discrepancy points."""
    plan = kernels.Plan()
    plan.n_environment, plan.n_visible, plan.n_cosine = (int(k) for k in options.samples)
    plan.antithetic = CHOICES["antithetic"].index(options.antithetic)
    plan.power = CHOICES["heuristic"].index(options.heuristic)
    plan.rotate = 1 - CHOICES["sequence"].index(options.sequence)
    plan.conserving = 1 - DIFFUSE_MODELS.index(options.diffuse_model)
    plan.seed = int(options.seed) & 0x7FFFFFFF
    plan.clamp = float("inf") if options.clamp is None else float(options.clamp)
    plan.scale = 0.0 if scene is None else scene.scale
    return plan, halton(max(1, *options.samples))
