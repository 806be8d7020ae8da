"""Soft visual hull: the least of a point's signed distances to the silhouettes of all views."""

import warp as wp

from reli3d.kernels.projection import NEAR, project_point

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

BEHIND = wp.constant(-1.0e3)  # distance given to a point behind a camera: further outside than any silhouette


@wp.kernel
def hull_distance_kernel(
    start: int,
    # in
    points: wp.array[wp.vec3],  # (N,)
    distance: wp.array3d[float],  # (V, H, W) pixels
    c2w: wp.array[wp.mat44],  # (V,)
    intrinsics: wp.array[wp.vec4],  # (V,)
    # out
    hull: wp.array[float],  # (N,)
):
    i = start + wp.tid()
    h = distance.shape[1]
    w = distance.shape[2]
    least = float(1.0e30)
    for v in range(distance.shape[0]):
        k = intrinsics[v]
        q = project_point(points[i], c2w[v], k)
        d = float(BEHIND)
        if q[2] > NEAR:
            x = wp.clamp(q[0] - 0.5, 0.0, float(w - 1))
            y = wp.clamp(q[1] - 0.5, 0.0, float(h - 1))
            x0 = wp.min(int(x), wp.max(w - 2, 0))
            y0 = wp.min(int(y), wp.max(h - 2, 0))
            x1 = wp.min(x0 + 1, w - 1)
            y1 = wp.min(y0 + 1, h - 1)
            fx = x - float(x0)
            fy = y - float(y0)
            top = distance[v, y0, x0] * (1.0 - fx) + distance[v, y0, x1] * fx
            bottom = distance[v, y1, x0] * (1.0 - fx) + distance[v, y1, x1] * fx
            d = (top * (1.0 - fy) + bottom * fy) * q[2] / wp.sqrt(k[0] * k[1])
        least = wp.min(least, d)
    hull[i] = least
