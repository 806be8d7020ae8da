"""Rays through Embree's tree, called by address from CPU kernels; on CUDA they would do nothing.

``intersect1``, ``occluded1`` and ``occluded16`` are addresses of ``rtcIntersect1`` and so on, ``scene`` that of a
committed RTCScene (:mod:`reli3d.geometry.embree`).  Layouts of rays and hits: Embree 4 API reference, rtcore_ray.h; the
two words at the end of a hit are for instances, of which there are none.
"""

import warp as wp

from reli3d.kernels.math import INLINE, largest
from reli3d.kernels.rays import ray_is_valid

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native " + INLINE})

SHORT = wp.constant(2.0**-50)  # Embree takes components of a direction below 1e-18 for 0
GROUP = wp.constant(64)  # rays, of which some may not be valid, for four packets
RUN = wp.constant(4096)  # rays of a thread that finds keys
LENGTHEN = wp.constant(2.0**100)  # exact in float32, and brings a length of 2^-149 to 2^-50 near 1

RAY = """
#ifndef __CUDA_ARCH__
struct alignas(16) Ray {
    float org[3], tnear, dir[3], time, tfar;
    unsigned mask, id, flags;
};
Ray ray = {{o[0], o[1], o[2]}, 0.0f, {d[0], d[1], d[2]}, 0.0f, limit, ~0u, 0, 0};
"""


@wp.func_native(
    RAY
    + """
struct Hit {
    Ray ray;
    float normal[3], u, v;
    unsigned face, geometry, instance[2];
} hit = {ray, {}, 0.0f, 0.0f, ~0u, ~0u, {~0u, ~0u}};
((void (*)(void*, Hit*, void*))intersect1)((void*)scene, &hit, nullptr);
if (hit.geometry == ~0u) return -1;
t.data[i] = hit.ray.tfar;
bary.data[i] = wp::vec2(hit.u, hit.v);
return (int)hit.face;
#else
return -1;
#endif
"""
)
def first_hit(
    intersect1: wp.uint64,
    scene: wp.uint64,
    o: wp.vec3,
    d: wp.vec3,
    limit: float,
    i: int,
    t: wp.array[float],
    bary: wp.array[wp.vec2],
) -> int:
    """Nearest face at t in [0, limit], -1 for none; a hit's t and the weights of vertices 1 and 2 go to place ``i``."""
    ...


@wp.func_native(
    RAY
    + """
((void (*)(void*, Ray*, void*))occluded1)((void*)scene, &ray, nullptr);
return ray.tfar < 0.0f;
#else
return false;
#endif
"""
)
def any_hit(occluded1: wp.uint64, scene: wp.uint64, o: wp.vec3, d: wp.vec3, limit: float) -> bool:
    """Whether there is a hit at t in [0, limit]."""
    ...


@wp.func_native("""
#ifndef __CUDA_ARCH__
struct alignas(64) Rays {
    float org[3][16], tnear[16], dir[3][16], time[16], tfar[16];
    unsigned mask[16], id[16], flags[16];
} rays = {};
alignas(64) int valid[16];
int place[16];
for (int s = 0; s < 16; s++) rays.mask[s] = ~0u;
for (int k = first; k < first + count;) {
    int filled = 0;
    for (; k < first + count && filled < 16; k++)
        if (t_max.data[k] >= 0.0f) {
            for (int axis = 0; axis < 3; axis++) {
                rays.org[axis][filled] = origins.data[k][axis];
                rays.dir[axis][filled] = directions.data[k][axis];
            }
            rays.tfar[filled] = t_max.data[k];
            place[filled++] = k;
        }
    for (int s = 0; s < 16; s++) valid[s] = s < filled ? -1 : 0;
    ((void (*)(const int*, void*, Rays*, void*))occluded16)(valid, (void*)scene, &rays, nullptr);
    for (int s = 0; s < filled; s++)
        if (rays.tfar[s] < 0.0f) t_max.data[place[s]] = -1.0f;
}
#endif
""")
def block_rays(
    occluded16: wp.uint64,
    scene: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    first: int,
    count: int,
    t_max: wp.array[float],
):
    """Set ``t_max`` to -1 for those of ``count`` valid rays that meet anything before it; those below 0 are left out.

    In packets of 16, which pays for rays that leave from one place.
    """
    ...


@wp.func_native("""
#ifndef __CUDA_ARCH__
const float* o = origins.data[first].c;
const float* d = directions.data[first].c;
short* out = key.data + first;
const float low_x = low[0], low_y = low[1], low_z = low[2];
const float per_x = per_cell[0], per_y = per_cell[1], per_z = per_cell[2];
#pragma clang loop vectorize(enable)
for (int i = 0; i < count; i++) {
    float dx = d[3 * i], dy = d[3 * i + 1], dz = d[3 * i + 2];
    float ax = __builtin_fabsf(dx), ay = __builtin_fabsf(dy), reach = ax + ay + __builtin_fabsf(dz);
    float scale = 16.0f / (reach > 1e-37f ? reach : 1e-37f);
    float x = dx * scale, y = dy * scale;
    float folded_x = __builtin_copysignf(16.0f - ay * scale, x), folded_y = __builtin_copysignf(16.0f - ax * scale, y);
    x = (dz < 0.0f ? folded_x : x) + 16.0f;
    y = (dz < 0.0f ? folded_y : y) + 16.0f;
    x = x < 31.0f ? x : 31.0f;
    y = y < 31.0f ? y : 31.0f;
    int k = (int)x | ((int)y << 16);
    k = (k | (k << 4)) & 0x0F0F0F0F;
    k = (k | (k << 2)) & 0x33333333;
    k = (k | (k << 1)) & 0x55555555;
    k = (k & 0xFFFF) + 2 * (k >> 16);
    float cx = (o[3 * i] - low_x) * per_x, cy = (o[3 * i + 1] - low_y) * per_y, cz = (o[3 * i + 2] - low_z) * per_z;
    cx = cx > 0.0f ? cx : 0.0f;
    cy = cy > 0.0f ? cy : 0.0f;
    cz = cz > 0.0f ? cz : 0.0f;
    cx = cx < 3.0f ? cx : 3.0f;
    cy = cy < 3.0f ? cy : 3.0f;
    cz = cz < 3.0f ? cz : 3.0f;
    out[i] = (short)((((k * 4 + (int)cx) * 4 + (int)cy) * 4 + (int)cz) - 32768);
}
#endif
""")
def ray_keys(
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    low: wp.vec3,
    per_cell: wp.vec3,
    first: int,
    count: int,
    key: wp.array[wp.int16],
):
    """16-bit sort keys, equal for coherent rays: the direction's cell of 32 x 32 on an octahedron in Morton order
    (Morton 1966), then the origin's cell of 4 x 4 x 4 above ``low``.

    The compiler vectorizes the loop 16 wide: 3 instead of 23 ns per ray.
    """
    ...


@wp.func
def before(t_max: float) -> float:
    """The largest float below a positive one: Embree's limits are inclusive."""
    return wp.cast(wp.cast(t_max, int) - 1, float)


@wp.func
def stretch_of(direction: wp.vec3) -> float:
    """Factor on a direction before it is passed to Embree."""
    return wp.where(largest(direction) < SHORT, LENGTHEN, 1.0)


@wp.kernel
def embree_closest_kernel(
    start: int,
    intersect1: wp.uint64,
    scene: wp.uint64,
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
    far = t_max[wp.min(i, t_max.shape[0] - 1)]
    found = wp.int32(-1)
    if ray_is_valid(o, d) and far > 0.0:  # false for NaN
        stretch = stretch_of(d)
        found = first_hit(intersect1, scene, o, d * stretch, before(far) / stretch, i, t, bary)
        if found >= 0 and stretch != 1.0:
            t[i] = t[i] * stretch
    if found < 0:
        t[i] = wp.inf
        bary[i] = wp.vec2(0.0, 0.0)
    face[i] = found


@wp.kernel
def embree_occluded_kernel(
    start: int,
    occluded1: wp.uint64,
    scene: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    t_max: wp.array[float],
    occluded: wp.array[wp.bool],  # out
):
    i = start + wp.tid()
    o = origins[i]
    d = directions[i]
    far = t_max[wp.min(i, t_max.shape[0] - 1)]
    occluded[i] = False
    if ray_is_valid(o, d) and far > 0.0:  # false for NaN
        stretch = stretch_of(d)
        occluded[i] = any_hit(occluded1, scene, o, d * stretch, before(far) / stretch)


@wp.kernel
def embree_unoccluded_kernel(
    start: int,
    occluded16: wp.uint64,
    scene: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    t_max: wp.array[float],  # in and out
):
    """``t_max`` becomes -1 where anything is met up to it; :data:`GROUP` rays a thread."""
    first = (start + wp.tid()) * GROUP
    block_rays(occluded16, scene, origins, directions, first, wp.min(GROUP, t_max.shape[0] - first), t_max)


@wp.kernel
def ray_key_kernel(
    start: int,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    low: wp.vec3,
    per_cell: wp.vec3,
    key: wp.array[wp.int16],  # out
):
    """:data:`RUN` rays a thread."""
    first = (start + wp.tid()) * RUN
    ray_keys(origins, directions, low, per_cell, first, wp.min(RUN, key.shape[0] - first), key)
