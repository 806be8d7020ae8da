"""Results in shards: an object is a folder until its shard is full.

The shard is on the disk, and in its entry, before the folders go; whatever is killed in between, an object is in a
folder, in a shard, or in both, and the next call ends what was begun.  Shards that are there never change.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection, Iterator
from pathlib import Path

from reli3d.io import shards
from reli3d.io.files import InputError
from reli3d.io.tar import Packed, packed_objects
from reli3d.output.folder import claimed

MAX_RECORD = 1 << 24  # bytes of run_info.json
LOCK = "shards.lock"  # nothing has this name: see claimed
HALF_WRITTEN = re.compile(r"\.[0-9]+\.[0-9a-f]{8}\.(tar|json)")  # of a process that was killed


class ShardWriter:
    """Shards of ``each`` objects in ``output``.  ours: names of the files that belong to a result."""

    def __init__(self, output: Path, each: int, ours: Collection[str]):
        self.output, self.each, self.ours = output, each, ours
        self.entries = shards.read_entries(output) if output.is_dir() else {}
        self.objects: dict[str, Packed] = {}  # of those that earlier calls packed
        for number, row in self.entries.items():
            path = output / shards.shard_name(number)
            wrong = shards.fault(output, row, hashed=False)
            if wrong or row["shard"] != path.name:
                told = wrong or f"{path.name}: expected its name in its entry, got {row['shard']}"
                raise InputError(output, f"{told}; delete {path.stem}.json and its objects are made again")
            self.objects.update((found.name, found) for found in packed_objects(path))
        self.place = {name: found.shard for name, found in self.objects.items()}
        self.waiting: list[str] = []

    def record(self, name: str, files: Collection[str]) -> bytes:
        """``run_info.json`` of a packed object.  Raises InputError where it was packed without one of ``files``."""
        packed = self.objects[name]
        found = packed.files()
        if lacks := [file for file in files if file not in found]:
            raise InputError(
                packed.shard,
                f"{name}: expected all files that these options write, got no {lacks[0]}; give another --output",
            )
        offset, size = found["run_info.json"]
        with open(packed.shard, "rb") as file:
            file.seek(offset)
            return file.read(min(size, MAX_RECORD))

    def add(self, name: str) -> Path | None:
        """Take the folder of a finished object; the shard that it fills."""
        self.waiting.append(name)
        return self.write() if len(self.waiting) == self.each else None

    def write(self) -> Path | None:
        """Pack what waits, if anything does."""
        if not self.waiting:
            return None
        number = next(k for k in range(len(self.entries) + 1) if k not in self.entries)
        packed = [(name, self._files(name)) for name in self.waiting]
        self.entries[number] = shards.write_shard(self.output, number, packed)
        path = self.output / shards.shard_name(number)
        shards.synced(path.with_suffix(".json"))
        for name in self.waiting:
            self.place[name] = path
            self.remove(name)
        self.waiting = []
        return path

    def _files(self, name: str) -> list[tuple[str, Path]]:
        return [(f"{name}.{n}", self.output / name / n) for n in self.ours if (self.output / name / n).is_file()]

    def remove(self, name: str) -> None:
        """Remove the folder of a packed object, and nothing from it that is not ours."""
        folder = self.output / name
        for file in self.ours:
            (folder / file).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            folder.rmdir()  # unless there is something in it

    def index(self) -> None:
        if self.entries:
            shards.write_index(self.output, [self.entries[k] for k in sorted(self.entries)])


@contextlib.contextmanager
def open_shards(output: Path, each: int, ours: Collection[str], *, more: bool) -> Iterator[ShardWriter]:
    """Shards in ``output``, which this process holds alone; at the end the index is written.

    more: shards may be there, to which others are added.  Raises InputError, OSError.
    """
    with claimed(output / LOCK, ()):
        writer = ShardWriter(output, each, ours)
        if writer.entries and not more:
            raise InputError(output, "expected no shards yet, got some; give --skip-existing or another --output")
        for path in output.glob(".*"):
            if HALF_WRITTEN.fullmatch(path.name):
                path.unlink()
        for name in writer.objects:
            if (output / name).is_dir():  # killed before the folder went
                writer.remove(name)
        try:
            yield writer
        finally:
            writer.index()
