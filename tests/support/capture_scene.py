"""A synthetic capture: a textured object on a textured table, photographed along a free path, with ground truth."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.io.images import with_exposure
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.shading import Samples, ShadeOptions, shade
from reli3d.synthetic.materials import Coat, Material
from reli3d.synthetic.patterns import mosaic as spots
from reli3d.synthetic.procedural import ProceduralObject, make_object, yaw_matrix
from reli3d.synthetic.samples import ObjectSurface

EXPOSURE = 1 / 60, 2.8, 100.0  # time [s], f-number, ISO
TABLE = 1.6  # half side, object's longest side 1


@dataclass(frozen=True)
class TrueCapture:
    """Images ``(V, H, W, 3)`` uint8, masks ``(V, H, W)`` bool, cameras in OpenGL axes and focal length in pixels."""

    images: np.ndarray
    masks: np.ndarray
    c2w: np.ndarray
    focal: float

    def write(self, folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        for k, image in enumerate(self.images):
            Image.fromarray(image).save(folder / f"{k:03d}.png", exif=with_exposure(EXPOSURE))
        return folder


@cache
def scene_surface(table_yaw: float, table: float) -> tuple[ObjectSurface, int]:
    """Object and table, and the number of the object's faces.

    table_yaw: radians by which the table's pattern is turned about the vertical axis, as if the object had been moved
    on it.  table: its half side.
    """
    shape = make_object(3)
    turn = yaw_matrix(table_yaw)
    mosaic = [spots(turn * f, 7 + k, fraction=0.5) for k, f in enumerate((9.0, 23.0, 51.0))]
    dark, light, warm = Coat((0.05, 0.06, 0.08), 0.9), Coat((0.7, 0.68, 0.6), 0.9), Coat((0.5, 0.2, 0.1), 0.9)
    stone = Material(Coat((0.3, 0.3, 0.32), 0.9), ((dark, mosaic[0]), (light, mosaic[1]), (warm, mosaic[2])))
    red, yellow, blue = (Coat(c, 0.7) for c in ((0.6, 0.1, 0.1), (0.8, 0.7, 0.2), (0.1, 0.1, 0.3)))
    skin = []
    for k in range(len(shape.materials)):
        coarse, fine = spots(np.eye(3) * 14.0, 31 + k, fraction=0.5), spots(np.eye(3) * 37.0, 61 + k, fraction=0.4)
        skin.append(Material(red, ((yellow, coarse), (blue, fine))))
    low = float(shape.vertices[:, 1].min())
    corners = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], np.float32) * table + (0, low, 0)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32) + len(shape.vertices)
    normals = np.zeros((2, 3, 3), np.float32)
    normals[..., 1] = 1.0
    whole = ProceduralObject(
        np.concatenate([shape.vertices, corners]).astype(np.float32),
        np.concatenate([shape.faces, faces]),
        np.concatenate([shape.normals, normals]),
        np.concatenate([shape.part, np.full(2, len(shape.materials), np.int32)]),
        (*skin, stone),
        "scene",
    )
    return ObjectSurface(whole), len(shape.faces)


def board(azimuth: float, origins, directions, depth) -> tuple[torch.Tensor, torch.Tensor]:
    """Which rays ``(N, 3)`` hit an upright board nearer than ``depth (N,)``, and the colors of its pattern there."""
    outward = torch.tensor([np.sin(azimuth), 0.0, np.cos(azimuth)], dtype=torch.float32)
    along = (1.1 - origins @ outward) / (directions @ outward)
    at = origins + along[:, None] * directions
    across = at @ torch.stack([outward[2], outward[1], -outward[0]])
    place = torch.stack([across / 0.5, at[:, 1] / 1.3], -1)
    front = (along > 0) & (along < depth) & (place.abs() < 1).all(-1)
    pattern = torch.rand(1, 3, 60, 24, generator=torch.Generator().manual_seed(8))
    shown = torch.nn.functional.grid_sample(pattern, place[front][None, None], align_corners=False)
    return front, shown[0, :, 0].T


def render_capture(
    views: int, *, heights=(24, 46), moved_after=None, turntable=(), passerby=False, plain=False
) -> TrueCapture:
    """A ring of hand-held views at two heights [degrees] under a sky; cameras are relative to the object.

    moved_after: from this view on the object is elsewhere on the table.  turntable: elevations [degrees] of a fixed
    camera, one after the other; the object turns with a small table in front of a textured background.  passerby:
    something upright moves behind the table.
    plain: a gray background without texture or shadow.
    """
    rng = np.random.default_rng(0)
    width, height = 400, 300
    focal = 1.4 * width
    steps = np.arange(views)
    azimuth = 2 * np.pi * (steps + (0 if turntable else 1) * rng.uniform(-0.2, 0.2, views)) / views
    elevation = np.radians(np.where(steps % 2 == 0, *heights) + rng.uniform(-3, 3, views))
    distance = 2.9 * rng.uniform(0.92, 1.08, views)
    target, roll = rng.normal(0, 0.03, (views, 3)), rng.normal(0, 0.04, (views, 3))
    if turntable:
        elevation = np.radians(np.repeat(turntable, views // len(turntable)))
        azimuth, distance[:], target[:], roll[:] = len(turntable) * azimuth, 2.9, 0.0, 0.0
    horizontal = np.cos(elevation) * distance
    eye = np.stack([horizontal * np.sin(azimuth), np.sin(elevation) * distance, horizontal * np.cos(azimuth)], -1)
    rows = torch.linspace(1.2, 0.5, 32)[:, None, None].expand(32, 64, 3)
    light = rows * torch.tensor(rng.uniform(0.5, 1.5, (32, 64, 1)), dtype=torch.float32) if turntable else rows.clone()
    light[4:8, 10:18] = 6.0
    sky = Environment(light.contiguous())
    samples = Samples(light=4, bsdf=2, cosine=2)
    images, masks, poses = [], [], []
    pooled = torch.nn.functional.avg_pool2d
    for k in range(views):
        yaw = 0.6 if moved_after is not None and k >= moved_after else 0.0
        surface, faces = scene_surface(yaw, 0.7 if turntable else 1.0 if passerby else TABLE)
        environment = sky.rotated(float(azimuth[k])) if turntable else sky
        at = (torch.tensor(v, dtype=torch.float32) for v in (eye[k], target[k], roll[k] + (0, 1, 0)))
        pose = look_at(*at)
        camera = Camera(pose, torch.tensor([focal, focal, width / 2, height / 2]), width, height)
        origins, directions = (r.reshape(-1, 3) for r in camera_rays(camera.scaled(2)))
        hits = surface.scene.closest(origins, directions)
        seen = (hits.face >= 0).nonzero()[:, 0]
        points = surface.points_at(hits.face[seen].long(), hits.bary[seen])
        image = environment.lookup(directions) * 0.5
        options = ShadeOptions(samples=samples, seed=k)
        image[seen] = shade(points, -directions[seen], environment, scene=surface.scene, options=options)
        if passerby:
            front, color = board(float(azimuth[k] + np.pi + 0.4 * np.sin(1.9 * k)), origins, directions, hits.t)
            image[front] = color
        on_object = (hits.face >= 0) & (hits.face < faces)
        if plain:
            image[~on_object] = 0.4
        image = pooled(image.reshape(1, 2 * height, 2 * width, 3).permute(0, 3, 1, 2), 2)[0].permute(1, 2, 0)
        covered = pooled(on_object.float().reshape(1, 2 * height, 2 * width), 2)[0] > 0.5
        images.append((linear_to_srgb((0.6 * image).clamp(0, 1)) * 255 + 0.5).to(torch.uint8).numpy())
        masks.append(covered.numpy())
        poses.append(pose.numpy())
    return TrueCapture(np.stack(images), np.stack(masks), np.stack(poses), focal)
