"""Keys of transforms.json that describe the lens: each spelling that is read, and the ones that are refused."""

import json
import math

import numpy as np
import pytest
from PIL import Image

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
    data = hostile.good(folder)
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
    "two that agree": ({"fl_x": F, "camera_angle_x": FOV, "w": S, "h": S}, MIDDLE),
}


@pytest.mark.parametrize("per_frame", [False, True])
@pytest.mark.parametrize("name", READ)
def test_spellings_that_are_read(tmp_path, name, per_frame):
    keys, expected = READ[name]
    views = load(tmp_path, keys) if per_frame else load(tmp_path, **keys)
    np.testing.assert_allclose(views.intrinsics, [expected] * 3, rtol=1e-6)  # float32
    assert not any("assumed" in note for note in views.notes)


def test_the_frame_goes_before_the_file(tmp_path):
    views = load(tmp_path, {"K": K}, camera_angle_x=1.2, fl_x=9.0)
    np.testing.assert_allclose(views.intrinsics, [[F, F, CX, CY]] * 3, rtol=1e-6)


@pytest.mark.parametrize(
    "x, y, low", [("fl_x", "fl_y", F), ("x_fov", "y_fov", 60.0), ("camera_angle_x", "camera_angle_y", 0.9)]
)
def test_one_axis_in_the_frame_and_the_other_in_the_file(tmp_path, x, y, low):
    together = load(tmp_path / "a", **{x: low, y: 1.3 * low})
    separate = load(tmp_path / "b", {x: low}, **{y: 1.3 * low})
    assert together.intrinsics.tolist() == separate.intrinsics.tolist()
    assert together.intrinsics[0, 0] != together.intrinsics[0, 1]


HARMLESS = {
    "is_fisheye": False,
    "fisheye": 0,
    "ftheta_p0": 0.0,
    "lens_model": "pinhole",
    "camera_model": "Simple-Pinhole",
    "camera_type": "PERSPECTIVE",
    "distortion_params": [0, 0.0],
    "k5": 0,
    "skew": 0.0,
    "focal": None,
    "lens": "Canon EF 50mm",
    "sharpness": 30.2,
    "aabb_scale": 16,
    "camera_convention": "opengl",
    "scale": 0.33,
    "depth_file_path": "none",
    "undistorted": True,
    "camera": 2,
    "sensor_id": 3,
    "pose_type": "c2w",
}


def test_keys_that_change_nothing_are_not_in_the_way(tmp_path):
    np.testing.assert_allclose(load(tmp_path / "a", fl_x=F, **HARMLESS).intrinsics, [MIDDLE] * 3, rtol=1e-6)
    np.testing.assert_allclose(load(tmp_path / "b", {"fl_x": F, **HARMLESS}).intrinsics, [MIDDLE] * 3, rtol=1e-6)


REFUSED = [
    {"is_fisheye": True},
    {"is_fisheye": 1},
    {"fisheye": "true"},
    {"camera_model": "OPENCV_FISHEYE"},
    {"camera_model": "OPENCV_FISHEYE", "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0},
    {"camera_model": "fisheye"},
    {"camera_model": "FISHEYE624"},
    {"camera_model": "THIN_PRISM_FISHEYE"},
    {"camera_model": "EQUIRECTANGULAR"},
    {"camera_type": "Fisheye"},
    {"lens_model": "opencv-fisheye"},
    {"lens_type": "kannala_brandt"},
    {"projection": "equidistant"},
    {"lens": "fisheye"},
    {"lens": 50.0},
    {"type": "Kannala-Brandt"},
    {"distortion_model": "equidistant"},
    {"ftheta_p0": 0.1},
    {"ftheta_cx": 3.0},
    {"latlong": True},
    {"equirectangular": True},
    {"orthographic": True},
    {"distortion": [0.1, 0.0]},
    {"dist_coeffs": [0.1]},
    {"k5": 0.1},
    {"k1": 3.0, "k2": -18.0},
    {"p3": 0.1},
    {"skew": 2.0},
    {"rolling_shutter": [0, 0, 0.1, 0]},
    {"focal": 50.0},
    {"focal_length": 50.0},
    {"focal_length_px": 50.0},
    {"fov": 40.0},
    {"FovX": 0.6},
    {"hfov": 40.0},
    {"field_of_view": 40.0},
    {"yfov": 0.6},
    {"y_fov": 40.0},
    {"fl_y": 40.0},
    {"camera_angle_y": 0.6},
    {"camera": {"fl_x": 50.0}},
    {"intrinsics": {"fx": 50.0}},
    {"intrinsics": [[-F, 0, CX], [0, F, CY], [0, 0, 1]]},
    {"intrinsics": [[F, 0, 0], [0, F, 0], [CX, CY, 1]]},
    {"intrinsics": [[F, 4.0, CX], [0, F, CY], [0, 0, 1]]},
    {"intrinsics": [F, F, CX, CY]},
    {"K": [[1.6, 0, 0.5], [0, 1.6, 0.5], [0, 0, 1]]},
    {"camera_intrinsics_px": [F, F]},
    {"fl_x": F, "cx": 0.5, "cy": 0.5},
    {"fl_x": F, "w": S},
    {"fl_x": F, "camera_angle_x": 1.2, "w": S, "h": S},
    {"K": K, "fl_x": 80.0, "w": S, "h": S},
    {"projection_matrix": [[1.2, 0, 0, 0], [0, 1.2, 0, 0], [0, 0, -1, -0.2], [0, 0, -1, 0]]},
    {"P": [[F, 0, CX, 0], [0, F, CY, 0], [0, 0, 1, 0]]},
    {"angle_x": 0.6},
    {"cam_angle_x": 0.6},
    {"cameras": {"0": {"fl_x": F}}},
    {"cameras": [{"model": "PINHOLE", "params": 4, "fx": F}]},
    {"metadata": {"camera_angle_x": 0.6}},
    {"perspective": {"yfov": 0.6}},
    {"cameras": [{"model": "OPENCV_FISHEYE"}], "fl_x": F},
    {"K": [[1.6, 0, 0], [0, 1.6, 0], [0, 0, 1]]},
    {"ortho": True, "fl_x": F},
    {"ortho_scale": 2.5, "fl_x": F},
    {"type": "ORTHO", "fl_x": F},
    {"type": "PANO", "fl_x": F},
    {"model": "double_sphere", "fl_x": F},
    {"xi": 1.2, "fl_x": F},
    {"D": [-0.3, 0.1, 0, 0, 0], "fl_x": F},
    {"dist": [-0.3, 0.1, 0, 0], "fl_x": F},
    {"coordinate_system": "opencv"},
    {"camera_convention": "COLMAP"},
    {"camera_convention": "pytorch3d"},
    {"coordinate_system": "unity"},
    {"pose_type": "w2c"},
    {"from_na": True},
    {"from_mitsuba": True},
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


def test_distortion_that_cancels_at_the_corner_is_refused(tmp_path):
    r2 = 2 * (0.5 * S / F) ** 2
    with pytest.raises(InputError, match="distortion: expected an undistorted lens"):
        load(tmp_path, fl_x=F, k1=3.0, k2=-3.0 / r2)  # 3 r^3 - 3 r^5 / r2 is 0 at the corner


FRAME_FIRST = [  # keys of a frame, keys of the file, pixels
    ({"w": None, "h": None}, {"fl_x": 2 * F, "w": 2 * S, "h": 2 * S}, MIDDLE),
    ({"cx": None, "cy": None}, {"fl_x": F, "cx": CX, "cy": CY}, [F, F, CX, CY]),
    ({"width": S, "height": S}, {"fl_x": F, "w": 2 * S, "h": 2 * S}, MIDDLE),
    ({"fl_x": 2 * F}, {"intrinsics": K}, [2 * F, 2 * F, CX, CY]),
    ({"cx": 14.0, "cy": 13.0}, {"intrinsics": K}, [F, F, 14.0, 13.0]),
    ({"cx": 14.0}, {"intrinsics": K}, [F, F, 14.0, CY]),
]


@pytest.mark.parametrize("frame, file, expected", FRAME_FIRST)
def test_each_value_is_the_frames_and_null_is_none(tmp_path, frame, file, expected):
    np.testing.assert_allclose(load(tmp_path, frame, **file).intrinsics, [expected] * 3, rtol=1e-6)


def test_null_in_a_frame_leaves_the_files_distortion(tmp_path):
    with pytest.raises(InputError, match="distortion: expected an undistorted lens"):
        load(tmp_path, {"k1": None}, fl_x=F, k1=0.5)


def test_distortion_counts_from_the_principal_point(tmp_path):
    k1 = 1.5 * 0.5 / F / (0.5 * 2**0.5 * S / F) ** 3  # of 0.75 pixels at the corners of a centered lens
    load(tmp_path / "a", fl_x=F, k1=0.5 * k1)
    with pytest.raises(InputError, match="distortion: expected an undistorted lens"):
        load(tmp_path / "b", fl_x=F, k1=0.5 * k1, cx=4.0, cy=4.0)


def test_a_byte_order_mark_is_read_over(tmp_path):
    load(tmp_path, fl_x=F)
    data = (tmp_path / "transforms.json").read_bytes()
    (tmp_path / "transforms.json").write_bytes(b"\xef\xbb\xbf" + data)
    np.testing.assert_allclose(load_views(tmp_path).intrinsics, [MIDDLE] * 3, rtol=1e-6)


@pytest.mark.parametrize("lens", [{"camera_fov": 0.6}, {"fov_rad": [0.6]}, {}])
def test_one_angle_means_square_pixels(tmp_path, lens):
    pixels = np.zeros((30, 40, 4), np.uint8)
    pixels[8:22, 10:30] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    frame = {"file_path": "a.png", "transform_matrix": hostile.pose(0), **lens}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    fx, fy = load_views(tmp_path).intrinsics[0, :2].tolist()
    assert fx == fy == pytest.approx(20 / math.tan(0.5 * (0.6 if lens else 0.7)), rel=1e-6)
