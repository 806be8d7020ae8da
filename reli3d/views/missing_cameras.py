"""What to do with a folder of photographs that has no cameras: the commands that make them."""

from __future__ import annotations

import shlex
from pathlib import Path

from reli3d.io.files import InputError

ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
UNREAD = (".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw")  # of telephones and cameras


def no_cameras(folder: Path) -> InputError:
    """The error for ``folder`` without cameras: with commands for COLMAP's program where it holds photographs.

    The camera is a pinhole, so that photographs and masks stay as they are and no undistortion is needed.
    """
    photographs = _images(folder / "images")
    move = ""
    if not photographs and (photographs := _images(folder)):
        names = " ".join(sorted({f"{shlex.quote(str(folder))}/*{p.suffix}" for p in photographs}))
        images = shlex.quote(str(folder / "images"))
        move = f"mkdir {images} && mv {names} {images} && "  # COLMAP would take the masks for photographs
    unread = [p for place in (folder, folder / "images") for p in _images(place, UNREAD)]
    if not photographs and unread:
        return InputError(
            unread[0], "expected PNG, JPEG, WebP or TIFF photographs; convert them to JPEG, at full size and uncropped"
        )
    if len(photographs) < 2:
        return InputError(
            folder, "expected transforms.json or a COLMAP model (sparse/0), got neither; see docs/inputs.md"
        )
    images, database, sparse = (shlex.quote(str(folder / name)) for name in ("images", "database.db", "sparse"))
    masked = any((folder / name).is_dir() for name in ("masks", "mask"))
    return InputError(
        folder,
        f"expected cameras, got {len(photographs)} photographs without; make them with COLMAP: "
        f"{move}colmap feature_extractor --database_path {database} --image_path {images} "
        "--ImageReader.single_camera 1 --ImageReader.camera_model PINHOLE && "
        f"colmap exhaustive_matcher --database_path {database} && mkdir {sparse} && "
        f"colmap mapper --database_path {database} --image_path {images} --output_path {sparse}; then "
        f"run this again{'' if masked else ', with masks or --remove-background'}",
    )


def _images(folder: Path, endings: tuple[str, ...] = ENDINGS) -> list[Path]:
    try:
        return sorted(p for p in folder.iterdir() if p.suffix.lower() in endings and p.is_file())
    except OSError:
        return []
