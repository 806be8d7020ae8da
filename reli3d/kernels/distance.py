"""Distance from points to a closed triangle mesh, signed: negative inside."""

import warp as wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": "-march=native"})

INTERIOR = wp.constant(1.0e-3)  # barycentric margin within which the nearest point counts as on an edge
SLIVER = wp.constant(1.0e-3)  # double area over squared longest side below which the normal of a face is not trusted


@wp.func
def signed_distance(mesh: wp.uint64, point: wp.vec3, reach: float) -> float:
    """Distance to the nearest face, negative inside; ``reach`` where none is nearer.

    Where the nearest point lies within a face the face's side is exact.  On an edge or a vertex the normals of the
    faces around may disagree: there the parity of the crossings of a skew ray decides.
    """
    query = wp.mesh_query_point_no_sign(mesh, point, reach)
    if not query.result:
        return reach
    u = query.u
    v = query.v
    away = point - wp.mesh_eval_position(mesh, query.face, u, v)
    distance = wp.length(away)
    a = wp.mesh_get_point(mesh, query.face * 3)
    b = wp.mesh_get_point(mesh, query.face * 3 + 1)
    c = wp.mesh_get_point(mesh, query.face * 3 + 2)
    n = wp.cross(b - a, c - a)
    side = wp.max(wp.length_sq(b - a), wp.max(wp.length_sq(c - a), wp.length_sq(c - b)))
    if wp.min(u, wp.min(v, 1.0 - u - v)) > INTERIOR and wp.length(n) > SLIVER * side:
        if wp.dot(away, n) < 0.0:
            distance = -distance
        return distance
    parity = wp.mesh_query_point_sign_parity(mesh, point, distance * 1.01 + 1.0e-6, 1, 0.1)
    if parity.result and parity.sign < 0.0:
        distance = -distance
    return distance


@wp.kernel
def signed_distance_kernel(
    start: int,
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    reach: float,
    distance: wp.array[float],  # out
):
    i = start + wp.tid()
    distance[i] = signed_distance(mesh, points[i], reach)
