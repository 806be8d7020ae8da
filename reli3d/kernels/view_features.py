"""What posed images show of points: a few numbers a view, how much the view is to be believed, and their mean."""

import warp as wp

from reli3d.kernels.bilinear import between_pixels, look_up
from reli3d.kernels.projection import project_point

wp.set_module_options(
    # functions that several kernels call: a call takes a third of the time
    {"enable_backward": False, "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=5000"}
)

vec8 = wp.types.vector(length=8, dtype=wp.float32)  # one AVX register
vec9 = wp.types.vector(length=9, dtype=wp.float32)

HIDDEN_WEIGHT = wp.constant(0.02)  # share of a view that does not see the point: enough to speak where no view does
SHARE_MIN = wp.constant(1.0e-4)  # keeps the mean defined for a point outside every image
EDGE = wp.constant(0.01)  # of the image: colours closer than this to the silhouette mix with the background
EDGE_MIN = wp.constant(0.05)
OUTSIDE = wp.constant(0.15)  # silhouette distances beyond this share of the image say no more
TANH_FLAT = wp.constant(8.3)  # where tanh is 1 but for 1.2e-7, a float32 rounding


@wp.struct
class Viewed:
    """Posed images, and N points that are looked up in them; points in space have no normals and no visibility."""

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
    """What a view says of ``p``, which it has at pixel and depth ``q``: colour, silhouette, depth, in the image, seen,
    facing, edge; and its share before the views' shares are made to sum to 1.
    """
    size = float(image.shape[1])
    value = look_up(image, view, q[0], q[1])
    eye = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3])
    axis = wp.vec3(pose[0, 2], pose[1, 2], pose[2, 2])
    inside = wp.float32(0.0)
    if q[0] > 0.0 and q[0] < size and q[1] > 0.0 and q[1] < size and q[2] > 0.0:
        inside = wp.float32(1.0)
    seen = wp.float32(0.0)
    facing = wp.float32(1.0)
    share = inside
    if surface != 0:
        seen = visible * 2.0 - 1.0
        facing = wp.max(wp.dot(wp.normalize(eye - p), normal), 0.0)
        share = inside * (HIDDEN_WEIGHT + visible * facing * facing)
    edge = value[3] / (EDGE * size)
    share = share * wp.clamp(edge, EDGE_MIN, 1.0) + SHARE_MIN
    distance = wp.clamp(value[3] / size, -OUTSIDE, OUTSIDE) / OUTSIDE
    depth = q[2] - wp.dot(eye, axis)  # the depth of the origin is 0
    edge = wp.clamp(edge, -1.0, 1.0)
    return vec9(value[0], value[1], value[2], distance, depth, inside, seen, facing, edge), share


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
__builtin_prefetch(wp::address(images, view, row, column));
#endif
""")
def prefetch(images: wp.array3d[wp.vec4], view: int, row: int, column: int): ...


@wp.func
def prefetch_views(viewed: Viewed, n: int, seen: bool):
    """Has the CPU fetch what point ``n`` will look up: without it half of the time is waiting.  seen: where seen."""
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
    """Visibility and normal of point ``n``; of no meaning for a point in space."""
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
    # in
    viewed: Viewed,
    # out
    numbers: wp.array3d[float],  # (N, V, 9) as view_numbers has them
    weight: wp.array2d[float],  # (N, V), sums to 1
    summary: wp.array2d[float],  # (N, 9) mean colour, its spread, least silhouette, greatest share, position
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
        shown, share = view_numbers(viewed.image, v, p, q, pose, viewed.normal.shape[0], seen, normal)
        for k in range(9):
            numbers[n, v, k] = shown[k]
        weight[n, v] = share
        total += share
        greatest = wp.max(greatest, share)
        least = wp.min(least, shown[3])
        color += wp.vec3(shown[0], shown[1], shown[2]) * share
    color /= total
    spread = wp.float32(0.0)
    for v in range(viewed.image.shape[0]):
        share = weight[n, v] / total
        weight[n, v] = share
        away = wp.vec3(numbers[n, v, 0], numbers[n, v, 1], numbers[n, v, 2]) - color
        spread += share * wp.dot(away, away)
    write_summary(summary, n, color, spread, least, greatest, p)


@wp.func
def silu(x: vec8) -> vec8:
    """``x / (1 + exp(-x))`` to 4e-7 of ``max(1, |x|)``, in operations on whole registers.

    ``x / 2 * (1 + tanh(x / 2))`` with a rational minimax fit of tanh, made for this file: relative error 3e-8.
    """
    h = x * 0.5
    t = wp.min(wp.max(h, vec8(-TANH_FLAT)), vec8(TANH_FLAT))
    s = wp.cw_mul(t, t)
    s2 = wp.cw_mul(s, s)  # Estrin's scheme: the pairs do not wait for each other
    p = s * 2.17983091e-11 - vec8(1.41076348e-08)
    p = wp.cw_mul(p, s2) + (s * 9.6959887e-06 + vec8(0.00296681555))
    p = wp.cw_mul(p, s2) + (s * 0.129617891 + vec8(0.999999973))
    q = wp.cw_mul(s * 0.000234517062 + vec8(0.0239508373), s2) + (s * 0.462950982 + vec8(1.0))
    return h + wp.cw_mul(h, wp.cw_div(wp.cw_mul(t, p), q))


@wp.kernel
def pool_views_kernel(
    start: int,
    # in
    viewed: Viewed,
    tokens: wp.array4d[vec8],  # (V, P, P, B) what the hidden layer makes of a token, with its bias
    mix: wp.array2d[vec8],  # (9, B) what it makes of the numbers of view_numbers
    # out
    pooled: wp.array2d[vec8],  # (N, B) mean over the views of the hidden layer
    summary: wp.array2d[float],  # (N, 9) as of view_summary_kernel
):
    """The hidden layer of every view and its mean in one pass: nothing a view is written to memory."""
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
        numbers, share = view_numbers(viewed.image, v, p, q, pose, viewed.normal.shape[0], seen, normal)
        total += share
        greatest = wp.max(greatest, share)
        least = wp.min(least, numbers[3])
        away = wp.vec3(numbers[0], numbers[1], numbers[2]) - color
        color += away * (share / total)  # Welford's update: no cancellation, no second look at the views
        spread += share * wp.dot(away, wp.vec3(numbers[0], numbers[1], numbers[2]) - color)
        at = between_pixels(q[0] * scale, q[1] * scale, tokens.shape[1], tokens.shape[2])
        i = int(at[0])
        j = int(at[1])
        w00 = (1.0 - at[2]) * (1.0 - at[3])  # four products a block; kernels.bilinear.blend takes twice the time here
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
            pooled[n, b] = pooled[n, b] + silu(h) * share
    for b in range(blocks):
        pooled[n, b] = pooled[n, b] / total
    write_summary(summary, n, color, spread / total, least, greatest, p)


@wp.kernel
def spread_views_kernel(
    start: int,
    # in
    viewed: Viewed,
    tokens: wp.array4d[vec8],  # (V, P, P, 4) what the hidden layer makes of a token, with its bias
    mix: wp.array2d[vec8],  # (9, 4) what it makes of the numbers of view_numbers
    last: wp.array2d[vec8],  # (32, 3) the layer after it
    bias: wp.array[vec8],  # (3,) of that layer
    # out
    pooled: wp.array2d[vec8],  # (N, 6) mean over the views of the last layer, and their mean square difference to it
    summary: wp.array2d[float],  # (N, 9) as of view_summary_kernel
):
    """Both layers of every view, and mean and spread of the second, in one pass.

    The first is that of pool_views_kernel, written out again: with a function that both call they take 1.3 and 1.7
    times as long on a Xeon with AMX.
    """
    n = start + wp.tid()
    prefetch_views(viewed, n + 1, False)
    p = viewed.points[n]
    scale = float(tokens.shape[1]) / float(viewed.image.shape[1])
    total = wp.float32(0.0)
    greatest = wp.float32(0.0)
    least = wp.float32(1.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    spread = wp.float32(0.0)
    mean0 = vec8()
    mean1 = vec8()
    mean2 = vec8()
    apart0 = vec8()
    apart1 = vec8()
    apart2 = vec8()
    for v in range(viewed.image.shape[0]):
        pose = viewed.c2w[v]
        q = project_point(p, pose, viewed.intrinsics[v])
        seen, normal = surface_point(viewed, n, v)
        numbers, share = view_numbers(viewed.image, v, p, q, pose, viewed.normal.shape[0], seen, normal)
        total += share
        greatest = wp.max(greatest, share)
        least = wp.min(least, numbers[3])
        away = wp.vec3(numbers[0], numbers[1], numbers[2]) - color
        color += away * (share / total)
        spread += share * wp.dot(away, wp.vec3(numbers[0], numbers[1], numbers[2]) - color)
        at = between_pixels(q[0] * scale, q[1] * scale, tokens.shape[1], tokens.shape[2])
        i = int(at[0])
        j = int(at[1])
        w00 = (1.0 - at[2]) * (1.0 - at[3])
        w01 = at[2] * (1.0 - at[3])
        w10 = (1.0 - at[2]) * at[3]
        w11 = at[2] * at[3]
        out0 = bias[0]
        out1 = bias[1]
        out2 = bias[2]
        for b in range(mix.shape[1]):
            h = tokens[v, j, i, b] * w00 + tokens[v, j, i + 1, b] * w01
            h += tokens[v, j + 1, i, b] * w10 + tokens[v, j + 1, i + 1, b] * w11
            for k in range(9):
                h += mix[k, b] * numbers[k]
            h = silu(h)
            for k in range(8):
                row = 8 * b + k
                out0 += last[row, 0] * h[k]
                out1 += last[row, 1] * h[k]
                out2 += last[row, 2] * h[k]
        part = share / total
        d0 = out0 - mean0
        d1 = out1 - mean1
        d2 = out2 - mean2
        mean0 += d0 * part
        mean1 += d1 * part
        mean2 += d2 * part
        apart0 += wp.cw_mul(d0, out0 - mean0) * share
        apart1 += wp.cw_mul(d1, out1 - mean1) * share
        apart2 += wp.cw_mul(d2, out2 - mean2) * share
    pooled[n, 0] = mean0
    pooled[n, 1] = mean1
    pooled[n, 2] = mean2
    pooled[n, 3] = apart0 / total
    pooled[n, 4] = apart1 / total
    pooled[n, 5] = apart2 / total
    write_summary(summary, n, color, spread / total, least, greatest, p)


CONFIDENT_WEIGHT = wp.constant(0.25)  # share of a view that needs no help from views that do not see the point
LOGIT_MARGIN = wp.constant(0.02)  # as nn.heads.COLOR_MARGIN: the logit of black and of white stays within reach


@wp.func
def color_logit(color: wp.vec4) -> wp.vec3:
    """Logit of the first three numbers, kept within reach."""
    value = wp.vec3()
    for k in range(3):
        x = wp.clamp(color[k], LOGIT_MARGIN, 1.0 - LOGIT_MARGIN)
        value[k] = wp.log(x / (1.0 - x))
    return value


@wp.func
def mix_four(images: wp.array3d[wp.vec4], view: int, i: int, j: int, share: wp.vec4) -> wp.vec4:
    """Pixels (j, i) and right, below and both of image ``view``, times their shares."""
    upper = images[view, j, i] * share[0] + images[view, j, i + 1] * share[1]
    return upper + images[view, j + 1, i] * share[2] + images[view, j + 1, i + 1] * share[3]


@wp.kernel
def fuse_views_kernel(
    start: int,
    # in
    viewed: Viewed,  # points of surfaces
    paint: wp.array3d[wp.vec4],  # (V, P, P) gain of the mean logit of the colour, shift of its logits
    rough_metal: wp.array3d[wp.vec4],  # (V, P, P) confidence, roughness, metallic, gain of the logits less their mean
    bent: wp.array3d[wp.vec4],  # (V, P, P) normal; 0
    # out
    logit: wp.array[wp.vec3],  # (N,)
    numbers: wp.array2d[float],  # (N, 10): roughness, metallic, gain, bend, facing, greatest share, confidence, spread
    shading: wp.array[wp.vec3],  # (N,) unit
):
    """Means over the views of what they predict, weighted by the square of their share times exp(confidence).

    A view that does not see the point is left out where another has at least CONFIDENT_WEIGHT: it would have less than
    1 % of that view's weight, at equal confidence.
    """
    n = start + wp.tid()
    prefetch_views(viewed, n + 1, True)
    p = viewed.points[n]
    views = viewed.image.shape[0]
    scale = float(paint.shape[1]) / float(viewed.image.shape[1])
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
        sees = viewed.visible[n, v] > 0.0
        # views that see the point come first; the others speak where none of those is sure
        if (k < views and sees) or (k >= views and not sees and greatest < CONFIDENT_WEIGHT):
            pose = viewed.c2w[v]
            q = project_point(p, pose, viewed.intrinsics[v])
            seen, share = view_numbers(viewed.image, v, p, q, pose, 1, viewed.visible[n, v], normal)
            greatest = wp.max(greatest, share)
            at = between_pixels(q[0] * scale, q[1] * scale, paint.shape[1], paint.shape[2])
            x = at[2]
            y = at[3]
            four = wp.vec4((1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y)  # as in pool_views_kernel
            change = mix_four(paint, v, int(at[0]), int(at[1]), four)
            of_view = mix_four(rough_metal, v, int(at[0]), int(at[1]), four)
            weight = share * share * wp.exp(of_view[0])
            color = color_logit(wp.vec4(seen[0], seen[1], seen[2], 0.0))
            level = (color[0] + color[1] + color[2]) / 3.0
            grey = wp.vec3(level, level, level)
            color = (color - grey) * of_view[3] + grey * change[0] + wp.vec3(change[1], change[2], change[3])
            total += weight
            away = color - mean
            mean += away * (weight / total)  # Welford's update, as in pool_views_kernel
            spread += weight * wp.dot(away, color - mean)
            gain += weight * change[0]
            surface += of_view * weight
            direction += mix_four(bent, v, int(at[0]), int(at[1]), four) * weight
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
