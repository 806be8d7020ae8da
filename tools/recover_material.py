"""Recover base colour, roughness, metallic and the light of a known mesh from 16 images that Mitsuba 3 rendered.

usage: python tools/recover_material.py OUTPUT_FOLDER [--data ../shared/data] [--steps 600] [--size 160]

The images are Mitsuba's own: its ``principled`` material, its light, its shadows, its film.  Everything on our side is
a public function of ``reli3d``.  The loss is the squared difference of pixel and target, whose gradient is unbiased
because two independent estimates are multiplied: one tells the difference, the other the slope.  Prints the scores,
also under a light that was not seen, and writes ``recovered.png``: before, after, truth.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from dataclasses import replace
from glob import glob
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image, ImageDraw

from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.io.hdr import read_environment
from reli3d.io.images import read_image
from reli3d.render.asset import Asset, TextureSet
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import surface_points
from reli3d.render.render import render
from reli3d.render.shading import ShadeOptions, shade

VIEWS, TEXELS, LIGHT_ROWS = 16, 192, 32
BATCH = 12288  # pixels a step
SAMPLES = (16, 16, 4)  # a pixel and step; the noise of a step is that of its pixels' subpixel places anyway
PAINT = "published"  # nearer to Mitsuba's ``principled`` than the default: true maps relit at 32.6 instead of 28.5 dB
MANY = ShadeOptions((64, 64, 8), paint=PAINT)  # for pictures and scores
CAPTURE, UNSEEN = "aerodynamics_workshop", "leadenhall_market"


def cameras(size: int, count: int) -> list[Camera]:
    """Eyes on a spiral from 25 degrees below the horizon to 65 above."""
    found = []
    for k in range(count):
        lift = math.radians(-25 + 90 * (k + 0.5) / count)
        turn = 2.399963 * k
        eye = 3.4 * torch.tensor([math.cos(lift) * math.sin(turn), math.sin(lift), math.cos(lift) * math.cos(turn)])
        pose = look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
        found.append(Camera.from_fov(pose, math.radians(34.0), size, size))
    return found


def load_object(folder: Path) -> Asset:
    """Keenan Crane's spot, half its diagonal 1: its paint dimmed, its dark patches of gold, stripes of roughness."""
    found = trimesh.load(folder / "spot.obj", process=False)
    vertices = torch.tensor(np.asarray(found.vertices), dtype=torch.float32)
    low, high = vertices.amin(0), vertices.amax(0)
    uv = torch.tensor(np.asarray(found.visual.uv), dtype=torch.float32) * torch.tensor([1.0, -1.0])  # OBJ: v up
    faces = torch.tensor(np.asarray(found.faces), dtype=torch.int32)
    mesh = Mesh((vertices - (low + high) / 2) / ((high - low).norm() / 2), faces, None, uv + torch.tensor([0.0, 1.0]))
    mesh = replace(mesh, normals=torch.tensor(np.array(found.vertex_normals), dtype=torch.float32))
    paint = srgb_to_linear(read_image(folder / "spot_texture.png")[0])
    gold = (paint.mean(-1, keepdim=True) < 0.25).float()
    column = (torch.arange(paint.shape[1]) + 0.5) / paint.shape[1]
    stripes = (0.5 + 0.2 * torch.sin(40.0 * column)).expand(paint.shape[:2])[..., None]
    base = torch.lerp(0.75 * paint, torch.tensor([0.9, 0.6, 0.25]), gold)
    return Asset(mesh, TextureSet(linear_to_srgb(base), torch.lerp(stripes, torch.full_like(gold, 0.25), gold), gold))


class Mitsuba:
    """The judge: the same mesh and maps in its own scene."""

    def __init__(self, asset: Asset):
        found = sorted(glob("/usr/lib/*/libLLVM-19.so*") + glob("/usr/lib/*/libLLVM-2?.so*"))
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", found[0] if found else "")
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")
        self.mi, maps = mi, asset.textures

        def texture(values, raw):
            bitmap = mi.Bitmap(np.ascontiguousarray(values.numpy(), np.float32))
            return {"type": "bitmap", "bitmap": bitmap, "raw": raw}

        material = {
            "type": "principled",
            "base_color": texture(srgb_to_linear(maps.base_color), True),
            "specular": 0.5,
            "roughness": texture(maps.roughness[..., None], True),
            "metallic": texture(maps.metallic[..., None], True),
        }
        props = mi.Properties()
        props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": material})
        mesh = asset.mesh
        self.mesh = mi.Mesh(
            "object",
            len(mesh.vertices),
            len(mesh.faces),
            has_vertex_normals=True,
            has_vertex_texcoords=True,
            props=props,
        )
        values = mi.traverse(self.mesh)
        values["vertex_positions"], values["vertex_normals"] = (
            mesh.vertices.numpy().ravel(),
            mesh.normals.numpy().ravel(),
        )
        values["vertex_texcoords"], values["faces"] = (
            mesh.uv.numpy().ravel(),
            mesh.faces.numpy().ravel().astype(np.uint32),
        )
        values.update()

    def image(self, camera: Camera, light: Environment, samples: int) -> torch.Tensor:
        """Direct light with shadows, ``(H, W, 4)`` linear with coverage, box filter."""
        mi = self.mi
        # its map's rows are nodes at v = r / (H' - 1), ours texel centres: on 2 H + 1 rows both are the same function
        planes = light.radiance.permute(2, 0, 1)[None]
        rows = torch.arange(2 * planes.shape[2] + 1) / 2 - 0.5
        low = rows.floor().long().clamp(0, planes.shape[2] - 1)
        high = (low + 1).clamp(max=planes.shape[2] - 1)
        part = (rows.clamp(min=0.0) - rows.clamp(min=0.0).floor())[:, None]
        data = (planes[:, :, low] * (1 - part) + planes[:, :, high] * part)[0].permute(1, 2, 0)
        emitter = {
            "type": "envmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(data.numpy(), np.float32)),
            "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 180),
        }
        pose = camera.c2w.double().numpy() @ np.diag([-1.0, 1.0, -1.0, 1.0])  # it looks along +Z with +X to the left
        fov = 2.0 * math.degrees(math.atan(0.5 * camera.width / float(camera.intrinsics[0])))
        sensor = {
            "type": "perspective",
            "fov": fov,
            "to_world": mi.ScalarTransform4f(pose),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "rgba",
                "rfilter": {"type": "box"},
            },
        }
        scene = mi.load_dict(
            {
                "type": "scene",
                "object": self.mesh,
                "light": emitter,
                "sensor": sensor,
                "integrator": {"type": "direct", "hide_emitters": True},
            }
        )
        return torch.from_numpy(np.array(mi.render(scene, spp=samples), dtype=np.float32))


class Unknowns(torch.nn.Module):
    """Maps and light, free of bounds inside: sigmoids for the maps, an exponential for radiance."""

    def __init__(self, brightness: float):
        super().__init__()
        self.base = torch.nn.Parameter(torch.zeros(TEXELS, TEXELS, 3))
        self.rough_metal = torch.nn.Parameter(torch.tensor([0.0, -1.0]).expand(TEXELS, TEXELS, 2).clone())
        self.light = torch.nn.Parameter(torch.full((LIGHT_ROWS, 2 * LIGHT_ROWS, 3), math.log(brightness)))

    def textures(self) -> TextureSet:
        rough, metal = torch.sigmoid(self.rough_metal).unbind(-1)
        return TextureSet(torch.sigmoid(self.base), 0.05 + 0.95 * rough, metal)

    def environment(self) -> Environment:
        return Environment(self.light.exp())

    def roughness_of_maps(self) -> torch.Tensor:
        """Mean absolute slopes: small where neighbouring texels and directions agree."""
        total = 0.0
        for values, weight in ((self.base, 2e-3), (self.rough_metal, 1e-2), (self.light, 1e-2)):
            total = total + weight * (values.diff(dim=0).abs().mean() + values.diff(dim=1).abs().mean())
        return total


def fit(asset: Asset, views: list[Camera], images: torch.Tensor, steps: int, report) -> Unknowns:
    """Adam on random pixels inside the object; ``images (V, H, W, 4)``."""
    scene, mesh = RayScene(asset.mesh.vertices, asset.mesh.faces), asset.mesh
    whole = torch.nn.functional.avg_pool2d(images[..., 3], 3, 1, 1) > 0.999  # no outline in the pixel or beside it
    pixels = torch.nonzero(whole)
    target = images[..., :3][whole]
    weight = 1.0 / (target + 0.1 * target.mean()).square()  # about relative errors: dark parts count too
    c2w, focal = torch.stack([v.c2w for v in views]), views[0].intrinsics
    unknowns = Unknowns(float(target.mean()) * 2.0)
    rates = [
        {"params": [unknowns.base], "lr": 0.06},
        {"params": [unknowns.rough_metal], "lr": 0.06},
        {"params": [unknowns.light], "lr": 0.05},
    ]
    optimizer = torch.optim.Adam(rates, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, 1e-3)
    rng, began = torch.Generator().manual_seed(0), time.perf_counter()
    for step in range(steps):
        pick = torch.randint(len(pixels), (BATCH,), generator=rng)
        view, row, column = pixels[pick].unbind(1)
        place = torch.rand(BATCH, 2, generator=rng) + torch.stack([column, row], 1)  # anywhere in the pixel
        local = torch.cat([(place - focal[2:]) / focal[:2] * torch.tensor([1.0, -1.0]), -torch.ones(BATCH, 1)], 1)
        direction = torch.nn.functional.normalize((c2w[view, :3, :3] @ local[..., None])[..., 0], dim=-1)
        hits = scene.closest(c2w[view, :3, 3], direction)
        seen = hits.face >= 0
        wo, aim, share = -direction[seen], target[pick][seen], weight[pick][seen]
        points = surface_points(mesh, unknowns.textures(), hits.face[seen], hits.bary[seen])
        light = unknowns.environment()

        def image(seed, points=points, wo=wo, light=light):
            return shade(points, wo, light, scene=scene, options=ShadeOptions(SAMPLES, seed, paint=PAINT))

        slope = image(2 * step)
        with torch.no_grad():
            other = image(2 * step + 1)
        # d (I - T)^2 = 2 (I - T) dI with two estimates of I: their product has no bias, a square would have the noise's
        loss = (share * 2.0 * (other - aim) * slope).mean() + unknowns.roughness_of_maps()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 50 == 49 or step == steps - 1:
            error = float((share * (other - aim) * (slope.detach() - aim)).mean())
            report(f"step {step + 1}: squared relative error {error:.4f}, {time.perf_counter() - began:.0f} s")
    return unknowns


def psnr(got: torch.Tensor, want: torch.Tensor, mask: torch.Tensor) -> float:
    """Decibels between values in [0, 1] where ``mask`` holds."""
    return -10.0 * math.log10(float((got - want)[mask].square().mean()))


def shown(radiance: torch.Tensor, exposure: float) -> torch.Tensor:
    return linear_to_srgb((radiance * exposure).clamp(0.0, 1.0))


def scale_to(got: torch.Tensor, want: torch.Tensor) -> torch.Tensor:
    """The factor per channel that brings linear colours nearest: light and paint are known only up to it."""
    return (got * want).sum(0) / got.square().sum(0)


def row_of_picture(asset: Asset, camera: Camera, unseen: Environment, own: Environment, exposures, size: int):
    """Tiles of one row: base colour, roughness, metallic, under its own light, under the unseen one, its light."""
    image = render(asset, camera, own, options=MANY, supersampling=2)
    relit = render(asset, camera, unseen, options=MANY, supersampling=2)
    grey = lambda v: v[..., None].expand(-1, -1, 3) * (image.alpha > 0)[..., None]  # noqa: E731
    sky = torch.nn.functional.interpolate(own.radiance.permute(2, 0, 1)[None], (size // 2, size), mode="area")[0]
    sky = torch.nn.functional.pad(sky.permute(1, 2, 0), (0, 0, 0, 0, size // 4, size - size // 2 - size // 4))
    return [
        linear_to_srgb(image.base_color.clamp(0, 1)),
        grey(image.roughness),
        grey(image.metallic),
        shown(image.radiance, exposures[0]),
        shown(relit.radiance, exposures[1]),
        shown(sky, exposures[0]),
    ]


def write_picture(path: Path, rows: list[list[torch.Tensor]], size: int) -> None:
    names = ["base colour", "roughness", "metallic", "capture light", "unseen light", "light"]
    sheet = Image.new("RGB", (70 + size * len(names), 18 + size * len(rows)))
    draw = ImageDraw.Draw(sheet)
    for c, name in enumerate(names):
        draw.text((74 + c * size, 3), name)
    for r, (label, tiles) in enumerate(zip(("before", "after", "truth"), rows, strict=True)):
        draw.text((6, 18 + r * size + size // 2), label)
        for c, tile in enumerate(tiles):
            pixels = (tile.detach() * 255.0 + 0.5).to(torch.uint8).numpy()
            sheet.paste(Image.fromarray(pixels), (70 + c * size, 18 + r * size))
    sheet.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--size", type=int, default=160, help="pixels along a side of the images")
    parser.add_argument("--truth-samples", type=int, default=256, help="of Mitsuba, a pixel")
    args = parser.parse_args(argv)
    say = lambda text: print(text, file=sys.stderr, flush=True)  # noqa: E731
    folder = args.data / "classic" / "spot"
    files = [
        folder / "spot.obj",
        folder / "spot_texture.png",
        *(args.data / "hdri" / f"{n}_512.hdr" for n in (CAPTURE, UNSEEN)),
    ]
    missing = [str(f) for f in files if not f.exists()]
    if missing:
        say(f"skipped: needs {', '.join(missing)}")
        return 0
    asset = load_object(folder)
    capture, unseen = (Environment(read_environment(f)).resized(64) for f in files[2:])
    judge, views = Mitsuba(asset), cameras(args.size, VIEWS)
    images = torch.stack([judge.image(v, capture, args.truth_samples) for v in views])
    say(f"{VIEWS} images of {args.size} x {args.size} rendered by Mitsuba")
    unknowns = fit(asset, views, images, args.steps, say)
    with torch.no_grad():
        return judge_results(args, asset, judge, images, unknowns, capture, unseen)


def judge_results(args, asset, judge, images, unknowns, capture, unseen) -> int:
    first = Unknowns(float(images[..., :3][images[..., 3] > 0.999].mean()) * 2.0)
    found = Asset(asset.mesh, unknowns.textures(), unknowns.environment())
    start = Asset(asset.mesh, first.textures(), first.environment())
    tests = cameras(args.size, 2 * VIEWS + 1)[3::8]  # four views beside those of the capture
    exposure = [
        float(0.8 / judge.image(tests[0], light, 64)[..., :3].flatten().quantile(0.97)) for light in (capture, unseen)
    ]
    layers = [[render(a, v, unseen, options=ShadeOptions((1, 0, 0))) for v in tests] for a in (asset, found, start)]
    mask = [x.alpha > 0 for x in layers[0]]
    joined = lambda k, name: torch.cat([getattr(x, name)[m] for x, m in zip(layers[k], mask)])  # noqa: E731
    scale = scale_to(joined(1, "base_color"), joined(0, "base_color"))
    balanced = linear_to_srgb((srgb_to_linear(found.textures.base_color) * scale).clamp(0, 1))
    found = replace(found, textures=replace(found.textures, base_color=balanced))
    scores = {}
    for name, subject in (("true maps", asset), ("recovered", found), ("before", start)):
        values = []
        for v in tests:
            want = judge.image(v, unseen, args.truth_samples)
            got = render(subject, v, unseen, options=MANY, supersampling=3)
            values.append(
                psnr(shown(got.radiance, exposure[1]), shown(want[..., :3], exposure[1]), want[..., 3] > 0.999)
            )
        scores[name] = sum(values) / len(values)
    want, got = (linear_to_srgb(v.clamp(0, 1)) for v in (joined(0, "base_color"), joined(1, "base_color") * scale))
    text = ", ".join(f"{name} {value:.2f} dB" for name, value in scores.items())
    print(f"relighting PSNR under {UNSEEN}, unseen, {len(tests)} new views, inside the outline: {text}")
    text = ", ".join(f"{s:.3f}" for s in scale.tolist())
    print(
        f"base colour PSNR {-10.0 * math.log10(float((got - want).square().mean())):.2f} dB "
        f"after one factor a channel ({text})"
    )
    for name in ("roughness", "metallic"):
        off = (joined(1, name) - joined(0, name)).abs()
        before = (joined(2, name) - joined(0, name)).abs()
        print(f"{name}: mean absolute error {float(off.mean()):.3f}, before {float(before.mean()):.3f}")
    lights = [light.resized(16).radiance.reshape(-1, 3) for light in (capture, found.environment)]
    lights[1] = lights[1] / scale  # the other half of what only the product of the two fixes
    logs = torch.stack([light.clamp(min=1e-3).log().flatten() for light in lights])
    print(f"light, 16 x 32: correlation of log radiance {float(torch.corrcoef(logs)[0, 1]):.3f}")
    args.output.mkdir(parents=True, exist_ok=True)
    tile, rows = 144, []
    view = cameras(tile, VIEWS)[5]
    for subject, own in (
        (start, start.environment),
        (found, Environment(found.environment.radiance / scale)),
        (asset, capture),
    ):
        rows.append(row_of_picture(subject, view, unseen, own, exposure, tile))
    write_picture(args.output / "recovered.png", rows, tile)
    print(args.output / "recovered.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
