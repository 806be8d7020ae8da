"""Environment maps: which ones training may see, and lamps that are added to them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reli3d.errors import InputError, shown
from reli3d.io.files import file_size
from reli3d.render.latlong import lat_long_directions, quarter_turn, texel_solid_angles

ROWS = 64
HELD_BACK = 6  # every sixth map is left out of the fit and of all training


def load_maps(path: Path) -> tuple[Tensor, list[str]]:
    """Maps ``(n, 64, 128, 3)``, linear, area-averaged, the center column +X, and their names, of an ``.npz``.

    The file has ``env (n, H, 2H, 3)``, linear, row 0 +Y, the center column -Z and right of it +X, and ``names``.
    Raises InputError for anything else.
    """
    file_size(path)
    try:
        with np.load(path) as data:
            env, names = data["env"], [str(n) for n in data["names"]]
    except KeyError as error:
        raise InputError(path, f"expected an .npz of env and names, got none of {error}") from None
    except Exception as error:  # on a broken file numpy and zipfile raise almost anything
        raise InputError(path, f"expected an .npz of env and names, got a broken file ({shown(str(error))})") from None
    if env.dtype.kind != "f" or env.ndim != 4 or env.shape[3] != 3 or env.shape[2] != 2 * env.shape[1] or not env.size:
        raise InputError(path, f"env: expected floats of shape (n, H, 2H, 3), got {env.dtype} {env.shape}")
    if len(names) != len(env):
        raise InputError(path, f"names: expected {len(env)}, one a map, got {len(names)}")
    maps = torch.as_tensor(env.astype(np.float32)).permute(0, 3, 1, 2)
    maps = torch.nn.functional.interpolate(maps, (ROWS, 2 * ROWS), mode="area").permute(0, 2, 3, 1)
    return quarter_turn(maps, -1).contiguous(), names  # the file has -Z in the center column


def held_back(names: list[str]) -> list[bool]:
    """Which maps no training may see: every sixth by alphabetical order."""
    rank = {n: i for i, n in enumerate(sorted(names))}
    return [rank[n] % HELD_BACK == HELD_BACK - 1 for n in names]


def training_maps(path: Path) -> Tensor:
    """The maps of :func:`load_maps` that training may see, ``(n, 64, 128, 3)``."""
    maps, names = load_maps(path)
    return maps[torch.tensor([not held for held in held_back(names)])].contiguous()


def with_lamps(light: Tensor, rng: np.random.Generator) -> Tensor:
    """The lat-long map ``(H, 2H, 3)`` with one to three lamps: soft disks that bring a good part of its light."""
    rows = light.shape[0]
    directions = lat_long_directions(rows)
    area = texel_solid_angles(rows, 2 * rows).float()[:, None, None]
    total = float((light.mean(-1, keepdim=True) * area).sum())
    out = light.clone()
    for _ in range(int(rng.integers(1, 4))):
        y = rng.uniform(-0.15, 0.98)
        angle = rng.uniform(0, 2 * np.pi)
        level = np.sqrt(1 - y * y)
        to = torch.tensor([level * np.cos(angle), y, level * np.sin(angle)], dtype=torch.float32)
        radius = np.radians(np.exp(rng.uniform(np.log(2.0), np.log(18.0))))
        away = (directions @ to).clamp(-1, 1).acos()
        disk = torch.sigmoid((radius - away) / (0.15 * radius + np.pi / rows / 2))[..., None]
        warmth = rng.normal(0, 0.25)
        tint = torch.tensor([np.exp(warmth), 1.0, np.exp(-warmth)], dtype=torch.float32)
        share = np.exp(rng.uniform(np.log(0.15), np.log(1.5)))
        out += disk * tint * (share * total / float((disk * area).sum()))
    return out
