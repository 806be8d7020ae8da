"""Direct lighting of a hit by multiple importance sampling.

Strategies in the order of the sample index: environment map, visible normals (with antithetic pairs, an even index is
the original sample and the next odd one its partner), cosine.  A sample contributes ``f L cos w / (n p)``: f is the
BSDF, L the radiance of the environment, cos the cosine of the sampled direction with the shading normal, w the MIS
weight, n the sample count of the strategy and p its density [1/sr].  Back faces are shaded two-sided.

``visible`` stores one bit per sample for the adjoint: 1 if the direction is unoccluded and above the horizon.  If it
has no columns, nothing is stored.
"""

import warp as wp

from reli3d.kernels.bsdf import eval_bsdf, pdf_lobes
from reli3d.kernels.envmap import direction_to_uv, lookup_envmap_uv, pdf_envmap_uv, sample_envmap
from reli3d.kernels.math import INLINE, tangent_frame
from reli3d.kernels.microfacet import ALPHA_MIN, COS_MIN, Facet, facet_between, ggx_root, sample_ggx_vndf, stretch_view
from reli3d.kernels.random import random_pair, rotate_point
from reli3d.kernels.rays import hit_occluded, offset_origin
from reli3d.kernels.sampling import mirror, opposite, reflect, sample_cosine

# it traces shadow rays: see rays.py on contraction
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "cpu_compiler_flags": "-march=native " + INLINE})

OPPOSITE = wp.constant(1)  # pairing of visible normals; 0 for none
MIRRORED = wp.constant(2)
COS_VIEW_MIN = wp.constant(1.0e-3)  # cosine with the view to which shading normals are adjusted if it is lower


@wp.struct
class Points:
    """Arrays with a row per hit; ``pixel`` seeds its random numbers.

    ``rotation``: from the frame of directions and normals to that of positions and shadow rays; no rows: the same.
    """

    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    ng: wp.array[wp.vec3]
    wo: wp.array[wp.vec3]
    base_color: wp.array[wp.vec3]
    alpha: wp.array[float]
    metallic: wp.array[float]
    pixel: wp.array[wp.int32]
    rotation: wp.array[wp.mat33]


@wp.struct
class Light:
    """Texels of the environment map, its importance-sampling CDF and density, and the low-discrepancy points, to which
    each hit applies a Cranley-Patterson rotation.
    """

    radiance: wp.array2d[wp.vec3]
    rows: wp.array2d[float]
    columns: wp.array2d[float]
    row_guide: wp.array2d[wp.int32]
    column_guide: wp.array2d[wp.int32]
    density: wp.array2d[float]
    points: wp.array[wp.vec2]


@wp.struct
class Surface:
    """Data common to all samples of a hit; ``wo`` is in the local frame, whose axes are the rows of ``frame``.

    The shifts are Cranley-Patterson rotations of each strategy's points; unused for independent samples.
    """

    pixel: int
    shift_environment: wp.vec2
    shift_visible: wp.vec2
    shift_cosine: wp.vec2
    frame: wp.mat33
    ng: wp.vec3
    wo: wp.vec3
    stretched: wp.vec3  # ``wo`` in the space in which the GGX microsurface is a hemisphere: stretch_view
    root_o: float
    base_color: wp.vec3
    alpha: float
    metallic: float


@wp.struct
class Plan:
    """Sample counts of the strategies, seed and options; ``rotate``: 1 for Halton points, 0 for random numbers."""

    n_environment: int
    n_visible: int
    n_cosine: int
    antithetic: int
    power: int
    rotate: int
    conserving: int
    seed: int
    clamp: float
    scale: float


@wp.struct
class Draw:
    """One sample: its direction in the environment's frame (``direction``), in the local frame (``wi``) and in
    coordinates of the environment map (``uv``).

    ``factor`` is w / (n p).  It is 0 for a rejected sample, whose ``facet`` is then undefined.  ``count`` is n.
    """

    direction: wp.vec3
    wi: wp.vec3
    uv: wp.vec2
    facet: Facet
    factor: float
    count: int


@wp.func
def adjust_normal(n: wp.vec3, wo: wp.vec3) -> wp.vec3:
    """Shading normal ``n``, adjusted toward the viewer if its cosine with ``wo`` is below ``COS_VIEW_MIN``."""
    out = n
    cos_o = wp.dot(n, wo)
    if cos_o < COS_VIEW_MIN:
        out = wp.normalize(n + wo * (COS_VIEW_MIN - cos_o))
    return out


@wp.func
def make_surface(plan: Plan, points: Points, i: int) -> Surface:
    """Material and local frame of hit ``i``, its normals on the viewer's side, and the shifts of its sample points."""
    normal = points.normal[i]
    ng = points.ng[i]
    wo = points.wo[i]
    pixel = points.pixel[i]
    side = wp.where(wp.dot(ng, wo) < 0.0, -1.0, 1.0)
    surface = Surface()
    surface.frame = tangent_frame(adjust_normal(normal * side, wo))
    surface.ng = ng * side
    surface.wo = surface.frame * wo
    surface.base_color = points.base_color[i]
    surface.alpha = wp.max(points.alpha[i], ALPHA_MIN)
    surface.metallic = points.metallic[i]
    surface.stretched = stretch_view(surface.wo, surface.alpha)
    surface.root_o = ggx_root(surface.wo, surface.alpha)
    surface.pixel = pixel
    surface.shift_environment = random_pair(plan.seed, pixel, 0, 0)
    surface.shift_visible = random_pair(plan.seed, pixel, 0, 1)
    surface.shift_cosine = random_pair(plan.seed, pixel, 0, 2)
    return surface


@wp.func
def draw_pair(plan: Plan, points: wp.array[wp.vec2], shift: wp.vec2, pixel: int, index: int, strategy: int) -> wp.vec2:
    """Uniform pair of a sample: random, or a low-discrepancy point after a Cranley-Patterson rotation by ``shift``."""
    u = rotate_point(points[index], shift)
    if plan.rotate == 0:
        u = random_pair(plan.seed, pixel, index, strategy)
    return u


@wp.func
def visible_normal(surface: Surface, plan: Plan, points: wp.array[wp.vec2], k: int) -> wp.vec3:
    """Microfacet normal of the ``k``-th visible-normal sample; both samples of a pair use the same random numbers."""
    index = k
    how = wp.int32(0)
    if plan.antithetic != 0:
        index = k >> 1
        if (k & 1) == 1:
            how = plan.antithetic
    u = draw_pair(plan, points, surface.shift_visible, surface.pixel, index, 1)
    if how == OPPOSITE:
        u = opposite(u)
    wm = sample_ggx_vndf(surface.stretched, surface.alpha, u)
    if how == MIRRORED:
        wm = mirror(wm)
    return wm


@wp.func
def mis_factor(chosen: float, all: wp.vec4, power: int) -> float:
    """MIS weight (Veach and Guibas 1995) over ``chosen``, the count times density of the strategy that drew the sample.

    all: count times density of every strategy, 0 for unused ones.  Balance heuristic (``power`` 0): 1 / sum(all).
    Power heuristic with exponent 2: chosen / sum(all**2), normalized by the sum because the squares of narrow lobes
    overflow float32.  0 if ``chosen`` is 0.
    """
    factor = wp.float32(0.0)
    total = all[0] + all[1] + all[2] + all[3]
    if chosen > 0.0:
        factor = 1.0 / total
        if power != 0:
            fraction = all / total
            factor = chosen / total / (wp.dot(fraction, fraction) * total)
    return factor


@wp.func
def draw_sample(surface: Surface, plan: Plan, light: Light, sample: int) -> Draw:
    """The sample of index ``sample`` of a hit.  A direction below the horizon has factor 0."""
    out = Draw()
    wi = wp.vec3(0.0, 0.0, 0.0)
    uv = wp.vec2(0.0, 0.0)
    factor = wp.float32(0.0)
    strategy = wp.int32(0)
    count = wp.int32(plan.n_environment)
    if sample < plan.n_environment:
        u = draw_pair(plan, light.points, surface.shift_environment, surface.pixel, sample, 0)
        drawn = sample_envmap(light.rows, light.columns, light.row_guide, light.column_guide, u)
        uv = drawn.uv
        out.direction = drawn.direction
        wi = surface.frame * out.direction
    else:
        k = sample - plan.n_environment
        if k < plan.n_visible:
            strategy = 1
            count = plan.n_visible
            if plan.antithetic == MIRRORED and (k & 1) == 1:
                strategy = 2
            wm = visible_normal(surface, plan, light.points, k)
            if wp.dot(surface.wo, wm) > COS_MIN:
                wi = reflect(surface.wo, wm)
        else:
            strategy = 3
            count = plan.n_cosine
            u = draw_pair(plan, light.points, surface.shift_cosine, surface.pixel, k - plan.n_visible, 2)
            wi = sample_cosine(u)
        out.direction = wp.transpose(surface.frame) * wi
        if wi[2] > COS_MIN:
            uv = direction_to_uv(out.direction)
    if wi[2] > COS_MIN:
        out.facet = facet_between(surface.wo, wi, surface.alpha, surface.root_o)
        lobes = pdf_lobes(out.facet, surface.wo, wi)
        mirrored = wp.float32(0.0)  # number of mirrored samples: only these have a density of their own
        if plan.antithetic == MIRRORED:
            mirrored = float(plan.n_visible // 2)
        all = wp.vec4(
            float(plan.n_environment) * pdf_envmap_uv(light.density, uv),
            (float(plan.n_visible) - mirrored) * lobes[0],
            mirrored * lobes[1],
            float(plan.n_cosine) * lobes[2],
        )
        chosen = all[0]  # not all[strategy], which would send the vector through memory
        if strategy == 1:
            chosen = all[1]
        elif strategy == 2:
            chosen = all[2]
        elif strategy == 3:
            chosen = all[3]
        factor = mis_factor(chosen, all, plan.power)
    out.wi = wi
    out.uv = uv
    out.factor = factor
    out.count = count
    return out


@wp.func
def sample_value(surface: Surface, plan: Plan, draw: Draw, light: wp.vec3) -> wp.vec3:
    """Contribution f L cos w / (n p) of an unoccluded sample, at most ``plan.clamp`` / n per channel."""
    value = eval_bsdf(
        draw.facet, surface.wo, draw.wi, surface.base_color, surface.alpha, surface.metallic, plan.conserving
    )
    value = wp.cw_mul(value, light) * (draw.factor * draw.wi[2])
    top = plan.clamp / float(draw.count)
    return wp.vec3(wp.min(value[0], top), wp.min(value[1], top), wp.min(value[2], top))


@wp.func
def shadow_ray(plan: Plan, points: Points, i: int, ng: wp.vec3, direction: wp.vec3):
    """Origin and direction of the shadow ray of a sample of hit ``i``, whose geometric normal is ``ng``."""
    if points.rotation.shape[0] != 0:
        ng = points.rotation[i] * ng
        direction = points.rotation[i] * direction
    return offset_origin(points.position[i], ng, direction, plan.scale), direction


@wp.kernel
def shade_kernel(
    start: int,
    points: Points,
    light: Light,
    plan: Plan,
    mesh: wp.uint64,
    shadows: int,
    out: wp.array[wp.vec3],  # out
    visible: wp.array2d[wp.int32],  # out
):
    """Radiance of each hit; traces shadow rays through Warp's BVH."""
    i = start + wp.tid()
    surface = make_surface(plan, points, i)
    total = wp.vec3(0.0, 0.0, 0.0)
    word = wp.int32(0)
    count = plan.n_environment + plan.n_visible + plan.n_cosine
    for s in range(count):
        d = draw_sample(surface, plan, light, s)
        if d.factor > 0.0:
            lit = wp.bool(True)
            if shadows != 0:
                origin, direction = shadow_ray(plan, points, i, surface.ng, d.direction)
                lit = not hit_occluded(mesh, origin, direction, wp.inf)
            if lit:
                total = total + sample_value(surface, plan, d, lookup_envmap_uv(light.radiance, d.uv))
                word = word | (1 << (s & 31))
        if (s & 31) == 31 or s == count - 1:
            if s // 32 < visible.shape[1]:
                visible[i, s // 32] = word
            word = 0
    out[i] = total
