"""A job without a network: objects are small files that contain their outcome."""

import functools
import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from reli3d.errors import InputError
from reli3d.output.folder import claimed

FILES = ("mesh.glb", "environment.exr", "environment.hdr", "preview.png", "viewer.html", "run_info.json")


def wait(ready: Callable[[], bool]) -> None:
    until = time.monotonic() + 60
    while time.monotonic() < until and not ready():
        time.sleep(0.02)


@dataclass
class WordJob:
    """Writes the word of ``folder/word`` in ``target``, and a line in ``log`` for every result that it finishes.

    The words ``crash`` and ``crash once`` kill the process in the middle of the work, ``wait`` waits there for a file
      ``go``; ``refuse`` and ``fail`` are errors.  Their files are in ``folder``.  A ``crash`` waits for each ``crash
      once`` before it, which would otherwise crash twice.
    """

    log: Path

    def run(self, folder, name: str, target: Path) -> str:
        word = (folder / "word").read_text()
        with claimed(target, FILES) as replacing:
            if (target / "mesh.glb").exists():
                return "skipped"
            if word == "refuse":
                raise InputError("word", "expected another, got refuse")
            if word == "fail":
                raise RuntimeError("it failed")
            with replacing() as new:
                self._write(folder, word, new)
        with open(self.log, "a") as log:
            log.write(f"{name}\n")
        return "done"

    def _write(self, folder: Path, word: str, new: Path) -> None:
        for file in FILES:
            (new / file).write_text(word)
        once = [p.parent for p in folder.parent.glob("*/word") if p.read_text() == "crash once"]
        if word == "crash":
            wait(lambda: all((p / "crashed").exists() for p in once if p.name < folder.name))
        if word == "crash" or (word == "crash once" and not (folder / "crashed").exists()):
            (folder / "crashed").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if word == "wait":
            (folder / "waits").touch()
            wait((folder / "go").exists)
        info = {"mask_iou": 0.5, "mesh": {"faces": len(word)}, "notes": [f"pid {os.getpid()}"]}
        (new / "run_info.json").write_text(json.dumps(info))

    def start(self) -> Callable[[], "WordJob"]:
        """Makes this job in another process."""
        return functools.partial(WordJob, self.log)
