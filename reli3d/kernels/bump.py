"""Bump-mapped normals in a tangent frame, and their encoding in a normal map."""

import warp as wp

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})

BUMP_EPS = wp.constant(1.0e-7)
ENCODE_EPS = wp.constant(1.0e-6)


@wp.func
def at_least(value: float, limit: float) -> float:
    """The larger one; NaN stays NaN, which ``wp.max`` does not promise."""
    result = value
    if value < limit:
        result = limit
    return result


@wp.func
def unit(v: wp.vec3, eps: float) -> wp.vec3:
    return v / at_least(wp.length(v), eps)


@wp.kernel
def radial_bump_kernel(
    start: int,
    # in
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    bump: wp.array[wp.vec3],
    # out
    out: wp.array[wp.vec3],
):
    i = start + wp.tid()
    p = position[i]
    n = normal[i]
    b = bump[i]
    tangent = unit(wp.cross(n, wp.cross(wp.vec3(p[2], 0.0, -p[0]), n)), BUMP_EPS)
    bitangent = unit(wp.cross(n, tangent), BUMP_EPS)
    out[i] = unit(tangent * b[0] + bitangent * b[1] + n * b[2], BUMP_EPS)


@wp.kernel
def encode_normals_kernel(
    start: int,
    # in
    world: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    tangent: wp.array[wp.vec4],
    # out
    out: wp.array[wp.vec3],
):
    i = start + wp.tid()
    w = world[i]
    n = normal[i]
    t = wp.vec3(tangent[i][0], tangent[i][1], tangent[i][2])
    b = wp.cross(n, t) * tangent[i][3]
    tt = wp.dot(t, t)
    tn = wp.dot(t, n)
    nn = wp.dot(n, n)
    wt = wp.dot(w, t)
    wn = wp.dot(w, n)
    determinant = at_least(tt * nn - tn * tn, ENCODE_EPS)
    x = (nn * wt - tn * wn) / determinant
    y = wp.dot(w, b) / at_least(wp.dot(b, b), ENCODE_EPS)
    z = (tt * wn - tn * wt) / determinant
    out[i] = unit(wp.vec3(x, y, at_least(z, 0.0)), ENCODE_EPS) * 0.5 + wp.vec3(0.5)
