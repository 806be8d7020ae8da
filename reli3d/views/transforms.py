"""Cameras of a ``transforms.json``: the published object folders, Blender's NeRF export, nerfstudio and instant-ngp.

All store camera-to-world matrices in OpenGL axes, which are used as stored; ``applied_transform`` and similar keys are
not applied.  :mod:`reli3d.views.lens_keys` reads the lens.
"""

import json
from collections import Counter
from pathlib import Path

from reli3d.errors import InputError, shown
from reli3d.fit.input_images import LIGHT_FRAMES
from reli3d.io.files import read_bytes
from reli3d.views.frames import Frame, file_within, number, rigid
from reli3d.views.lens_keys import check_keys, lens_of

MAX_BYTES = 1 << 24
MAX_FRAMES = 4096  # a video at 30 frames a second for two minutes


def read_json(path: Path) -> dict:
    """The object in a JSON file of at most 16 MB, without NaN, infinity or duplicate keys.  Raises InputError."""

    def reject(word: str):
        raise InputError(path, f"expected finite numbers, got {word}; correct the file")

    def unique(pairs: list) -> dict:
        result = dict(pairs)
        if len(result) != len(pairs):
            key = Counter(key for key, _ in pairs).most_common(1)[0][0]
            raise InputError(path, f"expected every key once, got {shown(key)} twice; correct the file")
        return result

    try:
        text = read_bytes(path, MAX_BYTES).decode("utf-8-sig")
        value = json.loads(text, parse_constant=reject, object_pairs_hook=unique)
    except InputError:
        raise
    except UnicodeDecodeError as error:
        raise InputError(path, f"expected UTF-8 text, got other bytes at {error.start}; save it as UTF-8") from None
    except RecursionError:
        raise InputError(path, "expected a flat JSON file, got one nested too deep; export the cameras again") from None
    except json.JSONDecodeError as error:
        raise InputError(path, f"line {error.lineno}: expected JSON ({error.msg}); correct the file") from None
    except ValueError:
        raise InputError(path, "expected numbers, got an integer of thousands of digits; correct the file") from None
    if not isinstance(value, dict):
        raise InputError(path, f"expected an object with frames, got {type(value).__name__}; export the cameras again")
    return value


def read_transforms(path: Path) -> tuple[list[Frame], list[str]]:
    """All frames ordered by ``view_index`` (default 0), then file order, and notes.

    Raises InputError naming the frame and the field.
    """
    data, notes = read_json(path), []
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(path, f"frames: expected a list of frames, got {shown(frames)}; export the cameras again")
    if len(frames) > MAX_FRAMES:
        raise InputError(path, f"frames: expected at most {MAX_FRAMES}, got {len(frames)}; keep the views to be used")
    check_keys(str(path), data)
    lighting = data.get("lighting", "object")
    if lighting not in LIGHT_FRAMES:
        expected = f"lighting: expected {', '.join(LIGHT_FRAMES)}"
        raise InputError(path, f"{expected}, got {shown(lighting)}; correct the camera file")
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise InputError(path, f"frames[{i}]: expected an object, got {shown(frame)}; export the cameras again")
    order = [number(f"{path}: frames[{i}]", "view_index", f.get("view_index", 0)) for i, f in enumerate(frames)]
    ranked = sorted(range(len(frames)), key=order.__getitem__)
    found = [_frame(path, i, frames[i], data) for i in ranked]
    if data.get("applied_transform") is not None:
        text = f"{path.name}: applied_transform recorded by nerfstudio is not undone"
        notes.append(f"{text}; the mesh is in the frame of transform_matrix")
    return found, notes


def _frame(path: Path, index: int, frame: dict, data: dict) -> Frame:
    where = f"{path}: frames[{index}]"
    key = next((k for k in ("transform_matrix", "camera_transform") if frame.get(k) is not None), None)
    if key is None:
        raise InputError(where, "transform_matrix: expected the camera-to-world matrix, got none; export again")
    image = file_within(path.parent, where, "file_path", frame.get("file_path"))
    mask = frame.get("mask_path")
    mask = None if mask is None else file_within(path.parent, where, "mask_path", mask)
    check_keys(where, frame)
    notes: list[str] = []
    lens = lens_of(where, frame, data, notes)
    pose, lighting, box = rigid(where, key, frame[key]), data.get("lighting", "object"), _object_box(path, data)
    return Frame(where, str(frame["file_path"]), image, mask, pose, lens, tuple(notes), lighting, box)


def _object_box(path: Path, data: dict) -> tuple[tuple[float, ...], ...] | None:
    """``object_box`` of the file: lower and upper corner in the frame of the cameras."""
    box = data.get("object_box")
    if box is None:
        return None
    if not isinstance(box, list) or len(box) != 2 or any(not isinstance(c, list) or len(c) != 3 for c in box):
        raise InputError(path, f"object_box: expected two corners of three numbers, got {shown(box)}; remove it")
    low, high = (tuple(number(str(path), "object_box", value) for value in corner) for corner in box)
    if not all(b > a for a, b in zip(low, high)):
        raise InputError(path, f"object_box: expected the lower corner first, got {shown(box)}; remove it")
    return low, high
