"""Per-view features of points by lookup in posed images, blend weights of the views, and weighted means over them."""

import warp as wp

from reli3d.kernels.bilinear import between_pixels, look_up
from reli3d.kernels.projection import project_point

wp.set_module_options(
    # inlines functions of several kernels: calls take a third of the time
    {"enable_backward": False, "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=5000"}
)

vec8 = wp.types.vector(length=8, dtype=wp.float32)  # one AVX register
vec9 = wp.types.vector(length=9, dtype=wp.float32)

HIDDEN_WEIGHT = wp.constant(0.02)  # fallback weight of a view in which the point is occluded
MIN_WEIGHT = wp.constant(1.0e-4)  # keeps the mean defined for a point outside every image
EDGE_WIDTH = wp.constant(0.01)  # in image widths: colors closer to the silhouette may mix with the background
MIN_EDGE_WEIGHT = wp.constant(0.05)  # factor on the weight of pixels on and outside the silhouette
MAX_SILHOUETTE_DISTANCE = wp.constant(0.15)  # in image widths: silhouette distances are clamped to this
TANH_SATURATION = wp.constant(8.3)  # tanh is 1 to within 1.2e-7, a float32 rounding


@wp.struct
class Viewed:
    """Posed images and N query points; points of the volume have no normals and no visibility."""

    image: wp.array3d[wp.vec4]  # (V, S, S) sRGB and silhouette distance in pixels
    c2w: wp.array[wp.mat44]  # (V,)
    intrinsics: wp.array[wp.vec4]  # (V,)
    points: wp.array[wp.vec3]  # (N,)
    normal: wp.array[wp.vec3]  # (N,) or none
    visible: wp.array2d[float]  # (N, V) or none


@wp.func
def view_numbers(
    image: wp.array3d[wp.vec4],
    view: int,
    p: wp.vec3,
    q: wp.vec3,
    pose: wp.mat44,
    surface: int,
    visible: float,
    normal: wp.vec3,
):
    """Features of ``p`` in a view where it projects to pixel and depth ``q``, and the unnormalized weight of the view.

    The 9 features: color (3), silhouette distance, depth relative to the origin's, 1 inside the image else 0,
    visibility in [-1, 1], cosine between normal and view direction, distance to the silhouette edge.
    """
    size = float(image.shape[1])
    value = look_up(image, view, q[0], q[1])
    eye = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3])
    axis = wp.vec3(pose[0, 2], pose[1, 2], pose[2, 2])
    inside = wp.where(q[0] > 0.0 and q[0] < size and q[1] > 0.0 and q[1] < size and q[2] > 0.0, 1.0, 0.0)
    seen = wp.float32(0.0)
    facing = wp.float32(1.0)
    view_weight = inside
    if surface != 0:
        seen = visible * 2.0 - 1.0
        facing = wp.max(wp.dot(wp.normalize(eye - p), normal), 0.0)
        view_weight = inside * (HIDDEN_WEIGHT + visible * facing * facing)
    edge = value[3] / (EDGE_WIDTH * size)
    view_weight = view_weight * wp.clamp(edge, MIN_EDGE_WEIGHT, 1.0) + MIN_WEIGHT
    distance = wp.clamp(value[3] / size, -MAX_SILHOUETTE_DISTANCE, MAX_SILHOUETTE_DISTANCE) / MAX_SILHOUETTE_DISTANCE
    depth = q[2] - wp.dot(eye, axis)  # the depth of the origin is 0
    edge = wp.clamp(edge, -1.0, 1.0)
    return vec9(value[0], value[1], value[2], distance, depth, inside, seen, facing, edge), view_weight


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
__builtin_prefetch(wp::address(images, view, row, column));
#endif
""")
def prefetch(images: wp.array3d[wp.vec4], view: int, row: int, column: int): ...


@wp.func
def prefetch_views(viewed: Viewed, n: int, seen: bool):
    """Prefetches the pixels that point ``n`` reads, which halves the time on a CPU.  seen: of views that see it."""
    n = wp.min(n, viewed.points.shape[0] - 1)
    p = viewed.points[n]
    for v in range(viewed.image.shape[0]):
        if not seen or viewed.visible[n, v] > 0.0:
            q = project_point(p, viewed.c2w[v], viewed.intrinsics[v])
            at = between_pixels(q[0], q[1], viewed.image.shape[1], viewed.image.shape[2])
            prefetch(viewed.image, v, int(at[1]), int(at[0]))
            prefetch(viewed.image, v, int(at[1]) + 1, int(at[0]))


@wp.func
def surface_point(viewed: Viewed, n: int, view: int):
    """Visibility and normal of point ``n``, zeros for points in free space."""
    if viewed.normal.shape[0] == 0:
        return 0.0, wp.vec3()
    return viewed.visible[n, view], viewed.normal[n]


@wp.func
def write_summary(
    summary: wp.array2d[float], n: int, color: wp.vec3, spread: float, least: float, greatest: float, p: wp.vec3
):
    for k in range(3):
        summary[n, k] = color[k]
        summary[n, 6 + k] = p[k]
    summary[n, 3] = wp.sqrt(wp.max(spread, 0.0) / 3.0)
    summary[n, 4] = least
    summary[n, 5] = greatest


@wp.kernel
def view_summary_kernel(
    start: int,
    viewed: Viewed,
    numbers: wp.array3d[float],  # out: (N, V, 9) from view_numbers
    weight: wp.array2d[float],  # out: (N, V), sums to 1 over the views
    summary: wp.array2d[float],  # out: (N, 9) mean color, its deviation, min silhouette distance, max weight, position
):
    n = start + wp.tid()
    p = viewed.points[n]
    total = wp.float32(0.0)
    greatest = wp.float32(0.0)
    least = wp.float32(1.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    for v in range(viewed.image.shape[0]):
        pose = viewed.c2w[v]
        q = project_point(p, pose, viewed.intrinsics[v])
        seen, normal = surface_point(viewed, n, v)
        shown, view_weight = view_numbers(viewed.image, v, p, q, pose, viewed.normal.shape[0], seen, normal)
        for k in range(9):
            numbers[n, v, k] = shown[k]
        weight[n, v] = view_weight
        total += view_weight
        greatest = wp.max(greatest, view_weight)
        least = wp.min(least, shown[3])
        color += wp.vec3(shown[0], shown[1], shown[2]) * view_weight
    color /= total
    spread = wp.float32(0.0)
    for v in range(viewed.image.shape[0]):
        view_weight = weight[n, v] / total
        weight[n, v] = view_weight
        away = wp.vec3(numbers[n, v, 0], numbers[n, v, 1], numbers[n, v, 2]) - color
        spread += view_weight * wp.dot(away, away)
    write_summary(summary, n, color, spread, least, greatest, p)


@wp.func
def silu(x: vec8) -> vec8:
    """``x / (1 + exp(-x))`` with an error of at most 4e-7 ``max(1, |x|)``, vectorized.

    ``x / 2 * (1 + tanh(x / 2))`` with a rational minimax approximation of tanh, fitted here: relative error 3e-8.
    """
    h = x * 0.5
    t = wp.min(wp.max(h, vec8(-TANH_SATURATION)), vec8(TANH_SATURATION))
    s = wp.cw_mul(t, t)
    s2 = wp.cw_mul(s, s)  # Estrin's scheme, for instruction-level parallelism
    p = s * 2.17983091e-11 - vec8(1.41076348e-08)
    p = wp.cw_mul(p, s2) + (s * 9.6959887e-06 + vec8(0.00296681555))
    p = wp.cw_mul(p, s2) + (s * 0.129617891 + vec8(0.999999973))
    q = wp.cw_mul(s * 0.000234517062 + vec8(0.0239508373), s2) + (s * 0.462950982 + vec8(1.0))
    return h + wp.cw_mul(h, wp.cw_div(wp.cw_mul(t, p), q))


@wp.kernel
def pool_views_kernel(
    start: int,
    viewed: Viewed,
    tokens: wp.array4d[vec8],  # (V, P, P, B) tokens multiplied by the hidden layer's weight, plus its bias
    mix: wp.array2d[vec8],  # (9, B) the hidden layer's weight for the features of view_numbers
    pooled: wp.array2d[vec8],  # out: (N, B) weighted mean of the hidden layer over the views
    summary: wp.array2d[float],  # out: (N, 9) as in view_summary_kernel
):
    """Hidden layer of every view and its weighted mean in one pass, without per-view results in memory."""
    n = start + wp.tid()
    prefetch_views(viewed, n + 1, False)
    p = viewed.points[n]
    blocks = mix.shape[1]
    scale = float(tokens.shape[1]) / float(viewed.image.shape[1])
    total = wp.float32(0.0)
    greatest = wp.float32(0.0)
    least = wp.float32(1.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    spread = wp.float32(0.0)
    for b in range(blocks):
        pooled[n, b] = vec8()
    for v in range(viewed.image.shape[0]):
        pose = viewed.c2w[v]
        q = project_point(p, pose, viewed.intrinsics[v])
        seen, normal = surface_point(viewed, n, v)
        numbers, view_weight = view_numbers(viewed.image, v, p, q, pose, viewed.normal.shape[0], seen, normal)
        total += view_weight
        greatest = wp.max(greatest, view_weight)
        least = wp.min(least, numbers[3])
        away = wp.vec3(numbers[0], numbers[1], numbers[2]) - color
        color += away * (view_weight / total)  # Welford's update: one pass, no cancellation
        spread += view_weight * wp.dot(away, wp.vec3(numbers[0], numbers[1], numbers[2]) - color)
        at = between_pixels(q[0] * scale, q[1] * scale, tokens.shape[1], tokens.shape[2])
        i = int(at[0])
        j = int(at[1])
        w00 = (1.0 - at[2]) * (1.0 - at[3])  # kernels.bilinear.blend takes twice the time here
        w01 = at[2] * (1.0 - at[3])
        w10 = (1.0 - at[2]) * at[3]
        w11 = at[2] * at[3]
        for b in range(blocks):
            h = tokens[v, j, i, b] * w00 + tokens[v, j, i + 1, b] * w01
            h += tokens[v, j + 1, i, b] * w10 + tokens[v, j + 1, i + 1, b] * w11
            g = mix[0, b] * numbers[0] + mix[1, b] * numbers[1]
            h += mix[2, b] * numbers[2] + mix[3, b] * numbers[3]
            g += mix[4, b] * numbers[4] + mix[5, b] * numbers[5]
            h += mix[6, b] * numbers[6] + mix[7, b] * numbers[7]
            h += g + mix[8, b] * numbers[8]
            pooled[n, b] = pooled[n, b] + silu(h) * view_weight
    for b in range(blocks):
        pooled[n, b] = pooled[n, b] / total
    write_summary(summary, n, color, spread / total, least, greatest, p)


CONFIDENT_WEIGHT = wp.constant(0.25)  # if any view has this weight, views in which the point is occluded are skipped
LOGIT_MARGIN = wp.constant(0.02)  # as nn.heads.COLOR_MARGIN: keeps the logits of black and white finite


@wp.func
def color_logit(color: wp.vec4) -> wp.vec3:
    """Logit of the first three components, clamped to [LOGIT_MARGIN, 1 - LOGIT_MARGIN]."""
    value = wp.vec3()
    for k in range(3):
        x = wp.clamp(color[k], LOGIT_MARGIN, 1.0 - LOGIT_MARGIN)
        value[k] = wp.log(x / (1.0 - x))
    return value


@wp.func
def mix_four(images: wp.array3d[wp.vec4], view: int, i: int, j: int, weights: wp.vec4) -> wp.vec4:
    """Weighted sum of the pixels (j, i), (j, i + 1), (j + 1, i) and (j + 1, i + 1) of image ``view``."""
    upper = images[view, j, i] * weights[0] + images[view, j, i + 1] * weights[1]
    return upper + images[view, j + 1, i] * weights[2] + images[view, j + 1, i + 1] * weights[3]


@wp.kernel
def fuse_views_kernel(
    start: int,
    viewed: Viewed,  # surface points
    base: wp.array3d[wp.vec4],  # (V, P, P) gain of the mean color logit, shift of the logits
    rough_metal: wp.array3d[wp.vec4],  # (V, P, P) confidence, roughness, metallic, gain of the logits minus their mean
    normals: wp.array3d[wp.vec4],  # (V, P, P) normal; 0
    logit: wp.array[wp.vec3],  # out: (N,) of the base color
    numbers: wp.array2d[float],  # out: (N, 10) roughness, metallic, gain, normal - mesh normal (3), cosine, max weight,
    # confidence, spread
    shading: wp.array[wp.vec3],  # out: (N,) unit normal
):
    """Blends the views' predictions, weighted by view_weight**2 * exp(confidence).

    Views in which the point is occluded are skipped if another view has at least CONFIDENT_WEIGHT: at equal confidence
    they would have less than 1 % of its weight.
    """
    n = start + wp.tid()
    prefetch_views(viewed, n + 1, True)
    p = viewed.points[n]
    views = viewed.image.shape[0]
    scale = float(base.shape[1]) / float(viewed.image.shape[1])
    normal = viewed.normal[n]
    total = wp.float32(0.0)
    greatest = wp.float32(0.0)
    mean = wp.vec3()
    spread = wp.float32(0.0)
    gain = wp.float32(0.0)
    surface = wp.vec4()
    direction = wp.vec4()
    for k in range(2 * views):
        v = k % views
        visible = viewed.visible[n, v] > 0.0
        # views that see the point come first; the others are used only if none of those is confident
        if (k < views and visible) or (k >= views and not visible and greatest < CONFIDENT_WEIGHT):
            pose = viewed.c2w[v]
            q = project_point(p, pose, viewed.intrinsics[v])
            seen, view_weight = view_numbers(viewed.image, v, p, q, pose, 1, viewed.visible[n, v], normal)
            greatest = wp.max(greatest, view_weight)
            at = between_pixels(q[0] * scale, q[1] * scale, base.shape[1], base.shape[2])
            x = at[2]
            y = at[3]
            four = wp.vec4((1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y)  # as in pool_views_kernel
            base_of_view = mix_four(base, v, int(at[0]), int(at[1]), four)
            of_view = mix_four(rough_metal, v, int(at[0]), int(at[1]), four)
            weight = view_weight * view_weight * wp.exp(of_view[0])
            color = color_logit(wp.vec4(seen[0], seen[1], seen[2], 0.0))
            mean_logit = (color[0] + color[1] + color[2]) / 3.0
            gray = wp.vec3(mean_logit, mean_logit, mean_logit)
            color = (
                (color - gray) * of_view[3]
                + gray * base_of_view[0]
                + wp.vec3(base_of_view[1], base_of_view[2], base_of_view[3])
            )
            total += weight
            away = color - mean
            mean += away * (weight / total)  # Welford's update, as in pool_views_kernel
            spread += weight * wp.dot(away, color - mean)
            gain += weight * base_of_view[0]
            surface += of_view * weight
            direction += mix_four(normals, v, int(at[0]), int(at[1]), four) * weight
    unit = wp.vec3(direction[0], direction[1], direction[2]) / total + 1.0e-3 * normal
    unit = unit / wp.max(wp.length(unit), 1.0e-12)
    logit[n] = mean
    shading[n] = unit
    numbers[n, 0] = surface[1] / total
    numbers[n, 1] = surface[2] / total
    numbers[n, 2] = gain / total
    for k in range(3):
        numbers[n, 3 + k] = unit[k] - normal[k]
    numbers[n, 6] = wp.dot(unit, normal)
    numbers[n, 7] = greatest
    numbers[n, 8] = surface[0] / total
    numbers[n, 9] = wp.sqrt(wp.max(spread / total, 1.0e-6))
