"""Batches from the sample files of :mod:`reli3d.synthetic.samples`: a choice of views and points, and one random turn
of the world.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor

from reli3d.geometry.hull import mask_distance
from reli3d.nn.reni import map_directions


@dataclass(frozen=True)
class Batch:
    """``B`` objects, ``V`` input views; float32; ``visible`` speaks of the input views; ``pixels`` come from all
    views.
    """

    images: Tensor  # (B, V, S, S, 3) sRGB
    masks: Tensor  # (B, V, S, S)
    silhouette: Tensor  # (B, V, S, S) pixels
    c2w: Tensor  # (B, V, 4, 4)
    intrinsics: Tensor  # (B, V, 4)
    points: Tensor  # (B, P, 3)
    distance: Tensor  # (B, P)
    surface: Tensor  # (B, N, 3, 3) position, normal, bumped normal
    material: Tensor  # (B, N, 5)
    visible: Tensor  # (B, N, V)
    light_directions: Tensor  # (B, 2048, 3) world, after the turn
    light: Tensor  # (B, 2048, 3) linear radiance
    pixels: Tensor  # (B, M, 3, 3)
    pixel_radiance: Tensor  # (B, M, 3)


TURNED_UP = 0.12  # share of objects whose world is not +Y up: captures come in any frame


def random_turn(rng: np.random.Generator) -> Tensor:
    """A yaw about +Y; now and then followed by a turn that makes another axis the vertical one."""
    a = rng.uniform(0, 2 * np.pi)
    yaw = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    if rng.random() < TURNED_UP:
        up = [np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
              np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]])][rng.integers(3)]  # fmt: skip
        yaw = up @ yaw
    return torch.as_tensor(yaw, dtype=torch.float32)


def mirrored(sample: dict[str, Tensor]) -> dict[str, Tensor]:
    """The sample seen in a mirror at the plane x = 0: another object under another light, as true as the first."""
    flip = torch.tensor([-1.0, 1.0, 1.0])
    out = dict(sample)
    for key in ("points", "surface", "light_directions", "pixels"):
        out[key] = sample[key] * flip
    out["c2w"] = sample["c2w"].clone()
    out["c2w"][:, :3] *= flip[:, None]
    out["c2w"][:, :, 0] *= -1  # the camera stays right-handed, its picture is flipped
    out["intrinsics"] = sample["intrinsics"].clone()
    out["intrinsics"][:, 2] = sample["images"].shape[2] - sample["intrinsics"][:, 2]
    out["images"] = sample["images"].flip(2)
    out["masks"], out["silhouette"] = sample["masks"].flip(2), sample["silhouette"].flip(2)
    return out


def recolored(sample: dict[str, Tensor], order: Tensor) -> dict[str, Tensor]:
    """The sample with its colour channels exchanged, ``order (3,)``, in material, light and images alike."""
    out = {k: sample[k][..., order] if k in ("images", "light", "pixel_radiance") else v for k, v in sample.items()}
    out["material"] = torch.cat([sample["material"][:, order], sample["material"][:, 3:]], -1)
    return out


def load_sample(
    path: Path, views: int, points: int, rng: np.random.Generator, *, augment: bool = True
) -> dict[str, Tensor]:
    """One object: ``views`` random views, ``points`` of each kind; turned, mirrored and recoloured at random.

    Without ``augment`` the first views, as they are.
    """
    with safe_open(path, "pt") as file:
        total = file.get_slice("c2w").get_shape()[0]
        order = rng.permutation(total) if augment else np.arange(total)
        chosen = torch.as_tensor(order[:views].copy())
        every = {k: file.get_tensor(k) for k in ("images", "c2w", "intrinsics", "visible", "environment")}

        def part(key: str, count: int) -> Tensor:
            n = file.get_slice(key).get_shape()[0]
            first = int(rng.integers(max(1, n - count + 1)))
            return file.get_slice(key)[first : first + count]

        # near and uniform points lie in two halves; a run of each is as random as a draw, and cheap to read
        half = file.get_slice("distance").get_shape()[0] // 2
        a, b = int(rng.integers(half - points // 2 + 1)), half + int(rng.integers(half - points // 2 + 1))
        runs = [slice(a, a + points // 2), slice(b, b + points // 2)]
        volume = torch.cat([file.get_slice("points")[r] for r in runs]).float()
        distance = torch.cat([file.get_slice("distance")[r] for r in runs]).float()
        n = file.get_slice("material").get_shape()[0]
        s = int(rng.integers(n - points // 2 + 1))
        s = slice(s, s + points // 2)
        surface, material = file.get_slice("surface")[s].float(), file.get_slice("material")[s].float() / 255
        view = int(order[-1])  # a view that is not among the inputs as long as there is one
        m = int(rng.integers(file.get_slice("pixels").get_shape()[1] - points // 4 + 1))
        pixels = file.get_slice("pixels")[view, m : m + points // 4].float()
        pixel_radiance = file.get_slice("pixel_radiance")[view, m : m + points // 4].float()
    turn = random_turn(rng) if augment else torch.eye(3)
    c2w = every["c2w"][chosen].clone()
    c2w[:, :3] = turn @ c2w[:, :3]
    images = every["images"][chosen].float() / 255
    light = every["environment"].float()
    sample = {
        "images": images[..., :3], "masks": images[..., 3], "silhouette": mask_distance(images[..., 3].contiguous()),
        "c2w": c2w, "intrinsics": every["intrinsics"][chosen], "points": volume @ turn.T, "distance": distance,
        "surface": surface @ turn.T, "material": material, "visible": every["visible"][s][:, chosen].float(),
        "light_directions": map_directions(light.shape[0]).reshape(-1, 3) @ turn.T, "light": light.reshape(-1, 3),
        "pixels": pixels @ turn.T, "pixel_radiance": pixel_radiance,
    }  # fmt: skip
    if augment and rng.random() < 0.5:
        sample = mirrored(sample)
    if augment:
        sample = recolored(sample, torch.as_tensor(rng.permutation(3)))
    return sample


def batches(
    folder: Path, *, size: int, points: int, max_views: int, seed: int, start: int = 0, rank: int = 0
) -> Iterator[Batch]:
    """Endless batches of ``size`` objects; step ``k`` is a function of ``seed`` and ``k`` alone for a fixed folder,
    so training resumes; ``rank`` tells processes apart that share a step.
    """
    files, step = sorted(folder.glob("*.safetensors")), start
    if not files:
        raise ValueError(f"samples: expected *.safetensors files, got none in {folder}")
    while True:
        if step % 100 == 0:  # samples may still be arriving
            files = sorted(folder.glob("*.safetensors"))
        views = int(np.random.default_rng((seed, step)).choice(np.arange(1, max_views + 1)))  # the same in all ranks
        rng = np.random.default_rng((seed, step, rank))
        loaded = [load_sample(files[int(rng.integers(len(files)))], views, points, rng) for _ in range(size)]
        yield Batch(**{k: torch.stack([s[k] for s in loaded]) for k in loaded[0]})
        step += 1
