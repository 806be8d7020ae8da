"""All that a GPU has to show, in under eight minutes: ``python -m bench.cuda``.

Needs nothing but pip's torch with CUDA, this checkout and pytest.  Each piece runs in a process of its own under a
limit of time; one that fails or runs out is told in the report, and the next one runs.  The report, Markdown with the
output of each piece, is written after every piece.  ``--dry-run`` takes the same way on the CPU at small sizes: it
proves the way, its numbers mean nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch

ROOT = Path(__file__).parents[1]
LIMIT = 470.0  # seconds of all pieces together
TAIL = 4000  # characters of a piece's output that the report keeps
BUILD = 4.0  # of the raw density at the centre of the ball that stands for a trained object, above the surface's


@dataclass(frozen=True)
class Piece:
    """command: arguments after ``python``.  fresh: with a kernel cache of its own, empty at the first such piece."""

    name: str
    command: tuple[str, ...]
    seconds: float
    fresh: bool = False


def pieces(device: str, dry: bool) -> list[Piece]:
    """What runs, in this order."""
    own = ("-m", "bench.cuda", "--device", device, *(("--dry-run",) if dry else ()), "--piece")
    tests = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "--no-header", "-x" if dry else "--maxfail=50")
    few = ("tests/geometry/test_grid.py",) if dry else ("tests",)
    cases = ("triplane.sample_1",) if dry else ("rays", "shading", "triplane", "surface", "environment", "volume")
    bench = ("-m", "bench.run", "--device", device, "--no-results", "--seconds", "0.1" if dry else "0.7")
    return [
        Piece("system", (*own, "system"), 40),
        Piece("kernels, cold cache", (*own, "kernels"), 120, fresh=True),
        Piece("kernels, warm cache", (*own, "kernels"), 40, fresh=True),
        Piece("training stages", (*own, "stages"), 110),
        Piece("official network, bfloat16", (*own, "official"), 90),
        Piece("bench cases", (*bench, *cases), 90),
        *([] if dry else [Piece("bench end to end", (*bench, "end_to_end.views_to_glb"), 60)]),
        Piece("operations, CPU against CUDA", (*tests, "tests/bridge/test_ops.py", "-k", "cpu_and_cuda"), 90),
        Piece("tests for CUDA", (*tests, *few, "-k", "cpu" if dry else "cuda"), 240),
    ]


def system(device: torch.device, dry: bool) -> dict:
    """What the machine is."""
    from bench.run import context

    found = context(device)
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info()
        found |= {
            "gpu": torch.cuda.get_device_name(),
            "cuda": torch.version.cuda,
            "free_GiB": round(free / 2**30, 1),
            "total_GiB": round(total / 2**30, 1),
        }
    return found


def kernels(device: torch.device, dry: bool) -> dict:
    """Seconds to the first result of a triplane lookup, a surface and a shaded picture, imports apart."""
    from reli3d.geometry.camera import Camera, look_at
    from reli3d.geometry.surface import extract_surface
    from reli3d.geometry.triplane import sample_triplane
    from reli3d.render.asset import Asset
    from reli3d.render.environment import Environment
    from reli3d.render.image import render_asset
    from reli3d.render.shading import ShadeOptions

    found = {}

    def timed(name, work):
        begin = time.perf_counter()
        value = work()
        if device.type == "cuda":
            torch.cuda.synchronize()
        found[name] = round(time.perf_counter() - begin, 2)
        return value

    axis = torch.linspace(-1, 1, 33, device=device)
    level = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0) - 0.7
    planes = torch.rand(1, 3, 8, 32, 32, device=device)
    points = torch.rand(1, 1000, 3, device=device)
    timed("triplane_s", lambda: sample_triplane(planes, points))
    if dry:  # compiling for a CPU takes minutes
        return found
    mesh = timed("surface_s", lambda: extract_surface(level.contiguous(), radius=1.0).with_normals())
    camera = Camera.from_fov(look_at(torch.tensor([0.5, 0.5, 3.0], device=device)), 0.8, 64, 64)
    light = Environment.constant(torch.ones(3, device=device))
    picture = timed(
        "render_s", lambda: render_asset(Asset(mesh, None, light), camera, options=ShadeOptions(samples=(4, 4, 2)))
    )
    found["mean_radiance"] = round(float(picture.radiance.mean()), 4)
    return found


def ball(preset):
    """A network from scratch that shows a ball: the field of an untrained one has no surface."""
    from reli3d.nn.model import Reconstructor

    class Ball(Reconstructor):
        def query(self, code, points, heads=("density",)):
            values = super().query(code, points, heads)
            if "density" in values:
                far = points.norm(dim=-1, keepdim=True) / (0.6 * self.preset.radius)
                values["density"] = values["density"] + 2.0 + BUILD * (1.0 - far)
            return values

    torch.manual_seed(0)
    return Ball(preset)


def drawn(preset, stage, device):
    """An object of four random pictures, one more to compare with."""
    from bench.official import views
    from reli3d.train.stages.views import Draw, ObjectViews

    images, masks, c2w, intrinsics = (t[0] for t in views(preset, 5, device))
    normal = torch.nn.functional.normalize(torch.rand_like(images), dim=-1)
    whole = ObjectViews(
        images,
        masks,
        c2w,
        intrinsics,
        background=True,
        normal=normal,
        shown=torch.ones_like(masks),
        material=torch.rand(*masks.shape, 5, device=device),
    )
    target = whole.select([4]).resized(stage.image_size)
    if stage.patch:
        target = target.window(0, 0, stage.patch)
    return Draw(whole.select(range(4)), target, False, 0)


def stages(device: torch.device, dry: bool) -> dict:
    """Objects a second and peak memory of each stage, forward and backward: tiny, and official where there is room."""
    from reli3d.nn.presets import OFFICIAL, TINY
    from reli3d.train.stages import config
    from reli3d.train.stages.losses import gradients
    from reli3d.train.stages.step import checkpointed, object_losses, total

    found = {}
    large = device.type == "cuda" and torch.cuda.mem_get_info()[1] > 60 * 2**30  # weights, gradients and features
    for preset, of in ((TINY, config.TINY), (OFFICIAL, config.PAPER)):
        if preset is OFFICIAL and (dry or not large):
            found["official"] = "left out: needs 60 GiB on the device"
            continue
        model = ball(preset).to(device)
        if preset is OFFICIAL:
            checkpointed(model)
        for name, stage in of.items():
            one, times = drawn(preset, stage, device), []
            if device.type == "cuda":
                torch.cuda.reset_peak_memory_stats()
            for _ in range(2 if dry else 4):
                begin = time.perf_counter()
                model.zero_grad(set_to_none=True)
                half = preset is OFFICIAL
                loss = total(object_losses(model, one, stage, gradients, bfloat16=half), stage)
                loss.backward()
                times.append((time.perf_counter() - begin, float(loss)))
            row = {"objects_per_s": round(1.0 / min(t for t, _ in times[1:]), 3), "loss": round(times[-1][1], 4)}
            if device.type == "cuda":
                row["peak_GiB"] = round(torch.cuda.max_memory_allocated() / 2**30, 2)
            found[f"{preset.name}, {name}"] = row
        del model
    return found


def official(device: torch.device, dry: bool) -> dict:
    """The published sizes with random weights: views to code, light and surface."""
    from bench.official import views
    from reli3d.nn.presets import OFFICIAL, TINY
    from reli3d.train.stages.surface import surface

    preset = TINY if dry else OFFICIAL
    model = ball(preset).to(device).to_compute(torch.bfloat16).eval()
    inputs, found = views(preset, 4, device), {"preset": preset.name}
    with torch.no_grad():
        for turn in ("first_s", "warm_s"):
            begin = time.perf_counter()
            code = model.encode(*inputs)
            model.decode_environment(code)
            mesh = surface(model, code, preset.resolution).mesh
            found[turn] = round(time.perf_counter() - begin, 3)
    return found | {"faces": len(mesh.faces)}


OWN = {f.__name__: f for f in (system, kernels, stages, official)}


def run_piece(piece: Piece, cache: Path, left: float) -> dict:
    """The piece's end: ``ok``, ``failed`` or ``out of time``, its seconds and the end of what it said."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])}
    if piece.fresh:
        env["WARP_CACHE_PATH"] = str(cache)
    begin, limit = time.perf_counter(), min(piece.seconds, left)
    if limit < 5.0:
        return {"name": piece.name, "end": "left out: no time left", "seconds": 0.0, "output": ""}
    try:
        done = subprocess.run(
            [sys.executable, *piece.command],
            cwd=ROOT,
            env=env,
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )
        end, output = ("ok" if done.returncode == 0 else f"failed ({done.returncode})"), done.stdout + done.stderr
    except subprocess.TimeoutExpired as error:
        parts = [p.decode(errors="replace") if isinstance(p, bytes) else p or "" for p in (error.stdout, error.stderr)]
        end, output = f"out of time ({limit:.0f} s)", "".join(parts)
    return {"name": piece.name, "end": end, "seconds": round(time.perf_counter() - begin, 1), "output": output[-TAIL:]}


def report(rows: list[dict], device: str, dry: bool) -> str:
    """Markdown of what is known so far."""
    text = [
        f"# bench.cuda on {device}{', a dry run' if dry else ''}",
        "",
        "| piece | end | seconds |",
        "|---|---|---|",
    ]
    text += [f"| {r['name']} | {r['end']} | {r['seconds']} |" for r in rows]
    for r in rows:
        text += ["", f"## {r['name']}", "", "```", r["output"].rstrip().replace("```", "'''"), "```"]
    return "\n".join(text) + "\n"


def main(argv: list[str] | None = None) -> int:
    """0 where every piece ended well, 1 where one did not, 2 where there is no CUDA device."""
    parser = argparse.ArgumentParser(prog="python -m bench.cuda", description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=ROOT / "bench" / "results" / "cuda.md")
    parser.add_argument("--dry-run", action="store_true", help="on the CPU, at small sizes")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda", help=argparse.SUPPRESS)
    parser.add_argument("--piece", choices=OWN, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    device = "cpu" if options.dry_run else options.device
    if device == "cuda" and not torch.cuda.is_available():
        print(
            "bench.cuda: expected a CUDA device, got none; --dry-run takes the same way on the CPU",
            file=sys.stderr,
        )
        return 2
    if options.piece:
        print(json.dumps(OWN[options.piece](torch.device(device), options.dry_run), indent=1))
        return 0
    began, rows = time.perf_counter(), []
    with tempfile.TemporaryDirectory() as folder:
        for piece in pieces(device, options.dry_run):
            rows.append(run_piece(piece, Path(folder), LIMIT - (time.perf_counter() - began)))
            print(f"{rows[-1]['name']}: {rows[-1]['end']}, {rows[-1]['seconds']} s", file=sys.stderr, flush=True)
            options.output.write_text(report(rows, device, options.dry_run))
    print(options.output)
    return 0 if all(r["end"] == "ok" for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
