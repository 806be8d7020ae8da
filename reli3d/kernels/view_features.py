"""What posed images show of points: a few numbers a view, how much the view is to be believed, and their mean."""

import warp as wp

from reli3d.kernels.bilinear import between_pixels, blend
from reli3d.kernels.projection import project_point

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

HIDDEN_WEIGHT = wp.constant(0.02)  # share of a view that does not see the point: enough to speak where no view does
SHARE_MIN = wp.constant(1.0e-4)  # keeps the mean defined for a point outside every image
EDGE = wp.constant(0.01)  # of the image: colours closer than this to the silhouette mix with the background
EDGE_MIN = wp.constant(0.05)
OUTSIDE = wp.constant(0.15)  # silhouette distances beyond this share of the image say no more


@wp.func
def look_up(image: wp.array3d[wp.vec4], view: int, x: float, y: float) -> wp.vec4:
    """Bilinear value at pixel coordinates, the border's value outside."""
    at = between_pixels(x, y, image.shape[1], image.shape[2])
    i = int(at[0])
    j = int(at[1])
    return blend(image[view, j, i], image[view, j, i + 1], image[view, j + 1, i], image[view, j + 1, i + 1], at)


@wp.kernel
def view_summary_kernel(
    start: int,
    # in
    image: wp.array3d[wp.vec4],  # (V, S, S) sRGB and silhouette distance in pixels
    c2w: wp.array[wp.mat44],  # (V,)
    intrinsics: wp.array[wp.vec4],  # (V,)
    points: wp.array[wp.vec3],  # (N,)
    surface: int,  # whether the points lie on a surface, so that the next two hold something
    normal: wp.array[wp.vec3],  # (N,)
    visible: wp.array2d[float],  # (N, V)
    # out
    own: wp.array3d[float],  # (N, V, 9) colour, silhouette, depth, in the image, seen, facing, edge
    weight: wp.array2d[float],  # (N, V), sums to 1
    summary: wp.array2d[float],  # (N, 9) mean colour, its spread, least silhouette, greatest share, position
):
    n = start + wp.tid()
    p = points[n]
    size = float(image.shape[1])
    total = wp.float32(0.0)
    greatest = wp.float32(0.0)
    least = wp.float32(1.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    for v in range(image.shape[0]):
        pose = c2w[v]
        q = project_point(p, pose, intrinsics[v])
        value = look_up(image, v, q[0], q[1])
        eye = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3])
        axis = wp.vec3(pose[0, 2], pose[1, 2], pose[2, 2])
        inside = wp.float32(0.0)
        if q[0] > 0.0 and q[0] < size and q[1] > 0.0 and q[1] < size and q[2] > 0.0:
            inside = wp.float32(1.0)
        seen = wp.float32(0.0)
        facing = wp.float32(1.0)
        share = inside
        if surface != 0:
            seen = visible[n, v] * 2.0 - 1.0
            facing = wp.max(wp.dot(wp.normalize(eye - p), normal[n]), 0.0)
            share = inside * (HIDDEN_WEIGHT + visible[n, v] * facing * facing)
        edge = value[3] / (EDGE * size)
        share = share * wp.clamp(edge, EDGE_MIN, 1.0) + SHARE_MIN
        distance = wp.clamp(value[3] / size, -OUTSIDE, OUTSIDE) / OUTSIDE
        own[n, v, 0] = value[0]
        own[n, v, 1] = value[1]
        own[n, v, 2] = value[2]
        own[n, v, 3] = distance
        own[n, v, 4] = q[2] - wp.dot(eye, axis)  # the depth of the origin is 0
        own[n, v, 5] = inside
        own[n, v, 6] = seen
        own[n, v, 7] = facing
        own[n, v, 8] = wp.clamp(edge, -1.0, 1.0)
        weight[n, v] = share
        total += share
        greatest = wp.max(greatest, share)
        least = wp.min(least, distance)
        color += wp.vec3(value[0], value[1], value[2]) * share
    color /= total
    spread = wp.float32(0.0)
    for v in range(image.shape[0]):
        share = weight[n, v] / total
        weight[n, v] = share
        away = wp.vec3(own[n, v, 0], own[n, v, 1], own[n, v, 2]) - color
        spread += share * wp.dot(away, away)
    for k in range(3):
        summary[n, k] = color[k]
        summary[n, 6 + k] = p[k]
    summary[n, 3] = wp.sqrt(spread / 3.0)
    summary[n, 4] = least
    summary[n, 5] = greatest
