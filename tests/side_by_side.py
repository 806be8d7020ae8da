"""A reconstruction in our renderer and in three clients, in one image: ``python -m tests.side_by_side FOLDER OUT``.

FOLDER is the output of reli3d-infer for an object.  For the clients see ``tests/support/clients.py``.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw

from reli3d.io.hdr import read_environment, write_environment
from reli3d.render.lights import studio
from tests.support import clients

BACKGROUND = 255.0
SAMPLES = (32, 64, 8)  # by light, by visible normals, by the cosine


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="python -m tests.side_by_side", description=__doc__.splitlines()[0])
    p.add_argument("folder", type=Path)
    p.add_argument("output", type=Path)
    for name, value in vars(clients.Viewpoint()).items():
        p.add_argument(f"--{name}", type=type(value), default=value)
    p.add_argument("--studio", action="store_true", help="under the package's studio instead of the estimated lighting")
    args = p.parse_args(argv)
    viewpoint = clients.Viewpoint(args.size, args.fov, args.azimuth, args.elevation, args.distance)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name in ("mesh.glb", "environment.hdr", "environment.exr"):
            shutil.copy(args.folder / name, folder)
        if args.studio:
            for name in ("environment.hdr", "environment.exr"):
                write_environment(folder / name, studio(256))
        light = read_environment(folder / "environment.exr")
        try:
            images = {
                "reli3d-render": clients.ours(folder / "mesh.glb", light, viewpoint, SAMPLES),
                "three.js": clients.three_js(folder, viewpoint),
                "model-viewer": clients.model_viewer(folder, viewpoint),
                "Blender Cycles": clients.blender(folder, viewpoint),
            }
        except pytest.skip.Exception as missing:  # a client is not there
            print(missing, file=sys.stderr)
            return 2
    tiles = []
    for name, rgba in images.items():
        cover = rgba[..., 3:] / 255.0
        tile = Image.fromarray((rgba[..., :3] * cover + BACKGROUND * (1.0 - cover)).round().astype(np.uint8))
        ImageDraw.Draw(tile).text((6, 4), name, fill="black")
        tiles.append(np.asarray(tile))
    Image.fromarray(np.concatenate(tiles, 1)).save(args.output, quality=92)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
