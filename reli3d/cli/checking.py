"""What the commands say of the cameras: ``--check``, and beside an error that wrong cameras may have caused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from reli3d.cli.exit_codes import reason

if TYPE_CHECKING:
    from reli3d.io.tar import Packed
    from reli3d.views.views import Views

SUSPECT = 3  # exit code of --check where it does not trust the cameras


class Check:
    """Explains cameras instead of a reconstruction: a :class:`~reli3d.cli.objects.Job`.

    read: the views of a folder.  silent: print nothing; ``found`` has it all, by the names of the objects.
    """

    def __init__(self, read: Callable[[Path | Packed], Views], silent: bool):
        self._read, self._silent = read, silent
        self.found: dict[str, dict] = {}

    def run(self, folder: Path | Packed, name: str, target: Path) -> str:
        """Print what the cameras look like, one line a view, and write the picture of the rig."""
        from reli3d.views.check import explain_cameras, rig_picture

        views = self._read(folder)
        lines = explain_cameras(views)
        target.mkdir(parents=True, exist_ok=True)
        rig_picture(views, target / "rig.png")
        if not self._silent:
            print(*views.notes, *lines, target / "rig.png", sep="\n")
        self.found[name] = {
            "suspect": lines[-1].startswith("suspect"),
            "verdict": lines[-1],
            "lines": lines[:-1],
            "notes": list(views.notes),
            "picture": str(target / "rig.png"),
        }
        return "done"

    def suspects(self) -> bool:
        """Whether the cameras of an object are not trusted."""
        return any(found["suspect"] for found in self.found.values())


@contextmanager
def diagnosed(views: Views) -> Iterator[None]:
    """Adds what :mod:`reli3d.views.check` suspects to an error of the block, where it suspects something."""
    from reli3d.views.check import verdict

    try:
        yield
    except ValueError as error:
        found = verdict(views)
        if not found.startswith("suspect"):
            raise
        raise ValueError(f"{reason(error)}; {found}") from None
