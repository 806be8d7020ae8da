"""Samples of the estimator of ``reli3d.kernels.shade`` with all strategies' densities, for choosing their counts."""

import warp as wp

from reli3d.kernels.bsdf import pdf_lobes
from reli3d.kernels.envmap import lookup_envmap_uv, pdf_envmap_uv
from reli3d.kernels.math import CONTRACT, INLINE
from reli3d.kernels.rays import offset_origin
from reli3d.kernels.shade import Light, Plan, Points, draw_sample, make_surface, sample_value

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": f"-march=native {INLINE} {CONTRACT}"})


@wp.kernel
def pilot_kernel(
    start: int,
    points: Points,
    light: Light,
    plan: Plan,
    origins: wp.array2d[wp.vec3],  # out
    directions: wp.array2d[wp.vec3],  # out
    values: wp.array2d[wp.vec3],  # out
    densities: wp.array2d[wp.vec3],  # out
):
    """Each sample's shadow ray, its value over q, and the densities of environment, visible normals and cosine over q.

    q is the sum of counts times densities of the plan, whose visible normals are not in pairs.  Values and densities
    are 0 for a sample below the horizon, whose ray is along the normal.
    """
    i = start + wp.tid()
    surface = make_surface(plan, points, i)
    count = plan.n_environment + plan.n_visible + plan.n_cosine
    for s in range(count):
        d = draw_sample(surface, plan, light, s)
        directions[i, s] = surface.ng
        values[i, s] = wp.vec3(0.0, 0.0, 0.0)
        densities[i, s] = wp.vec3(0.0, 0.0, 0.0)
        if d.factor > 0.0:
            lobes = pdf_lobes(d.facet, surface.wo, d.wi)
            directions[i, s] = d.direction
            values[i, s] = sample_value(surface, plan, d, lookup_envmap_uv(light.radiance, d.uv))
            densities[i, s] = wp.vec3(pdf_envmap_uv(light.density, d.uv), lobes[0], lobes[2]) * d.factor
        origins[i, s] = offset_origin(points.position[i], surface.ng, directions[i, s], plan.scale)
