"""Silhouette edges of a mesh seen from a viewpoint, and the number of pixel lines that each of them crosses.

An edge is ``(a, b, c, d)``: its two ends and the vertices opposite to it in its two faces, ``d = -1`` if it has one
face.  It is a silhouette edge if both faces project to the same side of it, regardless of winding.  It is intersected
with pixel rows if its projection is steeper than 45 degrees, else with columns, so that no part counts twice.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

DEPTH_MIN = wp.constant(1.0e-6)  # nearer ends count as behind the eye; their pixel would be beyond any image


@wp.func
def side_of_edge(eye: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """Signed volume, whose sign is the side of ``c`` relative to the plane through the camera and the edge."""
    return wp.dot(wp.cross(a - eye, b - eye), c - a)


@wp.func
def pixel_of(frame: wp.mat33, eye: wp.vec3, intrinsics: wp.vec4, p: wp.vec3) -> wp.vec3:
    """Pixel coordinates and depth of a world point; rows of ``frame`` are the camera's axes."""
    q = frame * (p - eye)
    z = wp.max(-q[2], DEPTH_MIN)
    return wp.vec3(intrinsics[0] * q[0] / z + intrinsics[2], intrinsics[3] - intrinsics[1] * q[1] / z, -q[2])


@wp.func
def line_range(from_: float, to: float, size: int) -> wp.vec2i:
    """First pixel line with a center in [low, high) of the two coordinates, and the number of such lines."""
    low = wp.clamp(wp.min(from_, to) - 0.5, -1.0, float(size))
    high = wp.clamp(wp.max(from_, to) - 0.5, -1.0, float(size))
    first = wp.max(int(wp.ceil(low)), 0)
    last = wp.min(int(wp.ceil(high)), size)
    return wp.vec2i(first, wp.max(last - first, 0))


@wp.kernel
def outline_kernel(
    start: int,
    # in
    vertices: wp.array[wp.vec3],
    edges: wp.array2d[wp.int32],
    c2w: wp.mat44,
    intrinsics: wp.vec4,
    width: int,
    height: int,
    # out
    outward: wp.array[float],
    steep: wp.array[wp.bool],
    first: wp.array[wp.int32],
    count: wp.array[wp.int32],
):
    """``outward``: 1 where the surface ends towards larger x (steep) or y, else -1.  ``count``: 0 for no outline."""
    i = start + wp.tid()
    eye = wp.vec3(c2w[0, 3], c2w[1, 3], c2w[2, 3])
    frame = wp.mat33(c2w[0, 0], c2w[1, 0], c2w[2, 0], c2w[0, 1], c2w[1, 1], c2w[2, 1], c2w[0, 2], c2w[1, 2], c2w[2, 2])
    a = vertices[edges[i, 0]]
    b = vertices[edges[i, 1]]
    d = edges[i, 3]
    outward[i] = 1.0
    steep[i] = False
    first[i] = 0
    count[i] = 0
    s = side_of_edge(eye, a, b, vertices[edges[i, 2]])
    r = s
    if d >= 0:
        r = side_of_edge(eye, a, b, vertices[d])
    if s * r >= 0.0 and (s != 0.0 or r != 0.0):
        p = pixel_of(frame, eye, intrinsics, a)
        q = pixel_of(frame, eye, intrinsics, b)
        if p[2] > DEPTH_MIN and q[2] > DEPTH_MIN:
            span = line_range(p[0], q[0], width)
            towards = -wp.vec3(frame[1, 0], frame[1, 1], frame[1, 2])
            if wp.abs(q[1] - p[1]) > wp.abs(q[0] - p[0]):
                steep[i] = True
                span = line_range(p[1], q[1], height)
                towards = wp.vec3(frame[0, 0], frame[0, 1], frame[0, 2])
            if wp.dot(wp.cross(a - eye, b - eye), towards) * (s + r) > 0.0:  # s and r agree in sign
                outward[i] = -1.0
            first[i] = span[0]
            count[i] = span[1]
