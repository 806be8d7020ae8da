"""Folders of training objects, among them WebDataset tar files with one ``<object>.safetensors`` per object."""

import tarfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from reli3d.errors import InputError
from reli3d.io.files import replacing
from reli3d.train.stages.captures import Captures
from reli3d.train.stages.views import Chooser, ObjectViews, Samples, Source, sample_views

OF_VIEWS = ("images", "c2w", "intrinsics", "view_material", "view_normal", "view_depth")
STORED_TENSORS = (*OF_VIEWS, "environment", "finish_known")


def packed(source: Samples | Captures, index: int) -> tuple[str, bytes]:
    """Name and file of an object; that of a capture has the layout of :mod:`reli3d.synthetic.samples`."""
    if isinstance(source, Samples):
        tensors = load(source.files[index].read_bytes())
        return source.files[index].stem, save({n: tensors[n] for n in STORED_TENSORS if n in tensors})
    views = source.load(index, range)
    images = torch.cat([views.images, views.masks[..., None]], -1)
    stored = {"images": (images * 255 + 0.5).to(torch.uint8), "c2w": views.c2w, "intrinsics": views.intrinsics}
    stored["background"] = torch.tensor(views.background)
    if views.valid is not None:
        stored["view_valid"] = views.valid.to(torch.uint8)
    return source.folders[index].name, save({k: v.contiguous() for k, v in stored.items()})


def pack(
    source: Samples | Captures, folder: Path, *, each: int = 64, progress: Callable[[str], None] = lambda line: None
) -> None:
    """Writes the objects of ``source`` to ``NNNNNN.tar``, ``each`` per file; existing files are kept."""
    try:
        from webdataset import TarWriter
    except ImportError:
        raise InputError("pack", "expected the package webdataset, got none; pip install webdataset") from None
    folder.mkdir(parents=True, exist_ok=True)
    total = len(source)
    for number, first in enumerate(range(0, total, each)):
        path = folder / f"{number:06d}.tar"
        if path.exists():
            continue
        with replacing(path) as temporary, TarWriter(str(temporary)) as writer:
            for name, data in (packed(source, k) for k in range(first, min(first + each, total))):
                writer.write({"__key__": name, "safetensors": data})
        progress(f"{path.name}: {min(first + each, total)} of {total} objects")


class Shards:
    """The objects of a folder of shards, by index.  Raises InputError if a shard is broken or there is none."""

    def __init__(self, folder: Path):
        self.places: list[tuple[Path, int, int]] = []  # shard, offset and length of the object's bytes
        for path in sorted(folder.glob("*.tar")):
            try:
                with tarfile.open(path, "r:") as tar:
                    found = [(path, m.offset_data, m.size) for m in tar if m.name.endswith(".safetensors")]
            except (tarfile.TarError, OSError) as error:
                raise InputError(path, f"expected a tar file, got a broken one ({error}); pack it again") from None
            self.places += found
        if not self.places:
            raise InputError(folder, "expected tar files with *.safetensors entries, got none; pack again")

    def __len__(self) -> int:
        return len(self.places)

    def load(self, index: int, choose: Chooser) -> ObjectViews:
        path, offset, length = self.places[index]
        with open(path, "rb") as file:
            file.seek(offset)
            data = file.read(length)
        try:
            stored = load(data)
        except SafetensorError as error:
            raise InputError(path, f"expected a sample at byte {offset}, got a broken one ({error})") from None
        return replace(sample_views(stored.get, choose), background=bool(stored.get("background", True)))


def source(folder: Path) -> Source:
    """The objects of a folder of shards, samples or captures.  Raises InputError if it has none."""
    if not folder.is_dir():
        raise InputError(folder, "expected a folder of samples, captures or shards, got none")
    if any(folder.glob("*.tar")):
        return Shards(folder)
    if any(folder.glob("*.safetensors")):
        return Samples(folder)
    return Captures(folder)
