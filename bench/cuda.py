"""Tests and timings of a GPU in a fixed time: ``python -m bench.cuda --minutes 8``.

Needs the package with its extras ``test`` and ``bench``, and this checkout; missing parts are printed before anything
runs.  Pieces run in this order: kernels are compiled once, CPU and CUDA are compared, then speed is measured.  Each
piece is a process with a limit of its own; the limits add up to ``--minutes``.  ``cuda.json`` and ``cuda.md`` in
``--output`` are written after every piece, and the same call again repeats only pieces that did not end well.
``--dry-run`` prints the pieces with their limits.  ``--device cpu`` runs small sizes, to test this program.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
NEEDED = ("torch", "warp", "numpy", "scipy", "PIL", "safetensors", "trimesh", "embreex", "OpenEXR", "manifold3d")
NEEDED = (*NEEDED, "xatlas", "tqdm", "pytest", "networkx")
TAIL = 4000  # characters of a piece's output that the report keeps
LEAST = 5.0  # seconds below which no piece begins
RISE = 4.0  # of the raw density from the surface to the center of the ball that replaces a trained object


@dataclass(frozen=True)
class Piece:
    """command: arguments after ``python``.  weight: its part of the time."""

    name: str
    command: tuple[str, ...]
    weight: float


def pieces(device: str) -> list[Piece]:
    """What runs, in this order; on a CPU the same at small sizes."""
    small = device == "cpu"
    own = ("-m", "bench.cuda", "--device", device, "--piece")
    tests = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "--no-header", "--maxfail=50")
    tests = (*tests, "--continue-on-collection-errors")  # of tests that need packages which this program does not
    bench = ("-m", "bench.run", "--device", device, "--no-results", "--seconds", "0.1" if small else "0.7")
    some = ("triplane.sample_1",) if small else ("rays", "shading", "triplane", "surface", "environment", "volume")
    compared = ("tests/geometry/test_grid.py",) if small else ("tests/bridge/test_ops.py", "-k", "cpu_and_cuda")
    chosen = "cuda and not cpu_and_cuda and not bench_cuda"
    whole = ("tests/geometry/test_grid.py",) if small else ("tests", "-k", chosen)
    return [
        Piece("system", (*own, "system"), 1),
        Piece("compile", (*own, "compile"), 6),
        Piece("operations, CPU against CUDA", (*tests, *compared), 5),
        Piece("tests on CUDA", (*tests, *whole), 12),
        Piece("training stages", (*own, "stages"), 5),
        Piece("official network, bfloat16", (*own, "official"), 4),
        Piece("bench cases", (*bench, *some), 5),
        Piece("bench end to end", (*bench, "end_to_end.views_to_glb"), 3),
    ]


def limits(plan: list[Piece], seconds: float) -> list[float]:
    """Seconds of each piece: their sum is ``seconds``."""
    total = sum(piece.weight for piece in plan)
    return [seconds * piece.weight / total for piece in plan]


def missing() -> list[str]:
    """Modules that the pieces import and that are not installed."""
    return [name for name in NEEDED if importlib.util.find_spec(name) is None]


def system(device) -> dict:
    """The machine, versions and the commit."""
    import torch

    from bench.run import context

    found = context(device)
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info()
        found |= {"gpu": torch.cuda.get_device_name(), "cuda": torch.version.cuda}
        found |= {"free_GiB": round(free / 2**30, 1), "total_GiB": round(total / 2**30, 1)}
    return found


def compile(device) -> dict:
    """Compile the kernels of the CPU and of the device into the cache that all later pieces use."""
    import pkgutil

    import warp as wp

    from reli3d import kernels
    from reli3d.kernels.cache import CPU_BLOCK, imported, initialize

    initialize()
    names = [f"{kernels.__name__}.{info.name}" for info in pkgutil.iter_modules(kernels.__path__)]
    names = names if device.type == "cuda" else [f"{kernels.__name__}.triplane"]
    for name in names:
        importlib.import_module(name)
    found, workers = {}, os.cpu_count()
    for kind, block in (("cuda", None), ("cpu", CPU_BLOCK)):
        if kind == "cuda" and device.type != "cuda":
            continue
        begin, modules = time.perf_counter(), [wp.get_module(m.__name__) for m in imported(kind) if m.__name__ in names]
        wp.force_load(kind, modules, block_dim=block, max_workers=workers)
        found[f"{kind}_s"] = round(time.perf_counter() - begin, 1)
        found[f"{kind}_modules"] = len(modules)
    return found | {"cache": str(wp.config.kernel_cache_dir)}


def ball(preset, device):
    """A network from scratch that shows a ball: the field of an untrained one has no surface."""
    import torch

    from reli3d.nn.model import Reconstructor

    class Ball(Reconstructor):
        def query(self, code, points, heads=("density",)):
            values = super().query(code, points, heads)
            if "density" in values:
                far = points.norm(dim=-1, keepdim=True) / (0.6 * self.preset.radius)
                values["density"] = values["density"] + 2.0 + RISE * (1.0 - far)
            return values

    torch.manual_seed(0)
    with torch.device(device):  # to draw three billion parameters takes a CPU a minute
        return Ball(preset).to(device)


def drawn(preset, stage, device):
    """An object of four random images, one more to compare with."""
    import torch

    from bench.official import views
    from reli3d.train.stages.views import Draw, ObjectViews

    images, masks, c2w, intrinsics = (t[0] for t in views(preset, 5, device))
    normal = torch.nn.functional.normalize(torch.rand_like(images), dim=-1)
    maps = {"normal": normal, "shown": torch.ones_like(masks)}
    maps["material"] = torch.rand(*masks.shape, 5, device=device)
    whole = ObjectViews(images, masks, c2w, intrinsics, background=True, **maps)
    target = whole.select([4]).resized(stage.image_size)
    if stage.patch:
        target = target.window(0, 0, stage.patch)
    return Draw(whole.select(range(4)), target, False, 0)


def stages(device) -> dict:
    """Objects a second and peak memory of each stage, forward and backward: tiny, and official if it fits."""
    import torch

    from reli3d.nn.presets import OFFICIAL, TINY
    from reli3d.train.stages import config
    from reli3d.train.stages.losses import gradients
    from reli3d.train.stages.step import checkpointed, object_losses, total

    found: dict = {}
    cuda = device.type == "cuda"
    fits = cuda and torch.cuda.mem_get_info()[1] > 60 * 2**30  # weights, gradients and features
    for preset, of in ((TINY, config.TINY), *(((OFFICIAL, config.PAPER),) if fits else ())):
        model = ball(preset, device)
        if preset is OFFICIAL:
            checkpointed(model)
        for name, stage in of.items() if cuda else list(of.items())[:1]:
            one, times = drawn(preset, stage, device), []
            if cuda:
                torch.cuda.reset_peak_memory_stats()
            for _ in range(4 if cuda else 2):
                begin = time.perf_counter()
                model.zero_grad(set_to_none=True)
                loss = total(object_losses(model, one, stage, gradients, bfloat16=preset is OFFICIAL), stage)
                loss.backward()
                times.append((time.perf_counter() - begin, float(loss)))
            row = {"objects_per_s": round(1.0 / min(t for t, _ in times[1:]), 3), "loss": round(times[-1][1], 4)}
            if cuda:
                row["peak_GiB"] = round(torch.cuda.max_memory_allocated() / 2**30, 2)
            found[f"{preset.name}, {name}"] = row
        del model
    return found if fits else found | {"official": "left out: needs 60 GiB on the device"}


def official(device) -> dict:
    """The published sizes with random weights: views to code, light and surface."""
    import torch

    from bench.official import views
    from bench.timing import synchronize
    from reli3d.nn.presets import OFFICIAL, TINY
    from reli3d.train.stages.surface import surface

    preset = OFFICIAL if device.type == "cuda" else TINY
    model = ball(preset, device).to_compute(torch.bfloat16).eval()
    inputs, found = views(preset, 4, device), {"preset": preset.name}
    with torch.no_grad():
        for turn in ("first_s", "warm_s"):
            begin = time.perf_counter()
            code = model.encode(*inputs)
            model.decode_environment(code)
            mesh = surface(model, code, preset.resolution).mesh
            synchronize(device)
            found[turn] = round(time.perf_counter() - begin, 3)
    return found | {"faces": len(mesh.faces)}


OWN = {f.__name__: f for f in (system, compile, stages, official)}


def run_piece(piece: Piece, cache: Path, limit: float) -> dict:
    """How the piece ended, ``ok``, ``failed`` or ``out of time``, its seconds and the tail of its output."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "WARP_CACHE_PATH": str(cache)}
    begin, call = time.perf_counter(), [sys.executable, *piece.command]
    try:
        done = subprocess.run(call, cwd=ROOT, env=env, capture_output=True, text=True, timeout=limit, check=False)
        end, output = ("ok" if done.returncode == 0 else f"failed ({done.returncode})"), done.stdout + done.stderr
    except subprocess.TimeoutExpired as error:
        parts = [p.decode(errors="replace") if isinstance(p, bytes) else p or "" for p in (error.stdout, error.stderr)]
        end, output = f"out of time ({limit:.0f} s)", "".join(parts)
    seconds = round(time.perf_counter() - begin, 1)
    return {"name": piece.name, "end": end, "seconds": seconds, "output": output[-TAIL:]}


def report(rows: list[dict], device: str) -> str:
    """Markdown of the pieces that have run so far."""
    text = [f"# bench.cuda on {device}", "", "| piece | end | seconds |", "|---|---|---|"]
    text += [f"| {r['name']} | {r['end']} | {r['seconds']} |" for r in rows]
    for r in rows:
        text += ["", f"## {r['name']}", "", "```", r["output"].rstrip().replace("```", "'''"), "```"]
    return "\n".join(text) + "\n"


def run(plan: list[Piece], device: str, folder: Path, seconds: float) -> list[dict]:
    """Run the pieces that have not ended well in ``folder`` before; time that a piece leaves goes to the later ones."""
    folder.mkdir(parents=True, exist_ok=True)
    found, stored = folder / "cuda.json", []
    if found.exists():
        before = json.loads(found.read_text())
        stored = before["pieces"] if before["device"] == device else []
    rows = {row["name"]: row for row in stored if row["end"] == "ok"}
    left = [piece for piece in plan if piece.name not in rows]
    end = time.perf_counter() + seconds
    while left:
        piece, limit = left[0], limits(left, end - time.perf_counter())[0]
        if limit < LEAST:
            row = {"name": piece.name, "end": "left out: no time left", "seconds": 0.0, "output": ""}
        else:
            row = run_piece(piece, folder / "kernels", limit)
        rows[piece.name], left = row, left[1:]
        print(f"{piece.name}: {row['end']}, {row['seconds']} s", file=sys.stderr, flush=True)
        done = [rows[p.name] for p in plan if p.name in rows]
        found.write_text(json.dumps({"device": device, "pieces": done}, indent=1) + "\n")
        (folder / "cuda.md").write_text(report(done, device))
    return [rows[piece.name] for piece in plan]


def main(argv: list[str] | None = None) -> int:
    """0 where every piece ended well, 1 where one did not, 2 where a dependency or a CUDA device is missing."""
    parser = argparse.ArgumentParser(prog="python -m bench.cuda", description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=8.0, help="of all pieces together")
    parser.add_argument("--output", type=Path, default=ROOT / "bench" / "results" / "cuda", help="folder")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    parser.add_argument("--only", nargs="+", metavar="PIECE", help="pieces by name; all when left out")
    parser.add_argument("--dry-run", action="store_true", help="print the pieces with their limits and stop")
    parser.add_argument("--piece", choices=OWN, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    plan = pieces(options.device)
    if options.only:
        unknown = sorted(set(options.only) - {piece.name for piece in plan})
        if unknown:
            parser.error(f"--only: expected some of {', '.join(p.name for p in plan)}, got {', '.join(unknown)}")
        plan = [piece for piece in plan if piece.name in options.only]
    lacking = missing()
    if not options.piece:
        for piece, limit in zip(plan, limits(plan, 60 * options.minutes), strict=True):
            print(f"{limit:5.0f} s  {piece.name}: python {' '.join(piece.command)}")
        print(f"{60 * options.minutes:5.0f} s  in all; missing packages: {', '.join(lacking) or 'none'}", flush=True)
    if lacking and not options.dry_run:
        print("bench.cuda: pip install -c constraints.txt -e '.[test,bench]'", file=sys.stderr)
        return 2
    if options.dry_run:
        return 0
    import torch

    if options.device == "cuda" and not torch.cuda.is_available():
        print("bench.cuda: expected a CUDA device, got none; --device cpu tests the program", file=sys.stderr)
        return 2
    if options.piece:
        print(json.dumps(OWN[options.piece](torch.device(options.device)), indent=1))
        return 0
    rows = run(plan, options.device, options.output, 60 * options.minutes)
    print(options.output / "cuda.md")
    return 0 if all(row["end"] == "ok" for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
