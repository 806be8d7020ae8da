"""File names regardless of case and Unicode form: image suffixes and lookup."""

import os
import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path, PurePath

from reli3d.errors import InputError, shown

ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")


class FolderIndex:
    """Cached folder listings: finds files by exact name, else regardless of case and Unicode form."""

    def __init__(self) -> None:
        self._names: dict[Path, dict[str, list[str]]] = {}

    def find(self, folder: str | os.PathLike, relative: PurePath) -> Path | None:
        """The path below ``folder``, in which no part is ``..``; None if there is none.

        Raises InputError if several paths differ from ``relative`` only in case.
        """
        at = Path(folder)
        for part in relative.parts:
            if at not in self._names:
                found: dict[str, list[str]] = defaultdict(list)
                for name in _listed(at):
                    found[_key(name)].append(name)
                self._names[at] = found  # complete: other threads read it
            names = self._names[at].get(_key(part), [])
            if part in names:
                at = at / part
            elif len(names) == 1:
                at = at / names[0]
            elif names:
                raise InputError(at, f"expected {shown(part)}, got {', '.join(sorted(names))}; rename one of them")
            else:
                return None
        return at


def _key(name: str) -> str:
    """Equal for names that differ in case or, as macOS stores them, in the composition of accents."""
    return unicodedata.normalize("NFC", name).casefold()


def _listed(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except (OSError, ValueError):
        return []


def named(folder: Path, names: Sequence[str]) -> list[str]:
    """Names in ``folder`` equal to ``names`` regardless of case, in the order of ``names``."""
    there = sorted(_listed(folder))
    return [found for name in names for found in there if found.casefold() == name]


def images_in(folder: Path, endings: Sequence[str] = ENDINGS) -> list[Path]:
    """The files of ``folder`` with one of ``endings`` in any case, sorted; empty if the folder does not exist."""
    there = (folder / name for name in _listed(folder) if not name.startswith("."))  # such as ._a.png of macOS
    return sorted(p for p in there if p.suffix.lower() in endings and p.is_file())


def images_below(folder: Path) -> list[Path]:
    """The images of ``folder`` and its sub-folders, sorted."""
    there = (Path(at, n) for at, _, names in os.walk(folder) for n in names if not n.startswith("."))
    return sorted(path for path in there if path.suffix.lower() in ENDINGS)
