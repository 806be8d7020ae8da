"""Opens a folder of training objects."""

from pathlib import Path

from reli3d.errors import InputError
from reli3d.train.stages.captures import Captures
from reli3d.train.stages.shards import Shards
from reli3d.train.stages.views import Samples, Source


def source(folder: Path) -> Source:
    """The objects of a folder of shards, samples or captures.  Raises InputError if it has none."""
    if not folder.is_dir():
        raise InputError(folder, "expected a folder of samples, captures or shards, got none")
    if any(folder.glob("*.tar")):
        return Shards(folder)
    if any(folder.glob("*.safetensors")):
        return Samples(folder)
    return Captures(folder)
