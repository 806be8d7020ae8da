"""Solid patterns: blend weights of material layers, and height fields.

A pattern, called with its parameters, gives a function of surface points ``(N, 3)`` and unit normals ``(N, 3)``: a
blend weight ``(N,)`` in [0, 1], or the gradient ``(N, 3)`` of a height in object units.  ``frame (3, 3)`` maps points
to pattern units: rotation, stretch and frequency.
"""

from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec

import numpy as np
import torch
from torch import Tensor

from reli3d.synthetic.materials import SurfaceFunction
from reli3d.synthetic.noise import cells, fbm

Vector = tuple[float, float, float]
Parameters = ParamSpec("Parameters")


def smoothstep(low: float, high: float, x: Tensor) -> Tensor:
    """Cubic ramp from 0 at ``low`` to 1 at ``high``."""
    t = ((x - low) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def pattern(
    evaluate: Callable[Concatenate[Tensor, Tensor, Parameters], Tensor],
) -> Callable[Parameters, SurfaceFunction]:
    """Decorator: called with the other parameters of ``evaluate``, the result is a function of points and normals."""
    return lambda *args, **options: lambda points, normals: evaluate(points, normals, *args, **options)


def _in(frame: np.ndarray, points: Tensor) -> Tensor:
    return points @ torch.as_tensor(frame, dtype=torch.float32, device=points.device).T


def _back(frame: np.ndarray, gradient: Tensor) -> Tensor:
    """Gradient with respect to the points from that with respect to pattern units."""
    return gradient @ torch.as_tensor(frame, dtype=torch.float32, device=gradient.device)


def _plane(q: Tensor, normals: Tensor) -> Tensor:
    """The two coordinates ``(N, 2)`` of ``q`` across the axis nearest to the normal."""
    axis = normals.abs().argmax(-1)
    index = torch.tensor([[2, 1], [0, 2], [0, 1]], device=q.device)[axis]
    return torch.gather(q, 1, index)


@pattern
def blotches(
    points: Tensor, normals: Tensor, frame: np.ndarray, threshold: float, softness: float, *, ridged=False, **noise: Any
) -> Tensor:
    """Thresholded fractal noise of :func:`fbm`: stains, rust, speckles; with ``ridged`` marble veins and scratches."""
    value, _ = fbm(_in(frame, points), ridged=ridged, **noise)
    return smoothstep(threshold - softness, threshold + softness, 0.5 - value if ridged else value)


@pattern
def bands(
    points: Tensor, normals: Tensor, frame: np.ndarray, duty: float, phase: float, wobble=0.0, seed=0, softness=0.03
) -> Tensor:
    """Bands across the first pattern axis, one per unit, of width ``duty``; ``wobble``: amplitude of a distortion."""
    q = _in(frame, points)
    x = q[:, 0] + phase
    if wobble > 0:
        x = x + wobble * fbm(q * 0.7, octaves=2, seed=seed)[0]
    distance = (x - torch.floor(x) - 0.5).abs() * 2  # 0 in the middle of a band, 1 between two
    return 1 - smoothstep(duty - softness, duty + softness, distance)


@pattern
def grain(
    points: Tensor, normals: Tensor, frame: np.ndarray, seed: int, rings: float, offset: tuple[float, float]
) -> Tensor:
    """Wood: growth rings around the third pattern axis, distorted by noise, and fine fibers along it."""
    q = _in(frame, points)
    bend = fbm(q * q.new_tensor([1.0, 1.0, 0.25]), octaves=2, seed=seed)[0]
    fiber = fbm(q * q.new_tensor([22.0, 22.0, 0.9]), octaves=2, seed=seed + 1)[0]
    ring = (torch.hypot(q[:, 0] - offset[0], q[:, 1] - offset[1]) + 0.22 * bend) * rings
    ring = ring - torch.floor(ring)
    late = smoothstep(0.15, 0.9, ring) * (1 - smoothstep(0.93, 1.0, ring))
    return (0.75 * late + 0.35 * fiber + 0.08).clamp(0, 1)


@pattern
def checker(points: Tensor, normals: Tensor, frame: np.ndarray) -> Tensor:
    """Solid checkerboard of unit cubes."""
    q = torch.floor(_in(frame, points) + 0.013)  # flat faces must not lie on a border
    return torch.remainder(q.sum(-1), 2.0)


@pattern
def dots(points: Tensor, normals: Tensor, frame: np.ndarray, radius: float) -> Tensor:
    """Disks of ``radius`` on a unit grid, alternate rows shifted, in the coordinate plane nearest to the surface."""
    uv = _plane(_in(frame, points), normals)
    row = torch.floor(uv[:, 1])
    x = uv[:, 0] + 0.5 * torch.remainder(row, 2.0)
    d = torch.hypot(x - torch.floor(x) - 0.5, uv[:, 1] - row - 0.5)
    return 1 - smoothstep(radius - 0.04, radius + 0.04, d)


@pattern
def ramp(points: Tensor, normals: Tensor, axis: Vector, low: float, high: float, fray: float, seed: int) -> Tensor:
    """Smooth step from ``low`` to ``high`` along ``axis``, distorted by noise: dirt at the base, fading at the top."""
    x = points @ points.new_tensor(axis)
    if fray > 0:
        x = x + fray * fbm(points * 7.0, octaves=3, seed=seed)[0]
    return smoothstep(low, high, x)


@pattern
def facing(points: Tensor, normals: Tensor, axis: Vector, low: float, high: float, seed: int) -> Tensor:
    """Smooth step of the cosine between normal and ``axis``, distorted by noise: dust, snow, worn upper faces."""
    x = normals @ normals.new_tensor(axis) + 0.25 * fbm(points * 9.0, octaves=3, seed=seed)[0]
    return smoothstep(low, high, x)


@pattern
def decal(
    points: Tensor, normals: Tensor, place: np.ndarray, half: np.ndarray, bitmap: np.ndarray, oval: bool = False
) -> Tensor:
    """Bitmap ``(h, w)`` of 0 and 1 projected onto a rectangle, or its inscribed ellipse: label, logo, letters.

    place: ``(3, 3)``, the center and unit directions to the right and up.  half: ``(2,)``, half sides.
    """
    center, right, up = torch.as_tensor(place, dtype=torch.float32, device=points.device)
    local = points - center
    u, v = local @ right / float(half[0]), local @ up / float(half[1])
    faces = normals @ torch.linalg.cross(right, up) > 0.35
    inside = (u * u + v * v < 1) if oval else (u.abs() < 1) & (v.abs() < 1)
    rows, columns = bitmap.shape
    j = ((u * 0.5 + 0.5) * columns).long().clamp(0, columns - 1)
    i = ((0.5 - v * 0.5) * rows).long().clamp(0, rows - 1)
    return torch.as_tensor(bitmap, dtype=torch.float32, device=points.device)[i, j] * (inside & faces)


@pattern
def mosaic(points: Tensor, normals: Tensor, frame: np.ndarray, seed: int, border=0.0, fraction=0.0) -> Tensor:
    """Cellular noise: borders of width ``border`` (cracks, scales), or a random ``fraction`` of the cells (spots)."""
    distance, cell, _ = cells(_in(frame, points), seed=seed)
    gap = distance[:, 1] - distance[:, 0]
    if border > 0:
        return 1 - smoothstep(border * 0.5, border, gap)
    return (cell < fraction) * smoothstep(0.02, 0.08, gap)


@pattern
def weave(points: Tensor, normals: Tensor, frame: np.ndarray) -> Tensor:
    """Woven threads, two per unit, in the coordinate plane nearest to the surface."""
    uv = _plane(_in(frame, points), normals) * np.pi
    return (0.5 + 0.5 * torch.sin(uv[:, 0]) * torch.sin(uv[:, 1])).clamp(0, 1)


@pattern
def weave_bump(points: Tensor, normals: Tensor, frame: np.ndarray, depth: float) -> Tensor:
    """Height gradient of the threads of ``weave``."""
    q = _in(frame, points) * np.pi
    a, b, c = torch.sin(q).unbind(-1)
    x, y, z = torch.cos(q).unbind(-1)
    return depth * np.pi * _back(frame, torch.stack([x * (b + c), y * (a + c), z * (a + b)], -1)) * 0.5


@pattern
def emboss(
    points: Tensor, normals: Tensor, frame: np.ndarray, seed: int, depth: float, octaves: int = 3, cellular=False
) -> Tensor:
    """Height gradient of fractal noise (hammered, cast, brushed) or of cellular borders (leather, scales)."""
    q = _in(frame, points)
    if cellular:
        distance, _, gradient = cells(q, seed=seed)
        near = 1 - smoothstep(0.1, 0.35, distance[:, 1] - distance[:, 0])
        return depth * _back(frame, gradient * near[:, None])
    return depth * _back(frame, fbm(q, octaves=octaves, seed=seed)[1])
