"""Procedural objects for training: mesh, parts and materials from a seed; +Y up, centered, longest side 1."""

import itertools
from dataclasses import dataclass

import numpy as np
import torch

from reli3d.geometry.camera import look_at
from reli3d.geometry.topology import graph_components
from reli3d.synthetic import furniture, manmade, organic, vessels, wires
from reli3d.synthetic.assembly import ON_BACK, ON_SIDE, Assembly
from reli3d.synthetic.finishes import draw_materials
from reli3d.synthetic.materials import Material

VALIDATION_SEEDS = range(1_000_000_000, 1_000_000_032)  # seeds of training objects are smaller
TEST_SEEDS = range(1_000_000_032, 1_000_000_064)
MAX_FACES = 30_000
CREASE_DEG = 38.0  # facets of rounded edges meet at 30 degrees at most, faces of boxes at 90
MIN_VOLUME_FRACTION = 2e-4  # volume over cubed longest side: a sword has 1e-3, a sheet seen edge-on less
FRAME_RADIUS = 0.87  # half diagonal of the unit cube: contains objects of longest side 1

WIRE_PROBABILITY, WIRE_STREAM = 0.04, 1000  # decided by a stream of its own, so that other objects do not depend on it
FAMILIES = (
    (manmade.csg, 0.2), (vessels.vessel, 0.12), (vessels.lamp, 0.05), (manmade.device, 0.12),
    (vessels.container, 0.08), (manmade.tool, 0.05), (manmade.profile, 0.05), (furniture.table, 0.05),
    (furniture.chair, 0.06), (furniture.sofa, 0.03), (furniture.shelf, 0.04), (furniture.vehicle, 0.03),
    (organic.creature, 0.045), (organic.figure, 0.04), (organic.shoe, 0.025), (organic.fruit, 0.025),
    (organic.stone, 0.035),
)  # fmt: skip


@dataclass(frozen=True)
class ProceduralObject:
    """Closed surface with materials, as numpy arrays.  ``normals`` are shading normals of the face corners."""

    vertices: np.ndarray  # (V, 3) float32
    faces: np.ndarray  # (F, 3) int32, counter-clockwise seen from outside
    normals: np.ndarray  # (F, 3, 3) float32 unit
    part: np.ndarray  # (F,) int32 index into materials
    materials: tuple[Material, ...]
    name: str  # of the family


def make_object(seed: int) -> ProceduralObject:
    """The object of ``seed``: a wire or a random family, deformed; pose and materials.  Raises ValueError below 0."""
    if seed < 0:
        raise ValueError(f"seed: expected at least 0, got {seed}")
    if is_wire(seed):
        assembly = Assembly(np.random.default_rng((seed, 0)))
        wires.wire(assembly)
        _pose(assembly)
        return assemble(assembly, "wire")
    weights = np.array([w for _, w in FAMILIES])
    for attempt in itertools.count():  # a cut may leave nothing or a thin sheet: draw again from the next stream
        assembly = Assembly(np.random.default_rng((seed, attempt)))
        family = FAMILIES[int(assembly.rng.choice(len(FAMILIES), p=weights / weights.sum()))][0]
        family(assembly)
        if assembly.solid_fraction() > MIN_VOLUME_FRACTION:
            break
    _deform(assembly)
    _pose(assembly)
    return assemble(assembly, family.__name__)


def is_wire(seed: int) -> bool:
    """Whether the object of ``seed`` is of thin tubes: some of the training objects are, no held-out one is."""
    if seed in VALIDATION_SEEDS or seed in TEST_SEEDS:
        return False
    return np.random.default_rng((seed, WIRE_STREAM)).random() < WIRE_PROBABILITY


def assemble(assembly: Assembly, name: str) -> ProceduralObject:
    """Builds the object of ``assembly``: union of at most MAX_FACES faces, normalization, normals, random materials."""
    vertices, faces, part = assembly.finish(MAX_FACES)
    vertices = unit_size(vertices).astype(np.float32)
    used, part = np.unique(part, return_inverse=True)
    part = part.reshape(-1).astype(np.int32)
    materials = draw_materials(assembly.rng, [assembly.roles[k] for k in used], part_bounds(vertices, faces, part))
    return ProceduralObject(vertices, faces, corner_normals(vertices, faces), part, materials, name)


def unit_size(vertices: np.ndarray) -> np.ndarray:
    """``vertices (V, 3)`` centered, with the longest side of their box 1."""
    low, high = vertices.min(0), vertices.max(0)
    return (vertices - (low + high) / 2) / (high - low).max()


def part_bounds(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Lowest and highest corner of the box of every part, ``(P, 2, 3)``."""
    corners = [vertices[faces[part == k]].reshape(-1, 3) for k in range(part.max() + 1)]
    return np.array([[points.min(0), points.max(0)] for points in corners])


def corner_normals(vertices: np.ndarray, faces: np.ndarray, crease_deg: float = CREASE_DEG) -> np.ndarray:
    """Shading normals ``(F, 3, 3)`` float32 of the corners, smooth across dihedral angles below ``crease_deg``.

    Corners connected by smooth edges get the mean of their faces' normals, weighted by area and angle.
    """
    p = vertices[faces].astype(np.float64)
    edge = np.roll(p, -1, 1) - p
    normal = np.cross(edge[:, 0], -edge[:, 2])
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-30)[:, None]
    a, b = edge, -np.roll(edge, 1, 1)
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))
    count, last = len(faces), int(faces.max()) + 1
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, 1).reshape(-1).astype(np.int64)
    key, mirrored = start * last + end, end * last + start
    order = np.argsort(key)
    opposite = order[np.minimum(np.searchsorted(key[order], mirrored), len(order) - 1)]  # half-edge on the other side
    half, found = np.arange(3 * count), key[opposite] == mirrored
    smooth = (normal[half // 3] * normal[opposite // 3]).sum(-1) > np.cos(np.radians(crease_deg))
    # a half-edge connects the corner at its start with the adjacent corner of the opposite face; slivers are smooth
    smooth |= (area[half // 3] < 1e-12) | (area[opposite // 3] < 1e-12)
    smooth &= found  # an open border has no other side
    here, there = half[smooth], (opposite - opposite % 3 + (opposite + 1) % 3)[smooth]
    label = graph_components(here, there, 3 * count)
    weight = np.repeat(normal * area[:, None], 3, axis=0) * angle.reshape(-1, 1)
    total = np.stack([np.bincount(label, weights=weight[:, k], minlength=3 * count) for k in range(3)], -1)
    size = np.linalg.norm(total, axis=1, keepdims=True)
    flat = np.repeat(normal, 3, axis=0)
    result = np.where(size[label] > 1e-20, total[label] / np.maximum(size[label], 1e-20), flat)
    result[np.linalg.norm(result, axis=1) < 0.5] = (0.0, 1.0, 0.0)  # an isolated sliver: any unit vector
    return result.reshape(count, 3, 3).astype(np.float32)


def _deform(a: Assembly) -> None:
    """Random scale per axis, and with probability 0.16 a taper, twist, bend or low-frequency waves."""
    rng, u = a.rng, a.rng.uniform
    a.transform(np.diag(np.exp(rng.normal(0, 0.12, 3))))
    if rng.random() > 0.16:
        return
    box = np.array(a.joined().bounding_box()).reshape(2, 3)
    center, size = box.mean(0), float((box[1] - box[0]).max())
    kind, k, wave = int(rng.integers(4)), u(-1, 1), rng.normal(0, 1, (4, 3)) * 4
    phase = u(0, 6.28, (4, 3))

    def move(q: np.ndarray) -> np.ndarray:
        r = (q - center) / size
        x, y, z = r.T
        if kind == 0:
            r = np.stack([x * (1 + 0.7 * k * y), y, z * (1 + 0.7 * k * y)], -1)
        elif kind == 1:
            c, s = np.cos(1.2 * k * y), np.sin(1.2 * k * y)
            r = np.stack([c * x + s * z, y, c * z - s * x], -1)
        elif kind == 2:
            r = np.stack([x + 0.35 * k * y**2, y, z], -1)
        else:
            r = r + 0.025 * abs(k) * sum(np.sin(r @ w[:, None] + f) for w, f in zip(wave, phase))
        return r * size + center

    a.warp(move, size / 18)


def _pose(a: Assembly) -> None:
    """Random yaw, a multiple of 90 degrees with probability 1/2; with probability 0.06 also lying on a side."""
    rng = a.rng
    if rng.random() < 0.06:
        a.transform(ON_BACK if rng.random() < 0.5 else ON_SIDE)
    yaw = rng.uniform(0, 2 * np.pi) if rng.random() < 0.5 else np.pi / 2 * rng.choice(4, p=[0.55, 0.15, 0.15, 0.15])
    a.transform(yaw_matrix(yaw))


def yaw_matrix(angle: float) -> np.ndarray:
    """Rotation ``(3, 3)`` about +Y by ``angle`` radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def sample_cameras(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world matrices ``(n, 4, 4)`` (OpenGL) and full fields of view ``(n,)`` in radians, float32.

    By the paper's protocol.  Azimuths are stratified with jitter and in random order; one set in six covers an arc.
    """
    if n < 1:
        raise ValueError(f"n: expected at least 1, got {n}")
    fov = np.radians(np.clip(rng.normal(29.5, 3.5, n), 22.0, 37.0))
    arc = 2 * np.pi if rng.random() > 1 / 6 else rng.uniform(0.4, 1.2) * np.pi
    azimuth = rng.uniform(0, 2 * np.pi) + arc * (rng.permutation(n) + rng.uniform(-0.35, 0.35, n)) / n
    elevation = np.radians(np.where(rng.random(n) < 0.9, rng.uniform(-20, 55, n), rng.uniform(-35, 75, n)))
    distance = FRAME_RADIUS / np.sin(fov / 2) * rng.uniform(0.8, 1.05, n)
    target = rng.normal(0, 0.02, (n, 3))
    horizontal = np.cos(elevation)
    direction = np.stack([horizontal * np.sin(azimuth), np.sin(elevation), horizontal * np.cos(azimuth)], -1)
    eye = torch.from_numpy((target + distance[:, None] * direction).astype(np.float32))
    c2w = look_at(eye, torch.from_numpy(target.astype(np.float32)), torch.tensor([0.0, 1.0, 0.0]))
    return c2w.numpy(), fov.astype(np.float32)
