"""Make the object folder that the package brings: a procedural kettle in a procedural room, seen by twelve cameras
from all sides; the first four see it from four sides.

usage: python tools/bundled_example.py reli3d/assets/example
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import torch

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.io.images import write_png
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.latlong import lat_long_directions
from reli3d.render.shading import ShadeOptions, shade
from reli3d.synthetic.procedural import FRAME_RADIUS, example_object
from reli3d.synthetic.samples import DIFFUSE_MODEL, EXPOSED, ObjectSurface

SIZE, SUBPIXELS = 512, 2
FOV = math.radians(30.0)
DISTANCE = 0.9 * FRAME_RADIUS / math.sin(FOV / 2)  # the object fills the frame
RIG = (  # azimuth from +Z to +X and elevation, degrees
    *((30.0, 20.0), (120.0, 35.0), (210.0, 12.0), (300.0, 45.0)),
    *((75.0, 12.0), (165.0, 45.0), (255.0, 20.0), (345.0, 35.0)),
    *((7.5, 5.0), (52.5, 50.0), (97.5, 5.0), (142.5, 20.0)),
)
SAMPLES = (24, 24, 4)


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
    surface, light = ObjectSurface(example_object()), room()
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
            exposure = EXPOSED / float(image[seen].mean(-1).quantile(0.9))
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
