"""What reads a user's files, each with files that it accepts: the targets of the campaign."""

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

import numpy as np
import torch
from safetensors.torch import save

from reli3d.cli.objects import listed
from reli3d.io.glb import glb_bytes, read_glb
from reli3d.io.hdr import environment_bytes, read_environment
from reli3d.io.images import read_image
from reli3d.nn.presets import SMALL, to_json
from reli3d.nn.weights import read_manifest
from reli3d.render.asset import Asset
from reli3d.synthetic.maps import load_maps
from reli3d.views.check import explain_cameras
from reli3d.views.folder import load_views
from tests.support import hostile, hostile_maps
from tests.support.known import KINDS
from tests.support.misread import Case
from tests.support.scenes import ball_mesh, textures


@dataclass(frozen=True)
class Target:
    """files: by their names in the folder that ``read`` is called with.  known: makes one with ground truth."""

    name: str
    files: dict[str, bytes]
    read: Callable[[Path], object]
    known: Callable[[Random], Case] | None = None


def _folder(make: Callable[[Path], object], root: Path) -> dict[str, bytes]:
    make(root)
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def _encoded(form: str, **options) -> bytes:
    return hostile.saved(hostile.random_image(alpha=form != "JPEG"), form, **options)


def _weights() -> bytes:
    return save({"x": torch.zeros(4)}, {"preset": to_json(SMALL), "licence": "none"})


def targets(root: Path) -> list[Target]:
    """root: an empty folder to make the accepted ones in."""
    found = [
        Target("transforms", _folder(hostile.good, root / "json"), load_views),
        Target("colmap", _folder(hostile.colmap, root / "colmap"), load_views),
    ]
    cameras = {"transforms.json": found[0].files["transforms.json"]}
    found.append(Target("rigs", cameras, _with_images))
    images = [
        ("png", {}),
        ("jpeg", {"progressive": True}),
        ("webp", {}),
        ("tiff", {}),
        ("tiff", {"compression": "tiff_lzw"}),
    ]
    for k, (form, options) in enumerate(images):
        name = f"a.{form}"
        found.append(
            Target(
                f"{form} {k}" if form == "tiff" else form,
                {name: _encoded(form.upper(), **options)},
                lambda folder, name=name: read_image(folder / name),
            )
        )
    radiance = torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(0))
    asset = Asset(ball_mesh(1, 0.6), textures(4, torch.device("cpu")))
    maps = io.BytesIO()
    np.savez(maps, env=np.ones((2, 4, 8, 3), np.float32), names=["a", "b"])
    found += [
        Target("hdr", {"a.hdr": environment_bytes(radiance)}, lambda f: read_environment(f / "a.hdr")),
        Target("exr", {"a.exr": hostile_maps.exr_bytes()}, lambda f: read_environment(f / "a.exr")),
        Target("glb", {"a.glb": glb_bytes(asset)}, lambda f: read_glb(f / "a.glb")),
        Target("weights", {"a.safetensors": _weights()}, lambda f: read_manifest(f / "a.safetensors").preset()),
        Target("maps", {"a.npz": maps.getvalue()}, lambda f: load_maps(f / "a.npz")),
        Target("list", {"a.txt": b"one\ntwo/three\n"}, lambda f: listed(f / "a.txt")),
    ]
    return found + [Target(name, {}, _nothing, make) for name, make in KINDS.items()]


def _nothing(folder: Path) -> None:
    """A target with ground truth reads by itself."""


def _with_images(folder: Path) -> None:
    """Only the cameras are changed; the images are valid."""
    (folder / "rgba").mkdir(exist_ok=True)
    data = _encoded("PNG")
    for k in range(3):
        (folder / "rgba" / f"{k}.png").write_bytes(data)
    explain_cameras(load_views(folder))
