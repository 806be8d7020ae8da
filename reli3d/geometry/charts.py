"""Charts of a surface: regions that project onto a plane without overlap.  Numpy on the CPU, sequential steps in Warp.

A face takes the axis (of six) nearest to its smoothed normal; connected faces of one axis are a chart, projected along its
own mean normal.  Topology is that of the welded mesh (equal positions are one vertex); an edge with one face or more than
two is a border.  Every step costs a sort or less, so that the time is bounded by the number of faces and of overlaps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from reli3d import _bridge
from reli3d.kernels import uv as kernels

CPU = torch.device("cpu")
COS_LABEL = 0.4  # a face keeps an axis only up to 66 degrees from its normal: at most 2.5 times stretched
COS_MERGE = 0.25  # for charts of a few texels, where a border costs more than stretch
COS_TILT = 0.3  # a chart is projected along its mean normal if no face is seen more obliquely
SMOOTHING = 2  # rounds in which the normal takes up those of the neighbours
MAJORITY = 4  # rounds of the majority vote along label borders
ANGLES = 24  # directions in [0, 90) degrees tried for the smallest bounding box of a chart: within 2 degrees of it
SLACK = 2.0e-3  # texels: overlap below this width is rounding
PAIRS_MAX = 1 << 24  # overlapping pairs listed at once (64 MB); charts above are halved first
LABELS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], np.float64)


@dataclass
class Charts:
    """Chart number of every face (-1: no area, kept apart) and the corners in the plane of their chart."""

    chart: np.ndarray  # (F,) int32
    corners: np.ndarray  # (F, 3, 2) float32, expected texels, x right, y up, chart minimum 0; counter-clockwise
    neighbours: np.ndarray  # (F, 3) int32, face across the edge from corner k to k + 1, -1 at a border
    count: int


def group(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(order, first)``: stable order that sorts non-negative ``keys``, and where in it each run of equal keys begins."""
    n = len(keys)
    low = max(1, int(n - 1).bit_length())
    if n and int(keys.max()).bit_length() + low <= 63:  # a plain sort of key and index is 5 times faster than argsort
        packed = np.sort((keys.astype(np.int64) << low) | np.arange(n, dtype=np.int64))
        order, ordered = packed & ((1 << low) - 1), packed >> low
    else:
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]
    return order, np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]])) if n else np.zeros(0, np.int64)


def face_neighbours(faces: np.ndarray) -> np.ndarray:
    """Face across each edge, ``(F, 3)`` int32: -1 where the edge has not exactly two different faces."""
    ends = np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2).astype(np.int64)
    keys = ends.min(1) * (int(faces.max()) + 1) + ends.max(1)
    order, first = group(keys)
    size = np.diff(first, append=len(keys))
    pair = first[size == 2]
    a, b = order[pair], order[pair + 1]
    result = np.full(len(keys), -1, np.int32)
    apart = a // 3 != b // 3
    result[a[apart]], result[b[apart]] = b[apart] // 3, a[apart] // 3
    return result.reshape(-1, 3)


def components(neighbours: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, int]:
    """Connected faces of equal label, ``(F,)`` int32 numbered by their first face, and their number."""
    parent = torch.empty(len(labels), dtype=torch.int32)
    ins = (torch.from_numpy(neighbours), wp.int32), (torch.from_numpy(labels.astype(np.int32)), wp.int32)
    _bridge.launch(kernels.components_serial_kernel, 1, [*ins, len(labels), (parent, wp.int32)], CPU)
    root = parent.numpy()
    number = np.cumsum(root == np.arange(len(root)), dtype=np.int32) - 1
    return number[root], int(number[-1]) + 1


def axis_labels(normal: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Axis 0..5 (+x, +y, +z, -x, -y, -z) of every face; smooth borders.  ``normal``: (F, 3), length twice the area."""
    has = (neighbours >= 0)[..., None]
    smooth = normal
    for _ in range(SMOOTHING):
        smooth = smooth + np.where(has, smooth[neighbours], 0.0).sum(1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    unit = normal / np.maximum(length, 1e-300)
    cosine = np.concatenate([unit, -unit], 1)
    rows = np.arange(len(normal))
    label = np.argmax(np.concatenate([smooth, -smooth], 1), 1).astype(np.int32)
    label = np.where(cosine[rows, label] >= COS_LABEL, label, np.argmax(cosine, 1)).astype(np.int32)
    for _ in range(MAJORITY):
        a, b, c = np.where(neighbours >= 0, label[neighbours], -1).T
        vote = np.where((a == b) | (a == c), a, np.where(b == c, b, -1))
        flip = (vote >= 0) & (vote != label)
        flip[flip] = cosine[rows[flip], vote[flip]] >= COS_LABEL
        if not flip.any():
            break
        label = np.where(flip, vote, label).astype(np.int32)
    return label


def merge_small(label: np.ndarray, normal: np.ndarray, neighbours: np.ndarray, least: float) -> np.ndarray:
    """Labels in which charts with less area than ``least`` take the label of a neighbour that all their faces can bear.

    Of several such labels the one with the most common edges.  Three rounds, from neighbours that are not small.
    """
    area = np.linalg.norm(normal, axis=1) * 0.5
    unit = normal * (0.5 / np.maximum(area, 1e-300))[:, None]
    cosine = np.concatenate([unit, -unit], 1)
    for _ in range(3):
        chart, count = components(neighbours, label)
        small = np.bincount(chart, area, count) < least
        faces = np.flatnonzero(small[chart])
        if not len(faces):
            break
        worst = np.full((count, 6), 1.0)
        np.minimum.at(worst, chart[faces], cosine[faces])
        near = neighbours[faces]
        border = (near >= 0) & (label[near] != label[faces, None]) & ~small[chart[near]]
        votes = np.bincount(np.repeat(chart[faces], 3)[border.ravel()] * 6 + label[near][border], minlength=count * 6)
        votes = np.where(worst >= COS_MERGE, votes.reshape(count, 6), 0)
        taken = votes.max(1) > 0
        if not taken.any():
            break
        label = np.where(taken[chart], votes.argmax(1)[chart], label).astype(np.int32)
    return label


def _project(points: np.ndarray, normal: np.ndarray, label: np.ndarray, chart: np.ndarray, count: int) -> np.ndarray:
    """Corners ``(F, 3, 2)`` in the plane of their chart; area of a chart as on the surface."""
    toward = np.stack([np.bincount(chart, normal[:, k], count) for k in range(3)], 1)
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-300)
    length = np.linalg.norm(normal, axis=1)
    axis = np.zeros((count, 3))
    axis[chart] = LABELS[label]  # one label in a chart
    seen = np.einsum("fk,fk->f", normal, toward[chart])
    oblique = np.zeros(count, bool)
    oblique[chart[seen < COS_TILT * length]] = True
    toward = np.where(oblique[:, None], axis, toward)
    helper = LABELS[np.where(np.abs(toward[:, 1]) < 0.9, 1, 0)]  # world up on the page where there is one
    right = np.cross(helper, toward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    frame = np.stack([right, np.cross(toward, right)], 1)  # (N, 2, 3)
    corners = np.einsum("fij,fkj->fki", frame[chart], points)
    flat = np.bincount(chart, np.einsum("fk,fk->f", normal, toward[chart]), count)
    grow = np.sqrt(np.bincount(chart, length, count) / np.maximum(flat, 1e-300))
    return corners * np.minimum(grow, 2.0)[chart, None, None]


def _turn(corners: np.ndarray, chart: np.ndarray, outer: np.ndarray, count: int) -> np.ndarray:
    """Corners rotated per chart to the smallest bounding box, longer side upright, minimum at 0.

    ``outer``: (F,) faces at a border of their chart: they hold its extremes.
    """
    order, first = group(chart[outer].astype(np.int64))
    tips = corners[outer][order].reshape(-1, 2)  # three a face, grouped by chart
    start = first * 3
    best, angle, tall = np.full(count, np.inf), np.zeros(count), np.zeros(count, bool)
    for a in np.arange(ANGLES) * (np.pi / 2 / ANGLES):
        x = tips @ (np.cos(a), -np.sin(a))
        y = tips @ (np.sin(a), np.cos(a))
        w = np.maximum.reduceat(x, start) - np.minimum.reduceat(x, start)
        h = np.maximum.reduceat(y, start) - np.minimum.reduceat(y, start)
        better = w * h < best * (1 - 1e-6)  # the first of equals, whatever the rounding
        best, angle, tall = np.where(better, w * h, best), np.where(better, a, angle), np.where(better, h >= w, tall)
    angle = np.where(tall, angle, angle + np.pi / 2)
    cos, sin = np.cos(angle)[chart, None], np.sin(angle)[chart, None]
    turned = np.stack([corners[..., 0] * cos - corners[..., 1] * sin, corners[..., 0] * sin + corners[..., 1] * cos], -1)
    return shift_to_zero(turned, chart, count)


def shift_to_zero(corners: np.ndarray, chart: np.ndarray, count: int) -> np.ndarray:
    """Corners with the minimum of every chart at 0 on both axes."""
    order, first = group(chart.astype(np.int64))
    low = np.minimum.reduceat(corners.min(1)[order], first, axis=0)
    return corners - low[chart][:, None]


def height(corners: np.ndarray) -> np.ndarray:
    """Smallest height of every triangle ``(F, 3, 2)``, negative if it is clockwise."""
    e = np.roll(corners, -1, 1) - corners
    area2 = e[:, 0, 0] * e[:, 1, 1] - e[:, 0, 1] * e[:, 1, 0]
    return area2 / np.maximum(np.sqrt((e * e).sum(-1).max(1)), 1e-300)


def outer_faces(chart: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Faces, ``(F,)`` bool, with an edge on the border of their chart."""
    return ((neighbours < 0) | (chart[neighbours] != chart[:, None])).any(1)


def _split(charts: Charts) -> None:
    """Give the faces of charts that overlap themselves to new charts that do not, in place."""
    faces = len(charts.chart)
    chart = torch.from_numpy(charts.chart)
    corners = torch.from_numpy(charts.corners)
    z = chart.float()[:, None]
    lower = torch.cat([corners.amin(1), z], 1)
    upper = torch.cat([corners.amax(1), z], 1)
    _bridge.initialise()
    bvh = wp.Bvh(wp.from_torch(lower, wp.vec3), wp.from_torch(upper, wp.vec3))
    count = torch.zeros(faces, dtype=torch.int32)
    offset = torch.zeros(1, dtype=torch.int64)
    partner = torch.zeros(1, dtype=torch.int32)

    def find(emit):
        _bridge.launch(kernels.overlaps_kernel, faces, [bvh.id, (lower, wp.vec3), (upper, wp.vec3), (corners, wp.vec2),
                       (chart, wp.int32), SLACK, (offset, wp.int64), emit, (count, wp.int32), (partner, wp.int32)], CPU)  # fmt: skip

    find(0)
    while int(count.sum(dtype=torch.int64)) > PAIRS_MAX:  # a winding staircase: halve its charts along their faces' order
        over = np.unique(charts.chart[count.numpy() > 0])
        for c in over:
            members = np.flatnonzero(charts.chart == c)
            charts.chart[members[len(members) // 2 :]] = charts.count
            charts.count += 1
        find(0)
    if not bool(count.any()):
        return
    total = count.long()
    offset = torch.cumsum(total, 0) - total
    partner = torch.empty(int(total.sum()), dtype=torch.int32)
    find(1)
    bad = np.zeros(charts.count, bool)
    bad[charts.chart[count.numpy() > 0]] = True
    members = bad[charts.chart] & (charts.chart >= 0)
    owner = torch.from_numpy(np.where(members, -1, charts.chart).astype(np.int32))
    seeds = np.flatnonzero(members)
    seeds = seeds[np.lexsort((seeds, count.numpy()[seeds] > 0))].astype(np.int32)  # free faces first: they grow large charts
    _bridge.launch(kernels.split_serial_kernel, 1, [
        (torch.from_numpy(charts.neighbours), wp.int32), (chart, wp.int32), (torch.from_numpy(seeds), wp.int32),
        (offset, wp.int64), (count, wp.int32), (partner, wp.int32), charts.count,
        (torch.empty(3 * faces + 1, dtype=torch.int32), wp.int32), (owner, wp.int32)], CPU)  # fmt: skip
    used, number = np.unique(owner.numpy(), return_inverse=True)
    spare = int(used[0] < 0)
    charts.chart = (number.reshape(-1) - spare).astype(np.int32)
    charts.count = len(used) - spare


def make_charts(vertices: np.ndarray, faces: np.ndarray, *, texels: float, least_texels: float, sliver: float) -> Charts:
    """Charts of a welded mesh.

    vertices: ``(V, 3)`` float64.  faces: ``(F, 3)``.  texels: area to fill [texels], which sets the unit of ``corners``.
    least_texels: charts below this area are merged where possible.  sliver: height [texels] of a face that gets no chart.
    """
    points = vertices[faces]
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    area = 0.5 * np.linalg.norm(normal, axis=1).sum()
    unit = np.sqrt(texels / area) if area > 0 else 0.0
    points, normal = points * unit, normal * (unit * unit)
    neighbours = face_neighbours(faces)
    label = merge_small(axis_labels(normal, neighbours), normal, neighbours, least_texels)
    chart, count = components(neighbours, label)
    corners = _project(points, normal, label, chart, count)
    corners = _turn(corners, chart, outer_faces(chart, neighbours), count)
    chart = np.where(height(corners) > sliver, chart, -1).astype(np.int32)
    charts = Charts(chart, corners.astype(np.float32), neighbours, count)
    _split(charts)
    return charts
