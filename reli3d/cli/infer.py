"""``reli3d-infer``: posed photographs to a relightable asset."""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

from reli3d.cli import objects
from reli3d.cli.checking import SUSPECT, Check, diagnosed
from reli3d.cli.ending import check_range, command, reason
from reli3d.cli.helping import Defaults, joined
from reli3d.cli.progress import Progress

STARTED = time.monotonic()
EXAMPLE = Path(__file__).parents[1] / "assets" / "example"
KERNELS = EXAMPLE.parent / "kernels.json"  # modules that a run launches, written by tests/support/kernel_list.py
AXES = ("x", "y", "z", "-x", "-y", "-z")
REFINE_SECONDS = {"cpu": 60.0, "cuda": 20.0}  # without a number
SHADER = {"cpu": ["shade_rays", "embree"], "cuda": ["shade"]}  # Embree traces the shader's rays, or Warp


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        formatter_class=Defaults,
        prog="reli3d-infer",
        description="Turn a few posed photographs of an object into a relightable GLB and an HDR environment.",
        epilog="Exit code: 0 all done, 1 some objects failed, 2 wrong input, 3 --check suspects cameras or masks, 130 "
        "interrupted.  Results go to stdout.",
    )
    p.add_argument(
        "folder",
        nargs="*",
        type=Path,
        help="object folders: transforms.json or a COLMAP model; default the bundled example",
    )
    p.add_argument("--output", type=Path, default=Path("outputs"), help="files land in OUTPUT/<object>/")
    taken = p.add_mutually_exclusive_group()
    taken.add_argument("--views", type=int, metavar="N", help="use the N views, 1 to 16, that lie farthest apart; "
                       "default all, of more than 16 those that lie farthest apart")  # fmt: skip
    taken.add_argument("--first-views", type=int, metavar="N", help="use the first N views, 1 to 16")
    p.add_argument("--masks", type=Path, help="folder of masks with the names of the images, instead of their alpha")
    p.add_argument(
        "--remove-background",
        action="store_true",
        help="make masks for photographs without, by rembg "
        "(pip install 'reli3d[masks]'), which fetches its network once",
    )
    p.add_argument("--weights", default="small", help="small (in the package), official, or a safetensors file")
    p.add_argument(
        "--download",
        action="store_true",
        help="with --weights official: fetch and convert the published "
        "checkpoint where it is not there yet; nothing else ever uses the network",
    )
    p.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="auto: cuda where there is one")
    p.add_argument(
        "--precision",
        choices=("float32", "bfloat16"),
        help="of the network's large parts; default float32, for official weights on CUDA bfloat16",
    )
    p.add_argument("--texture-size", type=int, default=1024, help="texels, 256 to 4096 (default 1024)")
    p.add_argument(
        "--resolution", type=int, help="cubes along a side of the surface grid, 16 to 256 (default the preset's)"
    )
    p.add_argument(
        "--uv", choices=("project", "xatlas"), default="project", help="atlas: own projection or xatlas (slow)"
    )
    p.add_argument(
        "--normalize",
        choices=("auto", "hull", "none"),
        help="auto: centre and scale by the visual hull unless it sits in the model's cube; default auto, "
        "with official weights none: poses as stored",
    )
    p.add_argument(
        "--hero",
        default="0",
        metavar="N",
        help="view that the network takes as its main one, counted from 0 (the default), or random",
    )
    p.add_argument(
        "--background",
        choices=("auto", "masked", "visible"),
        default="masked",
        help="what the light is read from: masked (default): the object alone; visible: the background "
        "too; auto: visible where all views have one and the weights know how",
    )
    p.add_argument(
        "--frame", choices=("input", "model"), default="input", help="frame of the mesh (default the cameras')"
    )
    p.add_argument("--up", choices=AXES, default="y", help="axis of that frame to turn to +Y")
    p.add_argument("--refine", nargs="?", type=float, const=0.0, metavar="SECONDS", help="fit the result to all "
                   "photographs of the folder; without a number 60 seconds, 20 on CUDA; stands after the "
                   "folders")  # fmt: skip
    p.add_argument(
        "--refine-steps",
        type=int,
        metavar="N",
        help="the same with a number of steps instead of seconds: every run of one machine gives the same",
    )
    p.add_argument("--refine-cameras", action="store_true", help="with either: correct the cameras as well")
    p.add_argument("--seed", type=int, default=0, help="of what is drawn by chance")
    p.add_argument(
        "--compatible-names",
        action="store_true",
        help="also write illumination.hdr: the published release's name and layout, -Z in the centre column",
    )
    p.add_argument("--list", type=Path, metavar="FILE", help="text file that names more object folders, one a line")
    p.add_argument("--workers", type=int, metavar="N", help="make N objects at a time, each in a process of its own "
                   "with one thread and the network, 0.7 GiB with the shipped weights")  # fmt: skip
    p.add_argument("--ray", metavar="ADDRESS", help="make the objects on a Ray cluster: its address, auto for that of "
                   "this machine, local to start one; needs pip install reli3d[ray]")  # fmt: skip
    p.add_argument("--skip-existing", action="store_true", help="leave objects alone whose files are all there")
    p.add_argument(
        "--warm", action="store_true", help="reconstruct every object twice and record the second time as well"
    )
    p.add_argument("--allow-outside", action="store_true", help="let a camera file name images outside its folder")
    p.add_argument("--check", action="store_true", help="explain the cameras and draw the rig; reconstruct nothing")
    p.add_argument("--json", action="store_true", help="print one JSON object, with an entry for each object, instead "
                   "of lines")  # fmt: skip
    p.add_argument("--doctor", action="store_true", help="say what is installed and where it runs")
    return p


@command("reli3d-infer")
def main(argv: list[str] | None = None) -> int:
    from reli3d.output.folder import check_place

    args = parser().parse_args(joined(argv, "--up", AXES))
    if args.doctor:
        from reli3d.cli import doctor

        return doctor.main([])
    try:
        items = objects.items_of(_folders(args), args.output)
        for item in items:
            check_place(item.target)  # before minutes of work
        summary = args.output / objects.SUMMARY
        if summary.is_dir():
            raise ValueError(f"{summary}: expected a file or none, got a folder; give another --output")
        check_range("workers", args.workers, 1, 1024)
        if args.workers is not None and args.ray is not None:
            raise ValueError("--workers: expected --workers or --ray, got both; Ray knows its workers")
        if args.check and (args.workers is not None or args.ray is not None):
            raise ValueError("--check: expected neither --workers nor --ray with it; it takes a moment")
        device = choose_device(args.device)
        job = Check(functools.partial(_read, args=args, whole=True), args.json) if args.check else Job(args, device)
        rows = _rows(args, items, device, job)
    except (ValueError, OSError) as error:
        return _fail(error)
    ended: list[objects.Row] = []
    try:
        with contextlib.closing(rows):
            for row in rows:
                ended.append(row)
                _tell(row, args, len(items))
    finally:
        if len(items) > 1 and not args.check:
            order = {item.name: k for k, item in enumerate(items)}
            objects.write_summary(summary, sorted(ended, key=lambda row: order[row.object]))
    results = {row.result for row in ended}
    if {"refused", "failed"} & results:
        code = 2 if results == {"refused"} else 1
    else:
        code = SUSPECT if isinstance(job, Check) and job.suspects() else 0
    if args.json:
        found = job.found if isinstance(job, Check) else {}
        entries = [asdict(row) | found.get(row.object, {"folder": str(args.output / row.object)}) for row in ended]
        print(json.dumps({"objects": entries, "exit_code": code}))
    return code


def _folders(args: argparse.Namespace) -> list[Path]:
    if args.list is not None:
        return [*args.folder, *objects.listed(args.list)]
    return args.folder or [EXAMPLE]


def _rows(args: argparse.Namespace, items: list[objects.Item], device: str, job: objects.Job) -> objects.Rows:
    """What becomes of each object, made where the options say.  Raises ValueError where there is no Ray."""
    if args.workers is None and args.ray is None:
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


def _tell(row: objects.Row, args: argparse.Namespace, count: int) -> None:
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
        if not args.json:
            print(args.output / row.object / "mesh.glb", flush=True)


def _fail(error: BaseException | str) -> int:
    print(f"reli3d-infer: {error if isinstance(error, str) else reason(error)}", file=sys.stderr)
    return 2


def choose_device(wanted: str) -> str:
    """``cpu`` or ``cuda``.  Raises ValueError where cuda is asked for and missing: nothing falls back silently."""
    import torch

    if wanted == "cuda" and not torch.cuda.is_available():
        raise ValueError("device: expected a CUDA device for --device cuda, got none; use --device cpu")
    return "cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu"


def _read(folder: Path, args: argparse.Namespace, *, every: bool = False, whole: bool = False):
    """The views of ``folder`` as the command asks for them; every: all of them where it names no number.

    whole: see :func:`~reli3d.views.folder.load_views`.
    """
    from reli3d.views.folder import load_views

    every = every and args.views is None and args.first_views is None
    return load_views(folder, views=args.views, first_views=args.first_views, masks=args.masks,
                      allow_outside=args.allow_outside, every=every, whole=whole,
                      remove_background=args.remove_background)  # fmt: skip


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
        self.options = ReconstructOptions(args.texture_size, args.resolution, args.normalize, args.frame, args.up,
                                          args.uv, hero, args.background, args.seed)  # fmt: skip
        if args.download:
            _fetch(args.weights)
        path = weights.locate(args.weights)
        self.args, self.device, self.budget = args, device, refinement_budget(args, device)
        trunk = args.precision and {"float32": torch.float32, "bfloat16": torch.bfloat16}[args.precision]
        self.model, self.manifest = weights.load(path, trunk=trunk, device=device)
        self.digest = weights.known_sha256(path)
        # takes half a minute the first time: not before the weights are known to be good
        ready_kernels(device, needed_kernels(device, type(self.model).__name__, refined=bool(self.budget)))
        self.cold = True

    def complete(self, target: Path) -> bool:
        """Whether ``target`` holds every file that this command writes."""
        from reli3d.output import results

        return results.complete(target, compatible=self.args.compatible_names, refined=bool(self.budget))

    def run(self, folder: Path, name: str, target: Path) -> str:
        """Reconstruct one object and write its files, unless they are there; the bar goes before an error is told."""
        from reli3d.output import results

        with results.claim(target) as replacing:
            if self.args.skip_existing and self.complete(target):
                return "skipped"
            with Progress(name) as steps:
                self._run(folder, name, replacing, steps)
        return "done"

    def _run(self, folder: Path, name: str, replacing: Callable, steps: Progress) -> None:
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
        shown, compared, record = views.transformed(output), None, {}
        if self.budget:
            steps("refine")
            photographs = photographs.transformed(output)
            result = refined(asset, photographs, seed=args.seed, cameras=args.refine_cameras, bar=True, **self.budget)
            steps.tell(result.notes)
            compared, asset = comparison(asset, result.asset, shown.to(self.device)), result.asset
            record = {"refinement": {"views": len(photographs), **self.budget, **result.record()}}
        steps("preview")
        picture = preview(asset, shown.to(self.device))
        frames, translation = results.frame_record(placed.model_from_input, output, views.origin, args.frame, args.up)
        info = {
            "object": name,
            "views": list(views.names),
            "views_in_folder": views.in_folder,
            "coordinate_system": views.coordinate_system,
            "notes": list(views.notes),
            **frames,
            "weights": results.weights_record(self.manifest, self.digest),
            "preset": self.model.preset.name,
            "precision": str(self.model.dtype).removeprefix("torch."),
            "texture_size": args.texture_size,
            "resolution": args.resolution or self.model.preset.resolution,
            "background": args.background,
            "seed": args.seed,
            "device": self.device,
            "mesh": results.mesh_statistics(asset.mesh),
            "mask_iou": results.mask_iou(asset.mesh, shown.to(self.device)),
            **record,
            "seconds": seconds,
            "seconds_since_start": round(time.monotonic() - STARTED, 3),
            "peak_memory_mib": results.peak_memory_mib(),
            "versions": results.versions(),
        }
        steps("writing")
        results.write_results(replacing, asset, shown, picture, info, compatible=args.compatible_names,
                              comparison=compared, translation=translation)  # fmt: skip


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

    from reli3d._bridge import compiled, load_modules

    modules = [importlib.import_module(f"reli3d.kernels.{name}") for name in names]
    if not compiled(modules, torch.device(device)):
        print("compiling kernels (first run only)", file=sys.stderr)
        load_modules(modules, torch.device(device))


if __name__ == "__main__":
    sys.exit(main())
