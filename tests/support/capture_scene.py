"""A synthetic capture: a textured object on a textured table, photographed along a hand-held path, with its truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from reli3d.geometry.camera import Camera, camera_rays, look_at
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.shading import Samples, ShadeOptions, shade
from reli3d.synthetic.materials import Coat, Material
from reli3d.synthetic.patterns import Mosaic
from reli3d.synthetic.procedural import ProceduralObject, make_object
from reli3d.synthetic.samples import ObjectSurface

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
            Image.fromarray(image).save(folder / f"{k:03d}.png")
        return folder


def scene_surface(seed: int, moved: float = 0.0) -> tuple[ObjectSurface, int]:
    """Object and table, and the number of the object's faces.  moved: shift of the object on the table."""
    shape = make_object(seed)
    mosaic = [Mosaic(np.eye(3) * f, 7 + k, share=0.5) for k, f in enumerate((9.0, 23.0, 51.0))]
    dark, light, warm = Coat((0.05, 0.06, 0.08), 0.9), Coat((0.7, 0.68, 0.6), 0.9), Coat((0.5, 0.2, 0.1), 0.9)
    table = Material(Coat((0.3, 0.3, 0.32), 0.9), ((dark, mosaic[0]), (light, mosaic[1]), (warm, mosaic[2])))
    skin = [
        Material(
            Coat(c, 0.7),
            (
                (Coat(d, 0.7), Mosaic(np.eye(3) * 14.0, 31 + k, share=0.5)),
                (Coat(e, 0.7), Mosaic(np.eye(3) * 37.0, 61 + k, share=0.4)),
            ),
        )
        for k, (c, d, e) in enumerate((((0.6, 0.1, 0.1), (0.8, 0.7, 0.2), (0.1, 0.1, 0.3)),) * len(shape.materials))
    ]
    vertices = shape.vertices + np.array([moved, 0, 0], np.float32)
    low = float(vertices[:, 1].min())
    corners = np.array(
        [[-TABLE, low, -TABLE], [-TABLE, low, TABLE], [TABLE, low, TABLE], [TABLE, low, -TABLE]], np.float32
    )
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32) + len(vertices)
    normals = np.zeros((2, 3, 3), np.float32)
    normals[..., 1] = 1.0
    whole = ProceduralObject(
        np.concatenate([vertices, corners]),
        np.concatenate([shape.faces, faces]),
        np.concatenate([shape.normals, normals]),
        np.concatenate([shape.part, np.full(2, len(shape.materials), np.int32)]),
        (*skin, table),
        "scene",
    )
    return ObjectSurface(whole), len(shape.faces)


def render_capture(
    seed: int = 3,
    views: int = 20,
    size: tuple[int, int] = (400, 300),
    *,
    moved_after: int | None = None,
    rng_seed: int = 0,
) -> TrueCapture:
    """A ring of hand-held views at two heights under a sky.  moved_after: from this view on the object stands elsewhere
    (cameras are then relative to the object).
    """
    rng = np.random.default_rng(rng_seed)
    width, height = size
    focal = 1.4 * width
    azimuth = 2 * np.pi * (np.arange(views) + rng.uniform(-0.2, 0.2, views)) / views
    elevation = np.radians(np.where(np.arange(views) % 2 == 0, 24, 46) + rng.uniform(-3, 3, views))
    distance = 2.9 * rng.uniform(0.92, 1.08, views)
    level = np.cos(elevation) * distance
    eye = np.stack([level * np.sin(azimuth), np.sin(elevation) * distance, level * np.cos(azimuth)], -1)
    target = rng.normal(0, 0.03, (views, 3))
    up = np.array([0.0, 1.0, 0.0]) + rng.normal(0, 0.04, (views, 3))
    c2w = torch.stack(
        [look_at(*(torch.tensor(v, dtype=torch.float32) for v in (eye[k], target[k], up[k]))) for k in range(views)]
    )
    rows = torch.linspace(1.2, 0.5, 32)[:, None, None].expand(32, 64, 3)
    light = rows.clone()
    light[4:8, 10:18] = 6.0
    environment = Environment(light.contiguous())
    samples = Samples(light=4, bsdf=2, cosine=2)
    images, masks, poses = [], [], []
    for k in range(views):
        shift = 0.35 if moved_after is not None and k >= moved_after else 0.0
        surface, faces = scene_surface(seed, shift)
        pose = c2w[k].clone()
        pose[0, 3] += shift  # the photographer follows the object
        camera = Camera(pose, torch.tensor([focal, focal, width / 2, height / 2]), width, height)
        origins, directions = (r.reshape(-1, 3) for r in camera_rays(camera.scaled(2)))
        hits = surface.scene.closest(origins, directions)
        seen = (hits.face >= 0).nonzero()[:, 0]
        points = surface.points_at(hits.face[seen].long(), hits.bary[seen])
        image = environment.lookup(directions) * 0.5
        image[seen] = shade(
            points, -directions[seen], environment, scene=surface.scene, options=ShadeOptions(samples=samples, seed=k)
        )
        on_object = (hits.face >= 0) & (hits.face < faces)
        pooled = torch.nn.functional.avg_pool2d
        image = pooled(image.reshape(1, 2 * height, 2 * width, 3).permute(0, 3, 1, 2), 2)[0].permute(1, 2, 0)
        covered = pooled(on_object.float().reshape(1, 2 * height, 2 * width), 2)[0] > 0.5
        images.append((linear_to_srgb((0.6 * image).clamp(0, 1)) * 255 + 0.5).to(torch.uint8).numpy())
        masks.append(covered.numpy())
        relative = pose.clone()
        relative[0, 3] -= shift
        poses.append(relative.numpy())
    return TrueCapture(np.stack(images), np.stack(masks), np.stack(poses), focal)
