"""UV atlases: charts by projection, packed with a guard band, or charts by xatlas in a separate process.

UV follow glTF: u right, v down, [0, 1].  Seen from outside, charts are not mirrored: in (u, 1 - v) every face is
counter-clockwise.  The atlas is computed on the CPU, and ``uv`` has no gradient.  The result's vertices and normals are
gathered from the input, and gradients pass through.
"""

import math
import os
import subprocess
import sys
import tempfile

import numpy as np
import torch
from torch import Tensor

from reli3d import _bridge
from reli3d.geometry import charts as parts
from reli3d.geometry.mesh import Mesh, vertex_normals, weld
from reli3d.geometry.topology import group
from reli3d.kernels import charts as kernels

FILL = 0.62  # expected fraction of the atlas covered by charts; sets only the length unit of the chart step
MAX_CHART_LENGTH = 1.0  # in sides of the atlas at the expected scale: longer charts are cut
MAX_PACKINGS = 10  # in the search for the scale, which also stops within 1 %
CELLS = 1024  # resolution of the packing: cells along the atlas
MAX_GUARD_RATIO = 3.0  # area of the boxes with guard band over without: above it the band is halved
SLIVER_PITCH, SLIVER_SIDE = 3.0, 2.0  # texels: a face without area gets a right triangle of this side
SLIVER_FRACTION = 0.1  # greatest fraction of the atlas for faces without area
XATLAS = """
import sys, numpy, xatlas
data = numpy.load(sys.argv[1])
atlas = xatlas.Atlas()
atlas.add_mesh(data["vertices"], data["faces"])
pack = xatlas.PackOptions()
pack.resolution, pack.padding, pack.bilinear = int(data["size"]), int(data["guard"]), True
atlas.generate(pack_options=pack)
source, faces, uv = atlas[0]
numpy.savez(sys.argv[2], source=source, faces=faces, uv=uv)
"""


def guard_band(texture_size: int) -> int:
    """Texels kept free between charts: 4 at 512 and 1024, more for larger textures, at least 2 for smaller ones."""
    return max(4, texture_size // 256) if texture_size >= 512 else max(2, texture_size // 128)


def _check(mesh: Mesh, texture_size: int) -> None:
    _bridge.expect("mesh", mesh, Mesh)
    if not isinstance(texture_size, int) or not 16 <= texture_size <= 16384:
        raise ValueError(f"texture_size: expected an integer in [16, 16384], got {texture_size!r}")
    if len(mesh.faces) == 0:
        raise ValueError("mesh.faces: expected at least one face, got 0")
    if not np.isfinite(mesh.vertices.detach().cpu().numpy()).all():
        raise ValueError("mesh.vertices: expected finite coordinates, got NaN or infinity")


def unwrap(mesh: Mesh, *, texture_size: int = 1024) -> Mesh:
    """Adds an atlas to a mesh: ``uv (V', 2)`` in [0, 1], u right, v down, without overlap.

    texture_size: 16 to 16384 texels per side; sets the gaps between charts, see
    :func:`~reli3d.geometry.uv.guard_band`.  Vertices are split at chart borders; faces keep their order, and each has
    positive UV area.  Normals are kept, or computed before the split: shading stays smooth across charts,
    and hard edges need separate vertices.  Any triangle mesh is accepted.  Deterministic.

    Gradients pass through vertices and normals; ``uv`` has none.  Raises TypeError for a wrong type; ValueError for no
    faces, non-finite vertices, or a texture size out of range or too small.

    >>> charted = reli3d.unwrap(mesh, texture_size=64)
    >>> maps = reli3d.bake(charted, 64, lambda position, normal: position.abs())
    """
    _check(mesh, texture_size)
    source_faces = mesh.faces.cpu().numpy()
    first, label = (t.cpu().numpy() for t in weld(mesh.vertices.detach()))
    points = mesh.vertices.detach().cpu().numpy()[first]
    guard = guard_band(texture_size)
    charts = parts.make_charts(
        points,
        label[source_faces].astype(np.int32),
        texels=FILL * texture_size**2,
        least_texels=9.0 * guard * guard,
        longest=MAX_CHART_LENGTH * texture_size,
        sliver=4.0e-6 * texture_size,
    )
    while (flat := _area(uv := _pack(charts, texture_size, guard)) <= 0.0).any():
        charts.chart[flat] = -1  # rounding to float32 took a face's area: it moves to the slivers
    return _joined(mesh, source_faces, charts, uv)


def _area(uv: np.ndarray) -> np.ndarray:
    """Area of the float32 triangles ``(F, 3, 2)`` of (u, v down), positive if they are not mirrored."""
    a, b, c = (uv[:, k].astype(np.float64) for k in range(3))
    return 0.5 * ((c - a)[:, 0] * (b - a)[:, 1] - (c - a)[:, 1] * (b - a)[:, 0])


def _joined(mesh: Mesh, faces: np.ndarray, charts: parts.Charts, uv: np.ndarray) -> Mesh:
    """Corners of one source vertex in one chart become one vertex; a sliver keeps its three for itself."""
    count = len(mesh.vertices)
    alone = charts.chart < 0
    corner_ids = charts.count + 3 * (np.cumsum(alone) - 1)[:, None] + np.arange(3)
    corner = (np.where(alone[:, None], corner_ids, charts.chart[:, None]).astype(np.int64) * count + faces).ravel()
    order, first = group(corner)
    rank = np.zeros(len(order), np.int64)
    rank[first[1:]] = 1
    vertex = np.empty(len(order), np.int32)
    vertex[order] = np.cumsum(rank)
    corners = order[first]
    return _split(mesh, faces.ravel()[corners], vertex.reshape(-1, 3), uv.reshape(-1, 2)[corners])


def _split(mesh: Mesh, source: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> Mesh:
    """``mesh`` with copies of its vertices ``source (V,)``, in ``faces (F, 3)``, at ``uv (V, 2)`` float32."""
    index, faces_on, uv_on = (
        torch.from_numpy(v).to(mesh.vertices.device) for v in (source.astype(np.int64), faces, uv)
    )
    normals = mesh.normals if mesh.normals is not None else vertex_normals(mesh.vertices, mesh.faces)
    return Mesh(
        vertices=mesh.vertices.index_select(0, index),  # a gradient that adds up in a fixed order
        faces=faces_on,
        normals=normals.index_select(0, index),
        colors=mesh.colors.index_select(0, index) if mesh.colors is not None else None,
        uv=uv_on,
    )


def _pack(charts: parts.Charts, size: int, guard: float) -> np.ndarray:
    """UV of the corners, ``(F, 3, 2)`` float32: all charts at one scale, the largest at which they fit."""
    uv = np.zeros((len(charts.chart), 3, 2))
    slivers = np.flatnonzero(charts.chart < 0)
    pitch = min(SLIVER_PITCH, size * np.sqrt(SLIVER_FRACTION / max(len(slivers), 1)))
    columns = int((size - 1) // pitch)
    if len(slivers):
        legs = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]) * (pitch * SLIVER_SIDE / SLIVER_PITCH)
        rank = np.arange(len(slivers))
        uv[slivers] = np.stack([rank % columns, rank // columns], -1)[:, None] * pitch + 0.5 + legs
    reserved = -(-len(slivers) // columns) * pitch + 0.5 if len(slivers) else 0.0
    normal = np.flatnonzero(charts.chart >= 0)
    if len(normal):
        uv[normal] = _place(charts, normal, size, guard, reserved)
    uv /= size
    uv[..., 1] = 1.0 - uv[..., 1]
    return uv.astype(np.float32)


def _place(charts: parts.Charts, faces: np.ndarray, size: int, guard: float, reserved: float) -> np.ndarray:
    """Corners of the ``faces`` that have a chart, in texels of the atlas, y up, above the ``reserved`` strip."""
    used = np.zeros(charts.count, bool)
    used[charts.chart[faces]] = True
    chart, count = (np.cumsum(used) - 1)[charts.chart[faces]], int(used.sum())
    face, corner = np.nonzero(parts.border_edges(charts.chart, charts.neighbors)[faces])
    order, start = group(chart[face])
    face, corner = face[order], corner[order]
    edges = np.stack([charts.corners[faces[face], corner], charts.corners[faces[face], (corner + 1) % 3]], 1)
    lowest = np.minimum.reduceat(edges.min(1), start, axis=0)
    edges -= lowest[chart[face]][:, None]
    edge_start = np.append(start, len(edges)).astype(np.int32)
    extent = np.maximum.reduceat(edges.max(1), start, axis=0).astype(np.float64)
    corners = charts.corners[faces].astype(np.float64) - lowest[chart][:, None]
    cell = max(1.0, size / CELLS)
    cells = int(size / cell)
    sequence = torch.from_numpy(np.lexsort((np.arange(count), -extent[:, 0], -extent[:, 1])).astype(np.int32))
    inputs = torch.from_numpy(edge_start), torch.from_numpy(edges)
    place, top_cell = (torch.empty(*shape, dtype=torch.int32, device="cpu") for shape in ((count, 4), (1,)))
    horizon = torch.empty(cells, dtype=torch.int32, device="cpu")
    strip = int(np.ceil((reserved + 0.5 * guard) / cell)) if reserved else 0

    def drop(scale: float, guard: float) -> int:
        margin = 0.5 * guard
        width = np.ceil((extent[:, 0] * scale + 2 * margin) / cell).astype(np.int64)
        if width.max() > cells:
            return 1 << 30
        column_start = np.concatenate([[0], np.cumsum(width)]).astype(np.int32)
        start = torch.from_numpy(column_start)
        bottom, top = torch.empty(2, int(column_start[-1]), dtype=torch.int32, device="cpu")
        args = [*inputs, start, scale / cell, margin / cell, bottom, top]
        _bridge.launch(kernels.outline_kernel, count, args, parts.CPU)
        args = [sequence, start, bottom, top, strip, horizon, place, top_cell]
        _bridge.launch(kernels.pack_serial_kernel, 1, args, parts.CPU)
        return int(top_cell)

    while True:
        best, best_place = 0.0, np.empty((0, 4), np.int32)
        low, high = 0.0, float(cells / max(extent.max() / cell, 1e-9))
        scale = min(1.0, 0.98 * high)
        for _ in range(MAX_PACKINGS):
            reached = drop(scale, guard)
            if reached <= cells:
                low, best, best_place = scale, scale, place.numpy().copy()
            else:
                high = scale
            if best and high < 1.01 * low:
                break
            ratio = math.sqrt(cells / reached) if reached < 1 << 30 else 0.5
            scale = scale * ratio
            if not low * 1.002 < scale < high * 0.998:
                scale = 0.5 * (low + high) if low else 0.7 * high
        if best and (
            (extent * best + guard).prod(1).sum() < MAX_GUARD_RATIO * (extent * best).prod(1).sum() or guard < 0.1
        ):
            break
        if not best and guard < 0.1:
            raise ValueError(f"texture_size: expected more texels for the {count} charts of the mesh, got {size}")
        guard *= 0.5  # too many charts: the guard band would take most of the atlas
    inside = corners * best + 0.5 * guard
    width = np.ceil((extent[:, 0] * best + guard) / cell)
    whole = np.stack([width, best_place[:, 3]], 1) * cell
    inside = np.where((best_place[:, 2] == 1)[chart][:, None, None], whole[chart][:, None] - inside, inside)
    return inside + (best_place[:, :2] * cell)[chart][:, None]


def unwrap_xatlas(mesh: Mesh, *, texture_size: int = 1024, timeout_s: float = 120.0) -> Mesh:
    """As :func:`unwrap`, with charts by xatlas (Young 2018), in a separate process, ended after ``timeout_s``.

    The time of xatlas grows with the square of the number of charts, and xatlas can crash.  Raises TimeoutError or
    RuntimeError in these cases instead of hanging.  Faces that xatlas cannot chart may overlap in UV.
    """
    _check(mesh, texture_size)
    with tempfile.TemporaryDirectory() as folder:
        job, result = os.path.join(folder, "job.npz"), os.path.join(folder, "result.npz")
        points = mesh.vertices.detach().cpu().numpy().astype(np.float64)
        size = float(np.ptp(points, axis=0).max()) or 1.0
        np.savez(
            job,
            vertices=((points - points.min(0)) / size).astype(np.float32),  # its thresholds are absolute
            faces=mesh.faces.cpu().numpy().astype(np.uint32),
            size=texture_size,
            guard=guard_band(texture_size),
        )
        try:
            done = subprocess.run([sys.executable, "-c", XATLAS, job, result], capture_output=True, timeout=timeout_s)
        except subprocess.TimeoutExpired:
            raise TimeoutError(
                f"unwrap_xatlas: no atlas of {len(mesh.faces)} faces in {timeout_s:g} s; use unwrap, or raise timeout_s"
            ) from None
        if done.returncode != 0:
            tail = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
            raise RuntimeError(f"unwrap_xatlas: xatlas ended with code {done.returncode} ({tail[0]}); use unwrap")
        with np.load(result) as data:
            source, faces, uv = data["source"], data["faces"], data["uv"]
    if not np.isfinite(uv).all():
        raise RuntimeError("unwrap_xatlas: expected finite texture coordinates, got NaN from xatlas; use unwrap")
    return _split(mesh, source, faces.astype(np.int32), uv.astype(np.float32))


def source_vertices(whole: Mesh, mesh: Mesh) -> Tensor:
    """Vertex of ``whole`` that :func:`unwrap` copied to each vertex of ``mesh``, ``(V,)`` int32.

    mesh: the unwrapped ``whole``.  Faces and their corners have the same order in both meshes; a vertex without a face
    gets 0.  Raises ValueError if the numbers of faces differ.
    """
    if whole.faces.shape != mesh.faces.shape:
        raise ValueError(f"mesh.faces: expected {len(whole.faces)} faces, got {len(mesh.faces)}")
    return mesh.faces.new_zeros(len(mesh.vertices)).index_put_((mesh.faces.long(),), whole.faces)
