"""One capture in the words of several programs, and a capture of many photographs from one place."""

import json
import math
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import reli3d
from reli3d.pipeline import ReconstructOptions, reconstruct
from reli3d.views.folder import load_views
from tests.support.rigs import sphere_views

EXAMPLE = Path(reli3d.__file__).parent / "assets/example"
FORMS = ("release", "nerfstudio", "instant-ngp", "colmap_text", "colmap_binary")


def lens(intrinsics: torch.Tensor, width: int, height: int) -> dict:
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    return dict(zip(keys, (*intrinsics.double().tolist(), width, height), strict=True))


def write_form(folder: Path, form: str) -> Path:
    """The bundled example as ``form`` has it: images in ``images/``, one lens for all."""
    views = load_views(EXAMPLE)
    shutil.copytree(EXAMPLE / "rgba", folder / "images")
    height, width = views.masks[0].shape
    fx, fy, cx, cy = views.intrinsics[0].double().tolist()
    poses = views.c2w.double().numpy()
    names = [Path(name).name for name in views.names]
    frames = [{"file_path": f"images/{n}", "transform_matrix": p.tolist()} for n, p in zip(names, poses)]
    fov = [2 * math.atan(0.5 * width / fx), 2 * math.atan(0.5 * height / fy)]
    pinhole = lens(views.intrinsics[0], width, height)
    if form == "release":
        data = {"frames": [f | {"camera_fov": fov, "camera_principal_point": [cx, cy]} for f in frames]}
    elif form == "nerfstudio":
        undistorted = dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
        data = {"camera_model": "OPENCV", **pinhole, **undistorted, "frames": frames}
    elif form == "instant-ngp":
        angles = dict(zip(("camera_angle_x", "camera_angle_y"), fov, strict=True))
        data = {**angles, **pinhole, "w": float(width), "h": float(height), "aabb_scale": 4}
        data["frames"] = [f | {"sharpness": 30.0} for f in frames]
    else:
        write_colmap(folder / "sparse/0", form, names, poses, (width, height), (fx, fy, cx, cy))
        return folder
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def write_colmap(model: Path, form: str, names, poses, size, camera) -> None:
    """World-to-camera quaternions (w first) and translations in OpenCV axes, by SciPy."""
    model.mkdir(parents=True)
    entries = []
    for pose in poses:
        turn = (pose[:3, :3] * (1, -1, -1)).T
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        entries.append([w, x, y, z, *(-turn @ pose[:3, 3])])
    if form == "colmap_text":
        (model / "cameras.txt").write_text(f"1 PINHOLE {size[0]} {size[1]} {' '.join(map(repr, camera))}\n")
        lines = [f"{k} {' '.join(repr(float(v)) for v in e)} 1 {n}\n\n" for k, (e, n) in enumerate(zip(entries, names))]
        (model / "images.txt").write_text("".join(lines))
        return
    (model / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, *size, *camera))
    data = struct.pack("<Q", len(names))
    for k, (entry, name) in enumerate(zip(entries, names)):
        data += struct.pack("<I7dI", k, *entry, 1) + name.encode() + b"\0" + struct.pack("<Q", 0)
    (model / "images.bin").write_bytes(data)


def test_every_form_gives_the_same_cameras_and_images(tmp_path):
    first, *others = (load_views(write_form(tmp_path / form, form)) for form in FORMS)
    for views in others:
        # the tangent of an angle and a quaternion in float64, then float32
        torch.testing.assert_close(views.c2w, first.c2w, rtol=0, atol=1e-6)
        torch.testing.assert_close(views.intrinsics, first.intrinsics, rtol=1e-6, atol=0)
        assert all(torch.equal(a, b) for a, b in zip(views.images, first.images))
        assert all(torch.equal(a, b) for a, b in zip(views.masks, first.masks))


def distance(a: torch.Tensor, b: torch.Tensor) -> float:
    """Mean distance of points to the nearest of the others, both ways."""
    ways = cKDTree(b.numpy()).query(a.numpy())[0].mean(), cKDTree(a.numpy()).query(b.numpy())[0].mean()
    return float(np.mean(ways))


def mean_base_color(asset) -> torch.Tensor:
    """Mean base color at the vertices."""
    at = (asset.mesh.uv * asset.textures.size).long().clamp(0, asset.textures.size - 1)
    return asset.textures.base_color[at[:, 1], at[:, 0]].mean()


@pytest.mark.slow
def test_every_form_gives_the_same_asset(tmp_path):
    options = ReconstructOptions(texture_size=256, resolution=40)
    first, *others = (reconstruct(load_views(write_form(tmp_path / form, form)), options=options) for form in FORMS)
    for asset in others:
        # cameras differ in the last bit of float32, which a network and a surface carry on
        assert distance(asset.mesh.vertices, first.mesh.vertices) < 1e-4
        # the mean over the vertices: where charts end, the next texel may be another
        assert float(mean_base_color(asset)) == pytest.approx(float(mean_base_color(first)), rel=1e-2)
        light = float(first.environment.radiance.mean())
        assert float(asset.environment.radiance.mean()) == pytest.approx(light, rel=1e-2)


@pytest.mark.slow
def test_many_photographs_from_one_place_do_not_hide_the_others(tmp_path):
    """60 views, 57 of them within 2 degrees, give the surface of the four that differ: mean distance below 0.01."""
    four = torch.tensor([[0.0, 0.6, 2.1], [2.1, 0.5, -0.3], [-0.4, 0.9, -2.0], [-2.0, 0.2, 0.6]], dtype=torch.float64)
    near = four[0] + 0.03 * torch.randn(56, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    meshes = {}
    for name, eyes in (("four", four), ("sixty", torch.cat([four[:1], near, four[1:]]))):
        views = sphere_views(eyes=eyes, size=(128, 128))
        (tmp_path / name).mkdir()
        frames = []
        for k, (image, mask) in enumerate(zip(views.images, views.masks)):
            pixels = torch.cat([image, mask[..., None]], -1).mul(255).round().byte().numpy()
            Image.fromarray(pixels).save(tmp_path / name / f"{k}.png")
            pose = {"file_path": f"{k}.png", "transform_matrix": views.c2w[k].double().tolist()}
            frames.append(pose | lens(views.intrinsics[k], 128, 128))
        (tmp_path / name / "transforms.json").write_text(json.dumps({"frames": frames}))
        loaded = load_views(tmp_path / name)
        assert len(loaded) <= 16 and loaded.in_folder == len(eyes)
        mesh = reconstruct(loaded, options=ReconstructOptions(texture_size=256, resolution=48)).mesh
        solid = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
        meshes[name] = torch.from_numpy(trimesh.sample.sample_surface(solid, 20000, seed=0)[0])
    assert distance(meshes["four"], meshes["sixty"]) < 0.01  # the sampling alone gives 0.004
