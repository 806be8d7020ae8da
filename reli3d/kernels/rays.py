"""Rays against a triangle mesh: closest face, occlusion, origins that leave their own face.

``bary`` are the weights of vertices 1 and 2 of a face.  Warp's u and v are those of vertices 0 and 1: converted here
only.  A ray with a NaN, an infinity or no direction misses.  ``t`` is the ray parameter; the
direction is not normalized.  A hit at ``t_max`` counts as a miss.
"""

import warp as wp

from reli3d.kernels.math import INLINE, largest
from reli3d.kernels.projection import project_point

# with products and sums contracted, as CUDA does by default, Warp's test of a triangle leaks at edges
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "cpu_compiler_flags": "-march=native " + INLINE})

OFFSET = wp.constant(3.814697265625e-06)  # 2^-18: 64 ulp; interpolation errs by some 7 ulp of the largest coordinate
T_FAR = wp.constant(3.0e38)


@wp.func
def ray_is_valid(origin: wp.vec3, direction: wp.vec3) -> bool:
    """Whether all components are finite and the direction is not zero."""
    total = wp.abs(origin[0]) + wp.abs(origin[1]) + wp.abs(origin[2])
    return wp.isfinite(total) and wp.isfinite(direction) and largest(direction) > 0.0


@wp.func
def offset_origin(position: wp.vec3, ng: wp.vec3, direction: wp.vec3, scale: float) -> wp.vec3:
    """``position`` moved along the geometric normal to the side that ``direction`` leaves to.

    The step is ``OFFSET`` times the largest coordinate, or ``scale`` (that of the mesh) where it is larger, because the
    error of an interpolated position grows with the corners of its face and not with the position itself.
    """
    step = OFFSET * wp.max(largest(position), scale)
    if wp.dot(ng, direction) < 0.0:
        step = -step
    return position + ng * step


@wp.func
def hit_occluded(mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
    """Whether there is a hit at t in [0, t_max)."""
    return wp.mesh_query_ray_anyhit(mesh, origin, direction, wp.min(t_max, T_FAR))


@wp.kernel
def closest_kernel(
    start: int,
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    t_max: wp.array[float],
    face: wp.array[wp.int32],  # out
    t: wp.array[float],  # out
    bary: wp.array[wp.vec2],  # out
):
    i = start + wp.tid()
    o = origins[i]
    d = directions[i]
    face[i] = -1
    t[i] = wp.inf
    bary[i] = wp.vec2(0.0, 0.0)
    far = t_max[wp.min(i, t_max.shape[0] - 1)]
    if ray_is_valid(o, d) and far > 0.0:  # false for NaN
        hit = wp.mesh_query_ray(mesh, o, d, wp.min(far, T_FAR))
        if hit.result:
            face[i] = hit.face
            t[i] = hit.t
            bary[i] = wp.vec2(hit.v, 1.0 - hit.u - hit.v)


@wp.kernel
def occluded_kernel(
    start: int,
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    t_max: wp.array[float],
    occluded: wp.array[wp.bool],  # out
):
    i = start + wp.tid()
    o = origins[i]
    d = directions[i]
    occluded[i] = False
    far = t_max[wp.min(i, t_max.shape[0] - 1)]
    if ray_is_valid(o, d) and far > 0.0:  # false for NaN
        occluded[i] = hit_occluded(mesh, o, d, far)


@wp.kernel
def sight_kernel(
    start: int,
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    c2w: wp.array[wp.mat44],
    intrinsics: wp.array[wp.vec4],
    pair: wp.array[wp.int32],
    size: wp.vec2,
    grazing: float,
    scale: float,
    origin: wp.array[wp.vec3],  # out
    direction: wp.array[wp.vec3],  # out
    t_max: wp.array[float],  # out
):
    """Ray from a surface point to a camera; ``t_max`` is -1 if the point faces away or projects outside the image.

    pair: the ray is of camera ``pair // N`` and point ``pair % N``, so that neighbors go to one camera from about one
    place; without any, the ray's own number.
    """
    i = start + wp.tid()
    number = i
    if pair.shape[0] > 0:
        number = pair[i]
    point = number % position.shape[0]
    camera = number // position.shape[0]
    p = position[point]
    n = normal[point]
    pose = c2w[camera]
    away = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3]) - p
    distance = wp.length(away)
    toward = away / distance
    q = project_point(p, pose, intrinsics[camera])
    t_max[i] = -1.0
    if wp.dot(toward, n) > grazing and q[2] > 0.0 and q[0] > 0.0 and q[0] < size[0] and q[1] > 0.0 and q[1] < size[1]:
        t_max[i] = distance
    direction[i] = toward
    origin[i] = offset_origin(p, n, toward, scale)
