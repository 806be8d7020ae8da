"""Packs the data of ``train_small.sh`` into one archive: ``maps.npz``, ``meshes/``, ``shapes/``, ``materials/``.

    python tools/pack_training_data.py DATA.tar.xz --maps MAPS.npz --meshes DIR... --materials DIR [--shapes DIR...]

Reduced: textures and material sets to 256 texels as JPEG without alpha, which training does not read; maps to 64 rows
as float16; positions of ``--meshes`` to 1/8192 of each primitive's longest side, texture coordinates to 1/2048,
normals to 1/128.
"""

import argparse
import io
import json
import struct
import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch.nn.functional import interpolate
from tqdm import tqdm

from reli3d.cli.data import glb_files
from reli3d.io.files import replacing
from reli3d.synthetic.refinished import material_sets

ROWS, TEXELS, QUALITY = 64, 256, 80
FLOAT = 5126  # componentType of float32 in glTF
STEPS = {"POSITION": 1 / 8192, "NORMAL": 1 / 128, "TEXCOORD_0": 1 / 2048}


def reduced_image(file: Path | io.BytesIO) -> bytes:
    """The image as JPEG with a longest side of at most TEXELS."""
    image = Image.open(file)
    if image.mode.startswith("I"):  # 16-bit gray
        image = Image.fromarray((np.asarray(image) / 257).round().astype(np.uint8))
    image = image.convert("RGB")
    image.thumbnail((TEXELS, TEXELS), Image.Resampling.BOX)
    encoded = io.BytesIO()
    image.save(encoded, "JPEG", quality=QUALITY, subsampling=0, optimize=True)
    return encoded.getvalue()


def reduced_mesh(path: Path) -> bytes:
    """The GLB with rounded float attributes and reduced images; the rest of its JSON is unchanged."""
    file = path.read_bytes()
    size = int.from_bytes(file[12:16], "little")
    document, binary = json.loads(file[20 : 20 + size]), file[28 + size :]
    views, images = document["bufferViews"], document.get("images", ())
    if len(document["buffers"]) > 1 or any("bufferView" not in image for image in images):
        raise SystemExit(f"{path}: expected buffer and images inside the file, got others; export it as one GLB")
    if (extension := "KHR_materials_pbrSpecularGlossiness") in document.get("extensionsUsed", ()):
        raise SystemExit(f"{path}: expected metallic-roughness materials, got {extension}; convert them")
    contents = [bytearray(binary[v.get("byteOffset", 0) :][: v["byteLength"]]) for v in views]
    for image in images:
        contents[image["bufferView"]] = bytearray(reduced_image(io.BytesIO(contents[image["bufferView"]])))
        image["mimeType"] = "image/jpeg"
    attributes = [p["attributes"] for m in document["meshes"] for p in m["primitives"]]
    for name, k in sorted({(name, a[name]) for a in attributes for name in STEPS if name in a}):
        accessor, width = document["accessors"][k], 2 if name == "TEXCOORD_0" else 3
        if accessor["componentType"] == FLOAT and "bufferView" in accessor:
            view = accessor["bufferView"]
            strides = views[view].get("byteStride", 4 * width), 4
            offset = accessor.get("byteOffset", 0)
            values = np.ndarray((accessor["count"], width), "<f4", contents[view], offset, strides)
            extent = float(np.ptp(values, 0).max()) if name == "POSITION" else 1.0
            step = 2.0 ** np.floor(np.log2(max(extent, 1e-30) * STEPS[name]))
            values[:] = np.round(values / step) * step
            if name == "POSITION":
                accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
    chunk = bytearray()
    for view, content in zip(views, contents, strict=True):
        view |= {"byteOffset": len(chunk), "byteLength": len(content)}
        chunk += content + bytes(-len(content) % 4)
    document["buffers"] = [{"byteLength": len(chunk)}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(chunk), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(chunk), b"BIN\0") + chunk


def reduced_maps(path: Path) -> bytes:
    """The environment maps, area-averaged to ROWS, as float16 (float32 where radiance exceeds its range)."""
    with np.load(path) as data:
        env, names = torch.as_tensor(data["env"].astype(np.float32)), data["names"]
    env = interpolate(env.permute(0, 3, 1, 2), (ROWS, 2 * ROWS), mode="area").permute(0, 2, 3, 1)
    file = io.BytesIO()
    dtype = np.float16 if env.max() < np.finfo(np.float16).max else np.float32
    np.savez(file, env=env.numpy().astype(dtype), names=names)
    return file.getvalue()


def members(args: argparse.Namespace) -> Iterator[tuple[str, bytes]]:
    """Names in the archive and contents."""
    files = {kind: glb_files(getattr(args, kind)) for kind in ("shapes", "meshes")}
    sets = material_sets(args.materials)
    yield "maps.npz", reduced_maps(args.maps)
    for folder in sets:
        for name in ("basecolor", "roughness", "metallic", "normal"):
            for file in sorted(folder.glob(f"{name}.*"))[:1]:
                yield f"materials/{folder.name}/{name}.jpg", reduced_image(file)
    for kind, paths in files.items():
        for k, path in enumerate(paths):
            yield f"{kind}/{k:04d}_{path.name}", path.read_bytes() if kind == "shapes" else reduced_mesh(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("archive", type=Path, help=".tar.xz")
    parser.add_argument("--maps", type=Path, required=True, help=".npz: env (n, H, 2H, 3), names")
    parser.add_argument("--meshes", type=Path, nargs="+", required=True, help="textured GLB files or folders of them")
    parser.add_argument("--materials", type=Path, required=True, help="folder of material sets")
    parser.add_argument("--shapes", type=Path, nargs="+", help="GLB files or folders of them, for --shapes in training")
    args = parser.parse_args()
    with replacing(args.archive) as temporary, tarfile.open(temporary, "w:xz") as archive:
        for name, content in tqdm(members(args), unit="file", disable=None):
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    print(f"{args.archive}: {args.archive.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
