"""Opens a folder of training objects."""

from pathlib import Path

from reli3d.errors import InputError
from reli3d.train.stages.captures import Captures
from reli3d.train.stages.views import Samples, Source


def source(folder: Path) -> Source:
    """The objects of a folder of samples or captures.  Raises InputError if it has none."""
    if not folder.is_dir():
        raise InputError(folder, "expected a folder of samples or captures, got none")
    if any(folder.glob("*.safetensors")):
        return Samples(folder)
    return Captures(folder)
