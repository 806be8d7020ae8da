"""Packs the data of ``train_small.sh`` into one archive: ``maps.npz``, ``meshes/``, ``shapes/``, ``materials/``.

    python tools/pack_training_data.py DATA.tar.xz --maps MAPS.npz --meshes DIR... --materials DIR [--shapes DIR...]

Reduced: textures and material sets to 256 texels as JPEG (with alpha: PNG), maps to 64 rows as float16, positions of
``--meshes`` to 1/8192 of the longest side, their texture coordinates to 1/2048, normals to 1/128.
"""

import argparse
import io
import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image
from torch.nn.functional import interpolate
from tqdm import tqdm

ROWS, TEXELS, QUALITY = 64, 256, 80
TEXTURES = ("baseColorTexture", "metallicRoughnessTexture", "normalTexture")


def reduced_image(image: Image.Image) -> bytes:
    """The image with a longest side of at most TEXELS, encoded."""
    image = image.convert("RGBA" if image.has_transparency_data else "RGB")
    image.thumbnail((TEXELS, TEXELS), Image.Resampling.BOX)
    file = io.BytesIO()
    image.save(file, "PNG" if image.mode == "RGBA" else "JPEG", quality=QUALITY, subsampling=0, optimize=True)
    return file.getvalue()


def reduced_mesh(path: Path) -> bytes:
    """The GLB with rounded coordinates and reduced textures."""
    scene = trimesh.load_scene(path, process=False)
    step = 2.0 ** np.round(np.log2(scene.extents.max() / 8192))
    for part in scene.geometry.values():
        normals = np.round(part.vertex_normals * 128) / 128
        part.vertices = np.round(part.vertices / step) * step
        part.vertex_normals = normals
        if getattr(part.visual, "uv", None) is not None:
            part.visual.uv = np.round(part.visual.uv * 2048) / 2048
        for name in TEXTURES:
            if image := getattr(getattr(part.visual, "material", None), name, None):
                setattr(part.visual.material, name, Image.open(io.BytesIO(reduced_image(image))))
    return scene.export(file_type="glb")


def reduced_maps(path: Path) -> bytes:
    """The environment maps, area-averaged to ROWS, as float16."""
    with np.load(path) as data:
        env, names = torch.as_tensor(data["env"].astype(np.float32)), data["names"]
    env = interpolate(env.permute(0, 3, 1, 2), (ROWS, 2 * ROWS), mode="area").permute(0, 2, 3, 1)
    file = io.BytesIO()
    np.savez(file, env=env.numpy().astype(np.float16), names=names)
    return file.getvalue()


def members(args: argparse.Namespace) -> Iterator[tuple[str, bytes]]:
    """Names in the archive and contents."""
    yield "maps.npz", reduced_maps(args.maps)
    for folder in args.materials.iterdir():
        for file in sorted(folder.iterdir()) if folder.is_dir() else ():
            yield f"materials/{folder.name}/{file.name}", reduced_image(Image.open(file))
    for kind in ("shapes", "meshes"):
        for file in sorted({f for folder in getattr(args, kind) for f in folder.rglob("*.glb")}):
            yield f"{kind}/{file.name}", file.read_bytes() if kind == "shapes" else reduced_mesh(file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("archive", type=Path, help=".tar.xz")
    parser.add_argument("--maps", type=Path, required=True, help=".npz: env (n, H, 2H, 3), names")
    parser.add_argument("--meshes", type=Path, nargs="+", required=True, help="folders of textured GLB files")
    parser.add_argument("--materials", type=Path, required=True, help="folder of material sets")
    parser.add_argument("--shapes", type=Path, nargs="+", default=[], help="folders of GLB files, for --shapes")
    args = parser.parse_args()
    with tarfile.open(args.archive, "x:xz") as archive:
        for name, content in tqdm(members(args), unit="file", disable=None):
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    print(f"{args.archive}: {args.archive.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
