"""Baking: evaluates a function of surface points at the texels of an atlas, and fills all other texels.

Maps are ``(T, T, C)``; row 0 is v = 0 (glTF: v down).  Texel (row, column) is sampled at its center ((column + 0.5) /
T, (row + 0.5) / T).  No gradients.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag, normalize

from reli3d import _bridge
from reli3d._bridge import check, expect, struct_of
from reli3d.geometry.mesh import Mesh, vertex_normals
from reli3d.geometry.topology import edges_of
from reli3d.kernels import bake as kernels

BORDER_TEXELS = 1.5  # texels: a bilinear tap of a point of the surface has its center within sqrt(2)
TILE_TEXELS = {"cpu": 16, "cuda": 4}  # side of a thread's tile in texels: large amortizes setup, small fills a GPU
STRIP = 64  # columns a thread sweeps in the column pass: one cache line of the mask
ROWS_MIN = 16  # rows of texels a CPU slice of the row pass
TILES_MIN = 16  # tiles a CPU slice: each of them walks its list of faces for 256 texels


@dataclass(frozen=True)
class Texels:
    """Result of :func:`rasterize_texels`."""

    face: Tensor  # (T, T) int32, -1 where no surface is near
    bary: Tensor  # (T, T, 2) weights of vertices 1 and 2
    inside: Tensor  # (T, T) bool: the center is in the face; other texels of a face have its nearest border point

    @property
    def valid(self) -> Tensor:
        """``(T, T)`` bool: texels that have a face."""
        return self.face >= 0


def _corners(mesh: Mesh, size: int) -> Tensor:
    """Corners of the faces in texels, ``(F, 3, 2)``, checked."""
    expect("mesh", mesh, Mesh)
    if mesh.uv is None:
        raise ValueError("mesh.uv: expected UV coordinates, got None (see unwrap)")
    if not isinstance(size, int) or not 1 <= size <= 16384:
        raise ValueError(f"size: expected an integer in [1, 16384], got {size!r}")
    uv = mesh.uv.detach()
    if len(uv) and not bool((uv.abs() <= 64.0).all()):  # NaN fails too
        raise ValueError("mesh.uv: expected finite values within [-64, 64], got others")
    return (uv * size)[mesh.faces.long()].contiguous()


def _bins(lower: Tensor, upper: Tensor, size: int, tile: int) -> tuple[Tensor, Tensor]:
    """``(start (tiles + 1,), items)`` int32: the boxes that touch each tile, in ascending order."""
    tiles = -(-size // tile)
    first = (lower / tile).floor().clamp(0, tiles).to(torch.int64)
    last = (upper / tile).floor().clamp(-1, tiles - 1).to(torch.int64)
    extent = (last - first + 1).clamp(min=0)
    count = extent[:, 0] * extent[:, 1]
    item = torch.repeat_interleave(count)
    local = torch.arange(len(item), device=item.device, dtype=torch.int64) - (torch.cumsum(count, 0) - count)[item]
    wide = extent[:, 0][item]
    tile_of = (first[:, 1][item] + local // wide) * tiles + first[:, 0][item] + local % wide
    keys, boxes = tile_of * len(lower) + item, max(len(lower), 1)
    # numpy's vector sort is 5 times faster than torch's, which carries indices
    order = torch.sort(keys).values if keys.is_cuda else torch.from_numpy(np.sort(keys.numpy()))
    edges = torch.arange(tiles * tiles + 1, device=item.device, dtype=torch.int64) * boxes
    return torch.searchsorted(order, edges).to(torch.int32), (order % boxes).to(torch.int32)


def rasterize_texels(mesh: Mesh, size: int) -> Texels:
    """Face and barycentrics of every texel of a ``size`` x ``size`` map over the UV of ``mesh``.

    A texel whose center lies in a face takes that face (the first, if several overlap).  A texel whose center is within
    1.5 texels of a chart takes the nearest point on the chart's border, so that bilinear lookups on the surface read
    only texels of that surface.  Bitwise identical for any number of threads.  Peak memory: 24 bytes per texel.  Raises
    ValueError without UV.
    """
    corners = _corners(mesh, size)
    device = corners.device
    face = torch.empty(size, size, dtype=torch.int32, device=device)
    bary = torch.empty(size, size, 2, device=device, dtype=torch.float32)
    distance = torch.empty(size, size, device=device, dtype=torch.float32)
    if len(mesh.faces) == 0:
        return Texels(face.fill_(-1), bary.zero_(), torch.zeros_like(face, dtype=torch.bool))
    tile = TILE_TEXELS[device.type]
    lower, upper = torch.aminmax(corners, dim=1)
    start, listed = _bins(lower, upper, size, tile)
    tiles = struct_of(kernels.Tiles, corners=corners, face_start=start, face_list=listed, size=size, tile=tile)
    single = np.sort(edges_of(mesh.faces.cpu().numpy()).of_valence(1)[0]).astype(np.int32)  # edges with one face
    segments = torch.from_numpy(single).to(device)  # 3 * face + corner
    ends = torch.stack([corners.reshape(-1, 2), corners.roll(-1, 1).reshape(-1, 2)], 1)[segments.long()]
    lower, upper = torch.aminmax(ends, dim=1)
    segment_start, segment_list = _bins(lower - BORDER_TEXELS, upper + BORDER_TEXELS, size, tile)
    args = [tiles, segment_start, segment_list, segments, BORDER_TEXELS, distance, face, bary]
    _bridge.launch(kernels.texels_kernel, (-(-size // tile)) ** 2, args, device, slice_min=TILES_MIN)
    return Texels(face, bary, distance == 0.0)


def _corner_weights(mesh: Mesh, texels: Texels, index: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices of the faces at the texels of ``index`` and their weights, both ``(N, 3)``."""
    bary = texels.bary.reshape(-1, 2)[index]
    weight = torch.cat([1.0 - bary.sum(1, keepdim=True), bary], 1)
    return mesh.faces[texels.face.reshape(-1)[index].long()].long(), weight


def _interpolated(values: Tensor, corner: Tensor, weight: Tensor) -> Tensor:
    """``values (V, C)`` at the texels, ``(N, C)``."""
    return embedding_bag(corner, values.contiguous(), per_sample_weights=weight, mode="sum")  # bits depend on strides


def _unit(values: Tensor, corner: Tensor, weight: Tensor) -> Tensor:
    """Interpolated unit vectors ``(N, 3)``; those of vertex 0 where they cancel."""
    mean = _interpolated(values, corner, weight)
    none = mean.square().sum(1, keepdim=True) < 1e-12
    return normalize(torch.where(none, values[corner[:, 0]], mean), dim=1)


def bake(
    mesh: Mesh,
    size: int,
    fn: Callable[..., Tensor | Mapping[str, Tensor]],
    *,
    chunk: int = 1 << 18,
    texels: Texels | None = None,
    tangents: bool = False,
    values: Tensor | None = None,
    fill: bool = True,
) -> dict[str, Tensor]:
    """Evaluates ``fn`` at the texels of an atlas; returns maps ``{name: (size, size, C)}`` float32, not clamped.

    mesh: with ``uv``, baked in [0, 1].  size: texels per side, 1 to 16384; row 0 is v = 0.  fn: ``fn(position (N, 3),
    normal (N, 3))``, N at most ``chunk``, without gradient; returns ``{name: (N, C)}`` or one tensor, named "value".
    texels: from :func:`~reli3d.geometry.bake.rasterize_texels`.  tangents: also pass ``(N, 4)``.  values: vertex
    attributes ``(V, C)``, interpolated, passed last.  fill: copy the nearest covered texel to uncovered ones.

    Raises TypeError for a wrong type, ValueError without ``uv`` or covered texels, or for wrong results.

    >>> maps = reli3d.bake(mesh, 64, lambda position, normal: 0.5 + 0.5 * normal)
    >>> textures = reli3d.TextureSet(maps["value"], roughness=0.5, metallic=0.0)
    """
    if chunk < 1:
        raise ValueError(f"chunk: expected at least 1, got {chunk}")
    if texels is None:
        texels = rasterize_texels(mesh, size)
    elif texels.face.shape != (size, size):
        raise ValueError(f"texels: expected size {size}, got {tuple(texels.face.shape)}")
    if values is not None:
        check("values", values, like=mesh.vertices)
        if values.ndim != 2 or len(values) != len(mesh.vertices):
            raise ValueError(f"values: expected ({len(mesh.vertices)}, C), got {tuple(values.shape)}")
    index = torch.nonzero(texels.valid.reshape(-1)).reshape(-1)
    if len(index) == 0:
        raise ValueError("mesh.uv: expected a surface within [0, 1]^2, got one that covers no texel")
    if tangents and mesh.tangents is None:
        raise ValueError("mesh.tangents: expected tangents, got None (see Mesh.with_tangents)")
    maps: dict[str, Tensor] = {}
    with torch.no_grad():
        normals = mesh.normals if mesh.normals is not None else vertex_normals(mesh.vertices, mesh.faces)
        for part in index.split(chunk):
            corner, weight = _corner_weights(mesh, texels, part)
            arguments = [_interpolated(mesh.vertices, corner, weight), _unit(normals, corner, weight)]
            if tangents and mesh.tangents is not None:
                along = _unit(mesh.tangents[:, :3], corner, weight)
                arguments.append(torch.cat([along, mesh.tangents[corner[:, 0], 3:]], 1))
            if values is not None:
                arguments.append(_interpolated(values, corner, weight))
            found = fn(*arguments)
            found = {"value": found} if isinstance(found, Tensor) else found
            expect("fn()", found, dict)
            if maps and found.keys() != maps.keys():
                raise ValueError(f"fn(): expected {', '.join(maps)} as before, got {', '.join(found)}")
            for name, value in found.items():
                check(f"fn()[{name!r}]", value, like=texels.bary)
                if value.ndim != 2 or len(value) != len(part):
                    raise ValueError(f"fn()[{name!r}]: expected shape ({len(part)}, C), got {tuple(value.shape)}")
                if name not in maps:
                    maps[name] = value.new_zeros(size * size, value.shape[1])
                if value.shape[1] != maps[name].shape[1]:
                    raise ValueError(f"fn()[{name!r}]: expected {maps[name].shape[1]} channels, got {value.shape[1]}")
                maps[name][part] = value
    if fill:
        source, square = nearest_valid(texels.valid)
        rows = (square > 0.0).reshape(-1).nonzero().squeeze(1)
        nearest = source.reshape(-1)[rows]
        for value in maps.values():
            value.index_copy_(0, rows, value.index_select(0, nearest))
    return {name: value.view(size, size, -1) for name, value in maps.items()}


def nearest_valid(valid: Tensor) -> tuple[Tensor, Tensor]:
    """Flat index (int32) of the nearest valid texel and squared distance [texels^2] to it, both ``(H, W)``; exact.

    Without a valid texel, the index is -1 and the distance inf.  Ties go to the upper row, then the left column.
    """
    check("valid", valid, shape=("H", "W"), dtype=torch.bool)
    (h, w), device = valid.shape, valid.device
    row, site, source = (torch.empty(h, w, dtype=torch.int32, device=device) for _ in range(3))
    border, square = (torch.empty(h, w, device=device, dtype=torch.float32) for _ in range(2))
    if valid.numel() == 0:
        return source, square
    strips = -(-w // STRIP)
    _bridge.launch(
        kernels.nearest_row_kernel, strips, [valid.contiguous().view(torch.uint8), STRIP, row], device, slice_min=1
    )
    _bridge.launch(kernels.nearest_texel_kernel, h, [row, site, border, source, square], device, slice_min=ROWS_MIN)
    return source, square
