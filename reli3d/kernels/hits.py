"""Values at known hits: vertex attributes, geometric normals and textures, all with gradients.

Normals and re-evaluated hits, and their adjoints, are computed in float64: differences of float32 positions cancel, and
gradients depend on the square of the result.

``bary`` are the weights of vertices 1 and 2 of a face.  Face -1 is a miss: value 0, no gradient.  Textures are bilinear
between texel centers at ((column + .5) / T, (row + .5) / T) and repeat in both axes (glTF's default wrap).
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": "-march=native"})

EDGE_ON = wp.constant(wp.float64(1.0e-6))  # sine of a ray to a face times that of its angle: below, a ray query cannot
AREA_TINY = wp.constant(wp.float64(1.0e-30))  # squared cross product of a face that has no normal
ONE = wp.constant(wp.float64(1.0))
HALF = wp.constant(wp.float64(0.5))


@wp.func
def wrap(k: int, size: int) -> int:
    """``k`` modulo ``size``, never negative."""
    return (k % size + size) % size


@wp.kernel
def interpolate_kernel(
    start: int,
    values: wp.array[Any],
    faces: wp.array2d[wp.int32],
    face: wp.array[wp.int32],
    bary: wp.array[wp.vec2],
    out: wp.array[Any],  # out
):
    i = start + wp.tid()
    f = face[i]
    if f >= 0:
        b = bary[i]
        out[i] = values[faces[f, 0]] * (1.0 - b[0] - b[1]) + values[faces[f, 1]] * b[0] + values[faces[f, 2]] * b[1]
    else:
        out[i] = out.dtype()


INTERPOLATE = {  # by the number of channels
    channels: wp.overload(interpolate_kernel, {"values": wp.array[kind], "out": wp.array[kind]})
    for channels, kind in ((2, wp.vec2), (3, wp.vec3), (4, wp.vec4))
}


@wp.kernel
def hit_normal_kernel(
    start: int,
    vertices: wp.array[wp.vec3],
    faces: wp.array2d[wp.int32],
    face: wp.array[wp.int32],
    out: wp.array[wp.vec3],  # out
):
    """Outward normal of a counter-clockwise face."""
    i = start + wp.tid()
    f = face[i]
    out[i] = wp.vec3(0.0, 0.0, 0.0)
    if f >= 0:
        a = wp.vec3d(vertices[faces[f, 0]])
        c = wp.cross(wp.vec3d(vertices[faces[f, 1]]) - a, wp.vec3d(vertices[faces[f, 2]]) - a)
        square = wp.dot(c, c)
        if square > AREA_TINY:
            out[i] = wp.vec3(c / wp.sqrt(square))


@wp.kernel
def reevaluate_kernel(
    start: int,
    vertices: wp.array[wp.vec3],
    faces: wp.array2d[wp.int32],
    face: wp.array[wp.int32],
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    hit_t: wp.array[float],
    hit_bary: wp.array[wp.vec2],
    t: wp.array[float],  # out
    bary: wp.array[wp.vec2],  # out
):
    """Ray against the plane of a known face.  Moller and Trumbore 1997, without their early exits.

    A miss, and a face seen edge-on, keep the values of the ray query, without gradient."""
    i = start + wp.tid()
    f = face[i]
    t[i] = hit_t[i]
    bary[i] = hit_bary[i]
    if f >= 0:
        a = wp.vec3d(vertices[faces[f, 0]])
        d = wp.vec3d(directions[i])
        e1 = wp.vec3d(vertices[faces[f, 1]]) - a
        e2 = wp.vec3d(vertices[faces[f, 2]]) - a
        s = wp.vec3d(origins[i]) - a
        p = wp.cross(d, e2)
        q = wp.cross(s, e1)
        det = wp.dot(e1, p)
        if wp.abs(det) > EDGE_ON * wp.length(e1) * wp.length(e2) * wp.length(d):
            inverse = ONE / det
            t[i] = wp.float32(wp.dot(e2, q) * inverse)
            bary[i] = wp.vec2(wp.float32(wp.dot(s, p) * inverse), wp.float32(wp.dot(d, q) * inverse))


@wp.kernel
def sample_texture_kernel(
    start: int,
    texture: wp.array2d[wp.vec3],
    uv: wp.array[wp.vec2],
    out: wp.array[wp.vec3],  # out
):
    i = start + wp.tid()
    height = texture.shape[0]
    width = texture.shape[1]
    x = wp.float64(uv[i][0]) * wp.float64(width) - HALF  # a place between texels has few digits left in float32
    y = wp.float64(uv[i][1]) * wp.float64(height) - HALF
    fx = wp.float32(x - wp.floor(x))
    fy = wp.float32(y - wp.floor(y))
    c0 = wrap(int(wp.floor(x)), width)
    r0 = wrap(int(wp.floor(y)), height)
    c1 = wrap(c0 + 1, width)
    r1 = wrap(r0 + 1, height)
    top = texture[r0, c0] * (1.0 - fx) + texture[r0, c1] * fx
    bottom = texture[r1, c0] * (1.0 - fx) + texture[r1, c1] * fx
    out[i] = top * (1.0 - fy) + bottom * fy
