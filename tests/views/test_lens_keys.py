"""Keys of transforms.json that describe the lens: each spelling that is read, and the ones that are refused."""

import json
import math

import numpy as np
import pytest

from reli3d.errors import InputError
from reli3d.views.folder import load_views
from tests.support import hostile

S = hostile.SIDE
F, CX, CY = 51.7, 15.0, 17.5
FOV = 2 * math.atan(0.5 * S / F)
K = [[F, 0, CX], [0, F, CY], [0, 0, 1]]
MIDDLE = [F, F, S / 2, S / 2]


def load(folder, frame=None, **top):
    """Views of a folder whose lens is given by keys of the file, and of each frame."""
    data = hostile.good(folder, views=1)
    for entry in data["frames"]:
        entry.pop("camera_fov", None), entry.pop("camera_principal_point", None)
        entry.update(frame or {})
    (folder / "transforms.json").write_text(json.dumps({**data, **top}))
    return load_views(folder)


READ = {
    "fl_x": ({"fl_x": F}, MIDDLE),
    "fx, fy, cx, cy": ({"fx": F, "fy": 2 * F, "cx": CX, "cy": CY}, [F, 2 * F, CX, CY]),
    "cx alone": ({"fl_x": F, "cx": CX}, [F, F, CX, S / 2]),
    "x_fov, degrees": ({"x_fov": math.degrees(FOV)}, MIDDLE),
    "x_fov and y_fov": ({"x_fov": math.degrees(FOV), "y_fov": 90.0}, [F, S / 2, S / 2, S / 2]),
    "camera_angle_x": ({"camera_angle_x": FOV}, MIDDLE),
    "camera_fov": ({"camera_fov": [FOV, FOV]}, MIDDLE),
    "focal_length and sensor_width": ({"focal_length": 50.0, "sensor_width": 50.0 * S / F}, MIDDLE),
    "intrinsics": ({"intrinsics": K}, [F, F, CX, CY]),
    "K": ({"K": K}, [F, F, CX, CY]),
    "intrinsic_matrix of 9 numbers": ({"intrinsic_matrix": sum(K, [])}, [F, F, CX, CY]),
    "intrinsics 4x4": ({"intrinsics": [[*row, 0] for row in K] + [[0, 0, 0, 1]]}, [F, F, CX, CY]),
    "width and height": ({"fl_x": 2 * F, "cx": 2 * CX, "cy": 2 * CY, "width": 2 * S, "height": 2 * S}, [F, F, CX, CY]),
    "resolution": ({"fl_x": 2 * F, "resolution": [2 * S, 2 * S]}, MIDDLE),
    "img_wh": ({"fl_x": 2 * F, "img_wh": [2 * S, 2 * S]}, MIDDLE),
    "two that agree": ({"fl_x": F, "camera_angle_x": FOV, "w": float(S), "h": float(S)}, MIDDLE),
}


@pytest.mark.parametrize("per_frame", [False, True])
@pytest.mark.parametrize("name", READ)
def test_spellings_that_are_read(tmp_path, name, per_frame):
    keys, expected = READ[name]
    views = load(tmp_path, keys) if per_frame else load(tmp_path, **keys)
    np.testing.assert_allclose(views.intrinsics, [expected], rtol=1e-6)  # float32
    assert not any("assumed" in note for note in views.notes)


@pytest.mark.parametrize(
    "x, y, low", [("fl_x", "fl_y", F), ("x_fov", "y_fov", 60.0), ("camera_angle_x", "camera_angle_y", 0.9)]
)
def test_one_axis_in_the_frame_and_the_other_in_the_file(tmp_path, x, y, low):
    together = load(tmp_path / "a", **{x: low, y: 1.3 * low})
    separate = load(tmp_path / "b", {x: low}, **{y: 1.3 * low})
    assert together.intrinsics.tolist() == separate.intrinsics.tolist()
    assert together.intrinsics[0, 0] != together.intrinsics[0, 1]


HARMLESS = {
    **dict(is_fisheye=False, fisheye=0, ftheta_p0=0.0, lens_model="pinhole", camera_model="Simple-Pinhole"),
    **dict(camera_type="PERSPECTIVE", distortion_params=[0, 0.0], k5=0, skew=0.0, focal=None, lens="Canon EF 50mm"),
    **dict(sharpness=30.2, aabb_scale=16, camera_convention="opengl", scale=0.33, depth_file_path="none"),
    **dict(undistorted=True, camera=2, sensor_id=3, pose_type="c2w"),
}


def test_keys_that_change_nothing_are_not_in_the_way(tmp_path):
    np.testing.assert_allclose(load(tmp_path / "a", fl_x=F, **HARMLESS).intrinsics, [MIDDLE], rtol=1e-6)
    np.testing.assert_allclose(load(tmp_path / "b", {"fl_x": F, **HARMLESS}).intrinsics, [MIDDLE], rtol=1e-6)


def each(**keys) -> list[dict]:
    """A file for each of the values of each key."""
    return [
        {key: value} for key, values in keys.items() for value in (values if isinstance(values, tuple) else [values])
    ]


REFUSED = [
    *each(is_fisheye=(True, 1), fisheye="true", ftheta_p0=0.1, ftheta_cx=3.0, latlong=True, equirectangular=True),
    *each(camera_model=("OPENCV_FISHEYE", "fisheye", "FISHEYE624", "THIN_PRISM_FISHEYE", "EQUIRECTANGULAR")),
    *each(camera_type="Fisheye", lens_model="opencv-fisheye", lens_type="kannala_brandt", projection="equidistant"),
    *each(lens=("fisheye", 50.0), type="Kannala-Brandt", distortion_model="equidistant", orthographic=True),
    *each(distortion=[0.1, 0.0], dist_coeffs=[0.1], k5=0.1, p3=0.1, skew=2.0, rolling_shutter=[0, 0, 0.1, 0]),
    *each(focal=50.0, focal_length=50.0, focal_length_px=50.0, fov=40.0, FovX=0.6, hfov=40.0, field_of_view=40.0),
    *each(yfov=0.6, y_fov=40.0, fl_y=40.0, camera_angle_y=0.6, angle_x=0.6, cam_angle_x=0.6, camera={"fl_x": 50.0}),
    *each(intrinsics=({"fx": 50.0}, [F, F, CX, CY], [[-F, 0, CX], [0, F, CY], [0, 0, 1]])),
    *each(intrinsics=([[F, 0, 0], [0, F, 0], [CX, CY, 1]], [[F, 4.0, CX], [0, F, CY], [0, 0, 1]])),
    *each(K=([[1.6, 0, 0.5], [0, 1.6, 0.5], [0, 0, 1]], [[1.6, 0, 0], [0, 1.6, 0], [0, 0, 1]])),
    *each(camera_intrinsics_px=[F, F], P=[[F, 0, CX, 0], [0, F, CY, 0], [0, 0, 1, 0]]),
    *each(projection_matrix=[[1.2, 0, 0, 0], [0, 1.2, 0, 0], [0, 0, -1, -0.2], [0, 0, -1, 0]]),
    *each(cameras=({"0": {"fl_x": F}}, [{"model": "PINHOLE", "params": 4, "fx": F}])),
    *each(metadata={"camera_angle_x": 0.6}, perspective={"yfov": 0.6}, from_na=True, from_mitsuba=True),
    *each(coordinate_system=("opencv", "unity"), camera_convention=("COLMAP", "pytorch3d"), pose_type="w2c"),
    *[{**keys, "fl_x": F} for keys in each(cameras=[{"model": "OPENCV_FISHEYE"}], ortho=True, ortho_scale=2.5, xi=1.2)],
    *[{**keys, "fl_x": F} for keys in each(type=("ORTHO", "PANO"), model="double_sphere", w=S)],
    *[{**keys, "fl_x": F} for keys in each(D=[-0.3, 0.1, 0, 0, 0], dist=[-0.3, 0.1, 0, 0])],
    {"camera_model": "OPENCV_FISHEYE", "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0},
    {"k1": 3.0, "k2": -18.0},
    *({"w": w, "h": h, "fl_x": F} for w, h in ((0.5, 8), (8, 1e-300))),  # divisions by zero, as the next three
    *each(fov_rad=5e-324, camera_fov=[0.7, 5e-324], camera_angle_x=1e-320),
    {"fl_x": F, "cx": 0.5, "cy": 0.5},
    {"fl_x": F, "camera_angle_x": 1.2, "w": S, "h": S},
    {"K": K, "fl_x": 80.0, "w": S, "h": S},
    {"fl_x": F, "fl_y": F, "camera_angle_y": 1.2, "camera_angle_x": FOV, "w": S, "h": S},
]


@pytest.mark.parametrize("per_frame", [False, True])
@pytest.mark.parametrize("keys", REFUSED, ids=str)
def test_unknown_lens_keys_are_refused(tmp_path, keys, per_frame):
    """By a line that names a key, its value or that of another, and a fix; never a default."""
    with pytest.raises(InputError) as caught:
        load(tmp_path, keys) if per_frame else load(tmp_path, **keys)
    text = str(caught.value)
    names = [*keys, "focal length", "distortion", "w, h", "cx, cy", "fl_x", "x_fov", "camera_angle_x"]
    assert any(f": {name}: expected" in text for name in names) and "; " in text


CORNER2 = 2 * (0.5 * S / F) ** 2  # r^2 at the corner, over the focal length
WEAK = 0.5 * 1.5 * 0.5 / F / CORNER2**1.5  # k1 of 0.75 / 2 pixels at the corners of a centered lens


@pytest.mark.parametrize(
    "frame, keys, refused",
    [
        ({}, {"k1": 3.0, "k2": -3.0 / CORNER2}, True),  # 3 r^3 - 3 r^5 / r2 is 0 at the corner, and not before it
        ({"fl_x": 1e-100}, {"k1": 0.1, "k2": 0.1, "k3": 0.1}, True),  # infinite
        ({"k1": None}, {"k1": 0.5}, True),  # null in a frame leaves that of the file
        ({}, {"k1": WEAK}, False),
        ({}, {"k1": WEAK, "cx": 4.0, "cy": 4.0}, True),  # it counts from the principal point
    ],
)
def test_distortion_up_to_a_pixel_is_ignored(tmp_path, frame, keys, refused):
    if not refused:
        assert any("distortion" in note for note in load(tmp_path, frame, fl_x=F, **keys).notes)
        return
    with pytest.raises(InputError, match="distortion: expected an undistorted lens"):
        load(tmp_path, frame, fl_x=F, **keys)


FRAME_FIRST = [  # keys of a frame, keys of the file, pixels
    ({"K": K}, {"camera_angle_x": 1.2, "fl_x": 9.0}, [F, F, CX, CY]),
    ({"w": None, "h": None}, {"fl_x": 2 * F, "w": 2 * S, "h": 2 * S}, MIDDLE),
    ({"cx": None, "cy": None}, {"fl_x": F, "cx": CX, "cy": CY}, [F, F, CX, CY]),
    ({"width": S, "height": S}, {"fl_x": F, "w": 2 * S, "h": 2 * S}, MIDDLE),
    ({"fl_x": 2 * F}, {"intrinsics": K}, [2 * F, 2 * F, CX, CY]),
    ({"cx": 14.0, "cy": 13.0}, {"intrinsics": K}, [F, F, 14.0, 13.0]),
    ({"cx": 14.0}, {"intrinsics": K}, [F, F, 14.0, CY]),
]


@pytest.mark.parametrize("frame, file, expected", FRAME_FIRST)
def test_each_value_is_the_frames_and_null_is_none(tmp_path, frame, file, expected):
    np.testing.assert_allclose(load(tmp_path, frame, **file).intrinsics, [expected], rtol=1e-6)


def test_a_byte_order_mark_is_read_over(tmp_path):
    load(tmp_path, fl_x=F)
    data = (tmp_path / "transforms.json").read_bytes()
    (tmp_path / "transforms.json").write_bytes(b"\xef\xbb\xbf" + data)
    np.testing.assert_allclose(load_views(tmp_path).intrinsics, [MIDDLE], rtol=1e-6)
