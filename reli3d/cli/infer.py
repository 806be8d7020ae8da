"""``reli3d-infer``: posed photographs to a relightable asset."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from reli3d.cli.ending import command, reason
from reli3d.cli.helping import Defaults

STARTED = time.monotonic()
EXAMPLE = Path(__file__).parents[1] / "assets" / "example"
KERNELS = ("hull", "cover", "view_features", "triplane", "flexicubes", "uv", "raster", "intersect", "attributes",
           "random", "envmap")  # modules of reli3d.kernels that one object needs  # fmt: skip
FITTING = ("distance", "grid", "silhouette", "shade_adjoint", "flexicubes_adjoint")  # what a refinement asks for too
REFINE_SECONDS = {"cpu": 60.0, "cuda": 20.0}  # without a number
SHADER = {"cpu": ("shade_rays", "embree"), "cuda": ("shade",)}  # and the shader's: Embree traces its rays, or Warp


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        formatter_class=Defaults,
        prog="reli3d-infer",
        description="Turn a few posed photographs of an object into a relightable GLB and an HDR environment.",
        epilog="Exit code: 0 all done, 1 some objects failed, 2 wrong input, 130 interrupted.  Results go to stdout.",
    )
    p.add_argument("folder", nargs="*", type=Path, help="object folders: transforms.json or a COLMAP text model; "
                   "default the bundled example")  # fmt: skip
    p.add_argument("--output", type=Path, default=Path("outputs"), help="files land in OUTPUT/<object>/")
    taken = p.add_mutually_exclusive_group()
    taken.add_argument("--views", type=int, metavar="N", help="use the N views, 1 to 16, that lie farthest apart; "
                       "default all, of more than 16 those that lie farthest apart")  # fmt: skip
    taken.add_argument("--first-views", type=int, metavar="N", help="use the first N views, 1 to 16")
    p.add_argument("--masks", type=Path, help="folder of masks with the names of the images, instead of their alpha")
    p.add_argument("--weights", default="small", help="small (in the package), official, or a safetensors file")
    p.add_argument("--download", action="store_true", help="with --weights official: fetch and convert the published "
                   "checkpoint where it is not there yet; nothing else ever uses the network")  # fmt: skip
    p.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="auto: cuda where there is one")
    p.add_argument("--precision", choices=("float32", "bfloat16"), help="of the network's large parts; default "
                   "float32, for official weights on CUDA bfloat16")  # fmt: skip
    p.add_argument("--texture-size", type=int, default=1024, help="texels, 256 to 4096 (default 1024)")
    p.add_argument(
        "--resolution", type=int, help="cubes along a side of the surface grid, 16 to 256 (default the preset's)"
    )
    p.add_argument(
        "--uv", choices=("project", "xatlas"), default="project", help="atlas: own projection or xatlas (slow)"
    )
    p.add_argument("--normalize", choices=("auto", "hull", "none"),
                   help="auto: centre and scale by the visual hull unless it sits in the model's cube; default auto, "
                   "with official weights none: poses as stored")  # fmt: skip
    p.add_argument("--hero", default="0", metavar="N", help="view that the network takes as its main one, counted "
                   "from 0 (the default), or random")  # fmt: skip
    p.add_argument("--background", choices=("auto", "masked", "visible"), default="masked",
                   help="what the light is read from: masked (default): the object alone; visible: the background "
                   "too; auto: visible where all views have one and the weights know how")  # fmt: skip
    p.add_argument(
        "--frame", choices=("input", "model"), default="input", help="frame of the mesh (default the cameras')"
    )
    p.add_argument(
        "--up", choices=("x", "y", "z", "-x", "-y", "-z"), default="y", help="axis of that frame to turn to +Y"
    )
    p.add_argument("--refine", nargs="?", type=float, const=0.0, metavar="SECONDS", help="fit the result to all "
                   "photographs of the folder; without a number 60 seconds, 20 on CUDA; stands after the "
                   "folders")  # fmt: skip
    p.add_argument("--refine-steps", type=int, metavar="N", help="the same with a number of steps instead of seconds: "
                   "every run of one machine gives the same")  # fmt: skip
    p.add_argument("--refine-cameras", action="store_true", help="with either: correct the cameras as well")
    p.add_argument("--seed", type=int, default=0, help="of what is drawn by chance")
    p.add_argument("--compatible-names", action="store_true", help="also write illumination.hdr: the published "
                   "release's name and layout, -Z in the centre column")  # fmt: skip
    p.add_argument("--skip-existing", action="store_true", help="leave objects alone whose files are all there")
    p.add_argument(
        "--warm", action="store_true", help="reconstruct every object twice and record the second time as well"
    )
    p.add_argument("--allow-outside", action="store_true", help="let a camera file name images outside its folder")
    p.add_argument("--check", action="store_true", help="explain the cameras and draw the rig; reconstruct nothing")
    p.add_argument("--doctor", action="store_true", help="say what is installed and where it runs")
    return p


@command("reli3d-infer")
def main(argv: list[str] | None = None) -> int:
    from reli3d.output.folder import check_place

    args = parser().parse_args(argv)
    if args.doctor:
        from reli3d.cli import doctor

        return doctor.main([])
    folders = args.folder or [EXAMPLE]
    names = object_names(folders)
    try:
        for name in names:
            check_place(args.output / name)  # before minutes of work
        device = choose_device(args.device)
        job = None if args.check else Job(args, device)
    except (ValueError, OSError) as error:
        return _fail(error)
    wrong = failed = done = 0
    for folder, name in zip(folders, names, strict=True):
        target = args.output / name
        try:
            if args.check:
                check(folder, target, args)
            else:
                job.run(folder, name, target)
            done += 1
        except ValueError as error:
            wrong += 1
            _fail(error)
        except (OSError, RuntimeError, MemoryError) as error:
            failed += 1
            _fail(error, name)
    if wrong + failed == 0:
        return 0
    return 2 if wrong and done == 0 and failed == 0 else 1


def _fail(error: BaseException, name: str | None = None) -> int:
    print(f"reli3d-infer: {name + ': ' if name else ''}{reason(error)}", file=sys.stderr)
    return 2


def object_names(folders: list[Path]) -> list[str]:
    """A name for each folder: its own, with a number where two are alike."""
    names: list[str] = []
    for folder in folders:
        base = name = Path(os.path.abspath(folder)).name or "object"
        k = 2
        while name in names:
            name, k = f"{base}-{k}", k + 1
        names.append(name)
    return names


def choose_device(wanted: str) -> str:
    """``cpu`` or ``cuda``.  Raises ValueError where cuda is asked for and missing: nothing falls back silently."""
    import torch

    if wanted == "cuda" and not torch.cuda.is_available():
        raise ValueError("device: expected a CUDA device for --device cuda, got none; use --device cpu")
    return "cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu"


def _read(folder: Path, args: argparse.Namespace, *, every: bool = False):
    """The views of ``folder`` as the command asks for them; every: all of them where it names no number."""
    from reli3d.views.folder import load_views

    every = every and args.views is None and args.first_views is None
    return load_views(folder, views=args.views, first_views=args.first_views, masks=args.masks,
                      allow_outside=args.allow_outside, every=every)  # fmt: skip


def check(folder: Path, target: Path, args: argparse.Namespace) -> None:
    """Print what the cameras look like, one line a view, and write the picture of the rig."""
    from reli3d.views.check import explain_cameras, rig_picture

    views = _read(folder, args)
    for line in (*views.notes, *explain_cameras(views)):
        print(line)
    target.mkdir(parents=True, exist_ok=True)
    rig_picture(views, target / "rig.png")
    print(target / "rig.png")


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
        from reli3d.pipeline import check_options

        check_options(args.texture_size, args.resolution)
        if args.download:
            _fetch(args.weights)
        path = weights.locate(args.weights)
        self.args, self.device, self.budget = args, device, refinement_budget(args, device)
        trunk = args.precision and {"float32": torch.float32, "bfloat16": torch.bfloat16}[args.precision]
        self.model, self.manifest = weights.load(path, trunk=trunk, device=device)
        self.digest = weights.known_sha256(path)
        ready_kernels(device)  # takes half a minute the first time: not before the weights are known to be good
        if self.budget:
            ready_kernels(device, FITTING)
        self.cold = True

    def complete(self, target: Path) -> bool:
        """Whether ``target`` holds every file that this command writes."""
        from reli3d.output import results

        return results.complete(target, compatible=self.args.compatible_names, refined=bool(self.budget))

    def run(self, folder: Path, name: str, target: Path) -> None:
        """Reconstruct one object and write its files; the bar goes before an error is told."""
        from reli3d.output import results

        with results.claim(target) as replacing:
            if self.args.skip_existing and self.complete(target):
                print(f"{name}: all files are there, skipped", file=sys.stderr)
                return
            with Progress(name) as steps:
                self._run(folder, name, replacing, steps)
        print(target / "mesh.glb", flush=True)

    def _run(self, folder: Path, name: str, replacing: Callable, steps: Progress) -> None:
        from reli3d.output import results
        from reli3d.output.preview import comparison, preview
        from reli3d.pipeline import default_normalization, output_frame, reconstruct, refined
        from reli3d.views.normalize import normalize
        from reli3d.views.published_views import hero_first, placement_notes

        args = self.args
        began = time.perf_counter()
        steps("reading")
        views = _read(folder, args)
        normalization = args.normalize or default_normalization(self.model.preset)
        if normalization == "none" and args.normalize is None:
            views = replace(views, notes=(*views.notes, *placement_notes(views)))
        for note in views.notes:
            steps.bar.write(f"{name}: {note}", file=sys.stderr)
        hero = int(args.hero) if args.hero.isdecimal() and args.hero.isascii() else args.hero
        views = hero_first(views, hero, args.seed)
        read = time.perf_counter()
        steps("normalize")
        to_model = normalize(views, normalization)
        before = {"read": read - began, "normalize": time.perf_counter() - read}
        seconds: dict[str, dict[str, float]] = {}
        for label in ["cold" if self.cold else "warm", *(["warm"] if args.warm else [])]:
            stages: dict[str, float] = {}
            asset = reconstruct(views, weights=self.model, texture_size=args.texture_size, resolution=args.resolution,
                                normalization=to_model, frame=args.frame, up=args.up, uv=args.uv, seed=args.seed,
                                background=args.background, timings=stages, progress=steps)  # fmt: skip
            seconds[label] = {k: round(v, 4) for k, v in {**stages, **before}.items()}
        self.cold = False
        output = output_frame(to_model, args.frame, args.up)
        shown, compared, record = views.transformed(output), None, {}
        if self.budget:
            steps("refine")
            photographs = _read(folder, args, every=True).transformed(output)
            result = refined(asset, photographs, seed=args.seed, cameras=args.refine_cameras, bar=True, **self.budget)
            for note in result.notes:
                steps.bar.write(f"{name}: {note}", file=sys.stderr)
            compared, asset = comparison(asset, result.asset, shown.to(self.device)), result.asset
            record = {"refinement": {"views": len(photographs), **self.budget, **result.record()}}
        steps("preview")
        picture = preview(asset, shown.to(self.device))
        info = {
            "object": name,
            "views": list(views.names),
            "views_in_folder": views.in_folder,
            "coordinate_system": views.coordinate_system,
            "notes": list(views.notes),
            **results.frame_record(to_model, output, args.frame, args.up),
            "weights": results.weights_record(self.manifest, self.digest),
            "preset": self.model.preset.name,
            "precision": str(self.model.dtype).removeprefix("torch."),
            "texture_size": args.texture_size,
            "resolution": args.resolution or self.model.preset.resolution,
            "background": args.background,
            "seed": args.seed,
            "device": self.device,
            "mesh": results.mesh_statistics(asset.mesh),
            **record,
            "seconds": seconds,
            "seconds_since_start": round(time.monotonic() - STARTED, 3),
            "peak_memory_mib": results.peak_memory_mib(),
            "versions": results.versions(),
        }
        steps("writing")
        results.write_results(replacing, asset, shown, picture, info, compatible=args.compatible_names,
                              comparison=compared)  # fmt: skip


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


def ready_kernels(device: str, names: tuple[str, ...] = KERNELS) -> None:
    """Compile side by side what the first run would compile piece by piece; says so on stderr if there is something."""
    import torch

    from reli3d._bridge import compiled, load_modules

    names = (*names, *SHADER[torch.device(device).type])
    modules = [importlib.import_module(f"reli3d.kernels.{name}") for name in names]
    if not compiled(modules, torch.device(device)):
        print("compiling kernels (first run only)", file=sys.stderr)
        load_modules(modules, torch.device(device))


class Progress:
    """A bar over the stages of one object, on stderr."""

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

        self.bar = tqdm(
            total=len(self.STAGES), desc=name, file=sys.stderr, bar_format="{desc}: {bar:20} {postfix} {elapsed}"
        )

    def __call__(self, stage: str) -> None:
        self.bar.set_postfix_str(stage, refresh=False)
        self.bar.n = self.STAGES.index(stage)
        self.bar.refresh()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.bar.leave = error is None
        if error is None:
            self.bar.n = len(self.STAGES)
            self.bar.set_postfix_str("done", refresh=True)
        self.bar.close()


if __name__ == "__main__":
    sys.exit(main())
