"""Make the object folder of the package: an enameled kettle with a wooden grip and brass fittings on a wooden board, in
a procedural room, seen by twelve cameras from all sides; the first four see it from four sides.

No family of ``reli3d.synthetic.procedural`` generates the kettle, so it is not in the training set.

usage: python tools/bundled_example.py reli3d/assets/example
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.io.images import write_png
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions
from reli3d.render.shading import ShadeOptions, shade
from reli3d.synthetic import patterns as pt
from reli3d.synthetic import primitives as p
from reli3d.synthetic.assembly import Assembly
from reli3d.synthetic.materials import Coat, Material
from reli3d.synthetic.procedural import FRAME_RADIUS, assemble
from reli3d.synthetic.samples import DIFFUSE_MODEL, EXPOSURE_TARGET, ObjectSurface

SIZE, SUBPIXELS = 512, 2
FOV = math.radians(30.0)
DISTANCE = 0.9 * FRAME_RADIUS / math.sin(FOV / 2)  # the object fills the frame
RIG = (  # azimuth from +Z to +X and elevation, degrees
    *((30.0, 20.0), (120.0, 35.0), (210.0, 12.0), (300.0, 45.0)),
    *((75.0, 12.0), (165.0, 45.0), (255.0, 20.0), (345.0, 35.0)),
    *((7.5, 5.0), (52.5, 50.0), (97.5, 5.0), (142.5, 20.0)),
)
SAMPLES = (24, 24, 4)
TEAL, CREAM, CHARCOAL = (0.02, 0.19, 0.22), (0.78, 0.7, 0.52), (0.03, 0.028, 0.026)
BRASS, STEEL = (0.86, 0.66, 0.3), (0.58, 0.58, 0.59)
OAK, DARK_OAK, WALNUT, DARK_WALNUT = (0.42, 0.26, 0.12), (0.22, 0.12, 0.05), (0.2, 0.085, 0.035), (0.08, 0.035, 0.018)


def kettle(a: Assembly) -> None:
    """Adds the solids; the parts are in the order of the materials of :func:`finish`."""
    body, lid, knob, arms, grip, spout, trim, board = (a.part("any") for _ in range(8))
    height = np.linspace(0, 0.62, 32)
    belly = p.curve([[0.44, 0], [0.5, 0.08], [0.47, 0.26], [0.37, 0.44], [0.27, 0.55], [0.235, 0.62]], 32)
    a.add(p.solid_of_profile(belly[:, 0], height, 72), body)
    line = p.curve([[0.38, 0.14, 0], [0.55, 0.22, 0], [0.66, 0.42, 0], [0.76, 0.54, 0]], 26)
    width = np.linspace(0.125, 0.052, 26)
    a.add(p.tube(line, width, segments=28), spout)
    a.add(p.tube(line[-4:], width[-4:] + 0.012, segments=28), trim)
    a.cut(p.tube(line[14:] + 0.02 * (line[-1] - line[-2]), width[14:] - 0.014, segments=24), spout)
    axis = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    a.cut(p.capsule(line[-1] - 0.05 * axis, line[-1] + 0.1 * axis, 0.036), spout)
    a.add(p.torus(0.245, 0.017, segments=72), trim, (0, 0.62, 0))
    a.add(p.torus(0.452, 0.014, segments=72), trim, (0, 0.02, 0))
    dome = np.linspace(0, np.pi / 2, 14)
    a.add(p.solid_of_profile(0.225 * np.cos(dome), 0.62 + 0.085 * np.sin(dome), 64), lid)
    neck = [0.035, 0.69], [0.022, 0.73], [0.03, 0.75], [0.058, 0.785], [0.056, 0.82], [0.03, 0.845], [0.004, 0.85]
    fine = p.curve(neck, 24)
    a.add(p.solid_of_profile(fine[:, 0].clip(0.003), fine[:, 1], 40), knob)
    rise = np.array([[0.3, 0.52, 0], [0.345, 0.72, 0], [0.2, 0.98, 0]])
    arch = p.curve([*rise * (-1, 1, 1), (0, 1.04, 0), *rise[::-1]], 60)
    a.add(p.tube(arch, 0.021, segments=16), arms)
    swell = 0.04 + 0.016 * np.sin(np.linspace(0, np.pi, 24))
    a.add(p.tube(arch[18:42], swell, segments=24), grip)
    for side in (-1, 1):
        a.add(p.ellipsoid((0.05, 0.06, 0.05), 32), arms, (side * 0.3, 0.53, 0))
        a.add(p.cylinder(0.022, 0.14, bevel=0.006, segments=24).rotate((90, 0, 0)), trim, (side * 0.3, 0.53, 0))
    a.add(p.box((1.2, 0.06, 1.0), 0.02), board, (0.06, -0.03, 0))
    for x in (-0.46, 0.58):
        a.add(p.box((0.09, 0.06, 0.86), 0.015), board, (x, -0.08, 0))


def finish() -> tuple[Material, ...]:
    """Materials of the parts: body, lid, knob, arms, grip, spout, trim, board."""
    horizontal = np.diag([1.0, 1.0, 1.0])[[1, 0, 2]]
    enamel, cream = Coat(TEAL, 0.2), Coat(CREAM, 0.24)
    chips = pt.blotches(5.0 * np.eye(3), 0.95, 0.04, octaves=5, gain=0.6, seed=11)
    body = Material(
        enamel,
        (
            (cream, pt.ramp((0.0, 1.0, 0.0), -0.012, -0.008, 0.0, 0)),
            (enamel, pt.bands(9.5 * horizontal, 0.16, 0.38, softness=0.02)),
            (Coat((0.55, 0.06, 0.03), 0.25), pt.dots(11.0 * np.eye(3), 0.22)),
            (enamel, pt.ramp((0.0, -1.0, 0.0), 0.03, 0.034, 0.0, 0)),
            (Coat(CHARCOAL, 0.75), chips),
        ),
        drift=0.03,
        drift_roughness=0.03,
        drift_scale=4.0,
        seed=5,
    )
    plain = Material(enamel, ((Coat(CHARCOAL, 0.75), chips),), drift=0.03, drift_roughness=0.03, seed=6)
    fiber = np.diag([0.8, 60.0, 60.0])
    steel = Material(
        Coat(STEEL, 0.32, 1.0),
        ((Coat((0.2, 0.08, 0.035), 0.9, 0.0), pt.blotches(9.0 * np.eye(3), 0.75, 0.15, octaves=5, gain=0.6, seed=3)),),
        (pt.emboss(fiber, 2, 0.0006, octaves=1),),
        drift_roughness=0.05,
        seed=7,
    )
    brass = Material(
        Coat(BRASS, 0.22, 1.0),
        ((Coat((0.3, 0.2, 0.09), 0.5, 1.0), pt.blotches(4.0 * np.eye(3), 0.1, 0.6, octaves=4, seed=9)),),
        drift_roughness=0.06,
        seed=8,
    )

    def wood(light, dark, rough: float, seed: int) -> Material:
        axes = np.eye(3)[[1, 2, 0]]  # the fibers run along x
        grain = pt.grain(2.6 * axes, seed, 5.0, (1.7, 0.9))
        bump = pt.emboss(np.diag([30.0, 30.0, 1.2]) @ axes, seed + 1, 0.003, octaves=1)
        return Material(
            Coat(light, rough), ((Coat(dark, min(rough + 0.1, 1.0)), grain),), (bump,), drift=0.1, seed=seed
        )

    return body, plain, brass, steel, wood(WALNUT, DARK_WALNUT, 0.38, 21), plain, brass, wood(OAK, DARK_OAK, 0.6, 31)


def room() -> Environment:
    """Warm walls, a dark floor, a bluish window on one side and two lamps in the ceiling."""
    d = lat_long_directions(128)
    x, y, z = d.unbind(-1)
    light = torch.lerp(torch.tensor([0.10, 0.08, 0.06]), torch.tensor([0.55, 0.50, 0.44]), (y[..., None] + 1) / 2)
    light = light * (1 + 0.3 * torch.sin(3 * torch.atan2(x, -z))[..., None])
    window = ((x > 0.55) & (y.abs() < 0.45) & (z.abs() < 0.5)).float()[..., None]
    bars = 1 - ((torch.remainder(z * 4, 1) < 0.12) | (torch.remainder(y * 4, 1) < 0.12)).float()[..., None]
    light = light + window * bars * torch.tensor([7.0, 8.0, 10.0])
    for at, size in (((-0.5, 0.8, -0.33), 0.975), ((-0.1, 0.75, 0.65), 0.985)):
        axis = torch.nn.functional.normalize(torch.tensor(at), dim=0)
        light = light + ((d @ axis) > size).float()[..., None] * torch.tensor([30.0, 24.0, 17.0])
    return Environment(light.contiguous())


def main(folder: Path) -> None:
    assembly = Assembly(np.random.default_rng(0))
    kettle(assembly)
    surface, light = ObjectSurface(replace(assemble(assembly, "kettle"), materials=finish())), room()
    (folder / "rgba").mkdir(parents=True, exist_ok=True)
    frames, exposure = [], None
    for i, (azimuth, elevation) in enumerate(RIG):
        a, lift = math.radians(azimuth), math.radians(elevation)
        away = torch.tensor([math.cos(lift) * math.sin(a), math.sin(lift), math.cos(lift) * math.cos(a)])
        c2w = look_at(DISTANCE * away, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
        camera = Camera.from_fov(c2w, FOV, SIZE, SIZE)
        origins, directions = (r.reshape(-1, 3) for r in camera_rays(camera.scaled(SUBPIXELS)))
        hits = surface.scene.closest(origins, directions)
        seen = (hits.face >= 0).nonzero()[:, 0]
        image = light.lookup(directions)
        points = surface.points_at(hits.face[seen].long(), hits.bary[seen])
        options = ShadeOptions(samples=SAMPLES, seed=i, diffuse_model=DIFFUSE_MODEL)
        image[seen] = shade(points, -directions[seen], light, scene=surface.scene, options=options)
        if exposure is None:
            exposure = EXPOSURE_TARGET / float(image[seen].mean(-1).quantile(0.9))
        planes = torch.cat([(image * exposure).clamp(0, 1), (hits.face >= 0).float()[:, None]], -1)
        planes = planes.reshape(SIZE, SUBPIXELS, SIZE, SUBPIXELS, 4).mean((1, 3))
        rgba = torch.cat([linear_to_srgb(planes[..., :3]), planes[..., 3:]], -1)
        write_png(folder / f"rgba/{i:04d}.png", rgba)
        frames.append(
            {
                "view_index": i,
                "file_path": f"rgba/{i:04d}.png",
                "width": SIZE,
                "height": SIZE,
                "transform_matrix": c2w.tolist(),
                "camera_fov": [FOV, FOV],
                "camera_principal_point": [SIZE / 2, SIZE / 2],
            }
        )
    record = {"object_uid": "kettle", "coordinate_system": "ogl", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
