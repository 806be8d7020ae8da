"""An input with its ground truth."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


class Misread(AssertionError):
    """A file was accepted and its content was misread; or it was refused and should not be, or the reverse."""


def check(condition: bool, text: str) -> None:
    if not condition:
        raise Misread(text)


@dataclass(frozen=True)
class Case:
    """files: by name.  compare: reads the folder that they are in and raises :class:`Misread` unless it finds the
    ground truth.  must_read: a refusal is a fault; must_refuse: an acceptance is.
    """

    files: dict[str, bytes]
    compare: Callable[[Path], None]
    must_read: bool = False
    must_refuse: bool = False

    def read(self, folder: Path) -> None:
        try:
            self.compare(folder)
        except (ValueError, OSError) as error:
            check(not self.must_read, f"refused: {error}")
            raise
        check(not self.must_refuse, "accepted an input that must be refused")
