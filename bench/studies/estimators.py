"""What the renderer of the last stage changes: Monte Carlo with shadows, the light's samples alone, Gaussians.

usage: python -m bench.studies.estimators OUT --train SAMPLES --held-back SAMPLES --maps FILE --prior FILE --start STATE

Runs begin with the averaged parameters of STATE and take the same draws; the renderer alone differs.
``images`` leaves out the truth of materials and normals.  A call goes on where the one before was stopped; ``--seeds``,
``--arms`` and ``--groups`` let several processes share it.  Then each object is read from four views and compared in
two others with the procedural object itself, rendered with shadows, also under two held-back lights.  Prints a table in
Markdown, with 95 % intervals of means over the objects by bootstrap.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.nn.functional import normalize

from bench.studies.stages import interval
from reli3d.eval.heldout import light_error
from reli3d.eval.metrics import psnr
from reli3d.geometry.camera import Camera, camera_rays
from reli3d.nn.model import Reconstructor
from reli3d.nn.presets import TINY
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.shading import ShadeOptions, shade
from reli3d.synthetic.maps import held_back, load_maps
from reli3d.synthetic.procedural import make_object
from reli3d.synthetic.samples import EXPOSED, FINE, PAINT, ObjectSurface, pooled_pixels
from reli3d.train.stages import config
from reli3d.train.stages.latents import fitted, load_prior
from reli3d.train.stages.loop import averaged, load_state, train
from reli3d.train.stages.step import encode
from reli3d.train.stages.surface import render_surface, surface
from reli3d.train.stages.views import Draw, ObjectViews, Samples

LAST = replace(config.TINY["monte_carlo"], targets=1, rate=5e-4)  # two thirds of the time of four views
ARMS = {
    "Monte Carlo": LAST,
    "light's samples": replace(LAST, samples=(sum(LAST.samples), 0, 0)),  # as many, with shadows
    "Gaussians": replace(LAST, renderer="gaussians", lobes=LAST.image_size),
}
IMAGES = replace(LAST.weights, material=0.0, normal=0.0)
TRUTHS = {"all": LAST.weights, "images": IMAGES}  # what the losses know
READ, SEEN = 4, 2  # views of a sample that are read, and the next that are compared
GROUPS = {"train": "training", "held_back": "held-back"}  # by the options that name their folders
SIZE = 64  # pixels of what is compared
SAMPLES = (16, 16, 4)  # of the render that is compared, whichever the training had
TRUE_SAMPLES = (16, 12, 4)  # of each of the rays of a pixel
METRICS = {  # name, better is
    "base_color_psnr": "more",
    "roughness_error": "less",
    "metallic_error": "less",
    "normal_deg": "less",
    "relit_psnr": "more",
    "relit_common_psnr": "more",
    "light_error": "less",
}


def folder_of(out: Path, truth: str, arm: str, seed: int) -> Path:
    return out / truth / arm.replace(" ", "_").replace("'", "") / f"seed{seed}"


def train_all(args: argparse.Namespace) -> None:
    """The runs that are not at their end."""
    model = Reconstructor(TINY)
    load_prior(model, args.prior)
    source = Samples(args.train, fitted(model.environment, sorted(args.train.glob("*.safetensors")), args.latents))
    for truth in args.truths:
        for seed in args.seeds:
            for arm in args.arms:
                stage = replace(ARMS[arm], weights=TRUTHS[truth], steps=args.steps)
                if args.rate:
                    stage = replace(stage, rate=args.rate)
                folder = folder_of(args.out, truth, arm, seed)
                run = config.Run((str(args.train),), str(folder), stage, str(args.start), seed, save_every=50)
                state = folder / "state.pt"
                if state.exists() and load_state(state, model)["step"] >= args.steps:
                    continue
                print(f"{truth}, {arm}, seed {seed}", file=sys.stderr, flush=True)
                one = Reconstructor(TINY)
                load_prior(one, args.prior)
                train(one, run, [source])


@dataclass(frozen=True)
class Truth:
    """An object as it is: what is read, what is compared, and the compared views in other light."""

    read: Draw
    views: ObjectViews  # ``SEEN`` of ``SIZE`` pixels
    cameras: list[Camera]
    environment: Tensor  # (32, 64, 3) the light of the photographs
    lights: list[Environment]
    exposures: list[float]
    relit: list[list[Tensor]]  # of each light and view (SIZE, SIZE, 3), display values over black


def rendered(thing: ObjectSurface, camera: Camera, light: Environment, seed: int) -> tuple[Tensor, Tensor]:
    """Mean linear radiance of each pixel over black, with its shadows; and the radiance of the rays that hit."""
    fine = camera.scaled(FINE)
    origins, directions = (r.reshape(-1, 3) for r in camera_rays(fine))
    hits = thing.scene.closest(origins, directions)
    seen = (hits.face >= 0).nonzero()[:, 0]
    points = thing.points_at(hits.face[seen].long(), hits.bary[seen])
    options = ShadeOptions(TRUE_SAMPLES, seed, paint=PAINT)
    radiance = shade(points, -directions[seen], light, scene=thing.scene, options=options)
    return pooled_pixels(torch.zeros_like(directions).index_copy(0, seen, radiance), camera.height), radiance


@torch.no_grad()
def truth_of(path: Path, maps: Tensor) -> Truth:
    """The object of a sample's seed.  Two of ``maps (n, H, 2H, 3)`` light it, turned: a function of the seed."""
    source = Samples(path.parent)
    views = source.load(source.files.index(path), lambda total: range(READ + SEEN))
    seen = views.select(range(READ, READ + SEEN)).resized(SIZE)
    cameras = [Camera(seen.c2w[v], seen.intrinsics[v], SIZE, SIZE) for v in range(SEEN)]
    rng = np.random.default_rng((int(path.stem), 7))
    lights, exposures, relit = [], [], []
    thing = ObjectSurface(make_object(int(path.stem)))
    for k in rng.choice(len(maps), 2, replace=False):
        light = Environment(torch.roll(maps[k], int(rng.integers(maps.shape[2])), 1).contiguous())
        shown = [rendered(thing, camera, light, v) for v, camera in enumerate(cameras)]
        exposures.append(EXPOSED / max(float(shown[0][1].mean(-1).quantile(0.9)), 1e-3))
        relit.append([linear_to_srgb((picture * exposures[-1]).clamp(0.0, 1.0)) for picture, _ in shown])
        lights.append(light)
    read = Draw(views.select(range(READ)).resized(TINY.image_size), seen, True, 0)
    return Truth(read, seen, cameras, load_file(path)["environment"].float(), lights, exposures, relit)


@torch.no_grad()
def figures(model: Reconstructor, truth: Truth) -> dict[str, float]:
    """:data:`METRICS` of one object; only of the light where the network shows no surface.

    Materials, normals and ``relit_common`` are of pixels that both cover; ``relit`` is of whole pictures over black.
    """
    code = encode(model, truth.read)
    found = {"light_error": light_error(model.decode_environment(code, 32)[0], truth.environment)}
    made = surface(model, code, model.preset.resolution)
    if made is None:
        return found
    parts: dict[str, list[Tensor]] = {"material": [], "normal": []}
    whole, common = [], []
    for light, exposure, want in zip(truth.lights, truth.exposures, truth.relit, strict=True):

        def shader(points, wo, scene, light=light, exposure=exposure):
            return exposure * shade(points, wo, light, scene=scene, options=ShadeOptions(SAMPLES, 1, paint=PAINT))

        for v, camera in enumerate(truth.cameras):
            picture = render_surface(model, code, made, camera, shader)
            got = picture.color.clamp(0.0, 1.0)
            both = truth.views.shown[v] * picture.known > 0
            whole.append(psnr(got, want[v]))
            if not both.any():
                continue
            common.append((got - want[v])[both].square())
            if light is truth.lights[0]:  # maps are the same in any light
                parts["material"].append((picture.material - truth.views.material[v])[both])
                cosine = (normalize(picture.normal, dim=-1) * truth.views.normal[v]).sum(-1)[both]
                parts["normal"].append(cosine.clamp(-1.0, 1.0).acos())
    found["relit_psnr"] = float(np.mean(whole))
    if not common:
        return found
    material = torch.cat(parts["material"])
    return found | {
        "base_color_psnr": psnr(material[:, :3], torch.zeros(())),
        "roughness_error": float(material[:, 3].abs().mean()),
        "metallic_error": float(material[:, 4].abs().mean()),
        "normal_deg": float(torch.cat(parts["normal"]).rad2deg().mean()),
        "relit_common_psnr": psnr(torch.cat(common).sqrt(), torch.zeros(())),
    }


def evaluated(args: argparse.Namespace) -> dict[str, dict[str, list[dict]]]:
    """Rows of figures of all objects by the group of objects and the run; kept in ``OUT``, a file for each group."""
    model = Reconstructor(TINY)
    load_prior(model, args.prior)
    maps, names = load_maps(args.maps)
    maps = maps[torch.tensor(held_back(names))]
    states = {"start": args.start}
    for truth in args.truths:
        for arm in args.arms:
            states |= {f"{truth}/{arm}/{s}": folder_of(args.out, truth, arm, s) / "state.pt" for s in args.seeds}
    known = {}
    for group in args.groups:
        kept = args.out / f"{group}.json"
        rows = json.loads(kept.read_text()) if kept.exists() else {}
        missing = {name: state for name, state in states.items() if name not in rows}
        networks = {name: averaged(model, load_state(state, model)["average"]) for name, state in missing.items()}
        made: dict[str, list[dict]] = {name: [] for name in missing}
        for path in sorted(getattr(args, group).glob("*.safetensors")) if missing else ():
            truth = truth_of(path, maps)
            for name, network in networks.items():
                made[name].append(figures(network, truth))
            print(f"{group}: {path.stem}", file=sys.stderr, flush=True)
        kept.write_text(json.dumps(rows | made))
        known[group] = rows | made
    return known


def column(rows: list[dict], name: str) -> np.ndarray:
    return np.array([r.get(name, np.nan) for r in rows])


def table(known: dict[str, dict[str, list[dict]]], args: argparse.Namespace) -> str:
    """Means over the objects of the start and of the first arm; the other arms less the first, object by object.

    Means are over objects for which all runs have the figure.  In brackets: the interval over objects of the mean over
    seeds; after it, the least and the largest mean of a seed.
    """
    first, *others = args.arms
    head = ["objects", "truth", "figure", "start", first, *(f"{arm} less {first}" for arm in others)]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for group, rows in known.items():
        for truth in args.truths:
            for name, better in METRICS.items():
                runs = {arm: [rows[f"{truth}/{arm}/{s}"] for s in args.seeds] for arm in args.arms}
                values = {arm: np.stack([column(r, name) for r in of_seeds]) for arm, of_seeds in runs.items()}
                start = column(rows["start"], name)
                whole = np.isfinite(np.stack([start, *(v for of in values.values() for v in of)])).all(0)
                values = {arm: v[:, whole] for arm, v in values.items()}
                cells = [f"{GROUPS[group]} {whole.sum()}", truth, f"{name} ({better})", interval(start[whole])]
                cells += [cell(values[first]), *(cell(values[arm] - values[first]) for arm in others)]
                lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def cell(values: np.ndarray) -> str:
    """Of ``(seeds, objects)``."""
    seeds = values.mean(1)
    return f"{interval(values.mean(0))}; {seeds.min():.3f} to {seeds.max():.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    for name in ("train", "held-back", "maps", "prior", "start"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--latents", type=Path, help="cache of the latents of the training lights")
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--rate", type=float, default=0.0, help="0: the stage's own")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--truths", nargs="+", choices=TRUTHS, default=list(TRUTHS))
    parser.add_argument("--groups", nargs="+", choices=GROUPS, default=list(GROUPS), help="objects to compare")
    parser.add_argument("--only-train", action="store_true", help="for one of several processes")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    args.latents = args.latents or args.out / "training.latents"
    train_all(args)
    if not args.only_train:
        report = table(evaluated(args), args)
        (args.out / "estimators.md").write_text(report)
        print(report)


if __name__ == "__main__":
    main()
