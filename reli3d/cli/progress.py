"""The bar of a reconstruction."""

from __future__ import annotations

import sys
from collections.abc import Iterable


class Progress:
    """A bar over the stages of one object, on stderr where that is a terminal; elsewhere lines alone are written."""

    STAGES = (
        "reading",
        "normalize",
        "prepare",
        "network",
        "surface",
        "textures",
        "light",
        "frame",
        "refine",
        "preview",
        "writing",
    )

    def __init__(self, name: str):
        from tqdm import tqdm

        self.name = name
        self.bar = tqdm(
            total=len(self.STAGES),
            desc=name,
            file=sys.stderr,
            bar_format="{desc}: {bar:20} {postfix} {elapsed}",
            disable=None,
        )

    def __call__(self, stage: str) -> None:
        if self.bar.disable:
            return
        self.bar.set_postfix_str(stage, refresh=False)
        self.bar.n = self.STAGES.index(stage)
        self.bar.refresh()

    def tell(self, notes: Iterable[str]) -> None:
        """Write notes on the object, a line each, above the bar."""
        for note in notes:
            self.bar.write(f"{self.name}: {note}", file=sys.stderr)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.bar.leave = error is None
        if error is None and not self.bar.disable:
            self.bar.n = len(self.STAGES)
            self.bar.set_postfix_str("done", refresh=True)
        self.bar.close()
