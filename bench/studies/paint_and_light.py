"""Mean paint of reconstructions beside the true one: meshes as they are and with their colours darkened to a third.

usage: python -m bench.studies.paint_and_light MESHES LIGHTS [--weights PATH]

Each GLB of MESHES is photographed by four cameras under an .hdr of LIGHTS.  Two ways of exposing: `scene`, the mean of
the light (the sun cut off) at 0.35, as a camera meters a room; `object`, the object's 90th percentile at 0.6.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch.nn.functional import interpolate

from reli3d.geometry.camera import Camera, look_at
from reli3d.geometry.rays import RayScene
from reli3d.io.glb import read_glb
from reli3d.io.hdr import read_environment
from reli3d.nn.weights import load_model
from reli3d.pipeline import ReconstructOptions, reconstruct
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb, srgb_to_linear
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import primary_hits, surface_points
from reli3d.render.render import render
from reli3d.render.shading import ShadeOptions
from reli3d.views.views import Views

SIZE, FOV = 192, 0.62
EYES = ((0.2, 0.5, 2.1), (2.0, 0.9, 0.3), (-0.3, 0.3, -2.2), (-2.0, 0.7, -0.2))
OPTIONS = ReconstructOptions(texture_size=256, normalization="none")
CASES = (("object", 1.0), ("scene", 1.0), ("scene", 1 / 3))  # exposure, factor of the paint


def centred(path: Path) -> list[Asset]:
    """The surfaces of a GLB about the origin, longest side 1."""
    parts = read_glb(path)
    points = torch.cat([p.mesh.vertices for p in parts])
    low, high = points.amin(0), points.amax(0)
    size, middle = float((high - low).max()), (low + high) / 2
    return [replace(p, mesh=replace(p.mesh, vertices=((p.mesh.vertices - middle) / size).contiguous())) for p in parts]


def darker(part: Asset, factor: float) -> Asset:
    paint = linear_to_srgb(srgb_to_linear(part.textures.base_color) * factor)
    return replace(part, textures=replace(part.textures, base_color=paint))


def photographed(parts: list[Asset], light: torch.Tensor, kind: str) -> tuple[Views, torch.Tensor]:
    """Views of the parts, and their true linear base colour ``(V, S, S, 3)``."""
    c2w = look_at(torch.tensor(EYES), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    camera = Camera.from_fov(c2w, FOV, SIZE, SIZE)
    lens = camera.intrinsics.expand(len(EYES), 4).contiguous()
    shots = [
        render(
            parts,
            Camera(pose, lens[0], SIZE, SIZE),
            Environment(light),
            supersampling=1,
            options=ShadeOptions((12, 12, 4), seed=k),
        )
        for k, pose in enumerate(c2w)
    ]
    radiance, alpha = (torch.stack([getattr(s, name) for s in shots]) for name in ("radiance", "alpha"))
    if kind == "scene":
        exposure = 0.35 / float(light.clamp(max=float(light.mean() * 20)).mean())
    else:
        exposure = 0.6 / float(radiance[0][alpha[0] > 0.9].mean(-1).quantile(0.9))
    images = linear_to_srgb((radiance / alpha[..., None].clamp(min=1e-3) * exposure).clamp(0, 1))
    names = tuple(f"{k}.png" for k in range(len(EYES)))
    return Views(tuple(images), tuple(alpha), c2w, lens, names), torch.stack([s.base_color for s in shots])


def compared(asset: Asset, views: Views, true: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Mean true and found paint ``(3,)`` on the pixels that show both, and the PSNR of the found one as it is, sRGB."""
    scene = RayScene(asset.mesh.vertices, asset.mesh.faces)
    hits, _, _ = primary_hits(scene, Camera(views.c2w, views.intrinsics, SIZE, SIZE))
    both = (hits.face >= 0) & (torch.stack(views.masks) > 0.9)
    found = surface_points(asset.mesh, asset.textures, hits.face[both], hits.bary[both]).base_color
    error = (linear_to_srgb(true[both]) - linear_to_srgb(found)).square().mean()
    return true[both].mean(0), found.mean(0), float(-10 * error.log10())


def main() -> None:
    p = argparse.ArgumentParser(prog="bench.studies.paint_and_light", description=__doc__)
    p.add_argument("meshes", type=Path)
    p.add_argument("lights", type=Path)
    p.add_argument("--weights", default="small")
    args = p.parse_args()
    model, lights = load_model(args.weights), sorted(args.lights.glob("*.hdr"))
    rows: dict[tuple[str, float], list] = {case: [] for case in CASES}
    for k, path in enumerate(sorted(args.meshes.glob("*.glb"))):
        light = read_environment(lights[7 * k % len(lights)]).permute(2, 0, 1)[None]
        light = interpolate(light, (64, 128), mode="area")[0].permute(1, 2, 0).contiguous()
        parts = centred(path)
        for kind, factor in CASES:
            views, true = photographed([darker(part, factor) for part in parts], light, kind)
            asset = reconstruct(views, weights=model, options=OPTIONS)
            rows[kind, factor].append(compared(asset, views, true))
            t, f, psnr = rows[kind, factor][-1]
            print(path.stem, kind, f"{factor:.2f}", *(f"{v:.3f}" for v in (*t, *f)), f"{psnr:.1f} dB", flush=True)
    for (kind, factor), found in rows.items():
        t, f = (torch.stack([row[k] for row in found]).clamp(min=1e-3) for k in (0, 1))
        off = (f.mean(-1) / t.mean(-1)).log()
        color = (f.log() - f.log().mean(-1, True)) - (t.log() - t.log().mean(-1, True))
        psnr = sum(row[2] for row in found) / len(found)
        rms, tint = (float(v.square().mean().sqrt()) for v in (off, color))
        print(
            f"{kind} {factor:.2f}: brightness off by {float(off.mean()):+.2f}, rms {rms:.2f}; colour rms {tint:.2f}; "
            f"{psnr:.1f} dB"
        )


if __name__ == "__main__":
    main()
