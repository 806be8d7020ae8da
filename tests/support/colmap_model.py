"""One small model as COLMAP itself writes it, as text and as binary, by pycolmap 4.2.1: the files in ``colmap``.

Two cameras, a radial one and a pinhole, and four images of 32 x 24 pixels with a few points.
"""

import shutil
from pathlib import Path

MODEL = Path(__file__).parent / "colmap"
CAMERAS_BIN, IMAGES_BIN = ((MODEL / f"{name}.bin").read_bytes() for name in ("cameras", "images"))


def write_text(folder: Path) -> None:
    """The text model, into ``folder``."""
    folder.mkdir(parents=True)
    for name in ("cameras.txt", "images.txt"):
        shutil.copy(MODEL / name, folder)


def write_binary(folder: Path, cameras: bytes = CAMERAS_BIN, images: bytes = IMAGES_BIN) -> None:
    """The binary model, or another, into ``folder``."""
    folder.mkdir(parents=True)
    (folder / "cameras.bin").write_bytes(cameras)
    (folder / "images.bin").write_bytes(images)
