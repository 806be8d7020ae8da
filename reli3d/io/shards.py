"""Folders of shards: tar files ``NNNNNN.tar`` of objects, found again by an index with sizes and hashes.

``NNNNNN.json`` is written after each shard, and ``index.json`` of all at the end.  A shard without an entry does not
count: the process that wrote it was killed, and its objects are packed again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from reli3d.errors import InputError, shown
from reli3d.io.files import read_bytes, write_bytes

INDEX = "index.json"
INDEX_LIMIT = 1 << 30  # bytes


def shard_name(number: int) -> str:
    return f"{number:06d}.tar"


def pack_in_parts(
    folder: Path,
    names: Sequence[str],
    write: Callable[[int, range], dict],
    *,
    each: int,
    part: tuple[int, int] = (0, 1),
    progress: Callable[[str], None] = lambda line: None,
) -> None:
    """Write the objects ``names`` as shards of ``each``, and the index with the last; those that are there stay.

    write: of the number of a shard and the numbers of its objects; gives its entry.  part: ``(k, n)``, this call
    writes every n-th shard from k; calls of all parts can run at once.
    """
    folder.mkdir(parents=True, exist_ok=True)
    count = -(-len(names) // each)
    entries = [folder / Path(shard_name(k)).with_suffix(".json") for k in range(count)]
    for number in range(part[0], count, part[1]):
        numbers = range(number * each, min((number + 1) * each, len(names)))
        path, wanted = entries[number], [names[k] for k in numbers]
        if path.exists() and json.loads(path.read_text())["objects"] == wanted:
            continue
        entry = write(number, numbers)
        progress(f"{entry['shard']}: {len(wanted)} objects, {entry['bytes'] / 1e6:.1f} MB")
    if all(p.exists() for p in entries):
        write_index(folder, [json.loads(p.read_text()) for p in entries])


def write_entry(folder: Path, number: int, names: Sequence[str]) -> dict:
    """Write ``NNNNNN.json`` of a shard with the objects ``names``."""
    path = folder / shard_name(number)
    size, digest = sized(path)
    entry = {"shard": path.name, "bytes": size, "sha256": digest, "objects": list(names)}
    write_bytes(path.with_suffix(".json"), json.dumps(entry).encode())
    return entry


def sized(path: Path) -> tuple[int, str]:
    """Bytes and SHA-256 of a file."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
        return file.tell(), digest.hexdigest()


def write_index(folder: Path, rows: Sequence[dict]) -> None:
    write_bytes(folder / INDEX, json.dumps({"shards": list(rows)}, indent=1).encode())


def read_index(folder: Path) -> list[dict]:
    """Rows of the index.  Raises InputError for a broken one."""
    path = folder / INDEX
    return _rows(path, lambda stored: stored["shards"])


def _rows(path: Path, rows_of) -> list[dict]:
    try:
        rows = rows_of(json.loads(read_bytes(path, INDEX_LIMIT)))
        for row in rows:
            hashed = isinstance(row["bytes"], int) and len(row["sha256"]) == 64 and isinstance(row["objects"], list)
            if not hashed or Path(row["shard"]).name != row["shard"]:
                raise ValueError(shown(row))
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            path, f"expected an index of shards, got a broken file ({shown(str(error))}); pack again"
        ) from None
    return rows


def fault(folder: Path, row: dict, *, hashed: bool) -> str | None:
    """What is wrong with a shard; None where nothing is.  hashed: read it whole and compare its hash."""
    path = folder / row["shard"]
    if not path.is_file():
        return f"{path.name}: expected a shard, got none"
    size = path.stat().st_size
    if size != row["bytes"]:
        return f"{path.name}: expected {row['bytes']} bytes, got {size}"
    if hashed and (digest := sized(path)[1]) != row["sha256"]:
        return f"{path.name}: expected SHA-256 {row['sha256'][:12]}..., got {digest[:12]}..."
    return None
