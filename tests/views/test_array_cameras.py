"""LLFF's poses_bounds.npy and NeuS's cameras_sphere.npz, written in closed form by the conventions of these formats."""

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.errors import InputError
from reli3d.views.check import verdict
from reli3d.views.folder import load_views
from tests.support.rigs import sphere_views

COUNT, WIDTH, HEIGHT = 5, 120, 96


@pytest.fixture
def rig():
    return sphere_views(count=COUNT, size=(WIDTH, HEIGHT))


def images(folder, rig, names, scale=1, mode="RGBA"):
    folder.mkdir(parents=True)
    for name, mask in zip(names, rig.masks):
        pixels = np.repeat((mask.numpy() * 255).astype(np.uint8)[..., None], 4, -1)
        image = Image.fromarray(pixels).resize((WIDTH // scale, HEIGHT // scale), Image.Resampling.BOX)
        image.convert(mode).save(folder / name)


def llff(folder, rig, place="images", scale=1):
    """poses_bounds.npy with the columns [down, right, back], position, and height, width, focal."""
    c2w, k = rig.c2w.double().numpy(), rig.intrinsics.double().numpy()
    right, up, back, eye = (c2w[:, :3, j] for j in range(4))
    size = np.repeat([[HEIGHT, WIDTH]], COUNT, 0)
    table = np.stack([-up, right, back, eye, np.concatenate([size, k[:, :1]], 1)], -1).reshape(COUNT, 15)
    images(folder / place, rig, [f"IMG_{j}.png" for j in range(COUNT)], scale)
    np.save(folder / "poses_bounds.npy", np.concatenate([table, np.ones((COUNT, 2))], 1))


@pytest.mark.parametrize("place, scale", [("images", 1), ("images_4", 4)])
def test_llff(tmp_path, rig, place, scale):
    llff(tmp_path, rig, place, scale)
    views = load_views(tmp_path)
    assert views.names == tuple(f"{place}/IMG_{j}.png" for j in range(COUNT))
    np.testing.assert_allclose(views.c2w, rig.c2w, atol=1e-6)  # float32
    focal = rig.intrinsics[0, 0] / scale
    expected = [focal, focal, WIDTH / scale / 2, HEIGHT / scale / 2]  # the format has no principal point
    np.testing.assert_allclose(views.intrinsics, [expected] * COUNT, rtol=1e-6)
    assert any("poses_bounds.npy" in note for note in views.notes)


def projections(rig, moved, size):
    """NeuS's matrices of the rig: x = K [R | t] X in OpenCV axes, with factors of any sign, and the unit sphere of an
    object at ``moved`` with the radius ``size``."""
    arrays = {}
    scale = np.diag([size, size, size, 1.0])
    scale[:3, 3] = moved
    for j, (pose, (fx, fy, cx, cy)) in enumerate(zip(rig.c2w.double().numpy(), rig.intrinsics.double().numpy())):
        rotation, eye = pose[:3, :3] * (1, -1, -1), size * pose[:3, 3] + moved
        k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        world = np.eye(4)
        world[:3] = (-1.0) ** j * (0.3 + j) * k @ np.concatenate([rotation.T, -rotation.T @ eye[:, None]], 1)
        arrays |= {f"world_mat_{j}": world, f"scale_mat_{j}": scale, f"world_mat_inv_{j}": np.linalg.inv(world)}
    return arrays


def neus(folder, rig, **changes):
    images(folder / "image", rig, [f"{j:06d}.png" for j in range(COUNT)], mode="RGB")
    images(folder / "mask", rig, [f"{j:03d}.png" for j in range(COUNT)], mode="RGB")
    whole = replace(rig, intrinsics=rig.intrinsics - torch.tensor([0.0, 0.0, 0.5, 0.5]))  # NeuS' pixel centers
    np.savez(folder / "cameras_sphere.npz", **{**projections(whole, np.array([3.0, -40.0, 700.0]), 25.0), **changes})


@pytest.mark.parametrize("name", ["cameras_sphere.npz", "cameras.npz"])  # NeuS's and IDR's
def test_neus(tmp_path, rig, name):
    neus(tmp_path, rig)
    (tmp_path / "cameras_sphere.npz").rename(tmp_path / name)
    views = load_views(tmp_path)
    assert views.names == tuple(f"image/{j:06d}.png" for j in range(COUNT))
    np.testing.assert_allclose(views.c2w, rig.c2w, atol=2e-6)  # float32
    np.testing.assert_allclose(views.intrinsics, rig.intrinsics, rtol=1e-6, atol=1e-4)  # float32 principal point
    for ours, true in zip(views.masks, rig.masks):
        np.testing.assert_array_equal(ours, true)
    assert any(name in note for note in views.notes)
    assert verdict(views).startswith("cameras agree")


def write(name, value, **options):
    return lambda folder, rig: (llff(folder, rig), np.save(folder / name, value, **options))


def claiming(folder, rig):
    """A header that claims 10^12 rows."""
    llff(folder, rig)
    data = io.BytesIO()
    np.lib.format.write_array_header_1_0(data, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 17)})
    (folder / "poses_bounds.npy").write_bytes(data.getvalue())


def shortened(folder, rig):
    llff(folder, rig)
    (folder / "poses_bounds.npy").write_bytes((folder / "poses_bounds.npy").read_bytes()[:99])


def bomb(folder, rig):
    neus(folder, rig)
    with zipfile.ZipFile(folder / "cameras_sphere.npz", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("world_mat_0.npy", bytes(1 << 27))


BROKEN = {
    "llff, pickle": write("poses_bounds.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True),
    "llff, shape": write("poses_bounds.npy", np.ones((COUNT, 15))),
    "llff, not finite": write("poses_bounds.npy", np.full((COUNT, 17), np.nan)),
    "llff, fewer than images": write("poses_bounds.npy", np.ones((COUNT - 1, 17))),
    "llff, zero": write("poses_bounds.npy", np.zeros((COUNT, 17))),
    "llff, no rotation": write("poses_bounds.npy", np.ones((COUNT, 17))),
    "llff, text": lambda folder, rig: (llff(folder, rig), (folder / "poses_bounds.npy").write_bytes(b"1 2 3")),
    "llff, cut off": shortened,
    "llff, claims more": claiming,
    "neus, singular": lambda folder, rig: neus(folder, rig, world_mat_2=np.zeros((4, 4))),
    "neus, shape": lambda folder, rig: neus(folder, rig, scale_mat_1=np.eye(3)),
    "neus, not finite": lambda folder, rig: neus(folder, rig, world_mat_1=np.full((4, 4), np.inf)),
    "neus, skew": lambda folder, rig: neus(folder, rig, world_mat_0=np.eye(4) + 0.2 * np.eye(4, k=1)),
    "neus, pickle": lambda folder, rig: neus(folder, rig, world_mat_0=np.array([{}], dtype=object)),
    "neus, no scale": lambda f, rig: (neus(f, rig), np.savez(f / "cameras_sphere.npz", world_mat_0=np.eye(4))),
    "neus, more images": lambda f, rig: (neus(f, rig), Image.new("RGB", (9, 9)).save(f / "image/9.png")),
    "neus, bomb": bomb,
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_refused(tmp_path, rig, name):
    BROKEN[name](tmp_path, rig)
    with pytest.raises(InputError, match=r"(poses_bounds.npy|cameras_sphere.npz): .*; "):
        load_views(tmp_path)


def test_another_number_of_masks_is_refused(tmp_path, rig):
    neus(tmp_path, rig)
    (tmp_path / "mask/001.png").unlink()
    with pytest.raises(InputError, match=f"mask: expected {COUNT} masks, one for each image, got {COUNT - 1}"):
        load_views(tmp_path)


def test_splits_of_nerf_synthetic(tmp_path, rig):
    """The training split, and a note of the others; another split where that is missing."""
    for split, numbers in (("train", [0, 1, 2]), ("test", [3]), ("val", [4])):
        images(tmp_path / split, rig.select(numbers), [f"r_{j}.png" for j in numbers])
        frames = [
            {"file_path": f"./{split}/r_{j}", "rotation": 0.0, "transform_matrix": rig.c2w[j].tolist()} for j in numbers
        ]
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    views = load_views(tmp_path)
    assert views.names == ("./train/r_0", "./train/r_1", "./train/r_2")
    np.testing.assert_allclose(views.intrinsics[:, 0], rig.intrinsics[0, 0], rtol=1e-6)
    used = "cameras of 3 images from transforms_train.json; not read: transforms_val.json, transforms_test.json"
    assert used in views.notes
    (tmp_path / "transforms_train.json").unlink()
    assert "cameras of 1 images from transforms_val.json; not read: transforms_test.json" in load_views(tmp_path).notes
