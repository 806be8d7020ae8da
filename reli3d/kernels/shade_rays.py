"""The estimator of ``reli3d.kernels.shade`` in two halves: rays and values, then the sum of what Embree finds lit."""

import warp as wp

from reli3d.kernels.embree import block_rays
from reli3d.kernels.envmap import lookup_envmap_uv
from reli3d.kernels.math import CONTRACT, INLINE
from reli3d.kernels.shade import Light, Plan, Points, draw_sample, make_surface, sample_value, shadow_ray

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": f"-march=native {INLINE} {CONTRACT}"})


@wp.kernel
def shade_rays_kernel(
    start: int,
    first: int,
    points: Points,
    light: Light,
    plan: Plan,
    origins: wp.array[wp.vec3],  # out
    directions: wp.array[wp.vec3],  # out
    t_max: wp.array[float],  # out
    values: wp.array[wp.vec3],  # out
):
    """First half of the estimator for a chunk of hits: shadow rays (``t_max`` < 0 where none is needed) and values."""
    j = start + wp.tid()
    i = first + j
    surface = make_surface(plan, points, i)
    count = plan.n_environment + plan.n_visible + plan.n_cosine
    for s in range(count):
        d = draw_sample(surface, plan, light, s)
        k = j * count + s
        t_max[k] = -1.0
        if d.factor > 0.0:
            t_max[k] = wp.inf
            origin, direction = shadow_ray(plan, points, i, surface.ng, d.direction)
            origins[k] = origin
            directions[k] = direction
            values[k] = sample_value(surface, plan, d, lookup_envmap_uv(light.radiance, d.uv))


@wp.kernel
def accumulate_kernel(
    start: int,
    first: int,
    hits: int,
    group: int,
    count: int,
    occluded16: wp.uint64,
    scene: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    values: wp.array[wp.vec3],
    t_max: wp.array[float],  # in and out
    out: wp.array[wp.vec3],  # out
    visible: wp.array2d[wp.int32],  # out
):
    """Second half: the sum of a hit's values whose shadow rays nothing stops; ``t_max`` of the others becomes -1.

    ``group`` hits of the chunk's ``hits`` a thread, whose rays fill Embree's packets together.
    """
    begin = (start + wp.tid()) * group
    end = wp.min(begin + group, hits)
    block_rays(occluded16, scene, origins, directions, begin * count, (end - begin) * count, t_max)
    for j in range(begin, end):
        total = wp.vec3(0.0, 0.0, 0.0)
        word = wp.int32(0)
        for s in range(count):
            k = j * count + s
            if t_max[k] >= 0.0:
                total = total + values[k]
                word = word | (1 << (s & 31))
            if (s & 31) == 31 or s == count - 1:
                if s // 32 < visible.shape[1]:
                    visible[first + j, s // 32] = word
                word = 0
        out[first + j] = total
