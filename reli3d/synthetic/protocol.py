"""Samples by the paper's rendering protocol: three lights an object, turned about the vertical, and framed cameras.

Section B.1 of the paper gives: three environments an object, each turned at random about the vertical axis; a field of
view from a scaled normal distribution between 22 and 37 degrees; objects of unit scale in the center; cameras that fill
the frame with padding and a small shift; 100 images of objects with PBR truth, 30 of others.

The paper leaves three things open.  Here the views of an object are shared among its lights, the normal distribution
ends three deviations from its mean, and eyes lie evenly over a zone of the sphere.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.special import ndtr, ndtri
from torch import Tensor

from reli3d.geometry.camera import Camera, look_at
from reli3d.render.environment import Environment
from reli3d.synthetic.samples import Surface, render_sample

LIGHTS = 3
VIEWS_PBR, VIEWS_RGB = 100, 30  # of an object, under all its lights together
FOV_DEG = (22.0, 37.0)
DEVIATIONS = 3.0  # from the mean field of view to either end
PADDING = (0.05, 0.1)  # of the frame's side, free on the side where the object comes nearest; open in the paper
JITTER = 0.04  # largest shift of the eye along an axis, over half the frame at the nearest vertex; open in the paper:
#                sqrt(3) (1 + tan(37 deg / 2)) of it is less than twice the padding, so no vertex leaves the frame
ELEVATION_DEG = (-20.0, 70.0)  # of the eye; open in the paper
OF_RGB = ("images", "c2w", "intrinsics", "environment")  # what an object without known material has


def views_of(light: int, pbr: bool) -> int:
    """How many of an object's views are under its light number ``light``."""
    total = VIEWS_PBR if pbr else VIEWS_RGB
    return total // LIGHTS + (light < total % LIGHTS)


def fields_of_view(u: np.ndarray) -> np.ndarray:
    """Full angles in degrees for uniform ``u``: a normal distribution cut at the ends of :data:`FOV_DEG`."""
    low, high = FOV_DEG
    tail = ndtr(-DEVIATIONS)
    return (low + high) / 2 + (high - low) / (2 * DEVIATIONS) * ndtri(tail + (1 - 2 * tail) * u)


def framed_cameras(vertices: Tensor, rng: np.random.Generator, count: int, size: int) -> Camera:
    """``count`` cameras of ``size`` by ``size`` pixels around an object of unit scale at the origin.

    vertices: ``(V, 3)``.  Each looks at the origin from where the object leaves its padding free, then the eye is
    shifted.  The principal point is the middle of the image.
    """
    fov = np.radians(fields_of_view(rng.random(count)))
    azimuth = rng.uniform(0.0, 2.0 * math.pi, count)
    low, high = (math.sin(math.radians(e)) for e in ELEVATION_DEG)
    height = rng.uniform(low, high, count)
    padding = rng.uniform(*PADDING, count)
    shift = torch.as_tensor(rng.uniform(-JITTER, JITTER, (count, 3)), dtype=torch.float32)
    level = np.sqrt(1.0 - height**2)
    away = np.stack([level * np.sin(azimuth), height, level * np.cos(azimuth)], -1)
    direction = torch.as_tensor(away, dtype=torch.float32)
    c2w = look_at(direction, torch.zeros(count, 3), torch.tensor([0.0, 1.0, 0.0]))
    tangent = torch.as_tensor(np.tan(fov / 2), dtype=torch.float32)
    slope = tangent * (1.0 - 2.0 * torch.as_tensor(padding, dtype=torch.float32))
    fitted = [fill_distance(vertices, m[:3, :3], float(k)) for m, k in zip(c2w, slope, strict=True)]
    distance, nearest = torch.tensor(fitted).unbind(-1)
    c2w[:, :3, 3] = direction * distance[:, None] + shift * (tangent * nearest)[:, None]
    focal = 0.5 * size / tangent
    middle = torch.full_like(focal, 0.5 * size)
    return Camera(c2w, torch.stack([focal, focal, middle, middle], -1), size, size)


def fill_distance(vertices: Tensor, rotation: Tensor, slope: float) -> tuple[float, float]:
    """How far from the origin a camera with these axes must be for all ``vertices`` to lie within ``slope``, and the
    depth of the nearest one then.

    rotation: ``(3, 3)``, columns right, up, back.  slope: largest ratio of the distance from the axis, along right or
    up, to the depth.
    """
    x, y, z = (vertices @ rotation).unbind(-1)
    distance = float((torch.maximum(x.abs(), y.abs()) / slope + z).max())
    return distance, distance - float(z.max())


def lights_of(count: int, columns: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of :data:`LIGHTS` different maps out of ``count``, and how many of ``columns`` each is turned by."""
    if count < LIGHTS:
        raise ValueError(f"maps: expected at least {LIGHTS} for the paper's protocol, got {count}")
    return rng.choice(count, LIGHTS, replace=False), rng.integers(columns, size=LIGHTS)


def protocol_sample(
    surface: Surface, maps: list[Tensor], seed: int, light: int, *, pbr: bool, size: int
) -> dict[str, Tensor]:
    """The views of an object under light ``light`` of its three, a function of ``seed`` and ``light``.

    maps: lat-long, ``(H, 2H, 3)`` linear.  pbr: whether its material is known.  Of an object whose material is not,
    the sample has images, cameras and light alone; nothing stands for the rest.
    """
    chosen, turns = lights_of(len(maps), maps[0].shape[1], np.random.default_rng((seed, 2)))
    radiance = torch.roll(maps[chosen[light]], int(turns[light]), 1).contiguous()
    rng = np.random.default_rng((seed, 3, light))
    cameras = framed_cameras(surface.vertices, rng, views_of(light, pbr), size)
    sample = render_sample(surface, Environment(radiance), cameras, rng)
    return sample if pbr else {name: sample[name] for name in OF_RGB}
