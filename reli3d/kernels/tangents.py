"""Angle-weighted tangents at the corners of faces, in float64 because differences of float32 values cancel."""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

MIN_TANGENT_LENGTH = wp.constant(wp.float64(1.0e-12))  # as in geometry.tangents
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))


@wp.func
def unit(v: wp.vec3d) -> wp.vec3d:
    """``v`` normalized, 0 if it is shorter than MIN_TANGENT_LENGTH."""
    length = wp.length(v)
    if length > MIN_TANGENT_LENGTH:
        return v / length
    return wp.vec3d()


@wp.func
def flat(v: wp.vec3d, n: wp.vec3d) -> wp.vec3d:
    """``v`` projected onto the plane with unit normal ``n``."""
    return v - n * wp.dot(n, v)


@wp.kernel
def corner_tangents_kernel(
    start: int,
    # in
    vertices: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    uv: wp.array[wp.vec2],
    faces: wp.array2d[wp.int32],
    same: wp.array[wp.int32],
    # out
    tangent: wp.array2d[wp.vec4d],  # (3, F) unit direction of +u times the corner's angle; the angle
    side: wp.array2d[wp.int32],  # (3, F) ``same`` of the vertex, plus the number of vertices unless the face is plain
):
    f = start + wp.tid()
    a = uv[faces[f, 0]]
    b = uv[faces[f, 1]]
    c = uv[faces[f, 2]]
    s0 = wp.float64(b[0]) - wp.float64(a[0])
    s1 = wp.float64(b[1]) - wp.float64(a[1])
    t0 = wp.float64(c[0]) - wp.float64(a[0])
    t1 = wp.float64(c[1]) - wp.float64(a[1])
    area = s0 * t1 - s1 * t0  # negative unless mirrored, as v points down
    p = wp.vec3d(vertices[faces[f, 0]])
    q = wp.vec3d(vertices[faces[f, 1]])
    r = wp.vec3d(vertices[faces[f, 2]])
    sign = ONE
    if area < ZERO:
        sign = -ONE
    along_u = unit(((q - p) * t1 - (r - p) * s1) * sign)
    for k in range(3):
        vertex = faces[f, k]
        n = unit(wp.vec3d(normals[vertex]))
        here = wp.vec3d(vertices[vertex])
        e1 = unit(flat(wp.vec3d(vertices[faces[f, (k + 1) % 3]]) - here, n))
        e2 = unit(flat(wp.vec3d(vertices[faces[f, (k + 2) % 3]]) - here, n))
        angle = ZERO
        if area != ZERO:
            angle = wp.acos(wp.clamp(wp.dot(e1, e2), -ONE, ONE))
        d = unit(flat(along_u, n)) * angle
        tangent[k, f] = wp.vec4d(d[0], d[1], d[2], angle)
        if area < ZERO:
            side[k, f] = same[vertex]
        else:
            side[k, f] = same[vertex] + same.shape[0]
