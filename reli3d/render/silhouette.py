"""Silhouette antialiasing, differentiable in the vertices, for images sampled at pixel centers.

After Laine et al. 2020, Modular Primitives for High-Performance Differentiable Rendering, section 3.4: two neighboring
pixels are blended where a silhouette crosses the line between their centers.  Unlike there, all crossings of edges with
rows and columns of pixel centers are listed, and each is tested for visibility with a ray, so that edges of triangles
smaller than a pixel are found.

The sum over an antialiased mask has the exact derivative of the covered area.  Pixels crossed by a silhouette have a
mean absolute error of 0.01 to 0.03 of coverage; gradients of a sum of squared differences err by about 10 %.
"""

import numpy as np
import torch
from torch import Tensor

from reli3d._bridge import check, full_precision
from reli3d.geometry.camera import Camera, project
from reli3d.geometry.mesh import check_topology, weld
from reli3d.geometry.rays import RayScene
from reli3d.geometry.topology import edges_of

DEPTH_MIN = 1e-6  # nearer ends count as behind the eye; their pixel would be beyond any image
RAY_OFFSET_PIXELS = 0.01  # pixels from the edge to the visibility ray, so that it does not graze the edge's own faces
IN_FRONT = 1e-3  # fraction of the distance by which an occluder must be nearer; above float32 rounding at folds


def mesh_edges(vertices: Tensor, faces: Tensor) -> Tensor:
    """Edges ``(E, 4)`` int32: two end vertices, then the opposite vertices of the two faces, -1 for a missing face.

    vertices: ``(V, 3)`` float32.  faces: ``(F, 3)`` int32.  Vertices at identical positions (split by an atlas) are
    merged: the first is listed and receives the gradient.  An edge with three or more faces is listed once per face.
    """
    check_topology(vertices, faces)
    if faces.numel() == 0:
        return faces.new_empty(0, 4)
    first, label = weld(vertices)
    corners = first[label[faces.long()]]
    corners = corners[(corners != corners.roll(1, 1)).all(1)]  # a face that welding closes has no edge to show
    edges = edges_of(corners.cpu().numpy())
    opposite = corners[:, [2, 0, 1]].reshape(-1).cpu().numpy()  # of each half-edge
    both = edges.of_valence(2)
    alone = edges.order[np.repeat(edges.valence != 2, edges.valence)]
    lead, second = np.concatenate([both[0], alone]), np.concatenate([opposite[both[1]], np.full(len(alone), -1)])
    tail, head = edges.tail[lead], edges.head[lead]
    rows = np.stack([np.minimum(tail, head), np.maximum(tail, head), opposite[lead], second], 1)
    return torch.from_numpy(rows.astype(np.int32)).to(faces.device)


@full_precision
def antialias(
    image: Tensor,
    vertices: Tensor,
    faces: Tensor,
    camera: Camera,
    scene: RayScene | None = None,
    *,
    edges: Tensor | None = None,
) -> Tensor:
    """Antialiases the silhouettes of a mesh in ``image (H, W, C)``, differentiably in the vertices.

    image: float32, sampled at the pixel centers, for instance shaded first hits or a mask.  vertices: ``(V, 3)``
    float32.  faces: ``(F, 3)`` int32.  camera: a single one of the image's size.  scene: occluders, None: the mesh.
    edges: from :func:`reli3d.render.silhouette.mesh_edges`, for reuse.

    Gradients reach image, vertices and camera, bitwise reproducibly.  Texture edges and intersections of faces are not
    handled.  Raises TypeError for a wrong dtype, ValueError for a wrong shape or size, or a face index out of range.
    Source: Laine et al. 2020, section 3.4.

    >>> mask = reli3d.RayScene(mesh).intersect(*reli3d.camera_rays(camera)).valid[..., None].float()
    >>> smooth = reli3d.antialias(mask, mesh.vertices, mesh.faces, camera)
    """
    check("vertices", vertices, last=3)
    check("image", image, like=vertices)
    if camera.c2w.ndim != 2:
        raise ValueError(f"camera.c2w: expected one camera (4, 4), got {tuple(camera.c2w.shape)}")
    if image.ndim != 3 or image.shape[:2] != (camera.height, camera.width):
        raise ValueError(f"image: expected ({camera.height}, {camera.width}, C), got {tuple(image.shape)}")
    edges = mesh_edges(vertices, faces) if edges is None else edges
    check("edges", edges, shape=("E", 4), like=vertices, dtype=torch.int32)
    if edges.numel() and not -1 <= int(edges.min()) <= int(edges.max()) < len(vertices):
        raise ValueError(f"edges: expected (E, 4) indices below {len(vertices)}, got others")
    scene = RayScene(vertices, faces) if scene is None else scene
    if scene.device != vertices.device:
        raise ValueError(f"scene: expected device {vertices.device}, got {scene.device}")
    return _blended(image, *_crossings(vertices, edges, camera, scene))


def _crossings(vertices: Tensor, edges: Tensor, camera: Camera, scene: RayScene) -> tuple[Tensor, Tensor, Tensor]:
    """Crossings of visible silhouettes with the lines between neighboring pixel centers; M pairs of neighbors.

    Returns the pixel index (row * W + column) on the surface side and on the other side, ``(M,)`` int64, and the
    distance ``(M,)`` in [0, 1] from the inner center to the crossing in pixels, whose gradients reach the vertices and
    the camera.  Edges with an end behind the camera are omitted.  Of several crossings of a pair in the same direction,
    the outermost is kept.
    """
    edge, line, steep, outward = _lines(vertices, edges, camera)
    ends = [vertices.index_select(0, k) for k in edges.long()[edge, :2].unbind(1)]
    (a, za), (b, zb) = (project(p, camera.c2w, camera.intrinsics) for p in ends)
    a, b = (torch.where(steep[:, None], p.flip(1), p) for p in (a, b))  # the coordinate that runs over lines first
    center = line.to(vertices.dtype) + 0.5
    part = (center - a[:, 0]) / (b[:, 0] - a[:, 0])
    across = a[:, 1] + part * (b[:, 1] - a[:, 1])
    low = torch.floor(across.detach() - 0.5)
    size = torch.where(steep, camera.width, camera.height)
    inner_at = torch.where(outward > 0.0, low, low + 1.0)
    place = (across - inner_at - 0.5) * outward
    keep = (low >= 0.0) & (low < size - 1)
    depth = 1.0 / ((1.0 - part) / za + part / zb)
    offset = torch.stack([center, across + RAY_OFFSET_PIXELS * outward], 1).detach()
    keep &= _seen(torch.where(steep[:, None], offset.flip(1), offset), depth.detach(), camera, scene)
    stride = torch.where(steep, 1, camera.width)
    inner = torch.where(steep, line * camera.width + inner_at.long(), inner_at.long() * camera.width + line)
    outer = inner + stride * outward.long()
    chosen = _outermost(keep, inner * 4 + 2 * steep + (outward > 0.0), place.detach(), 4 * camera.width * camera.height)
    return inner[chosen], outer[chosen], place.index_select(0, chosen)


def _blended(image: Tensor, inner: Tensor, outer: Tensor, place: Tensor) -> Tensor:
    """``image (H, W, C)`` with the pixels of each crossing blended according to the position of the silhouette.

    Of each pair, the pixel that the silhouette crosses changes.  The blends of several pairs add up; weights are scaled
    down where their sum exceeds 1, so values stay between those of the neighbors.
    """
    flat = image.reshape(-1, image.shape[2])
    grows = place.detach() > 0.5  # the surface spills into the outer pixel
    into, other = torch.where(grows, outer, inner), torch.where(grows, inner, outer)
    weight = (place - 0.5).abs()
    total = weight.new_zeros(len(flat)).index_add(0, into, weight).clamp(min=1.0)
    contrast = flat.index_select(0, other) - flat.index_select(0, into)
    return flat.index_add(0, into, (weight / total.index_select(0, into))[:, None] * contrast).reshape(image.shape)


def _lines(vertices: Tensor, edges: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Edge, pixel line, steepness and direction away from the surface (1 or -1) of every crossing, each ``(M,)``.

    An edge is a silhouette edge if both faces project to the same side of it, regardless of winding.  It is crossed
    with pixel rows if its projection is steeper than 45 degrees, else with columns, so that no part counts twice.
    """
    camera, ends = camera.detach(), edges.long()
    a, b, c, d = (vertices.detach()[k] for k in (*ends[:, :3].unbind(1), ends[:, 3].clamp(min=0)))
    normal = torch.linalg.cross(a - camera.position, b - camera.position)  # of the plane through the eye and the edge
    s = (normal * (c - a)).sum(-1)
    r = torch.where(ends[:, 3] >= 0, (normal * (d - a)).sum(-1), s)
    (p, zp), (q, zq) = (project(end, camera.c2w, camera.intrinsics) for end in (a, b))
    steep = (q - p)[:, 1].abs() > (q - p)[:, 0].abs()
    ends_along = torch.where(steep, torch.stack([p[:, 1], q[:, 1]]), torch.stack([p[:, 0], q[:, 0]]))
    low, high = torch.aminmax(ends_along, dim=0)
    size = torch.where(steep, camera.height, camera.width).to(low)
    outline = (s * r >= 0.0) & ((s != 0.0) | (r != 0.0)) & (zp > DEPTH_MIN) & (zq > DEPTH_MIN)
    # lines with a center in [low, high)
    first, last = (torch.where(outline, (v - 0.5).ceil().clamp(min=0.0).minimum(size), 0.0).long() for v in (low, high))
    right, up, _ = camera.c2w[:3, :3].unbind(1)
    towards = torch.where(steep[:, None], right, -up)  # larger x or y of the image
    outward = torch.where((normal * towards).sum(-1) * (s + r) > 0.0, -1.0, 1.0).to(vertices)
    count = last - first
    edge = torch.repeat_interleave(count)
    before = (count.cumsum(0) - count)[edge]
    line = first[edge] + torch.arange(len(edge), device=edge.device, dtype=torch.int64) - before
    return edge, line, steep[edge], outward[edge]


def _seen(pixels: Tensor, depth: Tensor, camera: Camera, scene: RayScene) -> Tensor:
    """Whether nothing occludes ``depth (M,)`` at ``pixels (M, 2)``."""
    fx, fy, cx, cy = camera.intrinsics.detach().unbind(-1)
    local = torch.stack([(pixels[:, 0] - cx) / fx, (cy - pixels[:, 1]) / fy, -torch.ones_like(depth)], -1)
    directions = local @ camera.c2w.detach()[:3, :3].T  # of depth 1: the ray's t is the depth
    return ~scene.occluded(camera.position.detach(), directions, t_max=depth * (1.0 - IN_FRONT))


def _outermost(keep: Tensor, key: Tensor, place: Tensor, keys: int) -> Tensor:
    """Rows that hold the largest ``place`` of their ``key`` among those to ``keep``, the first of equals; sorted."""
    rows = torch.nonzero(keep)[:, 0]
    key, place = key[rows], place[rows]
    best = place.new_full((keys,), -1.0).scatter_reduce(0, key, place, "amax")
    rows, key = rows[place == best[key]], key[place == best[key]]
    first = torch.full((keys,), len(keep), device=key.device, dtype=torch.int64).scatter_reduce(0, key, rows, "amin")
    return rows[rows == first[key]]
