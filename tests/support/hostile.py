"""Hostile and broken inputs, made by code.  Each must end in one line that names the fault, with nothing written.

``cases()`` are object folders for anything that takes one; environment files stand in ``hostile_maps``.
"""

import io
import json
import math
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

SIDE = 32


def pose(yaw: float) -> list[list[float]]:
    """Camera-to-world of a camera on the horizon that looks at the origin."""
    c, s = math.cos(yaw), math.sin(yaw)
    return [[c, 0.0, s, 2.0 * s], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, 2.0 * c], [0.0, 0.0, 0.0, 1.0]]


def random_image(side: int = SIDE, alpha: bool = True) -> np.ndarray:
    """A gray disk of a third of the side on black."""
    y, x = np.mgrid[:side, :side] + 0.5 - side / 2
    inside = ((x * x + y * y) < (side / 3) ** 2).astype(np.uint8)
    return np.stack([inside * 120] * 3 + [inside * 255] * alpha, -1)


def good(folder: Path, views: int = 3) -> dict:
    """A folder that loads, and its transforms."""
    (folder / "rgba").mkdir(parents=True, exist_ok=True)
    frames = []
    for i in range(views):
        Image.fromarray(random_image()).save(folder / f"rgba/{i}.png")
        lens = {"camera_fov": [0.6, 0.6], "camera_principal_point": [SIDE / 2, SIDE / 2]}
        frames.append({"view_index": i, "file_path": f"rgba/{i}.png", "transform_matrix": pose(2.1 * i), **lens})
    data = {"object_uid": "disk", "coordinate_system": "ogl", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(data))
    return data


def _with(change: Callable[[Path], object]) -> Callable[[Path], None]:
    """A good folder, changed."""

    def make(folder: Path) -> None:
        good(folder)
        change(folder)

    return make


def _text(change: Callable[[str], str | bytes]) -> Callable[[Path], None]:
    """A good folder with the text of its camera file changed."""

    def edit(folder: Path) -> None:
        text = change((folder / "transforms.json").read_text())
        (folder / "transforms.json").write_bytes(text.encode() if isinstance(text, str) else text)

    return _with(edit)


def _json(change: Callable[[dict], object]) -> Callable[[Path], None]:
    """A good folder whose transforms are changed in place, or replaced by what ``change`` returns."""

    def edit(text: str) -> str:
        data = json.loads(text)
        result = change(data)
        return json.dumps(data if result is None else result)

    return _text(edit)


def _frame(**fields) -> Callable[[Path], None]:
    """A good folder with fields of its first frame set (None: removed)."""

    def change(data: dict) -> None:
        data["frames"][0].update(fields)
        for key in [k for k, v in fields.items() if v is None]:
            del data["frames"][0][key]

    return _json(change)


def _matrix(change: Callable[[list], object]) -> Callable[[Path], None]:
    def edit(data: dict) -> None:
        matrix = data["frames"][0]["transform_matrix"]
        data["frames"][0]["transform_matrix"] = change(matrix) or matrix

    return _json(edit)


def _set(row: int, column: int, value: object) -> Callable[[Path], None]:
    return _matrix(lambda m: m[row].__setitem__(column, value))


def _image(data: bytes | Callable[[], bytes]) -> Callable[[Path], None]:
    """A good folder whose first image has this content."""
    return _with(lambda folder: (folder / "rgba/0.png").write_bytes(data if isinstance(data, bytes) else data()))


def saved(pixels: np.ndarray, form: str = "PNG", **options) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, form, **options)
    return buffer.getvalue()


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_claiming(width: int, height: int) -> bytes:
    """A PNG of a few bytes that claims this size."""
    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    data = _chunk(b"IDAT", zlib.compress(bytes(100)))
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + data + _chunk(b"IEND", b"")


def _animated() -> bytes:
    frames = [np.roll(random_image(), k, 0) for k in range(3)]
    others = [Image.fromarray(frame) for frame in frames[1:]]
    return saved(frames[0], "WEBP", save_all=True, append_images=others, lossless=True)


def _link(target: str, name: str = "rgba/0.png") -> Callable[[Path], None]:
    """A good folder with a link in place of a file."""
    return _with(lambda folder: ((folder / name).unlink(), (folder / name).symlink_to(target)))


def _mask(pixels: np.ndarray | bytes | None) -> Callable[[Path], None]:
    """A good folder whose images have no alpha, with this mask for each (None: none)."""

    def make(folder: Path) -> None:
        data = good(folder)
        (folder / "masks").mkdir()
        for i in range(len(data["frames"])):
            Image.fromarray(random_image(alpha=False)).save(folder / f"rgba/{i}.png")
            if isinstance(pixels, bytes):
                (folder / f"masks/{i}.png").write_bytes(pixels)
            elif pixels is not None:
                Image.fromarray(pixels).save(folder / f"masks/{i}.png")

    return make


def colmap(folder: Path) -> tuple[str, str]:
    """A COLMAP folder that loads; its cameras.txt and images.txt."""
    (folder / "images").mkdir(parents=True)
    (folder / "sparse/0").mkdir(parents=True)
    lines = []
    for i in range(3):
        Image.fromarray(random_image()).save(folder / f"images/{i}.png")
        half = 2.1 * i / 2  # OpenGL world to OpenCV camera: half a turn about x after the turn by -yaw about y
        lines += [f"{i + 1} 0 {math.cos(half)!r} 0 {math.sin(half)!r} 0 0 2 1 {i}.png", "1.5 2.5 -1"]
    cameras = f"# Camera list\n1 PINHOLE {SIDE} {SIDE} 51.7 51.7 {SIDE / 2} {SIDE / 2}\n"
    images = "# Image list\n" + "\n".join(lines) + "\n"
    (folder / "sparse/0/cameras.txt").write_text(cameras)
    (folder / "sparse/0/images.txt").write_text(images)
    return cameras, images


def _colmap(cameras=None, images=None) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        old = colmap(folder)
        for name, text, change in zip(("cameras", "images"), old, (cameras, images)):
            if change is not None:
                new = change(text)
                (folder / f"sparse/0/{name}.txt").write_bytes(new.encode() if isinstance(new, str) else new)

    return make


def _binary_only(folder: Path) -> None:
    colmap(folder)
    for name in ("cameras", "images"):
        (folder / f"sparse/0/{name}.txt").rename(folder / f"sparse/0/{name}.bin")


def _scaled(factor: float):
    return lambda m: [[v * factor if c < 3 and r < 3 else v for c, v in enumerate(row)] for r, row in enumerate(m)]


def cases() -> list[tuple[str, Callable[[Path], None]]]:
    """``(name, make)``: ``make(folder)`` fills a new folder that no command may accept."""
    full = random_image()
    full[..., 3] = 255
    noise = np.random.default_rng(0).integers(0, 255, (SIDE, SIDE, 4), np.uint8)
    big = "9" * 5000
    return [
        # the folder
        ("empty_folder", lambda f: f.mkdir(parents=True)),
        ("file_instead_of_folder", lambda f: f.write_bytes(b"x")),
        ("missing_folder", lambda f: None),
        ("transforms_is_folder", lambda f: (f / "transforms.json").mkdir(parents=True)),
        ("transforms_is_pipe", lambda f: (f.mkdir(), os.mkfifo(f / "transforms.json"))),
        ("transforms_links_outside", _link("/etc/passwd", "transforms.json")),
        ("transforms_dangling_link", _link("nowhere.json", "transforms.json")),
        # the text of the camera file
        ("json_empty", _text(lambda t: "")),
        ("json_truncated", _text(lambda t: t[: len(t) // 2])),
        ("json_binary", _text(lambda t: bytes(range(256)))),
        ("json_utf16", _text(lambda t: t.encode("utf-16"))),
        ("json_is_list", _text(lambda t: "[1, 2]")),
        ("json_is_null", _text(lambda t: "null")),
        ("json_nan", _text(lambda t: t.replace("0.6", "NaN", 1))),
        ("json_infinity", _text(lambda t: t.replace("0.6", "-Infinity", 1))),
        ("json_overflow", _text(lambda t: t.replace("0.6", "1e400", 1))),
        ("json_huge_integer", _text(lambda t: t.replace("0.6", big, 1))),
        ("json_large_integer", _text(lambda t: t.replace("0.6", "9" * 400, 1))),
        ("json_nested", _text(lambda t: "[" * 200_000)),
        ("json_nested_object", _text(lambda t: '{"frames":' * 100_000)),
        ("json_duplicate_key", _text(lambda t: t.replace('"object_uid"', '"frames": [], "object_uid"', 1))),
        ("json_trailing_garbage", _text(lambda t: t + "}")),
        ("json_too_large", _text(lambda t: t + " " * (17 << 20))),
        # frames
        ("frames_missing", _json(lambda d: {"object_uid": "x"})),
        ("frames_empty", _json(lambda d: {"frames": []})),
        ("frames_is_object", _json(lambda d: {"frames": {"0": d["frames"][0]}})),
        ("frames_of_numbers", _json(lambda d: {"frames": [1, 2, 3]})),
        ("frames_too_many", _json(lambda d: {"frames": d["frames"] * 2000})),
        ("view_index_text", _frame(view_index="0")),
        ("view_index_list", _frame(view_index=[0])),
        # the pose
        ("matrix_missing", _frame(transform_matrix=None)),
        ("matrix_3x4", _matrix(lambda m: m[:3])),
        ("matrix_flat", _matrix(lambda m: sum(m, []))),
        ("matrix_ragged", _matrix(lambda m: m[1].pop() and None)),
        ("matrix_text", _matrix(lambda m: "identity")),
        ("matrix_string_number", _set(0, 0, "1.0")),
        ("matrix_bool", _set(0, 0, True)),
        ("matrix_null", _set(1, 1, None)),
        ("matrix_nested_number", _set(1, 1, [1.0])),
        ("matrix_mirrored", _matrix(lambda m: [[-m[0][0], *m[0][1:]], m[1], [-m[2][0], *m[2][1:]], m[3]])),
        ("matrix_zero", _matrix(lambda m: [[0.0] * 4] * 3 + [m[3]])),
        ("matrix_scaled", _matrix(_scaled(2.0))),
        ("matrix_sheared", _matrix(lambda m: [[r[0] + 0.2 * r[1], *r[1:]] for r in m])),
        ("matrix_huge", _matrix(_scaled(1e200))),
        ("matrix_transposed", _matrix(lambda m: [list(c) for c in zip(*m)])),
        ("matrix_last_row", _set(3, 3, 2.0)),
        ("matrix_far_away", _set(0, 3, 1e30)),
        # the lens
        ("fov_zero", _frame(camera_fov=0.0)),
        ("fov_negative", _frame(camera_fov=[-0.6, 0.6])),
        ("fov_pi", _frame(camera_fov=3.1415927)),
        ("fov_degrees", _frame(camera_fov=40.0)),
        ("fov_text", _frame(camera_fov="0.6")),
        ("fov_three", _frame(camera_fov=[0.6, 0.6, 0.6])),
        ("fov_tiny", _frame(camera_fov=1e-9)),
        ("focal_negative", _frame(fl_x=-100.0)),
        ("focal_huge", _frame(fl_x=1e8)),
        ("angle_x_text", _frame(camera_angle_x="wide")),
        ("principal_outside", _frame(camera_principal_point=[9000.0, 0.0])),
        ("principal_scalar", _frame(camera_principal_point=16.0)),
        ("size_other_aspect", _frame(fl_x=50.0, w=64, h=32)),
        ("distorted", _frame(fl_x=50.0, k1=-0.3)),
        ("fisheye", _frame(camera_model="OPENCV_FISHEYE")),
        # paths
        ("path_missing", _frame(file_path=None)),
        ("path_number", _frame(file_path=7)),
        ("path_empty", _frame(file_path=" ")),
        ("path_not_there", _frame(file_path="rgba/none.png")),
        ("path_folder", _frame(file_path="rgba")),
        ("path_traversal", _frame(file_path="../../../../../../etc/passwd")),
        ("path_hidden_traversal", _frame(file_path="rgba/../../outside.png")),
        ("path_absolute", _frame(file_path="/etc/passwd")),
        ("path_windows", _frame(file_path="C:\\Windows\\win.ini")),
        ("path_share", _frame(file_path="\\\\server\\share\\a.png")),
        ("path_home", _frame(file_path="~/photo.png")),
        ("path_nul", _frame(file_path="rgba/0.png\0.txt")),
        ("path_url", _frame(file_path="http://localhost/a.png")),
        ("path_file_url", _frame(file_path="file:///etc/passwd")),
        ("path_data_url", _frame(file_path="data:image/png;base64,AAAA")),
        ("path_newline", _frame(file_path="a\nb\x1b[31m.png")),
        ("path_surrogate", _frame(file_path="rgba/\ud800.png")),
        ("path_long", _frame(file_path="a" * 900)),
        ("path_longer", _frame(file_path="a/" * 3000)),
        ("mask_traversal", _frame(mask_path="../secret.png")),
        ("mask_not_there", _frame(mask_path="rgba/none.png")),
        ("link_outside", _link("/etc/passwd")),
        ("link_device", _link("/dev/zero")),
        ("link_loop", _link("0.png")),
        # images
        ("image_empty", _image(b"")),
        ("image_text", _image(b"not an image at all")),
        ("image_truncated", _image(lambda: saved(noise)[:700])),
        ("image_bad_checksum", _image(lambda: saved(noise).replace(b"IDAT", b"IDAT\0", 1))),
        ("image_bomb", _image(png_claiming(30_000, 30_000))),
        ("image_bomb_max", _image(png_claiming(2**31 - 1, 2**31 - 1))),
        ("image_claims_more", _image(png_claiming(4000, 4000))),
        ("image_zero_width", _image(png_claiming(0, 32))),
        ("image_too_small", _image(lambda: saved(full[:4, :4]))),
        ("image_gif", _image(lambda: saved(full[..., 0], "GIF"))),
        ("image_bmp", _image(lambda: saved(full[..., :3], "BMP"))),
        ("image_eps", _image(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 32\n")),
        ("image_svg", _image(b'<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"/>')),
        ("image_animated", _image(_animated)),
        ("image_float", _image(lambda: saved(np.full((SIDE, SIDE), 0.5, np.float32), "TIFF"))),
        ("image_32_bit", _image(lambda: saved(np.full((SIDE, SIDE), 1 << 30, np.int32), "TIFF"))),
        ("image_broken_tiff", _image(b"II*\0" + b"\xff" * 60)),
        ("image_broken_webp", _image(b"RIFF\x40\0\0\0WEBPVP8L" + b"\xff" * 60)),
        ("image_broken_jpeg", _image(b"\xff\xd8\xff\xe0" + b"\xff" * 60)),
        ("image_no_alpha", _image(lambda: saved(full[..., :3]))),
        ("image_opaque", _image(lambda: saved(full))),
        ("image_transparent", _image(lambda: saved(full * np.array([1, 1, 1, 0], np.uint8)))),
        # masks
        ("mask_missing", _mask(None)),
        ("mask_black", _mask(np.zeros((SIDE, SIDE), np.uint8))),
        ("mask_other_size", _mask(np.full((SIDE, SIDE + 1), 255, np.uint8))),
        ("mask_broken", _mask(b"\x89PNG\r\n\x1a\n")),
        # COLMAP
        ("colmap_binary", _binary_only),
        ("colmap_no_cameras", _colmap(cameras=lambda t: "# nothing\n")),
        ("colmap_no_images", _colmap(images=lambda t: "# nothing\n")),
        ("colmap_fisheye", _colmap(cameras=lambda t: t.replace("PINHOLE", "OPENCV_FISHEYE"))),
        ("colmap_few_numbers", _colmap(cameras=lambda t: t.replace(" 51.7", "", 1))),
        ("colmap_text_number", _colmap(cameras=lambda t: t.replace("51.7", "wide", 1))),
        ("colmap_nan", _colmap(cameras=lambda t: t.replace("51.7", "nan", 1))),
        ("colmap_focal_zero", _colmap(cameras=lambda t: t.replace("51.7", "0", 1))),
        ("colmap_distorted", _colmap(cameras=lambda t: f"1 SIMPLE_RADIAL {SIDE} {SIDE} 51.7 16 16 -0.4\n")),
        ("colmap_camera_twice", _colmap(cameras=lambda t: t + t.splitlines()[1] + "\n")),
        ("colmap_unknown_camera", _colmap(images=lambda t: t.replace(" 1 0.png", " 7 0.png"))),
        ("colmap_zero_quaternion", _colmap(images=lambda t: t.replace("1 0 1.0 0", "1 0 0.0 0", 1))),
        ("colmap_infinite", _colmap(images=lambda t: t.replace(" 2 1 0.png", " inf 1 0.png"))),
        ("colmap_short_line", _colmap(images=lambda t: t.replace(" 1 0.png", ""))),
        ("colmap_traversal", _colmap(images=lambda t: t.replace("0.png", "../../../etc/passwd"))),
        ("colmap_binary_text", _colmap(images=lambda t: bytes(range(128, 256)))),
        ("colmap_one_line", _colmap(images=lambda t: "1 " * 500_000)),
    ]


class Bomb:
    """Creates a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)
