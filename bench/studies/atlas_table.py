"""The atlas of every mesh of a folder and of extracted surfaces, beside xatlas.

``python -m bench.studies.atlas_table FOLDER``

A row a mesh and a maker: processor time of all threads (which other work on the machine moves little), charts,
utilisation, overlap and stretch of ``atlas_report``.  xatlas runs in a process of its own with a limit in real time
(``--limit``; its start is part of the time, about 0.2 s); ``timeout`` stands where it ran out.  Rows are appended to
``bench/results/<machine>.jsonl``.  Ours is the best of three warm runs, xatlas runs once.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
import trimesh

from bench.run import HERE, context
from bench.surface import field
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.surface import extract_surface
from reli3d.geometry.uv import atlas_report, unwrap, unwrap_xatlas

EXTRACTED = (32, 80, 160)  # resolutions; 4,000 to 100,000 faces
REPEATS = 3


def meshes(folder: Path) -> dict[str, Mesh]:
    """The GLB files of ``folder``, their parts in one mesh, and surfaces of the bench's field."""
    found = {}
    for path in sorted(folder.glob("*.glb")):
        shape = trimesh.load(path, force="mesh", process=False)
        found[path.stem] = Mesh(
            torch.from_numpy(np.array(shape.vertices, np.float32)), torch.from_numpy(np.array(shape.faces, np.int32))
        )
    return found | {f"extracted_{n}": extract_surface(field(n, "cpu"), radius=0.87) for n in EXTRACTED}


def ours(mesh: Mesh, size: int) -> tuple[Mesh, float]:
    unwrap(mesh, texture_size=size)
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        result = unwrap(mesh, texture_size=size)
        times.append(time.process_time() - start)
    return result, min(times)


def theirs(mesh: Mesh, size: int, limit: float) -> tuple[Mesh | None, float]:
    import resource  # here: :func:`main` says where Python has none

    def clock() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    start = clock()
    try:
        return unwrap_xatlas(mesh, texture_size=size, timeout_s=limit), clock() - start
    except TimeoutError:
        return None, clock() - start


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m bench.studies.atlas_table", description="Atlas quality beside xatlas."
    )
    parser.add_argument("folder", type=Path, help="folder of GLB files")
    parser.add_argument("--size", type=int, default=1024, help="texels along the texture")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds for xatlas, a mesh; 0 leaves it out")
    parser.add_argument("--no-results", action="store_true", help="print only; append nothing to results/")
    options = parser.parse_args(argv)
    if not options.folder.is_dir():
        parser.error(f"folder: expected a folder of GLB files, got {options.folder}")
    if options.limit > 0 and sys.platform == "win32":
        parser.error("--limit: expected 0 on Windows, where Python does not tell a child's processor time")
    about = context(torch.device("cpu"))
    numbers = ("cpu ms", 9), ("charts", 7), ("used", 6), ("overlap", 8), ("stretch", 8)
    heading = " ".join(f"{name:>{width}s}" for name, width in numbers)
    sys.stdout.write(f"{'mesh':28s} {'faces':>7s}  {'maker':7s} {heading}\n")
    for name, mesh in meshes(options.folder).items():
        makers = {"reli3d": ours(mesh, options.size)}
        if options.limit > 0:
            makers["xatlas"] = theirs(mesh, options.size, options.limit)
        for maker, (result, seconds) in makers.items():
            row = {
                "case": f"atlas_table.{name}",
                "maker": maker,
                "faces": len(mesh.faces),
                "cpu_seconds": seconds,
                "size": options.size,
                "timeout": result is None,
            }
            text = f"{name:28s} {len(mesh.faces):7d}  {maker:7s} {1e3 * seconds:9.1f}"
            if result is None:
                text += " timeout"
            else:
                report = atlas_report(result, texture_size=options.size)
                row |= asdict(report)
                text += f" {report.charts:7d} {report.utilisation:6.3f} {report.overlap:8.5f} {report.stretch:8.3f}"
            sys.stdout.write(text + "\n")
            sys.stdout.flush()
            if not options.no_results:
                with open(HERE / "results" / f"{about['machine']}.jsonl", "a") as file:
                    file.write(json.dumps(row | about) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
