"""What a file of a training sample must hold, checked by its header before any work."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from safetensors import SafetensorError, safe_open

from reli3d.errors import InputError, shown
from reli3d.io.files import file_size

# Axes and dtype of each tensor of :mod:`reli3d.synthetic.samples`; a letter stands for the same number everywhere.
TENSORS = {
    "images": ("V S S 4", "U8"),
    "c2w": ("V 4 4", "F32"),
    "intrinsics": ("V 4", "F32"),
    "environment": ("32 64 3", "F16"),
    "points": ("P 3", "F16"),
    "distance": ("P", "F16"),
    "surface": ("N 3 3", "F16"),
    "material": ("N 5", "U8"),
    "visible": ("N V", "U8"),
    "view_material": ("V S S 5", "U8"),
    "view_normal": ("V S S 3", "I8"),
    "view_depth": ("V S S", "F16"),
    "finish_known": ("V", "U8"),
}
OF_POINTS = ("points", "distance", "surface", "material", "visible")  # not in samples of views alone
OPTIONAL = ("finish_known",)  # not in samples of version 0.3, whose finish is taken as known


def check_sample(path: str | os.PathLike, *, views: int = 1, points: bool = True) -> None:
    """Raise InputError where ``path`` is no whole sample of at least ``views`` views.  Values are not read.

    points: whether it must hold those of the volume and the surface.
    """
    file_size(path)
    try:
        with safe_open(path, "pt") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118 - no iterable
            found = {name: (tuple(s.get_shape()), s.get_dtype()) for name, s in slices.items()}
    except SafetensorError as error:
        raise InputError(
            path, f"expected a sample of reli3d-data, got a broken file ({shown(str(error))}); make it again"
        ) from None
    sizes: dict[str, int] = {}
    for name, (axes, dtype) in TENSORS.items():
        if (name in OF_POINTS and not points) or (name in OPTIONAL and name not in found):
            continue
        shape, got = found.get(name, ((), None))
        wanted = axes.split()
        if got != dtype or len(shape) != len(wanted):
            found_text = "none" if got is None else f"{got} {shape}"
            raise InputError(path, f"{name}: expected {dtype} ({', '.join(wanted)}), got {found_text}; make it again")
        for letter, size in zip(wanted, shape, strict=True):
            if size < 1 or size != (int(letter) if letter.isdigit() else sizes.setdefault(letter, size)):
                raise InputError(
                    path,
                    f"{name}: expected ({', '.join(wanted)}) as its other tensors have it, got {shape}; make it again",
                )
    if sizes["V"] < views:
        raise InputError(path, f"views: expected at least {views}, got {sizes['V']}; make samples of more views")


def check_samples(
    folder: Path,
    name: str,
    *,
    views: int = 1,
    points: bool = True,
    also: Callable[[Path], None] = lambda path: None,
) -> list[Path]:
    """Files of all samples in ``folder``, checked.  Raises InputError where one is broken or there is none.

    name: of the option or argument that gave the folder.  points: as in :func:`check_sample`.  also: what else must
    hold of each file.
    """
    if not folder.is_dir():
        raise InputError(name, f"expected a folder of samples, got {shown(str(folder))}; make them with reli3d-data")
    files = sorted(folder.glob("*.safetensors"))
    if not files:
        raise InputError(name, f"expected *.safetensors files, got none in {folder}; make them with reli3d-data")
    for path in files:
        also(path)
        check_sample(path, views=views, points=points)
    return files
