"""Samples by the rendering protocol of the ReLi3D paper (its section B.1).

The protocol: three environments per object, each rotated at random about the vertical axis; a field of view from a
scaled normal distribution between 22 and 37 degrees; centered objects of unit scale that fill the frame with padding
and a small shift; 100 images of objects with PBR ground truth, 30 of others.  Not given in the paper: here the views
are divided among the environments, the distribution is cut at three deviations, cameras are uniform over a zone.
"""

import math

import numpy as np
import torch
from scipy.special import ndtr, ndtri
from torch import Tensor

from reli3d.geometry.camera import Camera, look_at
from reli3d.render.environment import Environment
from reli3d.synthetic.samples import Surface, render_sample

LIGHTS = 3
VIEWS_PBR, VIEWS_RGB = 100, 30  # of an object, under all its environments together
FOV_DEG = (22.0, 37.0)
DEVIATIONS = 3.0  # from the mean field of view to either end
PADDING = (0.05, 0.1)  # smallest distance of the object from the frame, as a fraction of its side; not in the paper
JITTER = 0.04  # largest shift of the camera along an axis, over half the frame at the nearest vertex; not in the paper:
#                sqrt(3) (1 + tan(37 deg / 2)) of it is less than twice the padding, so no vertex leaves the frame
ELEVATION_DEG = (-20.0, 70.0)  # of the camera; not in the paper
RGB_TENSORS = ("images", "c2w", "intrinsics", "environment")  # of an object without ground-truth material


def fields_of_view(u: np.ndarray) -> np.ndarray:
    """Full angles in degrees for uniform ``u``: a normal distribution truncated to FOV_DEG."""
    low, high = FOV_DEG
    tail = ndtr(-DEVIATIONS)
    return (low + high) / 2 + (high - low) / (2 * DEVIATIONS) * ndtri(tail + (1 - 2 * tail) * u)


def framed_cameras(vertices: Tensor, rng: np.random.Generator, count: int, size: int) -> Camera:
    """``count`` random cameras of ``size`` by ``size`` pixels that frame centered ``vertices (V, 3)``, then shifted."""
    fov = np.radians(fields_of_view(rng.random(count)))
    azimuth = rng.uniform(0.0, 2.0 * math.pi, count)
    low, high = (math.sin(math.radians(e)) for e in ELEVATION_DEG)
    height = rng.uniform(low, high, count)
    padding = rng.uniform(*PADDING, count)
    shift = torch.as_tensor(rng.uniform(-JITTER, JITTER, (count, 3)), dtype=torch.float32)
    horizontal = np.sqrt(1.0 - height**2)
    away = np.stack([horizontal * np.sin(azimuth), height, horizontal * np.cos(azimuth)], -1)
    direction = torch.as_tensor(away, dtype=torch.float32)
    c2w = look_at(direction, torch.zeros(count, 3), torch.tensor([0.0, 1.0, 0.0]))
    tangent = torch.as_tensor(np.tan(fov / 2), dtype=torch.float32)
    limit = tangent * (1.0 - 2.0 * torch.as_tensor(padding, dtype=torch.float32))
    fitted = []  # distance of a camera at which the vertices fill its frame, and depth of the nearest vertex
    for rotation, most in zip(c2w[:, :3, :3], limit.tolist(), strict=True):
        x, y, z = (vertices @ rotation).unbind(-1)
        reach = float((torch.maximum(x.abs(), y.abs()) / most + z).max())
        fitted.append((reach, reach - float(z.max())))
    distance, nearest = torch.tensor(fitted).unbind(-1)
    c2w[:, :3, 3] = direction * distance[:, None] + shift * (tangent * nearest)[:, None]
    focal = 0.5 * size / tangent
    middle = torch.full_like(focal, 0.5 * size)
    return Camera(c2w, torch.stack([focal, focal, middle, middle], -1), size, size)


def lights_of(count: int, columns: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Indices of LIGHTS different maps out of ``count``, and the rotation of each in columns, below ``columns``."""
    if count < LIGHTS:
        raise ValueError(f"maps: expected at least {LIGHTS} for the paper's protocol, got {count}")
    return rng.choice(count, LIGHTS, replace=False), rng.integers(columns, size=LIGHTS)


def protocol_sample(
    surface: Surface, maps: list[Tensor], seed: int, light: int, *, pbr: bool, size: int
) -> dict[str, Tensor]:
    """The views of an object under its environment ``light``; without ``pbr`` no ground-truth material."""
    chosen, turns = lights_of(len(maps), maps[0].shape[1], np.random.default_rng((seed, 2)))
    radiance = torch.roll(maps[chosen[light]], int(turns[light]), 1).contiguous()
    rng = np.random.default_rng((seed, 3, light))
    total = VIEWS_PBR if pbr else VIEWS_RGB
    count = total // LIGHTS + (light < total % LIGHTS)
    cameras = framed_cameras(surface.vertices, rng, count, size)
    sample = render_sample(surface, Environment(radiance), cameras, rng)
    return sample if pbr else {name: sample[name] for name in RGB_TENSORS}
