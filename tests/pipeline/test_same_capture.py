"""One capture in the forms of several programs."""

import json
import math
import shutil
import struct
from pathlib import Path

import torch
from scipy.spatial.transform import Rotation

import reli3d
from reli3d.views.folder import load_views

EXAMPLE = Path(reli3d.__file__).parent / "assets/example"
FORMS = ("release", "nerfstudio", "instant-ngp", "colmap_text", "colmap_binary")


def write_form(folder: Path, form: str) -> Path:
    """The bundled example as ``form`` has it: images in ``images/``, one lens for all."""
    views = load_views(EXAMPLE)
    shutil.copytree(EXAMPLE / "rgba", folder / "images")
    height, width = views.masks[0].shape
    fx, fy, cx, cy = views.intrinsics[0].double().tolist()
    poses = views.c2w.double().numpy()
    names = [Path(name).name for name in views.names]
    frames = [{"file_path": f"images/{n}", "transform_matrix": p.tolist()} for n, p in zip(names, poses)]
    if form == "release":
        fov = [2 * math.atan(0.5 * width / fx), 2 * math.atan(0.5 * height / fy)]
        data = {"frames": [f | {"camera_fov": fov, "camera_principal_point": [cx, cy]} for f in frames]}
    elif form == "nerfstudio":
        data = {
            "camera_model": "OPENCV",
            "fl_x": fx,
            "fl_y": fy,
            "cx": cx,
            "cy": cy,
            "w": width,
            "h": height,
            "k1": 0.0,
            "k2": 0.0,
            "p1": 0.0,
            "p2": 0.0,
            "frames": frames,
        }
    elif form == "instant-ngp":
        data = {
            "camera_angle_x": 2 * math.atan(0.5 * width / fx),
            "camera_angle_y": 2 * math.atan(0.5 * height / fy),
            "fl_x": fx,
            "fl_y": fy,
            "cx": cx,
            "cy": cy,
            "w": float(width),
            "h": float(height),
            "aabb_scale": 4,
            "frames": [f | {"sharpness": 30.0} for f in frames],
        }
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
