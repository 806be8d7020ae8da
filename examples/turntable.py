"""Rotates an object in front of the camera, then rotates studio lighting around it.

usage: python examples/turntable.py OUTPUT_FOLDER [--glb FILE] [--frames 12] [--size 256]

Without ``--glb``, the object is reconstructed from the bundled photographs.  Writes the frames ``turn_00.png``, ... and
``light_00.png``, ..., and the animation ``turntable.webp``.
"""

import argparse
import math
from pathlib import Path

import torch
from PIL import Image

import reli3d
from reli3d.render.image import joined_scene

parser = argparse.ArgumentParser()
parser.add_argument("output", type=Path)
parser.add_argument("--glb", type=Path)
parser.add_argument("--frames", type=int, default=12)
parser.add_argument("--size", type=int, default=256, help="pixels per side of a frame")
args = parser.parse_args()
args.output.mkdir(parents=True, exist_ok=True)

if args.glb:
    parts = reli3d.read_glb(args.glb)
else:
    photographs = Path(reli3d.__file__).parent / "assets" / "example"
    options = reli3d.ReconstructOptions(texture_size=512)
    parts = [reli3d.reconstruct(reli3d.load_views(photographs), options=options)]

studio = torch.full((32, 64, 3), 0.2)
studio[6:12, 8:20] = 6.0  # a large lamp at one side
studio[8:10, 44:48] = torch.tensor([4.0, 8.0, 16.0])  # a small blue one at the other
studio = reli3d.Environment(studio)
own = next((part.environment for part in parts if part.environment is not None), studio)

vertices = torch.cat([part.mesh.vertices for part in parts])
center, reach = (vertices.amax(0) + vertices.amin(0)) / 2, (vertices.amax(0) - vertices.amin(0)).norm() / 2
scene, frames = joined_scene(parts), []
for name in ("turn", "light"):
    for i in range(args.frames):
        angle = math.tau * i / args.frames
        turn = angle if name == "turn" else 0.0
        eye = center + 3 * reach * torch.tensor([math.sin(turn), 0.35, math.cos(turn)])
        camera = reli3d.Camera.from_fov(reli3d.look_at(eye, center), 0.75, args.size, args.size)
        light = own if name == "turn" else studio.rotated(angle)
        path = args.output / f"{name}_{i:02d}.png"
        options = reli3d.ShadeOptions(samples=reli3d.Samples(light=8, bsdf=12, cosine=2))  # for each of four subpixels
        image = reli3d.render_asset(parts, camera, light, scene=scene, supersampling=2, options=options)
        reli3d.write_image(path, image.rgba)
        frames.append(Image.open(path).convert("RGBA"))
frames[0].save(args.output / "turntable.webp", save_all=True, append_images=frames[1:], duration=80, loop=0)
