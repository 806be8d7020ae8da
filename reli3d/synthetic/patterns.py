"""Solid patterns: blend weights of material layers, and height fields.

``weight(points, normals)``: ``(N,)`` in [0, 1] at surface points ``(N, 3)`` with unit normals ``(N, 3)``.
``height_gradient(points, normals)``: gradient ``(N, 3)`` of a height in object units.  ``frame (3, 3)`` maps points to
pattern units: rotation, stretch and frequency.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from reli3d.synthetic.noise import cells, fbm


def smoothstep(low: float, high: float, x: Tensor) -> Tensor:
    """Cubic ramp from 0 at ``low`` to 1 at ``high``."""
    t = ((x - low) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def _in(frame: np.ndarray, points: Tensor) -> Tensor:
    return points @ torch.as_tensor(frame, dtype=torch.float32, device=points.device).T


def _plane(q: Tensor, normals: Tensor) -> Tensor:
    """The two coordinates ``(N, 2)`` of ``q`` across the axis nearest to the normal."""
    axis = normals.abs().argmax(-1)
    index = torch.tensor([[2, 1], [0, 2], [0, 1]], device=q.device)[axis]
    return torch.gather(q, 1, index)


@dataclass(frozen=True)
class Blotches:
    """Thresholded fractal noise: stains, rust, camouflage, speckles; with ``ridged`` marble veins and scratches."""

    frame: np.ndarray
    seed: int
    threshold: float
    softness: float
    octaves: int = 4
    gain: float = 0.5
    ridged: bool = False

    def weight(self, points: Tensor, normals: Tensor) -> Tensor:
        value, _ = fbm(
            _in(self.frame, points), octaves=self.octaves, gain=self.gain, ridged=self.ridged, seed=self.seed
        )
        if self.ridged:
            value = 0.5 - value
        return smoothstep(self.threshold - self.softness, self.threshold + self.softness, value)


@dataclass(frozen=True)
class Bands:
    """Bands across the first pattern axis, one per unit, of width ``duty``; ``wobble``: amplitude of a distortion."""

    frame: np.ndarray
    duty: float
    phase: float
    wobble: float = 0.0
    seed: int = 0
    softness: float = 0.03

    def weight(self, points: Tensor, normals: Tensor) -> Tensor:
        q = _in(self.frame, points)
        x = q[:, 0] + self.phase
        if self.wobble > 0:
            x = x + self.wobble * fbm(q * 0.7, octaves=2, seed=self.seed)[0]
        distance = (x - torch.floor(x) - 0.5).abs() * 2  # 0 in the middle of a band, 1 between two
        return 1 - smoothstep(self.duty - self.softness, self.duty + self.softness, distance)


@dataclass(frozen=True)
class Grain:
    """Wood: growth rings around the third pattern axis, distorted by noise, and fine fibers along it."""

    frame: np.ndarray
    seed: int
    rings: float
    offset: tuple[float, float]

    def weight(self, points: Tensor, normals: Tensor) -> Tensor:
        q = _in(self.frame, points)
        bend = fbm(q * q.new_tensor([1.0, 1.0, 0.25]), octaves=2, seed=self.seed)[0]
        fiber = fbm(q * q.new_tensor([22.0, 22.0, 0.9]), octaves=2, seed=self.seed + 1)[0]
        radius = torch.hypot(q[:, 0] - self.offset[0], q[:, 1] - self.offset[1]) + 0.22 * bend
        ring = radius * self.rings
        ring = ring - torch.floor(ring)
        late = smoothstep(0.15, 0.9, ring) * (1 - smoothstep(0.93, 1.0, ring))
        return (0.75 * late + 0.35 * fiber + 0.08).clamp(0, 1)


@dataclass(frozen=True)
class Checker:
    """Solid checkerboard of unit cubes."""

    frame: np.ndarray

    def weight(self, points: Tensor, normals: Tensor) -> Tensor:
        q = torch.floor(_in(self.frame, points) + 0.013)  # flat faces must not lie on a border
        return torch.remainder(q.sum(-1), 2.0)


@dataclass(frozen=True)
class Dots:
    """Disks of ``radius`` on a unit grid, alternate rows shifted, in the coordinate plane nearest to the surface."""

    frame: np.ndarray
    radius: float

    def weight(self, points: Tensor, normals: Tensor) -> Tensor:
        uv = _plane(_in(self.frame, points), normals)
        row = torch.floor(uv[:, 1])
        x = uv[:, 0] + 0.5 * torch.remainder(row, 2.0)
        d = torch.hypot(x - torch.floor(x) - 0.5, uv[:, 1] - row - 0.5)
        return 1 - smoothstep(self.radius - 0.04, self.radius + 0.04, d)


@dataclass(frozen=True)
class Ramp:
    """Smooth step from ``low`` to ``high`` along ``axis``, distorted by noise: dirt at the base, fading at the top."""

    axis: tuple[float, float, float]
    low: float
    high: float
    fray: float
    seed: int

    def weight(self, points: Tensor, normals: Tensor) -> Tensor:
        x = points @ points.new_tensor(self.axis)
        if self.fray > 0:
            x = x + self.fray * fbm(points * 7.0, octaves=3, seed=self.seed)[0]
        return smoothstep(self.low, self.high, x)


@dataclass(frozen=True)
class Facing:
    """Smooth step of the cosine between normal and ``axis``, distorted by noise: dust, snow, worn upper faces."""

    axis: tuple[float, float, float]
    low: float
    high: float
    seed: int

    def weight(self, points: Tensor, normals: Tensor) -> Tensor:
        x = normals @ normals.new_tensor(self.axis) + 0.25 * fbm(points * 9.0, octaves=3, seed=self.seed)[0]
        return smoothstep(self.low, self.high, x)


@dataclass(frozen=True)
class Decal:
    """Bitmap ``(h, w)`` of 0 and 1 projected onto a rectangle, or its inscribed ellipse: label, logo, letters."""

    center: tuple[float, float, float]
    right: tuple[float, float, float]
    up: tuple[float, float, float]
    half: tuple[float, float]
    bitmap: np.ndarray
    oval: bool = False

    def weight(self, points: Tensor, normals: Tensor) -> Tensor:
        right, up = points.new_tensor(self.right), points.new_tensor(self.up)
        local = points - points.new_tensor(self.center)
        u, v = local @ right / self.half[0], local @ up / self.half[1]
        facing = normals @ torch.linalg.cross(right, up) > 0.35
        inside = (u * u + v * v < 1) if self.oval else (u.abs() < 1) & (v.abs() < 1)
        rows, columns = self.bitmap.shape
        j = ((u * 0.5 + 0.5) * columns).long().clamp(0, columns - 1)
        i = ((0.5 - v * 0.5) * rows).long().clamp(0, rows - 1)
        bitmap = torch.as_tensor(self.bitmap, dtype=torch.float32, device=points.device)
        return bitmap[i, j] * (inside & facing)


@dataclass(frozen=True)
class Mosaic:
    """Cellular noise: borders of width ``border`` (cracks, scales), or a random ``fraction`` of the cells (spots)."""

    frame: np.ndarray
    seed: int
    border: float = 0.0
    fraction: float = 0.0

    def weight(self, points: Tensor, normals: Tensor) -> Tensor:
        distance, cell, _ = cells(_in(self.frame, points), seed=self.seed)
        gap = distance[:, 1] - distance[:, 0]
        if self.border > 0:
            return 1 - smoothstep(self.border * 0.5, self.border, gap)
        return (cell < self.fraction) * smoothstep(0.02, 0.08, gap)


@dataclass(frozen=True)
class Weave:
    """Woven threads, two per unit, in the coordinate plane nearest to the surface."""

    frame: np.ndarray
    depth: float = 0.0

    def weight(self, points: Tensor, normals: Tensor) -> Tensor:
        uv = _plane(_in(self.frame, points), normals) * np.pi
        return (0.5 + 0.5 * torch.sin(uv[:, 0]) * torch.sin(uv[:, 1])).clamp(0, 1)

    def height_gradient(self, points: Tensor, normals: Tensor) -> Tensor:
        q = _in(self.frame, points) * np.pi
        a, b, c = torch.sin(q).unbind(-1)
        x, y, z = torch.cos(q).unbind(-1)
        scale = self.depth * np.pi
        return scale * _back(self.frame, torch.stack([x * (b + c), y * (a + c), z * (a + b)], -1)) * 0.5


@dataclass(frozen=True)
class Emboss:
    """Height field of fractal noise (hammered, cast, brushed) or of cellular borders (leather, scales)."""

    frame: np.ndarray
    seed: int
    depth: float
    octaves: int = 3
    cellular: bool = False

    def height_gradient(self, points: Tensor, normals: Tensor) -> Tensor:
        q = _in(self.frame, points)
        if self.cellular:
            distance, _, gradient = cells(q, seed=self.seed)
            near = 1 - smoothstep(0.1, 0.35, distance[:, 1] - distance[:, 0])
            return self.depth * _back(self.frame, gradient * near[:, None])
        return self.depth * _back(self.frame, fbm(q, octaves=self.octaves, seed=self.seed)[1])


def _back(frame: np.ndarray, gradient: Tensor) -> Tensor:
    """Gradient with respect to the points from that with respect to pattern units."""
    return gradient @ torch.as_tensor(frame, dtype=torch.float32, device=gradient.device)
