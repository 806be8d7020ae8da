"""``reli3d export``: converts a GLB to another format, with fewer triangles or smaller textures."""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from reli3d.cli.exit_codes import Parser, check_ranges, command, extra
from reli3d.errors import InputError

FORMATS = ("glb", "obj", "usdz")
DEFAULT_TEXELS = 1024  # per side of a new atlas
MIN_SOURCE_TEXELS = 128  # a smaller source does not set the size of a new atlas


def parser() -> argparse.ArgumentParser:
    p = Parser(
        prog="reli3d export",
        description="Convert a GLB with one surface to another format.  Prints the names of the written files.",
        epilog="Exit code: 0 done, 2 invalid input.",
    )
    p.add_argument("glb", type=Path, help="a GLB with one surface, such as mesh.glb of a result")
    p.add_argument(
        "--format",
        choices=FORMATS,
        default="glb",
        help="obj: with a material file and four PNG textures; usdz: needs pip install 'reli3d[usd]'",
    )
    p.add_argument(
        "--output", type=Path, default=Path("exports"), help="folder; files of the same name in it are replaced"
    )
    p.add_argument(
        "--decimate",
        type=int,
        metavar="N",
        help="reduce to at most N triangles, 16 to 10^7, with a new texture atlas (pip install 'reli3d[mesh]')",
    )
    p.add_argument(
        "--texture-size",
        type=int,
        help="texels per side, 64 to 4096 (default: as in the GLB, or 1024 for a new atlas of textures below 128)",
    )
    p.add_argument(
        "--textures",
        choices=("png", "webp"),
        default="png",
        help="image format in glb: png, or webp, also lossless and smaller, for viewers that support EXT_texture_webp",
    )
    p.add_argument("--json", action="store_true", help="print one JSON object instead of the names")
    return p


@command("reli3d export")
def main(argv: list[str] | None = None) -> int:
    from reli3d.output.folder import check_folder

    args = parser().parse_args(argv)
    check_ranges(args, decimate=(16, 10**7), texture_size=(64, 4096))
    if args.textures != "png" and args.format != "glb":
        raise InputError("--textures", f"expected png with --format {args.format}, got {args.textures}")
    check_folder(args.output)
    files, record = export(args)
    print(json.dumps({"files": [str(f) for f in files], **record}) if args.json else "\n".join(map(str, files)))
    return 0


def export(args: argparse.Namespace) -> tuple[list[Path], dict]:
    """Writes the files; returns their paths and a record of triangles and texture size."""
    from reli3d.fit.transfer import transfer_textures
    from reli3d.geometry.decimate import decimate
    from reli3d.geometry.mesh import vertex_normals
    from reli3d.io.files import write_bytes
    from reli3d.io.glb import glb_bytes, portable, read_glb
    from reli3d.io.obj import obj_files
    from reli3d.io.usd import usdz_bytes

    notes: list[str] = []
    origin: list[float] = []
    parts = read_glb(args.glb, notes=notes, origin=origin if args.format == "glb" else None)
    for note in notes:
        print(f"reli3d export: {note}", file=sys.stderr)
    if len(parts) != 1:
        raise InputError(args.glb, f"expected a GLB with one surface, got {len(parts)}")
    asset = parts[0]
    size = args.texture_size or asset.textures.size
    baked = size if args.texture_size or size >= MIN_SOURCE_TEXELS else DEFAULT_TEXELS
    if args.decimate is not None and len(asset.mesh.faces) > args.decimate:
        with extra("--decimate"):
            mesh = decimate(asset.mesh, args.decimate)
        mesh = replace(mesh, normals=vertex_normals(mesh.vertices, mesh.faces))
        asset = transfer_textures(mesh, asset, baked, shape=True)
    elif size != asset.textures.size or (args.format != "glb" and not portable(asset)):
        asset = transfer_textures(asset.mesh, asset, baked, shape=True)
    name = args.glb.stem
    if args.format == "glb":
        files = {f"{name}.glb": glb_bytes(asset, textures=args.textures, translation=origin)}
    elif args.format == "obj":
        files = obj_files(asset, name)
    else:
        with extra("--format usdz"):
            files = {f"{name}.usdz": usdz_bytes(asset)}
    args.output.mkdir(parents=True, exist_ok=True)
    for file, data in files.items():
        write_bytes(args.output / file, data)
    record = {"triangles": len(asset.mesh.faces), "texture_size": asset.textures.size}
    return [args.output / file for file in files], record
