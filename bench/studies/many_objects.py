"""Many different objects with one worker, two workers, and two workers of Ray: speed, memory, and whether bits agree.

``python -m bench.studies.many_objects`` (64 objects), ``--count 4 --texture-size 256 --resolution 40`` to try it.

Each place runs ``reli3d-infer`` once, from the start of the command to its end.  The objects are procedural ones
(``reli3d.synthetic``) under a sky with a lamp, four views each, and differ by their seeds.  The bits of ``mesh.glb``
are compared with those of the first place; the exit code is 1 where one differs.  Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from reli3d.io.images import write_png
from reli3d.synthetic.procedural import make_object
from reli3d.synthetic.samples import ObjectSurface, synthesize

VIEWS = 4
STEP = 0.5  # seconds between two looks at the memory
HEADER = [
    "| where | objects a minute | seconds an object, median | highest memory of a process [MiB] "
    "| of all together [MiB] | other bits |",
    "|---|---|---|---|---|---|",
]


def sky(height: int = 32) -> torch.Tensor:
    """A lat-long map ``(H, 2H, 3)``: brighter above, with one lamp."""
    rows = torch.linspace(1.0, 0.1, height)[:, None, None] * torch.tensor([0.9, 1.0, 1.2])
    light = rows.expand(height, 2 * height, 3).clone()
    light[height // 4 : height // 4 + 4, height : height + 6] = torch.tensor([40.0, 36.0, 30.0])
    return light


def write_object(folder: Path, seed: int, size: int) -> None:
    """An object folder of ``VIEWS`` photographs, as ``docs/inputs.md`` has it."""
    made = synthesize(ObjectSurface(make_object(seed)), sky(), np.random.default_rng(seed), size=size, views=VIEWS)
    (folder / "rgba").mkdir(parents=True)
    frames = []
    for k in range(VIEWS):
        write_png(folder / "rgba" / f"{k}.png", made["images"][k])
        fx, fy, cx, cy = made["intrinsics"][k].tolist()
        lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": size, "h": size}
        frames.append({"file_path": f"rgba/{k}.png", "transform_matrix": made["c2w"][k].tolist(), **lens})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))  # last: a folder with it is whole


def write_objects(root: Path, count: int, size: int) -> list[Path]:
    """Folders of ``count`` objects; those that are there are kept."""
    folders = [root / f"object{seed:03d}" for seed in range(count)]
    for seed, folder in enumerate(folders):
        if not (folder / "transforms.json").exists():
            write_object(folder, seed, size)
            print(f"{folder.name} made", file=sys.stderr)
    return folders


@dataclass
class Row:
    where: str
    seconds: float
    objects: list[float]
    process: float
    together: float | None
    bits: dict[str, str]

    def line(self, first: Row) -> str:
        other = sum(first.bits.get(name) != digest for name, digest in self.bits.items())
        rate = 60 * len(self.bits) / self.seconds
        together = "not measured" if self.together is None else f"{self.together:.0f}"
        return (
            f"| {self.where} | {rate:.2f} | {statistics.median(self.objects):.1f} | {self.process:.0f} | {together} "
            f"| {other} of {len(self.bits)} |"
        )


class Memory(threading.Thread):
    """Most memory that all processes below this one take together, shared pages once.  Linux."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.most, self._end = 0, threading.Event()

    def run(self) -> None:
        while not self._end.wait(STEP):
            self.most = max(self.most, sum(map(_proportional, _below(os.getpid()))))

    def stop(self) -> float | None:
        self._end.set()
        self.join()
        return self.most / 1024 or None


def _below(pid: int) -> Iterator[int]:
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield int(child)
                yield from _below(int(child))


def _proportional(pid: int) -> int:
    with contextlib.suppress(OSError), open(f"/proc/{pid}/smaps_rollup") as file:
        return next((int(line.split()[1]) for line in file if line.startswith("Pss:")), 0)
    return 0


def infer(folders: list[Path], output: Path, options: list[str]) -> float:
    """Seconds of one command."""
    names = output.with_suffix(".txt")
    names.write_text("".join(f"{folder}\n" for folder in folders))
    command = [sys.executable, "-m", "reli3d.cli.infer", "--list", names, "--output", output, "--device", "cpu"]
    start = time.perf_counter()
    subprocess.run([*command, *options], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def measured(where: str, folders: list[Path], output: Path, options: list[str]) -> Row:
    memory = Memory()
    memory.start()
    seconds = infer(folders, output, options)
    together = memory.stop()
    info = [json.loads((output / f.name / "run_info.json").read_bytes()) for f in folders]
    with open(output / "summary.csv", newline="") as file:
        times = [float(row["seconds"]) for row in csv.DictReader(file)]
    bits = {f.name: hashlib.sha256((output / f.name / "mesh.glb").read_bytes()).hexdigest() for f in folders}
    return Row(where, seconds, times, max(i["peak_memory_mib"] for i in info), together, bits)


@contextlib.contextmanager
def cluster(workers: int) -> Iterator[str | None]:
    """Address of a Ray cluster of so many CPUs; None where there is no Ray."""
    try:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        from ray.cluster_utils import Cluster
    except ImportError:
        yield None
        return
    found = Cluster(initialize_head=True, head_node_args={"num_cpus": workers})
    try:
        yield found.address
    finally:
        found.shutdown()


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="python -m bench.studies.many_objects", description=__doc__.splitlines()[0])
    p.add_argument("--count", type=int, default=64, help="objects")
    p.add_argument("--size", type=int, default=256, help="pixels of the photographs")
    p.add_argument("--texture-size", default="512", help="texels of the maps")
    p.add_argument("--resolution", help="cubes along a side of the surface grid (default the preset's)")
    p.add_argument("--folder", type=Path, help="where the objects are made, and kept (default a temporary folder)")
    args = p.parse_args(argv)
    quick = ["--texture-size", args.texture_size, *(["--resolution", args.resolution] if args.resolution else [])]
    rows = []
    with tempfile.TemporaryDirectory() as root:
        folders = write_objects(args.folder or Path(root, "in"), args.count, args.size)
        infer(folders[:1], Path(root, "first"), quick)  # compiles the kernels
        for workers in (1, 2):
            where = f"--workers {workers}"
            rows.append(measured(where, folders, Path(root, f"out{workers}"), [*quick, *where.split()]))
        with cluster(2) as address:
            if address is None:
                print("Ray is left out: pip install reli3d[ray]", file=sys.stderr)
            else:
                out = Path(root, "ray")
                rows.append(measured("--ray, two workers", folders, out, [*quick, "--ray", address]))
    print(f"{args.count} objects, {VIEWS} views of {args.size}², {' '.join(quick)}, {os.cpu_count()} cores\n")
    print("\n".join([*HEADER, *(row.line(rows[0]) for row in rows)]))
    return int(any(row.bits != rows[0].bits for row in rows))


if __name__ == "__main__":
    sys.exit(main())
