"""Surfaces with randomly exchanged materials, so that a network cannot infer the material from the shape.

The base color of many objects is multiplied by a random color.  Each of one to four regions with sharp borders gets its
original material, another roughness and metallic value, a scanned material set, or a procedural material.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from reli3d.errors import InputError
from reli3d.io.files import file_size
from reli3d.io.images import read_image
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.gbuffer import sample_texture
from reli3d.render.points import SurfacePoints
from reli3d.synthetic.finishes import draw_materials
from reli3d.synthetic.noise import fbm
from reli3d.synthetic.samples import Surface, random_faces

UNCHANGED_PROBABILITY = 0.4  # of an object without other materials; its base color may still be multiplied
RECOLORED_PROBABILITY = 0.3  # of an object whose base color is multiplied by a random color
GAIN_DEVIATION, HUE_DEVIATION = 0.3, 0.12  # standard deviations of its logarithm: of all channels, of each channel
REGION_COUNTS = (0.3, 0.35, 0.2, 0.15)  # probability of 1, 2, 3, 4 regions
MAX_ALBEDO = 0.95  # of a base color that was multiplied, unless it was larger
BLEND_EXPONENT = 8.0  # of |n| in the blend of the three projections: 1 % of a neighbor's weight at 30 degrees
ROLES = ("metal", "metal", "plastic", "paint", "ceramic", "leather", "fabric", "rubber", "stone", "wood", "any")
CLUSTER_POINTS = 2048  # surface points on which base colors are clustered

Finish = Callable[[SurfacePoints], SurfacePoints]
Region = Callable[[SurfacePoints], Tensor]


def material_sets(folder: Path) -> tuple[Path, ...]:
    """Folders in ``folder`` with basecolor, roughness, metallic and optionally normal, JPEG or PNG; or InputError."""
    found = sorted({path.parent for path in folder.glob("*/basecolor.*")})
    if not found:
        raise InputError(folder, "expected folders with basecolor, roughness, metallic and normal, got none")
    for path in found:
        for name in ("roughness", "metallic"):
            file_size(_map_file(path, name))
    return tuple(path.absolute() for path in found)


def _map_file(folder: Path, name: str) -> Path:
    return next(iter(sorted(folder.glob(f"{name}.*"))), folder / f"{name}.jpg")


@lru_cache(24)
def _read_set(folder: Path, side: int) -> tuple[Tensor, Tensor, Tensor]:
    """Linear base color, (roughness, metallic, 0), tangent-space normal (OpenGL) of a set, each ``(side, side, 3)``."""

    def read(name: str, change: Callable[[Tensor], Tensor] = lambda values: values) -> Tensor:
        chw = change(read_image(_map_file(folder, name))[0]).permute(2, 0, 1)[None]
        return functional.interpolate(chw, (side, side), mode="area")[0].permute(1, 2, 0).contiguous()

    base, rough, metal = read("basecolor", srgb_to_linear), read("roughness")[..., :1], read("metallic")[..., :1]
    if _map_file(folder, "normal").exists():
        normal = read("normal", lambda values: values * 2 - 1)
    else:
        normal = torch.tensor([0.0, 0.0, 1.0]).expand(side, side, 3).contiguous()
    return base, torch.cat([rough, metal, torch.zeros_like(rough)], -1), functional.normalize(normal, dim=-1)


class RefinishedSurface:
    """``base`` with random materials and base colors: a ``Surface`` of :mod:`reli3d.synthetic.samples`.

    measured: whether the finish of ``base`` is ground truth.  texels: of a material set per unit of length.
    """

    def __init__(self, base: Surface, sets: Sequence[Path], rng: np.random.Generator, *, measured: bool, texels: int):
        self.base, self.vertices, self.faces, self.scene = base, base.vertices, base.faces, base.scene
        self.outer, self.distance = base.outer, base.distance
        kept = rng.random() < UNCHANGED_PROBABILITY
        count = 1 if kept else 1 + int(rng.choice(len(REGION_COUNTS), p=REGION_COUNTS))
        self._region = _draw_region(base, rng, count) if count > 1 else None
        kind = "keep" if kept else None
        self._finishes = [_draw_finish(sets, rng, kind, measured=measured, texels=texels) for _ in range(count)]
        log = rng.normal(0, GAIN_DEVIATION) + rng.normal(0, HUE_DEVIATION, 3)
        self._gain = torch.as_tensor(np.exp(log * (rng.random() < RECOLORED_PROBABILITY)), dtype=torch.float32)

    def points_at(self, face: Tensor, bary: Tensor) -> SurfacePoints:
        original = self.base.points_at(face, bary)
        color = torch.minimum(original.base_color * self._gain, original.base_color.clamp(min=MAX_ALBEDO))
        points = replace(original, base_color=color)
        if self._region is None:
            return self._finishes[0](points)
        region = self._region(original)
        changed = {name: value.clone() for name, value in vars(points).items()}
        for k, finish in enumerate(self._finishes):
            rows = (region == k).nonzero()[:, 0]
            for name, value in vars(finish(points[rows])).items() if len(rows) else ():
                changed[name][rows] = value
        return SurfacePoints(**changed)


def _draw_region(base: Surface, rng: np.random.Generator, count: int) -> Region:
    """A function from points to region indices ``(N,)`` in [0, count): clusters of the base color, or cuts in space."""
    if rng.random() < 0.45:
        samples = base.points_at(*random_faces(base, CLUSTER_POINTS, rng))
        centers = _cluster(linear_to_srgb(samples.base_color.clamp(0, 1)), count, rng)
        if len(centers) == count:
            order = torch.as_tensor(rng.permutation(count))
            return lambda p: order[torch.cdist(linear_to_srgb(p.base_color.clamp(0, 1)), centers).argmin(1)]
    cuts = [_draw_cut(base, rng) for _ in range(count - 1)]

    def by_cuts(p: SurfacePoints) -> Tensor:
        region = torch.zeros(len(p), dtype=torch.long)
        for k, cut in enumerate(cuts, 1):
            region[cut(p.position)] = k
        return region

    return by_cuts


def _cluster(colors: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """Centers ``(K, 3)`` of k-means, K at most ``count``; clusters of less than 3 % of the points are removed."""
    centers = colors[torch.as_tensor(rng.choice(len(colors), count, replace=False))]
    for _ in range(12):
        nearest = torch.cdist(colors, centers).argmin(1)
        size = torch.bincount(nearest, minlength=len(centers))
        sums = torch.zeros_like(centers).index_add_(0, nearest, colors)
        keep = size > 0.03 * len(colors)
        centers = sums[keep] / size[keep, None]
    return centers


def _draw_cut(base: Surface, rng: np.random.Generator) -> Callable[[Tensor], Tensor]:
    """A function from positions ``(N, 3)`` to a mask ``(N,)``: a half-space, slab, ball or thresholded noise."""
    low, high = base.vertices.amin(0), base.vertices.amax(0)
    at = low + torch.as_tensor(rng.uniform(0.2, 0.8, 3), dtype=torch.float32) * (high - low)
    axis = np.eye(3)[rng.integers(3)] if rng.random() < 0.6 else rng.normal(size=3)
    n = torch.as_tensor(axis / np.linalg.norm(axis) * rng.choice([-1, 1]), dtype=torch.float32)
    kind, width, seed = int(rng.integers(4)), float(rng.uniform(0.04, 0.15)), int(rng.integers(1 << 20))
    frequency, threshold = float(np.exp(rng.uniform(np.log(1.5), np.log(8.0)))), float(rng.uniform(-0.1, 0.25))
    if kind == 0:
        return lambda x: (x - at) @ n > 0
    if kind == 1:
        return lambda x: ((x - at) @ n).abs() < width
    if kind == 2:
        return lambda x: (x - at).norm(dim=-1) < 2.5 * width
    return lambda x: fbm((x * frequency).contiguous(), octaves=2, seed=seed)[0] > threshold


def _draw_finish(
    sets: Sequence[Path], rng: np.random.Generator, kind: str | None, *, measured: bool, texels: int
) -> Finish:
    """kind: ``keep``, ``recoat``, ``set`` or ``procedural``; drawn where it is None."""
    kind = kind or str(rng.choice(["keep", "recoat", "set", "procedural"], p=[0.32, 0.26, 0.24, 0.18]))
    if kind == "set" and sets:
        return _set_finish(sets[int(rng.integers(len(sets)))], rng, texels)
    if kind == "procedural":
        role = str(rng.choice(ROLES))
        (material,) = draw_materials(rng, [role], np.full((1, 2, 3), 0.5) * [[-1], [1]])
        names = ("base_color", "roughness", "metallic", "normal")
        return lambda p: replace(p, **dict(zip(names, material.at(p.position, p.normal))))
    if kind == "keep" and measured:
        return lambda p: p
    metallic = float(rng.random() < (0.45 if kind == "recoat" else 0.06))
    roughness = float(rng.uniform(0.06, 1.0) if rng.random() < 0.8 else rng.uniform(0.05, 0.3))
    drift, frequency, seed = float(rng.uniform(0, 0.15)), float(rng.uniform(1, 8)), int(rng.integers(1 << 20))

    def recoat(p: SurfacePoints) -> SurfacePoints:
        noise = fbm((p.position * frequency).contiguous(), octaves=3, seed=seed)[0]
        rough = (roughness + drift * noise).clamp(0.04, 1.0)
        color = p.base_color
        if metallic:  # metals reflect at least a third
            color = 0.35 + 0.6 * linear_to_srgb(color.clamp(0, 1))
        return replace(p, base_color=color, roughness=rough, metallic=torch.full_like(rough, metallic))

    return recoat


def _set_finish(folder: Path, rng: np.random.Generator, texels: int) -> Finish:
    """A material set by triplanar projection, blended by the normal, with 0.8 to 4 repeats per unit."""
    repeats = float(np.exp(rng.uniform(np.log(0.8), np.log(4.0))))
    side = int(np.clip(2 ** np.round(np.log2(texels / repeats)), 32, 512))
    offset = torch.as_tensor(rng.random((3, 2)), dtype=torch.float32)
    gain = torch.as_tensor(np.exp(rng.normal(0, 0.15, 3) + rng.normal(0, 0.15)), dtype=torch.float32)
    shift = float(rng.normal(0, 0.06))
    strength = float(rng.uniform(0.3, 1.0))

    def finish(p: SurfacePoints) -> SurfacePoints:
        base, numbers, mapped = _read_set(folder, side)
        weight = p.normal.abs() ** BLEND_EXPONENT
        weight = weight / weight.sum(-1, keepdim=True)
        color, number, bend = torch.zeros_like(p.normal), torch.zeros_like(p.normal), torch.zeros_like(p.normal)
        for k in range(3):
            u, v = (k + 1) % 3, (k + 2) % 3
            uv = (p.position[:, [u, v]] * repeats + offset[k]) * torch.tensor([1.0, -1.0])
            w, uv = weight[:, k : k + 1], uv.contiguous()
            color += w * sample_texture(base, uv)
            number += w * sample_texture(numbers, uv)
            tilt = w * sample_texture(mapped, uv)
            bend[:, u] += tilt[:, 0]
            bend[:, v] += tilt[:, 1]
        normal = functional.normalize(p.normal + strength * bend, dim=-1)
        rough, metal = (number[:, 0] + shift).clamp(0.04, 1.0), number[:, 1].clamp(0, 1)
        color = (color * gain).clamp(0.0, MAX_ALBEDO)
        return replace(p, base_color=color, roughness=rough, metallic=metal, normal=normal)

    return finish
