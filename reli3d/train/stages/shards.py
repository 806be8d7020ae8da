"""Objects in tar files of the WebDataset form: written in parallel and resumable, read in any order, checked by hash.

A shard holds ``<object>.safetensors`` entries.  :mod:`reli3d.io.shards` has the index beside them.  Any reader of
WebDataset can stream them.
"""

from __future__ import annotations

import io
import sys
import tarfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from safetensors.torch import load, save
from torch import Tensor

from reli3d.io.files import InputError, replacing
from reli3d.io.shards import fault, pack_in_parts, read_index, shard_name, write_entry
from reli3d.train.stages.captures import Captures
from reli3d.train.stages.views import Chooser, ObjectViews, Samples, sample_views

OF_SAMPLE = ("images", "c2w", "intrinsics", "view_material", "view_normal", "view_depth", "environment")


def to_tensors(views: ObjectViews) -> dict[str, Tensor]:
    """What is stored of captures; the layout of :mod:`reli3d.synthetic.samples`, and what it lacks is not there."""
    images = torch.cat([views.images, views.masks[..., None]], -1)
    stored = {
        "images": (images * 255 + 0.5).to(torch.uint8),
        "c2w": views.c2w,
        "intrinsics": views.intrinsics,
        "background": torch.tensor(views.background),
    }
    if views.valid is not None:
        stored["view_valid"] = views.valid.to(torch.uint8)
    return {k: v.contiguous() for k, v in stored.items()}


def objects(source: Samples | Captures, numbers: Iterable[int]) -> Iterator[tuple[str, bytes]]:
    """Name and stored bytes of these objects of a folder of samples or captures."""
    for k in numbers:
        if isinstance(source, Samples):
            tensors = load(source.files[k].read_bytes())
            yield source.files[k].stem, save({n: tensors[n] for n in OF_SAMPLE if n in tensors})
        else:
            yield source.folders[k].name, save(to_tensors(source.load(k, range)))


def pack(
    source: Samples | Captures,
    folder: Path,
    *,
    each: int = 64,
    progress: Callable[[str], None] = lambda line: None,
    part: tuple[int, int] = (0, 1),
) -> None:
    """Write the objects of ``source`` as :func:`~reli3d.io.shards.pack_in_parts` does."""
    from webdataset import TarWriter

    names = [p.stem for p in source.files] if isinstance(source, Samples) else [p.name for p in source.folders]

    def write(number: int, numbers: range) -> dict:
        with replacing(folder / shard_name(number)) as temporary, TarWriter(str(temporary)) as writer:
            for name, data in objects(source, numbers):
                writer.write({"__key__": name, "safetensors": data})
        return write_entry(folder, number, [names[k] for k in numbers])

    pack_in_parts(folder, names, write, each=each, part=part, progress=progress)


class Shards:
    """Objects of a folder of shards, by number; a shard that is not whole is told on stderr and left out.

    Sizes are checked here, hashes by ``reli3d-data check``.
    """

    def __init__(self, folder: Path):
        self.places: list[tuple[Path, str, int, int]] = []  # shard, object, offset and length of its bytes
        for row in read_index(folder):
            wrong = fault(folder, row, hashed=False)
            found = [] if wrong else _members(folder / row["shard"])
            if found is None:
                wrong = f"{row['shard']}: expected a tar file, got a broken one"
            if wrong:
                print(f"{folder}: left out {wrong}", file=sys.stderr, flush=True)
            self.places += found or []
        if not self.places:
            raise InputError(folder, "expected a whole shard, got none; pack again")

    def __len__(self) -> int:
        return len(self.places)

    def tensors(self, index: int) -> dict[str, Tensor]:
        """What is stored of an object."""
        path, _, offset, length = self.places[index]
        with open(path, "rb") as file:
            file.seek(offset)
            return load(file.read(length))

    def load(self, index: int, choose: Chooser) -> ObjectViews:
        stored = self.tensors(index)
        views = sample_views(stored.get, choose)
        return replace(views, background=bool(stored.get("background", True)))


def _members(path: Path) -> list[tuple[Path, str, int, int]] | None:
    try:
        with tarfile.open(path, "r:") as tar:
            return [
                (path, m.name.removesuffix(".safetensors"), m.offset_data, m.size)
                for m in tar
                if m.name.endswith(".safetensors")
            ]
    except (tarfile.TarError, OSError):
        return None


def picture(tensors: dict[str, Tensor]) -> bytes:
    """PNG of all views of an object, with its base colours below where it has them."""
    from reli3d.io.images import png_bytes

    images = tensors["images"].float() / 255
    rows = [torch.cat(list(images[..., :3] * images[..., 3:]), 1)]
    if "view_material" in tensors:
        rows.append(torch.cat(list(tensors["view_material"][..., :3].float() / 255), 1))
    out = io.BytesIO()
    out.write(png_bytes((torch.cat(rows) * 255 + 0.5).to(torch.uint8)))
    return out.getvalue()
