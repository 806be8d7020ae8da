"""The lens of a frame of ``transforms.json``: supported keys, and keys that are errors.

Supported, in this order, from the frame, else from the file:

- a 3x3 matrix in pixels: ``intrinsics``, ``K``, ``intrinsic_matrix``, ``camera_intrinsics``, ``camera_matrix``, ...
- focal lengths in pixels: ``fl_x``, ``fl_y``, or ``fx``, ``fy``
- ``x_fov``, ``y_fov`` in degrees (instant-ngp)
- ``camera_angle_x``, ``camera_angle_y`` in radians (Blender)
- ``camera_fov``, ``fov_rad`` in radians, one number or two (the published object folders)
- ``focal_length`` and ``sensor_width`` in the same unit

The field of view is 0.7 radians, as in the ReLi3D release, if neither the frame nor the file has a lens key.
Unsupported keys that resemble lens keys, and lenses other than a pinhole, are errors.
"""

import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from reli3d.errors import InputError, shown
from reli3d.views.frames import MAX_SKEW, Lens, number

DEFAULT_FOV = 0.7  # radians, of the ReLi3D release
MIN_FOV = 1e-6  # radians: the tangent of a much smaller angle is 0
AGREE = 0.02  # relative difference up to which two spellings of one focal length agree
_PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL", "FULL_OPENCV", "PERSPECTIVE", "PERSP")
_MATRICES = (
    *("intrinsics", "K", "intrinsic_matrix", "intrinsics_matrix", "intrinsic"),
    *("camera_intrinsics", "camera_matrix", "cam_K"),
)
_FOCALS = (("fl_x", "fl_y"), ("fx", "fy"))
_ANGLES = (("x_fov", "y_fov", math.pi / 180), ("camera_angle_x", "camera_angle_y", 1.0))
_FOVS = ("camera_fov", "fov_rad")
_SIDES = (("w", "width", "image_width"), ("h", "height", "image_height"))
_SIZES = ("resolution", "img_wh", "image_size", "img_size")  # width and height in a list
_RADIAL, _TANGENTIAL = ("k1", "k2", "k3", "k4"), ("p1", "p2")
_READ = {
    *(*_MATRICES, *_FOVS, *_RADIAL, *_TANGENTIAL),
    *(key for pair in (*_FOCALS, *_ANGLES, *_SIDES) for key in pair if isinstance(key, str)),
    *("cx", "cy", "camera_principal_point", "focal_length", "sensor_width"),
}
# words are keys in lower case without punctuation
_MODEL = re.compile(r"(camera|lens|distortion|projection)(model|mode|type)|projection")
_KIND = re.compile(r"(camera|cam|lens|sensor)?(model|mode|type|kind|name)?")
_NO_PINHOLE = re.compile(
    r"fisheye|ftheta|latlong|equirect|equidist|kannala|thinprism|^pano(ram|$)|spherical|omnidir|doublesphere"
    r"|^(is)?ortho(?!n|go)|vr180"
)
_BENT = re.compile(
    r"xi|[kps]\d+|.*(distort|distcoef|skew|rollingshutter|pixelaspect|lensshift|camerashift).*|(shift|tau)[xy]"
)
_LENS = re.compile(
    r".*(focal|fov|fieldofview|angleofview|cameraangle|intrinsic|principal|sensor|calib|cameramatrix).*"
    r"|(camera|cam)(param(eter)?s?|info|data)?|(cam|view)?angle[xy]|fl[xy]?|f[xy]?|c[xy]|k|kmatrix|camk|hwf|lens"
    r"|p|(camera|cam)?proj(ection)?(mat(rix)?)?"
)
_NO_LENS = re.compile(
    r"(is)?undistorted|distortioncorrected|(camera|cam|sensor|lens|calib(ration)?|intrinsics?)(id|idx|index)"
)
_COEFFICIENTS = ("d", "dist", "coeffs", "coefficients")  # where these are lists
_AXES = re.compile(r"(coordinate|coord|axis|axes|pose|camera)*(system|convention|coordinates?|axes)|pose(type|format)")
_OPENCV = re.compile(r".*(opencv|colmap|rdf).*|cv")
_OTHER_AXES = re.compile(r".*(pytorch3d|p3d|unity|unreal|mitsuba|directx|left.?hand|w2c|world.?(to|2).?cam).*")
_FLIPPED = {"from_na": "second and third", "from_mitsuba": "first and third"}  # columns, of forks of instant-ngp


def check_keys(where: str, values: dict) -> None:
    """Raises InputError for an unsupported key that changes the camera.  Null, false and 0 change nothing."""
    for key, value in values.items():
        word = _word(key)
        columns = None if _nothing(value) else _FLIPPED.get(key)
        other = False
        if isinstance(value, str) and _AXES.fullmatch(word):
            columns = "second and third" if _OPENCV.fullmatch(value.lower().strip()) else None
            other = bool(_OTHER_AXES.fullmatch(value.lower().strip()))
        if columns or other:
            fix = f"negate the {columns} column of each matrix" if columns else "convert the matrices"
            problem = f"{key}: expected camera-to-world matrices in OpenGL axes, got {shown(value)}"
            raise InputError(where, f"{problem}; {fix} and remove the key")
        is_index = word in ("camera", "cam") and isinstance(value, int)
        if key in _READ or _nothing(value) or _NO_LENS.fullmatch(word) or is_index:
            continue
        text, expected, fix = isinstance(value, str), "", "undistort the images first"
        if text and _MODEL.fullmatch(word):
            if re.sub(r"[^A-Z0-9]+", "_", value.upper().strip()) not in _PINHOLE:
                expected = "a pinhole camera"
        elif _no_pinhole(key, value):
            expected = "a pinhole camera"
        elif _BENT.fullmatch(word) and (word[0] != "s" or not text) or word in _COEFFICIENTS and type(value) is list:
            expected = "0 or none, as it is not read"
        elif _LENS.fullmatch(word) and not (text and not re.match(r"\s*[-+.]?\d", value)):  # not a name
            expected = "fl_x in pixels, camera_angle_x in radians or a 3x3 matrix intrinsics, as it is not read"
            fix = "write one of these and remove it"
        if expected:
            raise InputError(where, f"{key}: expected {expected}, got {shown(value)}; {fix}")
    for key, entry in _inner(values):
        for name, value in entry.items():
            if _no_pinhole(name, value):
                got = f"{name}: {shown(value)}"
                raise InputError(where, f"{key}: expected a pinhole camera, got {got}; undistort the images first")


def _no_pinhole(key: str, value: object) -> bool:
    """Whether a key, or a model that it names, is a lens that is none."""
    word = _word(key)
    if isinstance(value, str) and (_KIND.fullmatch(word) or _MODEL.fullmatch(word)):
        word += " " + _word(value)
    return not _nothing(value) and any(map(_NO_PINHOLE.search, word.split()))


def _inner(values: dict) -> Iterator[tuple[str, dict[str, object]]]:
    """``(key, object)`` of the objects that are values of ``values``, alone, in a list or by name, frames left out."""
    for key, value in values.items():
        if key != "frames":
            found = value if isinstance(value, list) else [value]
            for entry in (e for e in found if isinstance(e, dict)):
                yield from ((key, e) for e in (entry, *entry.values()) if isinstance(e, dict))


def _word(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())


def _nothing(value: object) -> bool:
    """Whether a flag or a coefficient of this value is the same as none."""
    if isinstance(value, list):
        return all(_nothing(v) for v in value)
    return value is None or value in (False, 0) or value in ("", "false", "False", "none", "None")


def lens_of(where: str, frame: dict, data: dict, notes: list[str]) -> Lens:
    """The lens of ``frame`` in a file with the fields ``data``; both have passed :func:`check_keys`.

    A null is no value.  Raises InputError naming the field if the values are not a lens or if two keys disagree.
    """
    frame, data = ({k: v for k, v in source.items() if v is not None} for source in (frame, data))
    size, center = _size(where, frame, data), _center(where, frame, data)
    lens = None
    for source in (frame, data):
        spellings = list(_spellings(where, source, data, size))
        if spellings:
            names, lens, first = spellings[0]
            for (others, _, second), k in itertools.product(spellings[1:], (0, 1)):
                if abs(first[k] - second[k]) > AGREE * first[k]:  # False where one is not known, NaN
                    expected = f"{others[k]}: expected the focal length of {names[k]}, {first[k]:.4g}"
                    got = f"image {_SIDES[k][1]}s, got {second[k]:.4g}"
                    raise InputError(where, f"{expected} {got}; remove the wrong one")
            lens = replace(lens, center=center)
            if names[0] not in _FOVS or lens.center is not None:
                lens = replace(lens, size=size)
            break
    if lens is None:
        for key, entry in (*_inner(frame), *_inner(data)):
            if name := next((n for n in map(str, entry) if n in _READ or _LENS.fullmatch(_word(n))), None):
                problem = f"{key}: expected the lens in the frame or the file, got {shown(name)} within {key}"
                fix = "which is not read; write it into the object that has transform_matrix"
                raise InputError(where, f"{problem}, {fix}")
        notes.append(f"{where}: no field of view given, {DEFAULT_FOV} radians assumed as in the ReLi3D release")
        lens = Lens(fov=(DEFAULT_FOV, math.nan), center=center)
    both = {**data, **frame}
    radial, tangential = (
        tuple(number(where, k, both.get(k, 0.0), -1e6, 1e6) for k in keys) for keys in (_RADIAL, _TANGENTIAL)
    )
    model = both.get("camera_model")
    if radial[3] and isinstance(model, str) and model.upper() == "FULL_OPENCV":  # of a denominator there
        raise InputError(where, f"k4: expected 0 for FULL_OPENCV, got {radial[3]:g}; undistort the images first")
    return replace(lens, radial=radial, tangential=tangential)


def _spellings(
    where: str, source: dict, data: dict, size
) -> Iterator[tuple[tuple[str, str], Lens, tuple[float, float]]]:
    """``(keys, lens, focal lengths)`` of each spelling in ``source``, in order of preference.

    Keys are of both axes; focal lengths in image widths and heights, NaN where one is not known.
    """
    width, height = (math.nan, math.nan) if size is None else size
    for key in _MATRICES:
        if key in source:
            fx, fy, cx, cy = _matrix(where, key, source[key])
            yield (key, key), Lens(focal=(fx, fy), center=(cx, cy)), (fx / width, fy / height)
    for x_key, y_key in _FOCALS:
        if x_key in source or y_key in source:
            fx, fy = _both(where, source, data, (x_key, y_key), (0, 1e9))
            yield (x_key, y_key), Lens(focal=(fx, fx if math.isnan(fy) else fy)), (fx / width, fy / height)
    for x_key, y_key, unit in _ANGLES:
        if x_key in source or y_key in source:
            x, y = (unit * v for v in _both(where, source, data, (x_key, y_key), (MIN_FOV / unit, math.pi / unit)))
            yield (x_key, y_key), Lens(fov=(x, y)), (_widths(x), _widths(y))
    for key in _FOVS:
        if key in source:
            value = source[key][0] if isinstance(source[key], list) and len(source[key]) == 1 else source[key]
            if isinstance(value, list):
                fov = _pair(where, key, value, MIN_FOV, math.pi)
            else:
                fov = number(where, key, value, MIN_FOV, math.pi), math.nan  # square pixels
            yield (key, key), Lens(fov=fov), (_widths(fov[0]), math.nan)  # some write the field across twice
    if "focal_length" in source:
        sensor = source.get("sensor_width", data.get("sensor_width"))
        if sensor is None:
            got = f"{shown(source['focal_length'])} of an unknown unit"
            raise InputError(where, f"focal_length: expected sensor_width with it, got {got}; write fl_x in pixels")
        focal = number(where, "focal_length", source["focal_length"], 0, 1e9)
        ratio = focal / number(where, "sensor_width", sensor, 0, 1e9)
        yield ("focal_length", "focal_length"), Lens(fov=(2 * math.atan(0.5 / ratio), math.nan)), (ratio, math.nan)


def _both(where: str, source: dict, data: dict, keys: tuple[str, str], limits: tuple[float, float]) -> list[float]:
    """The values of two keys, across and upright, NaN for none upright.

    The file's value upright counts for a frame only where the file has none across as well.
    """
    across, upright = keys
    x = source.get(across, data.get(across))
    y = source.get(upright, None if across in data else data.get(upright))
    if x is None:
        raise InputError(where, f"{across}: expected it with {upright}, got {upright} alone; add {across}")
    return [number(where, across, x, *limits), math.nan if y is None else number(where, upright, y, *limits)]


def _widths(fov: float) -> float:
    return 0.5 / math.tan(0.5 * fov)


def _size(where: str, frame: dict, data: dict) -> tuple[int, int] | None:
    def side(axis: int) -> float | None:
        for source in (frame, data):
            for key in _SIDES[axis]:
                if key in source:
                    return number(where, key, source[key], 0, 1e6)
            for key in _SIZES:
                pair = source.get(key)
                if isinstance(pair, list) and len(pair) == 2:
                    return number(where, key, pair[axis], 0, 1e6)
        return None

    w, h = side(0), side(1)
    if w is None and h is None:
        return None
    if w is None or h is None or min(w, h) < 1:
        raise InputError(where, f"w, h: expected both, at least 1 pixel, got {w} x {h}; write the size of the images")
    return int(w), int(h)


def _center(where: str, frame: dict, data: dict) -> tuple[float, float] | None:
    """The principal point, each coordinate first of the frame, NaN where only the other is given."""
    found = [math.nan, math.nan]
    for source in (frame, data):
        matrix = next((key for key in _MATRICES if isinstance(source.get(key), list)), None)
        if not any(map(math.isnan, found)):
            break
        if matrix:
            pair = _matrix(where, matrix, source[matrix])[2:]
        elif "camera_principal_point" in source:
            pair = _pair(where, "camera_principal_point", source["camera_principal_point"], -1e6, 1e6)
        else:
            x, y = (number(where, k, source[k], -1e6, 1e6) if k in source else math.nan for k in ("cx", "cy"))
            pair = x, y
        found = [new if math.isnan(old) else old for old, new in zip(found, pair)]
    return None if all(map(math.isnan, found)) else (found[0], found[1])


def _matrix(where: str, key: str, value: object) -> tuple[float, float, float, float]:
    """Focal lengths and center of a 3x3 matrix, its 9 numbers by rows, or a 4x4 matrix that holds it."""
    rows = value if isinstance(value, list) else []
    if len(rows) == 9:
        rows = [rows[0:3], rows[3:6], rows[6:9]]
    if len(rows) not in (3, 4) or any(not isinstance(row, list) or len(row) not in (3, 4) for row in rows):
        raise InputError(where, f"{key}: expected a 3x3 matrix in pixels, got {shown(value)}; write it row by row")
    m = np.array([[number(where, key, v, -1e9, 1e9) for v in row[:3]] for row in rows[:3]])
    fx, fy, cx, cy = m[0, 0], m[1, 1], m[0, 2], m[1, 2]
    if not (min(fx, fy) > 0 and np.abs(m[2] - (0, 0, 1)).max() < 1e-6 and abs(m[1, 0]) + abs(m[0, 1]) <= MAX_SKEW * fx):
        expected = "expected the rows fx 0 cx, 0 fy cy, 0 0 1 in pixels with fx and fy above 0"
        raise InputError(where, f"{key}: {expected}, got {shown(m.tolist(), 120)}; correct the camera file")
    return float(fx), float(fy), float(cx), float(cy)


def _pair(where: str, key: str, value: object, low: float, high: float) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(where, f"{key}: expected two numbers, got {shown(value)}; correct the camera file")
    return number(where, key, value[0], low, high), number(where, key, value[1], low, high)
