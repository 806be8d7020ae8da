import json
import math
from pathlib import PurePath

import numpy as np
import pytest
import torch
from PIL import Image

from reli3d.errors import InputError
from reli3d.geometry.camera import project
from reli3d.views.file_names import FolderIndex, images_below, images_in
from reli3d.views.folder import MAX_VIEWS, load_views
from tests.support import hostile


def photo(path, width=40, height=30, alpha=True):
    """An image of this size with a rectangle as object."""
    pixels = np.zeros((height, width, 4), np.uint8)
    pixels[..., :3] = 90
    pixels[5:-5, 8:-8] = (200, 50, 20, 255)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels if alpha else pixels[..., :3].copy()).save(path)


def transforms(folder, frames, **top):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps({**top, "frames": frames}))


def test_object_folder_as_published(tmp_path):
    data = hostile.good(tmp_path)
    frames = data["frames"]
    frames[0].update(view_index=7, camera_fov=0.5)  # scalar: both sides
    frames[1].update(view_index=3, camera_fov=[0.6, 0.4], camera_principal_point=[10.0, 20.5])
    frames[1]["camera_transform"] = frames[1].pop("transform_matrix")
    del frames[2]["camera_fov"], frames[2]["camera_principal_point"], frames[2]["view_index"]  # index 0, default lens
    transforms(tmp_path, frames, coordinate_system="blender")
    views = load_views(tmp_path)
    assert views.names == ("rgba/2.png", "rgba/1.png", "rgba/0.png")
    s = hostile.SIDE / 2
    expected = [
        [s / math.tan(0.35), s / math.tan(0.35), s, s],
        [s / math.tan(0.3), s / math.tan(0.2), 10.0, 20.5],
        [s / math.tan(0.25), s / math.tan(0.25), s, s],
    ]
    torch.testing.assert_close(views.intrinsics, torch.tensor(expected), rtol=1e-6, atol=0)
    torch.testing.assert_close(views.c2w, torch.tensor([hostile.pose(2.1 * i) for i in (2, 1, 0)]), rtol=0, atol=1e-6)
    assert len(views.notes) == 1
    assert "0.7 radians" in views.notes[0]


@pytest.mark.parametrize(
    "lens, angle", [({"camera_angle_x": 0.69}, 0.69), ({"camera_fov": 0.6}, 0.6), ({"fov_rad": [0.6]}, 0.6), ({}, 0.7)]
)
def test_blender_folder_and_one_angle(tmp_path, lens, angle):
    photo(tmp_path / "train/r_0.png")
    frame = {"file_path": "./train/r_0", "rotation": 0.1, "transform_matrix": hostile.pose(0.3)}
    transforms(tmp_path, [frame], **lens)
    views = load_views(tmp_path)
    focal = 0.5 * 40 / math.tan(0.5 * angle)  # the focal length of x serves y: square pixels
    torch.testing.assert_close(views.intrinsics, torch.tensor([[focal, focal, 20.0, 15.0]]))
    assert views.images[0].shape == (30, 40, 3)
    assert float(views.images[0][0, 0, 0]) == pytest.approx(90 / 255)  # the color under alpha 0


def test_nerfstudio_folder(tmp_path):
    mask = np.zeros((30, 40), np.uint8)
    mask[4:20, 6:30] = 255
    (tmp_path / "masks").mkdir()
    for name in "ab":
        photo(tmp_path / f"images/{name}.jpg", alpha=False)
        Image.fromarray(mask).save(tmp_path / f"masks/{name}.png")
    own = {"fl_x": 70.0, "w": 40, "h": 30, "cx": 19.0, "cy": 14.0}
    frames = [
        {"file_path": "images/a.jpg", "mask_path": "masks/a.png", "transform_matrix": hostile.pose(0.0)},
        {"file_path": "images/b.jpg", "transform_matrix": hostile.pose(1.0), **own},
    ]
    top = dict(fl_x=120.0, fl_y=121.0, cx=41.0, cy=29.0, w=80, h=60, k1=1e-4, k2=0.0, p1=0, p2=0)
    applied = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
    transforms(tmp_path, frames, camera_model="OPENCV", **top, applied_transform=applied)
    views = load_views(tmp_path)
    # the first is calibrated at twice the size; the second has its own focal length, which serves both sides
    torch.testing.assert_close(views.intrinsics, torch.tensor([[60.0, 60.5, 20.5, 14.5], [70.0, 70.0, 19.0, 14.0]]))
    for text in ("scaled from 80 x 60 to 40 x 30", "applied_transform", "distortion"):
        assert text in " ".join(views.notes)
    assert [int(m.sum()) for m in views.masks] == [384, 384]


def test_colmap_folder_agrees_with_colmaps_own_projection(tmp_path):
    """x = K (R X + t) with the stored quaternion, in float64, against our camera-to-world and project()."""
    rng = np.random.default_rng(4)
    photo(tmp_path / "images/sub dir/ü 1.png")
    photo(tmp_path / "images/a.png")
    quaternions = rng.standard_normal((2, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    t = np.array([[0.1, -0.2, 3.0], [0.3, 0.1, 2.5]])
    (tmp_path / "sparse/0").mkdir(parents=True)
    cameras = "# c\n3 PINHOLE 40 30 55.5 56.5 21.0 13.0\n9 SIMPLE_PINHOLE 40 30 44 20 15\n"
    (tmp_path / "sparse/0/cameras.txt").write_text(cameras)
    lines = [
        f"{i} {' '.join(map(repr, map(float, q)))} {' '.join(map(repr, map(float, p)))} {c} {n}\n"
        for i, q, p, c, n in zip((5, 2), quaternions, t, (3, 9), ("sub dir/ü 1.png", "a.png"))
    ]
    (tmp_path / "sparse/0/images.txt").write_text(f"# i\n{lines[0]}1 2 -1 3 4 7\n{lines[1]}\n")  # no points: empty line
    views = load_views(tmp_path)
    assert views.names == ("a.png", "sub dir/ü 1.png")
    points = rng.uniform(-0.5, 0.5, (20, 3))
    for ours, i, k in ((0, 1, (44, 44, 20, 15)), (1, 0, (55.5, 56.5, 21.0, 13.0))):
        w, v = quaternions[i][0], quaternions[i][1:]
        turned = points + 2 * np.cross(v, np.cross(v, points) + w * points)  # q X q*
        camera = turned + t[i]
        expected = camera[:, :2] / camera[:, 2:] * k[:2] + k[2:]
        pixels, depth = project(torch.from_numpy(points).float(), views.c2w[ours], views.intrinsics[ours])
        np.testing.assert_allclose(pixels, expected, atol=2e-4)  # float32 poses, some 50 pixels from the center
        np.testing.assert_allclose(depth, camera[:, 2], rtol=1e-5)
    with pytest.raises(InputError, match="masks: expected a folder"):
        load_views(tmp_path, masks=tmp_path / "none")


def test_the_distortion_of_a_colmap_camera(tmp_path):
    hostile.colmap(tmp_path)
    (tmp_path / "sparse/0/cameras.txt").write_text("1 RADIAL 32 32 51.7 16 16 0.001 0\n")
    moved = 51.7 * 0.001 * (16 * 2**0.5 / 51.7) ** 3  # f k1 r^3 at the corner, at radius r over the focal length
    assert any(f"lens distortion of at most {moved:.2g} pixels ignored" in n for n in load_views(tmp_path).notes)


def test_which_mask_counts(tmp_path):
    """A masks argument, then mask_path, then alpha, then a masks folder."""
    photo(tmp_path / "a.png")
    for rows, name in ((10, "given"), (11, "named"), (12, "masks")):
        mask = np.zeros((30, 40), np.uint8)
        mask[:rows] = 255
        (tmp_path / name).mkdir()
        Image.fromarray(mask).save(tmp_path / name / "a.png")
    frame = {"file_path": "a.png", "transform_matrix": hostile.pose(0), "camera_fov": 0.6}

    def area(**options):
        return int(load_views(tmp_path, **options).masks[0].sum())

    transforms(tmp_path, [frame])
    assert area() == 20 * 24 and area(masks=tmp_path / "given") == 10 * 40  # alpha's, and the given
    transforms(tmp_path, [frame | {"mask_path": "named/a.png"}])
    assert area() == 11 * 40
    transforms(tmp_path, [frame])
    photo(tmp_path / "a.png", alpha=False)
    assert area() == 12 * 40
    (tmp_path / "masks/a.png").rename(tmp_path / "masks/a.png.png")  # as COLMAP names them
    assert area() == 12 * 40


def test_files_outside_are_refused(tmp_path):
    photo(tmp_path / "elsewhere/a.png")
    frame = {"file_path": "../elsewhere/a.png", "transform_matrix": hostile.pose(0), "camera_fov": 0.6}
    transforms(tmp_path / "object", [frame])
    with pytest.raises(InputError, match="leads out of it"):
        load_views(tmp_path / "object")
    transforms(tmp_path / "object", [frame | {"file_path": "../object/../object/b"}])  # inside again: accepted
    photo(tmp_path / "object/b.png")
    assert len(load_views(tmp_path / "object")) == 1


@pytest.mark.parametrize("name", ["rgba/0.png", "./rgba/0.png", "RGBA/0.PNG", "rgba/0"])
def test_an_image_with_two_poses_is_refused(tmp_path, name):
    data = hostile.good(tmp_path)
    data["frames"].append(data["frames"][0] | {"file_path": name, "view_index": 3})
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    assert len(load_views(tmp_path)) == 4  # the same pose again
    data["frames"][3]["transform_matrix"] = hostile.pose(1.0)
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"frames\[3\]: pose: expected one for each image, got another .*frames\[0\]"):
        load_views(tmp_path)


def test_number_of_views(tmp_path):
    frames = hostile.good(tmp_path)["frames"] * 7
    transforms(tmp_path, frames)
    assert len(load_views(tmp_path)) == 3  # an image listed seven times is used once
    assert len(load_views(tmp_path, views=MAX_VIEWS)) == MAX_VIEWS
    for wrong in (0, 17, -1, True, 2.0):
        with pytest.raises(InputError, match="^views: expected 1 to 16"):
            load_views(tmp_path, views=wrong)


def test_rounding_in_the_matrix_is_cleaned_up(tmp_path):
    data = hostile.good(tmp_path, views=1)
    matrix = [[round(v, 4) for v in row] for row in hostile.pose(0.7)]
    transforms(tmp_path, [data["frames"][0] | {"transform_matrix": matrix}])
    rotation = load_views(tmp_path).c2w[0, :3, :3].double()
    assert float((rotation.T @ rotation - torch.eye(3)).abs().max()) < 3e-7  # float32
    exact = torch.tensor(hostile.pose(0.7), dtype=torch.float64)[:3, :3]
    assert float((rotation - exact).abs().max()) < 1e-4  # four digits


def test_names_of_files(tmp_path):
    """Spaces and other letters, accents in either composition; resource files of macOS are no images."""
    folder = tmp_path / "mein Objekt ñ"
    photo(folder / "im ages/é 1.png")
    transforms(folder, [{"file_path": "im ages/é 1.png", "transform_matrix": hostile.pose(0), "camera_fov": 0.6}])
    assert load_views(str(folder)).names == ("im ages/é 1.png",)
    composed, decomposed = "St\u00fcck.png", "Stu\u0308ck.png"
    for name in (decomposed, "._a.png"):
        (tmp_path / name).write_bytes(b"")
    assert FolderIndex().find(tmp_path, PurePath(composed)) == tmp_path / decomposed
    assert images_in(tmp_path) == [tmp_path / decomposed] and tmp_path / "._a.png" not in images_below(tmp_path)


@pytest.mark.parametrize("name", ["Camera_01", "Lantern_01", "UCO3D_217-72983-41010", "UCO3D_639-13622-90739"])
def test_real_captures(shared_data, name):
    folder = shared_data / "captures" / name
    views = load_views(folder)
    stored = json.loads((folder / "transforms.json").read_text())["frames"]
    stored.sort(key=lambda f: f["view_index"])
    assert (len(views), views.notes) == (4, ())
    for i, frame in enumerate(stored):
        pixels = np.asarray(Image.open(folder / frame["file_path"]))
        assert torch.equal((views.images[i] * 255).round().byte(), torch.from_numpy(pixels[..., :3].copy()))
        assert torch.equal((views.masks[i] * 255).round().byte(), torch.from_numpy(pixels[..., 3].copy()))
        # float32 of the file against a rotation made exact: its own rounding
        np.testing.assert_allclose(views.c2w[i], frame["transform_matrix"], atol=1e-6)
        fx, fy = (288 / math.tan(0.5 * a) for a in frame["camera_fov"])
        np.testing.assert_allclose(views.intrinsics[i], [fx, fy, *frame["camera_principal_point"]], rtol=1e-6)


def test_premultiplied_alpha_is_noted(tmp_path):
    """A bright disk with a soft edge on black, its color multiplied by alpha or not."""
    y, x = np.mgrid[:64, :64] - 31.5
    alpha = np.clip((24 - np.hypot(x, y)) / 6, 0, 1)
    frame = {"file_path": "a.png", "transform_matrix": hostile.pose(0), "camera_fov": 0.6}
    transforms(tmp_path, [frame])
    flat = np.full_like(alpha, 0.8)
    for color_of, noted in ((np.where(alpha > 0, flat, 0.0), False), (flat * alpha, True), (flat, False)):
        pixels = np.stack([color_of, color_of * 0.7, color_of * 0.5, alpha], -1)
        Image.fromarray(np.rint(pixels * 255).astype(np.uint8)).save(tmp_path / "a.png")
        assert bool(load_views(tmp_path).notes) == noted


def test_the_lighting_of_a_capture_is_read(tmp_path):
    frames = hostile.good(tmp_path)["frames"]
    assert load_views(tmp_path).lighting == "object"
    transforms(tmp_path, frames, lighting="camera")
    assert load_views(tmp_path).lighting == "camera"
    transforms(tmp_path, frames, lighting="turntable")
    assert load_views(tmp_path).lighting == "turntable"
    transforms(tmp_path, frames, lighting="room")
    with pytest.raises(InputError, match="lighting: expected object, camera, turntable, got 'room'"):
        load_views(tmp_path)
