"""Cameras of a ``transforms.json``: the published object folders, Blender's NeRF export, nerfstudio and instant-ngp.

All store camera-to-world matrices in OpenGL axes, which are used as they stand: ``coordinate_system``,
``applied_transform`` and the like are recorded and turn nothing.  The lens is looked up in the frame, then in the file:
``fl_x``, ``camera_angle_x``, ``camera_fov``, ``fov_rad``; 0.7 radians where none is given, as published.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

from reli3d.io.files import InputError, read_bytes, shown
from reli3d.views.shots import Lens, Shot, inside, number, rigid

MAX_BYTES = 1 << 24
MAX_FRAMES = 4096  # a video at 30 frames a second for two minutes
DEFAULT_FOV = 0.7  # radians, of the published release
MIN_FOV = 1e-6  # radians: the tangent of a much smaller angle is 0
_PINHOLE = (None, "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL", "FULL_OPENCV", "PERSPECTIVE")


def read_json(path: Path) -> dict:
    """The object in a JSON file; stricter than Python: no NaN, no infinity, no key twice, 16 MB.  Raises InputError."""
    try:
        text = read_bytes(path, MAX_BYTES).decode("utf-8-sig")
        value = json.loads(text, parse_constant=_refuse, object_pairs_hook=_unique)
    except InputError:
        raise
    except UnicodeDecodeError as error:
        raise InputError(path, f"expected UTF-8 text, got other bytes at {error.start}; save it as UTF-8") from None
    except RecursionError:
        raise InputError(path, "expected a flat JSON file, got one nested too deep; export the cameras again") from None
    except json.JSONDecodeError as error:
        raise InputError(path, f"line {error.lineno}: expected JSON ({error.msg}); correct the file") from None
    except _Refused as error:
        raise InputError(path, f"{error}; correct the file") from None
    except ValueError:
        raise InputError(path, "expected numbers, got an integer of thousands of digits; correct the file") from None
    if not isinstance(value, dict):
        raise InputError(
            path, f"expected a JSON object with frames, got {type(value).__name__}; export the cameras again"
        )
    return value


class _Refused(ValueError):
    """JSON that Python would read and we do not."""


def _refuse(word: str):
    raise _Refused(f"expected finite numbers, got {word}")


def _unique(pairs: list) -> dict:
    result = dict(pairs)
    if len(result) != len(pairs):
        seen: set[str] = set()
        for key, _ in pairs:
            if key in seen:
                raise _Refused(f"expected every key once, got {shown(key)} twice")
            seen.add(key)
    return result


def read_transforms(path: Path, *, outside: bool = False) -> tuple[list[Shot], list[str], str | None]:
    """All shots by ``view_index`` (missing: 0; else file order), notes, and ``coordinate_system``.

    Raises InputError naming the frame and the field.
    """
    data, notes = read_json(path), []
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(path, f"frames: expected a list of frames, got {shown(frames)}; export the cameras again")
    if len(frames) > MAX_FRAMES:
        raise InputError(path, f"frames: expected at most {MAX_FRAMES}, got {len(frames)}; keep the views to be used")
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise InputError(path, f"frames[{i}]: expected an object, got {shown(frame)}; export the cameras again")
    order = [number(f"{path}: frames[{i}]", "view_index", f.get("view_index", 0)) for i, f in enumerate(frames)]
    ranked = sorted(range(len(frames)), key=order.__getitem__)
    shots = [_shot(path, i, frames[i], data, outside) for i in ranked]
    system = data.get("coordinate_system")
    if data.get("applied_transform") is not None:
        notes.append(
            f"{path.name}: applied_transform recorded by nerfstudio is not undone; the mesh comes out in the "
            "frame of transform_matrix"
        )
    return shots, notes, system[:80] if isinstance(system, str) else None


def _shot(path: Path, index: int, frame: dict, data: dict, outside: bool) -> Shot:
    where = f"{path}: frames[{index}]"
    key = next((k for k in ("transform_matrix", "camera_transform") if frame.get(k) is not None), None)
    if key is None:
        raise InputError(
            where, "transform_matrix: expected the camera-to-world matrix, got none; export the cameras again"
        )
    image = inside(path.parent, where, "file_path", frame.get("file_path"), outside=outside)
    mask = frame.get("mask_path")
    mask = None if mask is None else inside(path.parent, where, "mask_path", mask, outside=outside)
    notes: list[str] = []
    lens = _lens(where, frame, data, notes)
    return Shot(where, str(frame["file_path"]), image, mask, rigid(where, key, frame[key]), lens, tuple(notes))


def _lens(where: str, frame: dict, data: dict, notes: list[str]) -> Lens:
    def found(key: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        value = frame.get(key, data.get(key))
        return None if value is None else number(where, key, value, low, high)

    model = frame.get("camera_model", data.get("camera_model"))
    if model not in _PINHOLE:
        raise InputError(
            where, f"camera_model: expected a pinhole camera, got {shown(model)}; undistort the images first"
        )
    w, h = found("w", 0, 1e6), found("h", 0, 1e6)
    if any(side is not None and side < 1 for side in (w, h)):
        raise InputError(where, f"w, h: expected at least 1 pixel, got {w} x {h}; correct the camera file")
    size = None if w is None or h is None else (int(w), int(h))
    cx, cy = found("cx", -1e6, 1e6), found("cy", -1e6, 1e6)
    centre = None if cx is None or cy is None else (cx, cy)
    lens = None
    for source in (frame, data):
        if lens is None and source.get("fl_x") is not None:
            fx = number(where, "fl_x", source["fl_x"], 0, 1e9)
            fy = fx if source.get("fl_y") is None else number(where, "fl_y", source["fl_y"], 0, 1e9)
            lens = Lens(focal=(fx, fy), centre=centre, size=size)
        if lens is None and source.get("camera_angle_x") is not None:
            x = number(where, "camera_angle_x", source["camera_angle_x"], MIN_FOV, math.pi)
            y = source.get("camera_angle_y")
            y = math.nan if y is None else number(where, "camera_angle_y", y, MIN_FOV, math.pi)
            lens = Lens(fov=(x, y), centre=centre, size=size)
        for key in ("camera_fov", "fov_rad"):
            if lens is None and source.get(key) is not None:
                centre_key = frame.get("camera_principal_point", data.get("camera_principal_point"))
                point = centre if centre_key is None else _pair(where, "camera_principal_point", centre_key, -1e6, 1e6)
                lens = Lens(fov=_fov(where, key, source[key]), centre=point, size=None if point is None else size)
    if lens is None:
        notes.append(f"{where}: no field of view given, {DEFAULT_FOV} radians assumed as in the published release")
        centre_key = frame.get("camera_principal_point")
        point = centre if centre_key is None else _pair(where, "camera_principal_point", centre_key, -1e6, 1e6)
        lens = Lens(fov=(DEFAULT_FOV, DEFAULT_FOV), centre=point)
    radial = tuple(found(k, -1e6, 1e6) or 0.0 for k in ("k1", "k2", "k3", "k4"))
    tangential = tuple(found(k, -1e6, 1e6) or 0.0 for k in ("p1", "p2"))
    return replace(lens, radial=radial, tangential=tangential)


def _fov(where: str, key: str, value: object) -> tuple[float, float]:
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, list):
        return _pair(where, key, value, MIN_FOV, math.pi)
    angle = number(where, key, value, MIN_FOV, math.pi)
    return angle, angle


def _pair(where: str, key: str, value: object, low: float, high: float) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(where, f"{key}: expected two numbers, got {shown(value)}; correct the camera file")
    return number(where, key, value[0], low, high), number(where, key, value[1], low, high)
