"""Look-up of points in posed feature maps: pinhole projection and a bilinear gather, one thread a point and view.

Cameras are OpenGL (look along -Z, +Y up); pixel centers at +0.5; outside the image lookups clamp to the border.
"""

import warp as wp

from reli3d.kernels.bilinear import between_pixels, blend

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})

DEPTH_MIN = wp.constant(1.0e-9)  # a point closer than this to the camera plane is treated as being on it


@wp.func
def project_point(p: wp.vec3, c2w: wp.mat44, k: wp.vec4) -> wp.vec3:
    """Pixel x, y and depth of ``p``; the pixel of a point behind the camera is that of depth DEPTH_MIN."""
    d = wp.vec3(p[0] - c2w[0, 3], p[1] - c2w[1, 3], p[2] - c2w[2, 3])
    x = d[0] * c2w[0, 0] + d[1] * c2w[1, 0] + d[2] * c2w[2, 0]
    y = d[0] * c2w[0, 1] + d[1] * c2w[1, 1] + d[2] * c2w[2, 1]
    depth = -(d[0] * c2w[0, 2] + d[1] * c2w[1, 2] + d[2] * c2w[2, 2])
    z = wp.max(depth, DEPTH_MIN)
    return wp.vec3(k[0] * x / z + k[2], k[3] - k[1] * y / z, depth)


@wp.kernel
def gather_views_kernel(
    start: int,
    maps: wp.array4d[float],  # (V, H, W, C)
    points: wp.array[wp.vec3],  # (N,)
    c2w: wp.array[wp.mat44],  # (V,)
    intrinsics: wp.array[wp.vec4],  # (V,) in units of the maps' pixels
    features: wp.array3d[float],  # out: (N, V, C)
    pixels: wp.array2d[wp.vec3],  # out: (N, V)
):
    i = start + wp.tid()
    views = maps.shape[0]
    n = i // views
    v = i - n * views
    q = project_point(points[n], c2w[v], intrinsics[v])
    pixels[n, v] = q
    at = between_pixels(q[0], q[1], maps.shape[1], maps.shape[2])
    x = int(at[0])
    y = int(at[1])
    for c in range(maps.shape[3]):
        features[n, v, c] = blend(
            maps[v, y, x, c], maps[v, y, x + 1, c], maps[v, y + 1, x, c], maps[v, y + 1, x + 1, c], at
        )
