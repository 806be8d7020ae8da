"""The error for input without cameras, with the command that estimates them."""

import os
import shlex
from pathlib import Path

from reli3d.errors import InputError
from reli3d.views.file_names import ENDINGS, images_in

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
PHOTOGRAPHS = (*ENDINGS, ".heic", ".heif")  # that reli3d capture reads
RAW = (".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw")
CAMERA_FILES = ("transforms.json", "transforms_train.json", "sparse", "poses_bounds.npy", "cameras_sphere.npz")


def no_cameras(source: Path) -> InputError:
    """The error for ``source``, which is not a folder with cameras."""
    missing = "expected transforms.json or a COLMAP model (sparse/0), got neither; see docs/guide.md"
    return capture_command(source, "a folder with cameras, got {} without") or InputError(source, missing)


def capture_command(source: Path, expected: str) -> InputError | None:
    """An error that names the exact ``reli3d capture`` command, or what it needs.

    None unless ``source`` is a video or a photograph, or has photographs in it, in ``images`` or in a sub-folder.
    expected: with ``{}`` for what there is.
    """
    if source.suffix.lower() in VIDEOS and source.is_file():
        return _capture(source, source, expected.format("a video"))
    if source.suffix.lower() in PHOTOGRAPHS and source.is_file():
        return _capture(source, source.absolute().parent, expected.format("a photograph"), source.parent)
    try:
        folders = sorted(p for p in source.iterdir() if p.is_dir())
    except (OSError, ValueError):
        return InputError(source, "expected a folder with transforms.json or a COLMAP model; check the path")
    for place in (source / "images", source):
        photographs = images_in(place, PHOTOGRAPHS)
        if len(photographs) > 1:
            return _capture(source, place, expected.format(f"{len(photographs)} photographs"))
        if not photographs and (videos := images_in(place, VIDEOS)):
            return _capture(source, videos[0], expected.format(f"{len(videos)} video{'s' if len(videos) > 1 else ''}"))
        if raw := images_in(place, RAW):
            return InputError(raw[0], "expected JPEG, HEIC or PNG photographs; convert them, full size and uncropped")
    ready = [p for p in folders if any((p / name).exists() for name in CAMERA_FILES)]
    if ready:
        one = shlex.quote(str(ready[0]))
        return InputError(source, f"expected one object, got {len(ready)} folders of objects; give {one}")
    for folder in folders:
        for place in (folder / "images", folder):
            if len(photographs := images_in(place, PHOTOGRAPHS)) > 1:
                got = expected.format(f"{len(photographs)} photographs in {folder.name}")
                return _capture(source, place, got, folder)
    return None


def _capture(source: Path, place: Path, expected: str, target: Path | None = None) -> InputError:
    base = Path(os.path.abspath(target or source))
    out = base.with_name(f"{base.stem if base.is_file() else base.name}-object")
    if not (target or source).is_absolute():
        out = Path(os.path.relpath(out))
    command = shlex.join(["reli3d", "capture", str(place), str(out)])
    return InputError(source, f"expected {expected}; run: {command}")
