"""A job without a network: objects are small files that say what shall happen to them."""

import json
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from reli3d.cli.objects import opened
from reli3d.output.folder import claimed

FILES = ("mesh.glb", "environment.exr", "environment.hdr", "preview.png", "viewer.html", "run_info.json")


@dataclass
class WordJob:
    """Writes the word of ``folder/word`` in ``target``, and a line in ``log`` for every result that it finishes.

    The words ``die`` and ``die once`` kill the process in the middle of the work, ``wait`` waits there for a file
      ``go``; ``refuse`` and ``fail`` are errors.  What they leave stands in ``folder``, or beside the tar file that the
      object is in.
    """

    log: Path

    def run(self, folder, name: str, target: Path) -> str:
        with opened(folder) as found:
            word = (found / "word").read_text()
        folder = folder if isinstance(folder, Path) else folder.shard.with_name(f"{folder.name}-marks")
        folder.mkdir(exist_ok=True)
        if (target / "mesh.glb").exists():
            return "skipped"
        if word == "refuse":
            raise ValueError("word: expected another, got refuse")
        if word == "fail":
            raise RuntimeError("it failed")
        with claimed(target, FILES) as replacing, replacing() as new:
            for file in FILES:
                (new / file).write_text(word)
            if word == "die" or (word == "die once" and not (folder / "died").exists()):
                (folder / "died").touch()
                os.kill(os.getpid(), signal.SIGKILL)
            if word == "wait":
                (folder / "waits").touch()
                until = time.monotonic() + 60
                while time.monotonic() < until and not (folder / "go").exists():
                    time.sleep(0.02)
            info = {"mask_iou": 0.5, "mesh": {"faces": len(word)}, "notes": [f"pid {os.getpid()}"]}
            (new / "run_info.json").write_text(json.dumps(info))
        with open(self.log, "a") as log:
            log.write(f"{name}\n")
        return "done"


@dataclass(frozen=True)
class Start:
    """Makes the job of a process, and writes down that it did."""

    log: Path

    def __call__(self) -> WordJob:
        with open(self.log.with_name("starts"), "a") as log:
            log.write(f"{os.getpid()}\n")
        return WordJob(self.log)
