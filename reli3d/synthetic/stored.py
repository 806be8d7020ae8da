"""Validation of training samples by their file headers."""

import os
from collections.abc import Callable
from pathlib import Path

from safetensors import SafetensorError, safe_open

from reli3d.errors import InputError, shown
from reli3d.io.files import file_size

# Axes and dtype of each tensor of :mod:`reli3d.synthetic.samples`; equal letters must have equal sizes.
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
POINT_TENSORS = ("points", "distance", "surface", "material", "visible")  # absent from samples with views only
OPTIONAL = ("finish_known",)  # not in samples of version 0.3, whose finish is taken as known


def check_sample(path: str | os.PathLike, *, views: int = 1, points: bool = True) -> None:
    """Raises InputError unless ``path`` is a complete sample with at least ``views`` views.  Reads the header only.

    points: whether it must have points of the volume and the surface.
    """
    file_size(path)
    try:
        with safe_open(path, "pt") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118 - no iterable
            found = {name: (tuple(s.get_shape()), s.get_dtype()) for name, s in slices.items()}
    except SafetensorError as error:
        problem = f"expected a sample of reli3d-data, got a broken file ({shown(str(error))})"
        raise InputError(path, f"{problem}; make it again") from None
    sizes: dict[str, int] = {}
    for name, (axes, dtype) in TENSORS.items():
        if (name in POINT_TENSORS and not points) or (name in OPTIONAL and name not in found):
            continue
        shape, got = found.get(name, ((), None))
        expected = axes.split()
        if got != dtype or len(shape) != len(expected):
            found_text = "none" if got is None else f"{got} {shape}"
            raise InputError(path, f"{name}: expected {dtype} ({', '.join(expected)}), got {found_text}; make it again")
        for letter, size in zip(expected, shape, strict=True):
            if size < 1 or size != (int(letter) if letter.isdigit() else sizes.setdefault(letter, size)):
                problem = f"{name}: expected ({', '.join(expected)}) as in its other tensors, got {shape}"
                raise InputError(path, f"{problem}; make it again")
    if sizes["V"] < views:
        raise InputError(path, f"views: expected at least {views}, got {sizes['V']}; make samples of more views")


def check_samples(
    folder: Path, name: str, *, views: int = 1, points: bool = True, also: Callable[[Path], None] = lambda path: None
) -> list[Path]:
    """All sample files of ``folder``, checked, also by ``also``.  name: of the option.  Raises InputError."""
    if not folder.is_dir():
        raise InputError(name, f"expected a folder of samples, got {shown(str(folder))}; make them with reli3d-data")
    files = sorted(folder.glob("*.safetensors"))
    if not files:
        raise InputError(name, f"expected *.safetensors files, got none in {folder}; make them with reli3d-data")
    for path in files:
        also(path)
        check_sample(path, views=views, points=points)
    return files
