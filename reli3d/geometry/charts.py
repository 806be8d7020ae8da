"""Charts of a surface: regions that project onto a plane without overlap.

A face takes the axis (of six) nearest to its smoothed normal.  Connected faces of one axis are a chart, projected along
its mean normal.  Topology is that of the welded mesh (equal positions are one vertex).  An edge with one face, or with
more than two, is a border.  Every step takes a sort or less, so the time is bounded by the number of faces and of
overlaps.  All runs on the CPU, in numpy but for the kernels' steps.
"""

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from reli3d import _bridge
from reli3d.geometry.topology import face_neighbors, graph_components, group
from reli3d.kernels import charts as kernels
from reli3d.kernels.cache import initialize

CPU = torch.device("cpu")
COS_LABEL = 0.4  # a face keeps an axis only up to 66 degrees from its normal: at most 2.5 times stretched
COS_MERGE = 0.25  # for charts of a few texels, where a border costs more than stretch
COS_TILT = 0.3  # a chart is projected along its mean normal if no face is seen more obliquely
NORMAL_ROUNDS = 2  # in which normals are averaged with those of neighbors
MAJORITY_ROUNDS = 4  # of the majority vote along label borders
MERGE_ROUNDS = 4  # in which small charts join their neighbors
CUT_ROUNDS = 4  # in which charts that fill their box poorly are cut in two
CUT_WASTE = 0.002  # of the atlas: empty area of a chart's box from which a cut is tried
CUT_FILL = 0.6  # of its box: a chart that covers more is left whole
CUT_GAIN = 0.85  # boxes of the two pieces over the box of the chart, at most ...
CUT_HOLLOW, CUT_HOLLOW_GAIN = 0.25, 1.02  # ... but a ring gains by the second cut only: no gain needed below this fill
CUT_ANGLES = 8  # directions in [0, 180) degrees of the cut, and of the boxes that judge it, as in kernels.charts
ANGLES = 24  # directions in [0, 90) degrees tried for the smallest bounding box of a chart: within 2 degrees of it
GROW_MAX = 2.0  # a chart seen obliquely is enlarged to its area on the surface, up to this factor
OVERLAP_TEXELS = 2.0e-3  # texels: overlap below this width is rounding
PAIRS_MAX = 1 << 24  # overlapping pairs listed at once (64 MB); charts above are halved first
AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], np.float64)


@dataclass
class Charts:
    """Chart number of every face (-1: no area, packed separately) and the corners in the plane of their chart."""

    chart: np.ndarray  # (F,) int32
    corners: np.ndarray  # (F, 3, 2) float32, expected texels, x right, y up; counter-clockwise
    neighbors: np.ndarray  # (F, 3) int32, face across the edge from corner k to k + 1, -1 at a border
    count: int


def components(neighbors: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, int]:
    """Connected faces of equal label, ``(F,)`` int32 numbered by their first face, and their number."""
    face, side = np.nonzero((neighbors >= 0) & (labels[neighbors] == labels[:, None]))
    root = graph_components(face, neighbors[face, side], len(labels))
    number = np.cumsum(root == np.arange(len(root)), dtype=np.int32) - 1
    return number[root], int(number[-1]) + 1


def outer_faces(chart: np.ndarray, neighbors: np.ndarray) -> np.ndarray:
    """Faces with an edge on the border of their chart, ascending."""
    return np.flatnonzero(border_edges(chart, neighbors).any(1))


def border_edges(chart: np.ndarray, neighbors: np.ndarray) -> np.ndarray:
    """Boundary edges of the charts, ``(F, 3)`` bool."""
    return (neighbors < 0) | (chart[neighbors] != chart[:, None])


def _ints(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.int32))


def _lengths(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("fk,fk->f", vectors, vectors))


def axis_labels(normal: np.ndarray, neighbors: np.ndarray) -> np.ndarray:
    """Axis 0..5 (as AXES) of every face, with smooth borders.  ``normal``: (F, 3), length twice the area."""
    rows, across = np.arange(len(normal)), neighbors >= 0
    smoothed = normal
    for _ in range(NORMAL_ROUNDS):
        smoothed = smoothed + np.einsum("fik,fi->fk", smoothed[neighbors], across)
    along = np.concatenate([normal, -normal], 1)
    fits = along >= COS_LABEL * _lengths(normal)[:, None]
    label = np.concatenate([smoothed, -smoothed], 1).argmax(1)
    label = np.where(fits[rows, label], label, along.argmax(1)).astype(np.int32)
    for _ in range(MAJORITY_ROUNDS):  # the label of two or three neighbors
        a, b, c = np.where(across, label[neighbors], -1).T
        winner = np.where((a == b) | (a == c), a, np.where(b == c, b, -1))
        label = np.where((winner >= 0) & fits[rows, winner], winner, label)
    return label


def merge_small(label: np.ndarray, normal: np.ndarray, neighbors: np.ndarray, least: float) -> np.ndarray:
    """Merges charts with less area than ``least`` into a neighbor into whose projection all their faces fit.

    Of several such neighbors the one with the most common edges is chosen; repeats while charts merge.
    """
    area = _lengths(normal) * 0.5
    for _ in range(MERGE_ROUNDS):
        chart, count = components(neighbors, label)
        total = np.bincount(chart, area, count)
        faces = np.flatnonzero((total < least)[chart])
        if not len(faces):
            break
        cosine = normal[faces] * (0.5 / np.maximum(area[faces], 1e-30))[:, None]
        worst = np.full((count, 6), 1.0)
        np.minimum.at(worst, chart[faces], np.concatenate([cosine, -cosine], 1))
        near = neighbors[faces]
        border = (near >= 0) & (label[near] != label[faces, None]) & (total[chart[near]] > total[chart[faces]][:, None])
        votes = np.bincount(np.repeat(chart[faces], 3)[border.ravel()] * 6 + label[near][border], minlength=count * 6)
        votes = np.where(worst >= COS_MERGE, votes.reshape(count, 6), 0)
        taken = votes.max(1) > 0
        if not taken.any():
            break
        label = np.where(taken[chart], votes.argmax(1)[chart], label).astype(np.int32)
    return label


def _frames(normal: np.ndarray, label: np.ndarray, chart: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Right and up vectors ``(N, 3)`` of the plane of each chart, with the factor that keeps its area."""
    total = np.stack([np.bincount(chart, normal[:, k], count) for k in range(3)], 1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    toward = total / np.maximum(length, 1e-300)
    size = _lengths(normal)
    oblique = np.zeros(count, bool)
    oblique[chart[np.einsum("fk,fk->f", normal, toward[chart]) < COS_TILT * size]] = True
    axis = np.zeros((count, 3))
    axis[chart] = AXES[label]  # one label in a chart
    toward = np.where(oblique[:, None] | (length < 1e-20), axis, toward)
    helper = AXES[np.where(np.abs(toward[:, 1]) < 0.9, 1, 0)]  # world up on the page where there is one
    right = np.cross(helper, toward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    seen = np.einsum("ck,ck->c", total, toward)
    area = np.bincount(chart, size, count)
    grow = np.minimum(np.sqrt(area / np.maximum(seen, 1e-300)), GROW_MAX)[:, None]
    return right * grow, np.cross(toward, right) * grow


def _upright(right: np.ndarray, up: np.ndarray, points: np.ndarray, chart: np.ndarray) -> tuple[np.ndarray, ...]:
    """Frames turned to the smallest box, longer side up, of ``points (P, 3)``, and minima ``(N, 2)``."""
    order, start = group(chart)
    points, chart = points[order], chart[order]
    x0, y0 = np.einsum("pk,pk->p", points, right[chart]), np.einsum("pk,pk->p", points, up[chart])
    count = len(right)
    best, angle, tall = np.full(count, np.inf), np.zeros(count), np.zeros(count, bool)
    for a in np.arange(ANGLES) * (np.pi / 2 / ANGLES):
        x, y = x0 * np.cos(a) - y0 * np.sin(a), x0 * np.sin(a) + y0 * np.cos(a)
        w = np.maximum.reduceat(x, start) - np.minimum.reduceat(x, start)
        h = np.maximum.reduceat(y, start) - np.minimum.reduceat(y, start)
        better = w * h < best * (1 - 1e-6)  # the first of equals, whatever the rounding
        best, angle, tall = np.where(better, w * h, best), np.where(better, a, angle), np.where(better, h >= w, tall)
    angle = np.where(tall, angle, angle + np.pi / 2)
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = x0 * cos[chart] - y0 * sin[chart], x0 * sin[chart] + y0 * cos[chart]
    low = np.stack([np.minimum.reduceat(x, start), np.minimum.reduceat(y, start)], 1)
    cos, sin = cos[:, None], sin[:, None]
    return right * cos - up * sin, right * sin + up * cos, low


def cuts(along: np.ndarray, begin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cuts across each direction, in the middle of a chart and at the mean of its points: their places and the area of
    the pieces' smallest boxes, both ``(C, CUT_ANGLES, 2)`` float64.

    along: ``(P, CUT_ANGLES)`` float64, points along the directions, one chart after the other.  begin: ``(C + 1,)``
    int32, where those of a chart begin.
    """
    at, area = torch.empty(2, len(begin) - 1, CUT_ANGLES, 2, dtype=torch.float64, device="cpu")
    ins = torch.from_numpy(along), torch.from_numpy(begin)
    _bridge.launch(kernels.cuts_kernel, area.numel(), [*ins, at, area], CPU, slice_min=CUT_ANGLES)
    return at.numpy(), area.numpy()


def _cut_bulky(
    points: np.ndarray,
    chart: np.ndarray,
    right: np.ndarray,
    up: np.ndarray,
    area: np.ndarray,
    waste: float,
    longest: float,
    neighbors: np.ndarray,
) -> tuple[np.ndarray, np.ndarray] | None:
    """``(chart, parent of each)``, cut in two where that saves ``waste`` [texels] or beyond ``longest``, or None."""
    outer = outer_faces(chart, neighbors)
    order, start = group(chart[outer])
    outer = outer[order]
    x, y = (np.einsum("pk,pk->p", points[outer], v[chart[outer]]) for v in (right, up))
    angles = np.arange(CUT_ANGLES) * (np.pi / CUT_ANGLES)
    turned = [x * np.cos(a) + y * np.sin(a) for a in angles]
    extent = np.stack([np.maximum.reduceat(v, start) - np.minimum.reduceat(v, start) for v in turned])
    box = (extent * np.roll(extent, CUT_ANGLES // 2, 0)).min(0)
    axis, long = extent.argmax(0), extent.max(0) > longest
    bulky = (box - area > waste) & (area < CUT_FILL * box) | long
    if not bulky.any():
        return None
    keep = bulky[chart[outer]]
    outer, turned = outer[keep], [v[keep] for v in turned]
    owner = (np.cumsum(bulky) - 1)[chart[outer]]
    count = int(bulky.sum())
    least = np.where(area < CUT_HOLLOW * box, CUT_HOLLOW_GAIN, CUT_GAIN) * box
    start = np.searchsorted(owner, np.arange(count + 1)).astype(np.int32)
    at, total = cuts(np.stack(turned, 1), start)
    best, best_angle, best_at = least[bulky], np.full(count, -1), np.zeros(count)
    axis = np.where(long, axis, -1)[bulky]
    for k, kind in np.ndindex(CUT_ANGLES, 2):
        boxed = np.where(axis < 0, total[:, k, kind], np.where(axis == k, 0.0, np.inf))
        better = boxed < best * (1 - 1e-6)
        best, best_angle, best_at = (
            np.where(better, new, old) for new, old in ((boxed, best), (k, best_angle), (at[:, k, kind], best_at))
        )
    cut = np.flatnonzero(bulky)[best_angle >= 0]
    if not len(cut):
        return None
    direction, threshold = np.zeros((len(area), 3)), np.full(len(area), np.inf)
    turn = angles[best_angle[best_angle >= 0]][:, None]
    direction[cut] = right[cut] * np.cos(turn) + up[cut] * np.sin(turn)
    threshold[cut] = best_at[best_angle >= 0]
    upper = np.einsum("fk,fk->f", points, direction[chart]) > threshold[chart]
    pieces, number = components(neighbors, 2 * chart + upper)
    parent = np.zeros(number, np.int64)
    parent[pieces] = chart
    return pieces, parent


def _overlaps(charts: Charts, boxes: np.ndarray, query: np.ndarray):
    """``find(emit, offset, partner)``: number of faces of ``boxes`` that overlap each of ``query``, ``(Q,)`` int32."""
    corners = torch.from_numpy(charts.corners)
    a, b, c = (charts.corners[boxes, k] for k in range(3))
    z = charts.chart[boxes].astype(np.float32)
    lower = torch.from_numpy(np.column_stack([np.minimum(np.minimum(a, b), c), z]))
    upper = torch.from_numpy(np.column_stack([np.maximum(np.maximum(a, b), c), z]))
    initialize()
    bvh = wp.Bvh(_bridge.array_of(lower, wp.vec3), _bridge.array_of(upper, wp.vec3))
    count = torch.zeros(len(query), dtype=torch.int32, device="cpu")
    none = torch.zeros(1, dtype=torch.int64, device="cpu"), torch.zeros(1, dtype=torch.int32, device="cpu")
    ins = _ints(boxes), _ints(query), corners

    def find(emit: int = 0, offset: torch.Tensor = none[0], partner: torch.Tensor = none[1]) -> torch.Tensor:
        _bridge.launch(kernels.overlaps_kernel, len(query), [bvh.id, *ins, _ints(charts.chart), OVERLAP_TEXELS,
                       offset, emit, count, partner], CPU)  # fmt: skip
        return count

    return find


def split_overlaps(charts: Charts) -> bool:
    """Moves faces of self-overlapping charts to new charts without overlap, in place; True if there were any.

    All faces of a chart face its plane.  So where two sheets overlap, the border of one of them is within the other: it
    suffices to test the faces at a border against all faces.
    """
    outer = outer_faces(charts.chart, charts.neighbors)
    outer = outer[charts.chart[outer] >= 0]
    everything = np.arange(len(charts.chart), dtype=np.int32)
    if not len(outer):
        return False
    over = _overlaps(charts, outer, everything)().numpy() > 0
    if not over.any():
        return False
    bad = np.zeros(charts.count, bool)
    bad[charts.chart[over]] = True
    members = np.flatnonzero((charts.chart >= 0) & bad[charts.chart])
    find = _overlaps(charts, members, members)
    count = find()
    while int(count.sum(dtype=torch.int64)) > PAIRS_MAX:  # a winding staircase: cut its charts in half, by face number
        for c in np.unique(charts.chart[members[count.numpy() > 0]]):
            part = np.flatnonzero(charts.chart == c)
            charts.chart[part[len(part) // 2 :]] = charts.count
            charts.count += 1
        count = find()
    offset = torch.cumsum(count.long(), 0) - count
    partner = torch.empty(max(int(count.sum(dtype=torch.int64)), 1), dtype=torch.int32, device="cpu")
    find(1, offset, partner)
    rank = np.full(len(everything), -1, np.int32)
    rank[members] = np.arange(len(members), dtype=np.int32)
    near = charts.neighbors[members]
    near = np.where(near >= 0, rank[near], -1)
    # faces without overlap first: they grow large charts
    seeds = np.lexsort((np.arange(len(members)), count.numpy() > 0))
    owner = torch.full((len(members),), -1, dtype=torch.int32, device="cpu")
    queue = torch.empty(3 * len(members) + 1, dtype=torch.int32, device="cpu")
    _bridge.launch(kernels.split_serial_kernel, 1, [
        _ints(near), _ints(charts.chart[members]), _ints(seeds), offset, count,
        _ints(rank[partner.numpy()]), charts.count, queue, owner], CPU)  # fmt: skip
    charts.chart[members] = owner.numpy()
    used, number = np.unique(charts.chart, return_inverse=True)
    spare = int(used[0] < 0)
    charts.chart = (number.reshape(-1) - spare).astype(np.int32)
    charts.count = len(used) - spare
    return True


def make_charts(
    points: np.ndarray, faces: np.ndarray, *, texels: float, least_texels: float, longest: float, sliver: float
) -> Charts:
    """Charts of a welded mesh.

    points: ``(V, 3)`` float32.  faces: ``(F, 3)`` int32.  texels: area to fill [texels]; it sets the unit of
    ``corners``.  least_texels: smaller charts are merged where possible.  longest: longer charts are cut [texels].
    sliver: height [texels] of a face without a chart.
    """
    center = 0.5 * (points.min(0).astype(np.float64) + points.max(0))
    reach = np.abs(points - center).max() or 1.0
    local = ((points - center) / reach).astype(np.float32)  # at most 1: products cannot overflow
    a, b, c = (local[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    size = 0.5 * np.sqrt(np.einsum("fk,fk->f", normal, normal, dtype=np.float64))
    area = float(size.sum())
    unit = np.sqrt(texels / area) if area > 1e-30 else 0.0
    local, size, normal = local * np.float32(unit), size * unit**2, normal * np.float32(unit * unit)
    neighbors = face_neighbors(faces)
    label = merge_small(axis_labels(normal, neighbors), normal, neighbors, least_texels)
    chart, count = components(neighbors, label)
    empty = np.bincount(chart, size, count) == 0.0
    neighbors = np.where(empty[chart][:, None], -1, neighbors)  # so that closed parts without area have a border
    right, up = _frames(normal, label, chart, count)
    centers = local[faces].mean(1).astype(np.float64)
    for _ in range(CUT_ROUNDS):
        cut = _cut_bulky(
            centers, chart, right, up, np.bincount(chart, size, count), CUT_WASTE * texels, longest, neighbors
        )
        if cut is None:
            break
        chart, parent = cut
        right, up, count = right[parent], up[parent], len(parent)
    outer = outer_faces(chart, neighbors)
    tips = local[faces[outer]].reshape(-1, 3).astype(np.float64)
    right, up, low = _upright(right, up, tips, np.repeat(chart[outer], 3))
    plane = np.stack([right, up], 2).astype(np.float32)[chart]
    corners = local[faces] @ plane - low.astype(np.float32)[chart][:, None]
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    longest = np.sqrt(np.maximum(np.maximum(ax**2 + ay**2, bx**2 + by**2), (bx - ax) ** 2 + (by - ay) ** 2))
    flat = ~(ax * by - ay * bx > sliver * longest)  # lower than ``sliver``, or turned over
    charts = Charts(np.where(flat, -1, chart).astype(np.int32), corners, neighbors, count)
    split_overlaps(charts)
    return charts
