"""Environment maps: the split into training and held-out maps, and added lamps."""

import zipfile
import zlib
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reli3d.errors import InputError, shown
from reli3d.io.files import file_size
from reli3d.render.latlong import lat_long_directions, quarter_turn, texel_solid_angles

ROWS = 64
# of numpy, zipfile and zlib for a cut, changed, encrypted or unknown file; TypeError and AttributeError: an .npy file
BROKEN = (ValueError, TypeError, AttributeError, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)
HELD_OUT_EVERY = 6  # every sixth map is held out of all training


def load_maps(path: Path) -> tuple[Tensor, list[str]]:
    """Reads maps ``(n, 64, 128, 3)``, linear radiance, and their names from an ``.npz``.

    The file has ``names`` and ``env (n, H, 2H, 3)``, linear, upper edge +Y, horizontal center -Z, +X right of it.  The
    result is area-averaged, in the layout of :mod:`reli3d.render.latlong`.  Raises InputError for any other file.
    """
    file_size(path)
    try:
        with np.load(path) as data:
            env, names = data["env"], [str(n) for n in data["names"]]
    except KeyError as error:
        raise InputError(path, f"expected an .npz of env and names, got none of {error}") from None
    except BROKEN as error:
        raise InputError(path, f"expected an .npz of env and names, got a broken file ({shown(str(error))})") from None
    if env.dtype.kind != "f" or env.ndim != 4 or env.shape[3] != 3 or env.shape[2] != 2 * env.shape[1] or not env.size:
        raise InputError(path, f"env: expected floats of shape (n, H, 2H, 3), got {env.dtype} {env.shape}")
    if len(names) != len(env):
        raise InputError(path, f"names: expected {len(env)}, one a map, got {len(names)}")
    maps = torch.as_tensor(env.astype(np.float32)).permute(0, 3, 1, 2)
    bad = [name for name, light in zip(names, maps) if not bool(((light >= 0) & light.isfinite()).all())]
    if bad:
        raise InputError(path, f"env: expected finite radiance of at least 0, got others in {', '.join(bad[:3])}")
    maps = torch.nn.functional.interpolate(maps, (ROWS, 2 * ROWS), mode="area").permute(0, 2, 3, 1)
    return quarter_turn(maps, -1).contiguous(), names  # the file has -Z at the horizontal center


def held_out(names: list[str]) -> list[bool]:
    """Whether each map is held out: every sixth in alphabetical order."""
    rank = {n: i for i, n in enumerate(sorted(names))}
    return [rank[n] % HELD_OUT_EVERY == HELD_OUT_EVERY - 1 for n in names]


def training_maps(path: Path) -> Tensor:
    """The maps of :func:`load_maps` that are not held out, ``(n, 64, 128, 3)``."""
    maps, names = load_maps(path)
    return maps[torch.tensor([not h for h in held_out(names)])].contiguous()


def with_lamps(light: Tensor, rng: np.random.Generator) -> Tensor:
    """The lat-long map ``(H, 2H, 3)`` with one to three added lamps: soft disks of 0.15 to 1.5 times its total flux."""
    rows = light.shape[0]
    directions = lat_long_directions(rows)
    area = texel_solid_angles(rows, 2 * rows).float()[:, None, None]
    total = float((light.mean(-1, keepdim=True) * area).sum())
    out = light.clone()
    for _ in range(int(rng.integers(1, 4))):
        y, angle = rng.uniform(-0.15, 0.98), rng.uniform(0, 2 * np.pi)
        horizontal = np.sqrt(1 - y * y)
        to = torch.tensor([horizontal * np.cos(angle), y, horizontal * np.sin(angle)], dtype=torch.float32)
        radius = np.radians(np.exp(rng.uniform(np.log(2.0), np.log(18.0))))
        away = (directions @ to).clamp(-1, 1).acos()
        disk = torch.sigmoid((radius - away) / (0.15 * radius + np.pi / rows / 2))[..., None]
        tint = torch.tensor(np.exp(rng.normal(0, 0.25) * np.array([1, 0, -1])), dtype=torch.float32)
        flux = total * np.exp(rng.uniform(np.log(0.15), np.log(1.5)))
        out += disk * tint * (flux / float((disk * area).sum()))
    return out
