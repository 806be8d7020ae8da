"""``reli3d-infer``: posed photographs to a relightable asset."""

from __future__ import annotations

import argparse
import contextlib
import functools
import itertools
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from reli3d.cli import collector, imports, objects
from reli3d.cli.checking import SUSPECT, Check, diagnosed
from reli3d.cli.exit_codes import check_range, command, reason
from reli3d.cli.help_format import joined
from reli3d.cli.options import AXES, parser
from reli3d.cli.progress import Progress
from reli3d.cli.shard_writer import ShardWriter, open_shards
from reli3d.io.tar import Packed

STARTED = time.monotonic()
EXAMPLE = Path(__file__).parents[1] / "assets" / "example"
KERNELS = EXAMPLE.parent / "kernels.json"  # modules that a run launches, written by tests/support/kernel_list.py
REFINE_SECONDS = {"cpu": 60.0, "cuda": 20.0}  # without a number
SHADER = {"cpu": ["shade_rays", "embree"], "cuda": ["shade"]}  # Embree traces the shader's rays, or Warp


@command("reli3d-infer")
def main(argv: list[str] | None = None) -> int:
    args = parser().parse_args(joined(argv, "--up", AXES))
    if args.doctor:
        from reli3d.cli import doctor

        return doctor.main([])
    with contextlib.ExitStack() as held:
        try:
            plan = _plan(args, held)
        except (ValueError, OSError) as error:
            return _fail(error)
        return _execute(args, plan)


@dataclass
class Plan:
    """ready: rows of the objects that earlier calls put into shards.  rows: those of the others, as they are made."""

    items: list[objects.Item]
    ready: list[objects.Row]
    rows: objects.Rows
    job: objects.Job
    writer: ShardWriter | None


def _plan(args: argparse.Namespace, held: contextlib.ExitStack) -> Plan:
    """What the command will do; what is wrong with it is raised here.  Raises ValueError, OSError."""
    with collector.importing():
        # the longest list: of a module too many an import takes milliseconds
        imports.beside_torch(json.loads(KERNELS.read_text())["LocalReconstructor"])
        from reli3d.output import results
        from reli3d.output.folder import check_place

    for name, high in (("workers", 1024), ("shards_out", 10**6)):
        check_range(name.replace("_", "-"), getattr(args, name), 1, high)
    for name in ("workers", "ray", "shards_out"):
        if args.check and getattr(args, name) is not None:
            raise ValueError(f"--check: expected no --{name.replace('_', '-')} with it, got one; it takes a moment")
    if args.workers is not None and args.ray is not None:
        raise ValueError("--workers: expected --workers or --ray, got both; Ray knows its workers")
    listed = [] if args.list is None else objects.listed(args.list)
    named = [*args.folder, *listed] or [EXAMPLE]
    items = objects.items_of(objects.sources(named), args.output, dots=args.shards_out is None)
    for item in items:
        check_place(item.target)  # before minutes of work
    if (args.output / objects.SUMMARY).is_dir():
        raise ValueError(
            f"{args.output / objects.SUMMARY}: expected a file or none, got a folder; give another --output"
        )
    device = choose_device(args.device)
    budget = refinement_budget(args, device)
    ready, left, writer = [], items, None
    if args.shards_out is not None:
        writer = held.enter_context(open_shards(args.output, args.shards_out, results.OURS, more=args.skip_existing))
        files = results.names(compatible=args.compatible_names, refined=bool(budget))
        left = [item for item in items if item.name not in writer.objects]
        packed = [item.name for item in items if item.name in writer.objects]
        ready = [objects.Row(n, "skipped", **objects.recorded(writer.record(n, files))) for n in packed]
    job = Check(functools.partial(_read, args=args, whole=True), args.json) if args.check else Job(args, device)
    return Plan(items, ready, _rows(args, left, device, job), job, writer)


def _execute(args: argparse.Namespace, plan: Plan) -> int:
    """Make the objects of ``plan``; the exit code."""
    items, job, writer = plan.items, plan.job, plan.writer
    ended: list[objects.Row] = []
    try:
        with contextlib.closing(plan.rows):
            for row in itertools.chain(plan.ready, plan.rows):
                ended.append(row)
                _report(row, args, len(items))
                if writer and row.result in ("done", "skipped") and row.object not in writer.place:
                    _report_shard(writer.add(row.object), args)
        if writer:
            _report_shard(writer.write(), args)
    finally:
        if len(items) > 1 and not args.check:
            order = {item.name: k for k, item in enumerate(items)}
            objects.write_summary(args.output / objects.SUMMARY, sorted(ended, key=lambda row: order[row.object]))
    results = {row.result for row in ended}
    if {"refused", "failed"} & results:
        code = 2 if results == {"refused"} else 1
    else:
        code = SUSPECT if isinstance(job, Check) and job.suspects() else 0
    if args.json:
        found = job.found if isinstance(job, Check) else {}
        entries = [asdict(row) | (found.get(row.object) or _place(row, args, writer)) for row in ended]
        print(json.dumps({"objects": entries, "exit_code": code}))
    return code


def _place(row: objects.Row, args: argparse.Namespace, writer: ShardWriter | None) -> dict[str, str]:
    if writer is None:
        return {"folder": str(args.output / row.object)}
    return {"shard": str(writer.place[row.object])} if row.object in writer.place else {}


def _rows(args: argparse.Namespace, items: list[objects.Item], device: str, job: objects.Job) -> objects.Rows:
    """What becomes of each object, made where the options say.  Raises ValueError where there is no Ray."""
    if not items or (args.workers is None and args.ray is None):
        return (objects.make(job, item) for item in items)
    # the weights are good and the kernels compiled: other processes make jobs of their own
    start = functools.partial(objects.called, "reli3d.cli.infer", "worker_job", args, device)
    if args.workers is not None:
        return objects.in_processes(start, items, min(args.workers, len(items)))
    return objects.on_ray(start, items, args.ray, gpu=device == "cuda")


def worker_job(args: argparse.Namespace, device: str) -> Job:
    """The job of a process that has others beside it."""
    import torch

    torch.set_num_threads(1)
    return Job(args, device)


def _report(row: objects.Row, args: argparse.Namespace, count: int) -> None:
    """The path of a result on stdout; errors, and what processes cannot show by a bar, on stderr."""
    if row.result == "refused" and count == 1:
        _fail(*row.notes)
    elif row.result in ("refused", "failed"):
        _fail(f"{row.object}: {row.notes[0]}")
    elif row.result == "skipped":
        print(f"{row.object}: all files are there, skipped", file=sys.stderr)
    elif not args.check:
        if args.workers is not None or args.ray is not None:
            print(f"{row.object}: {row.seconds:.1f} s", file=sys.stderr)
        if args.verbose:
            print(_stages(args.output / row.object), file=sys.stderr)
        if not args.json and args.shards_out is None:
            print(args.output / row.object / "mesh.glb", flush=True)


def _stages(folder: Path) -> str:
    """Seconds of the stages of a result, one line a run, and what its process took."""
    info = json.loads((folder / "run_info.json").read_text())
    lines = []
    for label, seconds in info["seconds"].items():
        parts = ", ".join(f"{name} {value:.2f}" for name, value in seconds.items())
        lines.append(f"{info['object']}, {label}: {parts}; in all {sum(seconds.values()):.2f} s")
    peak = info["peak_memory_mib"]
    memory = "" if peak is None else f"; peak memory {peak:.0f} MiB"
    return "\n".join([*lines, f"{info['object']}: {info['seconds_since_start']:.2f} s since the start{memory}"])


def _report_shard(path: Path | None, args: argparse.Namespace) -> None:
    if path and not args.json:
        print(path, flush=True)


def _fail(error: BaseException | str) -> int:
    print(f"reli3d-infer: {error if isinstance(error, str) else reason(error)}", file=sys.stderr)
    return 2


def choose_device(wanted: str) -> str:
    """``cpu`` or ``cuda``.  Raises ValueError where cuda is asked for and missing: nothing falls back silently."""
    import torch

    if wanted == "cuda" and not torch.cuda.is_available():
        raise ValueError("device: expected a CUDA device for --device cuda, got none; use --device cpu")
    return "cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu"


def _read(folder: Path | Packed, args: argparse.Namespace, *, every: bool = False, whole: bool = False):
    """The views of ``folder`` as the command asks for them; every: all of them where it names no number.

    whole: see :func:`~reli3d.views.folder.load_views`.
    """
    from reli3d.views.folder import load_views

    every = every and args.views is None and args.first_views is None
    with objects.opened(folder) as found:
        return load_views(
            found,
            views=args.views,
            first_views=args.first_views,
            masks=args.masks,
            every=every,
            whole=whole,
            remove_background=args.remove_background,
        )


def _fetch(weights: str) -> None:
    from reli3d.nn import hub

    if weights != "official":
        raise ValueError(f"download: expected --weights official with it, got {weights}")
    hub.fetch_official()


class Job:
    """What all objects of one command share: options and the loaded network."""

    def __init__(self, args: argparse.Namespace, device: str):
        import torch

        from reli3d.nn import weights
        from reli3d.pipeline import ReconstructOptions

        hero = int(args.hero) if args.hero.isdecimal() and args.hero.isascii() else args.hero
        self.options = ReconstructOptions(
            args.texture_size,
            args.resolution,
            args.normalize,
            args.frame,
            args.up,
            args.uv,
            hero,
            args.background,
            args.seed,
            symmetry=args.symmetry,
        )
        if args.download:
            _fetch(args.weights)
        path = weights.locate(args.weights)
        self.args, self.device, self.budget = args, device, refinement_budget(args, device)
        trunk = args.precision if args.precision in (None, "auto") else getattr(torch, args.precision)
        self.model, self.manifest = weights.load(path, trunk=trunk, device=device)
        self.digest = weights.known_sha256(path)
        # takes half a minute the first time: not before the weights are known to be good
        ready_kernels(device, needed_kernels(device, type(self.model).__name__, refined=bool(self.budget)))
        self.cold = True

    def complete(self, target: Path) -> bool:
        """Whether ``target`` holds every file that this command writes."""
        from reli3d.output import results

        return results.complete(target, compatible=self.args.compatible_names, refined=bool(self.budget))

    def run(self, folder: Path | Packed, name: str, target: Path) -> str:
        """Reconstruct one object and write its files, unless they are there; the bar ends before an error is raised."""
        from reli3d.output import results

        with results.claim(target) as replacing:
            if self.args.skip_existing and self.complete(target):
                return "skipped"
            with Progress(name) as steps:
                self._run(folder, name, replacing, steps)
        return "done"

    def _run(self, folder: Path | Packed, name: str, replacing: Callable, steps: Progress) -> None:
        from reli3d.geometry.rays import RayScene
        from reli3d.output import results
        from reli3d.output.preview import comparison, preview
        from reli3d.pipeline import Stopwatch, place, published_input, reconstruct_placed, refined
        from reli3d.views.check import up_axis

        args = self.args
        began = time.perf_counter()
        steps("reading")
        whole = published_input(self.model.preset) or args.background != "masked"
        photographs = _read(folder, args, every=bool(self.budget), whole=whole)
        read = time.perf_counter()
        views = photographs.taken()
        if args.up == "y" and args.frame == "input" and (axis := up_axis(views.c2w)) not in (None, "y"):
            views = replace(views, notes=(*views.notes, f"the cameras stand upright about {axis}: try --up {axis}"))
        steps.tell(views.notes)
        steps("normalize")
        with diagnosed(views):
            placed = place(views, self.model.preset, self.options)
        before = {"read": read - began, "normalize": time.perf_counter() - read}
        steps.tell(placed.views.notes[len(views.notes) :])
        views, output = placed.views, placed.output_from_input
        seconds: dict[str, dict[str, float]] = {}
        for label in ["cold" if self.cold else "warm", *(["warm"] if args.warm else [])]:
            watch = Stopwatch(self.model.device, steps)
            with diagnosed(views):
                asset = reconstruct_placed(placed, self.model, self.options, watch)
            seconds[label] = {k: round(v, 4) for k, v in {**before, **watch.seconds}.items()}
        self.cold = False
        steps.tell(watch.notes)
        shown, compared, first, record = views.transformed(output), None, None, {}
        if self.budget:
            steps("refine")
            photographs = photographs.transformed(output)
            result = refined(asset, photographs, seed=args.seed, cameras=args.refine_cameras, bar=True, **self.budget)
            steps.tell(result.notes)
            compared = comparison(asset, result.asset, shown.to(self.device))
            first, asset = asset if result.changed else None, result.asset
            record = {"refinement": {"views": len(photographs), **self.budget, **result.record()}}
        steps("preview")
        scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
        frames, moved = results.frame_record(placed.model_from_input, output, views.origin, args.frame, args.up)
        frames["weights"] = results.weights_record(self.manifest, self.digest)
        on_device = shown.to(self.device)
        picture = preview(asset, on_device, scene)  # the longest tasks first, so that the threads end at about one time
        measured = results.measure(asset.mesh, scene, on_device)
        encoded = results.encode(asset, shown, frames, name=name, before=first, translation=moved, scene=scene)
        drawn = picture()
        info = {
            "object": name,
            "views": list(views.names),
            "views_in_folder": views.in_folder,
            "notes": [*views.notes, *watch.notes],
            **frames,
            "preset": self.model.preset.name,
            "precision": str(self.model.dtype).removeprefix("torch."),
            "texture_size": args.texture_size,
            "resolution": args.resolution or self.model.preset.resolution,
            "background": args.background,
            "symmetry": args.symmetry,
            "seed": args.seed,
            "device": self.device,
            **measured(),
            **record,
            "seconds": seconds,
            "seconds_since_start": round(time.monotonic() - STARTED, 3),
            "peak_memory_mib": results.peak_memory_mib(),
            "versions": results.versions(),
        }
        steps("writing")
        results.write_results(replacing, encoded, drawn, info, compatible=args.compatible_names, comparison=compared)


def refinement_budget(args: argparse.Namespace, device: str) -> dict[str, float | int]:
    """``seconds`` or ``steps`` of a refinement, empty for none.  Raises ValueError for what makes no sense."""
    if args.refine is None and args.refine_steps is None:
        if args.refine_cameras:
            raise ValueError("refine-cameras: expected --refine or --refine-steps with it, got neither")
        return {}
    if args.refine_steps is not None:
        if args.refine_steps < 1:
            raise ValueError(f"refine-steps: expected at least 1, got {args.refine_steps}")
        return {"steps": args.refine_steps}
    if not 0.0 <= args.refine < 1e6:
        raise ValueError(f"refine: expected a positive number of seconds, got {args.refine}")
    return {"seconds": args.refine or REFINE_SECONDS[device]}


def needed_kernels(device: str, network: str, *, refined: bool) -> list[str]:
    """Names of the kernel modules that objects need on ``device`` with a network of the class ``network``."""
    found = json.loads(KERNELS.read_text())  # of runs on a CPU
    names = {*found[network], *(found["refine"] if refined else ())}
    return sorted(names if device == "cpu" else names - {*SHADER["cpu"]} | {*SHADER[device]})


def ready_kernels(device: str, names: list[str]) -> None:
    """Compile side by side what the first run would compile piece by piece; says so on stderr if there is something."""
    import torch

    from reli3d._bridge import load_modules
    from reli3d.kernels.cache import compiled

    modules = imports.kernel_modules(names)
    if not compiled(modules, device):
        print("compiling kernels (first run only)", file=sys.stderr)
        load_modules(modules, torch.device(device))


if __name__ == "__main__":
    sys.exit(main())
