"""Random inputs whose parsed result is known by construction: each is read right or refused, never misread.

``KINDS`` maps a name to a function of a random generator that gives a :class:`Case`.
"""

import io
import json
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
import OpenEXR
from PIL import Image
from scipy.spatial.transform import Rotation

from reli3d.io.glb import read_glb
from reli3d.io.hdr import read_hdr_image
from reli3d.views.folder import load_views
from tests.support import known_gltf
from tests.support.misread import Case, check

SIDE = 48


def disk(rng: Random, side: int = SIDE, scale: int = 8) -> np.ndarray:
    """Coverage ``(side, side)`` in [0, 1] of a random disc, antialiased."""
    n = side * scale
    y, x = np.mgrid[:n, :n] + 0.5
    radius, cx, cy = (scale * rng.uniform(*span) for span in ((8, 16), (19, 29), (19, 29)))
    inside = (x - cx) ** 2 + (y - cy) ** 2 < radius**2
    return inside.reshape(side, scale, side, scale).mean((1, 3))


def png(pixels: np.ndarray | Image.Image) -> bytes:
    data = io.BytesIO()
    (pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)).save(data, "PNG")
    return data.getvalue()


def random_image(rng: Random, width: int = SIDE, height: int = SIDE) -> bytes:
    return png(np.random.default_rng(rng.getrandbits(32)).integers(30, 220, (height, width, 3), dtype=np.uint8))


def rotations(rng: Random, count: int) -> list[np.ndarray]:
    """Camera-to-world matrices, OpenGL axes, around the origin at distances of 2 to 3."""
    found = []
    for k in range(count):
        yaw, pitch = 2 * math.pi * k / count + rng.uniform(0, 0.3), rng.uniform(-0.6, 0.6)
        back = np.array([math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)])
        right = np.array([math.cos(yaw), 0.0, -math.sin(yaw)])
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, rng.uniform(2, 3) * back], -1)
        found.append(pose)
    return found


def transforms(frames: list[dict], **data) -> bytes:
    return json.dumps({**data, "frames": frames}).encode()


def frame_of(path: str, pose: np.ndarray, **fields) -> dict:
    return {"file_path": path, "transform_matrix": pose.tolist(), **fields}


def by_name(views) -> dict[str, int]:
    return {name: i for i, name in enumerate(views.names)}


def check_masks(folder: Path, ground_truth: dict[str, np.ndarray], tolerance: float) -> None:
    views = load_views(folder)
    check(
        len(views.names) == len(ground_truth), f"{len(views.names)} of {len(ground_truth)} views, notes {views.notes}"
    )
    at = by_name(views)
    for name, mask in ground_truth.items():
        error = float(np.abs(views.masks[at[name]].numpy() - mask).max())
        check(error <= tolerance, f"the mask of {name} differs by {error:.3f}, notes {views.notes}")


def masks(rng: Random) -> Case:
    """Masks with labels: gray, palette, one bit, a color, alpha, soft edges, two labels."""
    kind = rng.choice(["white", "gray", "palette", "bit", "color", "soft", "alpha", "two labels"])
    label = rng.randrange(1, 256)
    color = [rng.randrange(256) for _ in range(3)]
    color[rng.randrange(3)] = rng.randrange(40, 256)
    suffix = rng.choice([".png", ".png.png"])
    files, ground_truth, frames = {}, {}, []
    for k, pose in enumerate(rotations(rng, 3)):
        soft = disk(rng)
        hard = soft > 0.5
        name, image = f"images/{k:03d}.png", random_image(rng)
        gray = {"white": 255 * hard, "soft": np.rint(255 * soft), "two labels": np.where(hard, label, 0)}
        mask: np.ndarray | Image.Image = gray.get(kind, label * hard).astype(np.uint8)
        if kind == "two labels":
            mask[:, SIDE // 2 :] = np.where(hard, (label + 97) % 200 + 20, 0)[:, SIDE // 2 :]
        if kind == "palette":
            table = np.zeros((256, 3), np.uint8)
            table[label] = color
            mask = Image.fromarray(mask)
            mask.putpalette(table.tobytes())
        elif kind == "bit":
            mask = Image.fromarray((255 * hard).astype(np.uint8)).convert("1", dither=Image.Dither.NONE)
        elif kind == "color":
            mask = (hard[..., None] * np.array(color)).astype(np.uint8)
        if kind == "alpha":
            rgb = np.asarray(Image.open(io.BytesIO(image)))
            files[name] = png(np.concatenate([rgb, mask[..., None]], -1))
        else:
            files[name], files[f"masks/{k:03d}{suffix}"] = image, png(mask)
        ground_truth[name] = soft if kind == "soft" else hard
        frames.append(frame_of(name, pose))
    files["transforms.json"] = transforms(frames, camera_angle_x=0.8)
    return Case(
        files, lambda f: check_masks(f, ground_truth, 0.003), must_read=kind in ("white", "soft", "bit", "gray")
    )


def names(rng: Random) -> Case:
    """Images with one bare name in several folders; masks in the same folders, flat, or shared."""
    layout = rng.choice(["mirrored", "suffixed", "below images", "flat and unique", "shared"])
    folders = rng.sample(["front", "back", "left/near", "left/far", "cam 1", "ü"], rng.choice((2, 3)))
    files, ground_truth, frames = {}, {}, []
    for k, pose in enumerate(rotations(rng, 2 * len(folders))):
        stem = f"{k:06d}" if layout == "flat and unique" else f"{k // len(folders):06d}"
        part = f"{folders[k % len(folders)]}/{stem}"
        mask = disk(rng) > 0.5
        name = f"images/{part}.jpg" if layout == "below images" else f"{part}.png"
        image = Image.open(io.BytesIO(random_image(rng)))
        data = io.BytesIO()
        image.save(data, "JPEG" if name.endswith("jpg") else "PNG")
        files[name], ground_truth[name] = data.getvalue(), mask
        place = {"suffixed": f"{part}.png.png", "flat and unique": f"{stem}.png", "shared": f"{stem}.png"}
        files[f"masks/{place.get(layout, f'{part}.png')}"] = png((255 * mask).astype(np.uint8))
        frames.append(frame_of(name, pose))
    files["transforms.json"] = transforms(frames, camera_angle_x=0.8)
    return Case(files, lambda f: check_masks(f, ground_truth, 0.003), must_read=layout != "shared")


UNKNOWN = (
    {"is_fisheye": True},
    {"fisheye": True},
    {"camera_model": "OPENCV_FISHEYE"},
    {"camera_type": "FISHEYE"},
    {"lens_type": "fisheye"},
    {"ftheta_p0": 0.1, "ftheta_p1": 0.9},
    {"projection": "equirectangular"},
    {"camera_model": "EQUIRECTANGULAR"},
    {"focal_px": 55.0},
    {"hfov": 40.0},
    {"fov_x": 40.0},
    {"horizontal_fov": 0.7},
    {"fov": 40.0},
    {"focal": 55.0},
    {"lens": 35.0},
    {"camera_intrinsics_px": [55.0, 55.0, 32.0, 24.0]},
)


def spelled(rng: Random, width: int, height: int) -> tuple[dict, list[float]]:
    """Keys of a lens, and the ``fx, fy, cx, cy`` that they mean."""
    fx, cx, cy = rng.uniform(50, 120), width / 2 + rng.uniform(-3, 3), height / 2 + rng.uniform(-3, 3)
    fy = fx * rng.uniform(0.95, 1.05)
    size = {"w": width, "h": height}
    angle = [2 * math.atan(0.5 * side / f) for side, f in ((width, fx), (height, fy))]
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    center = {"cx": cx, "cy": cy}
    lenses = [
        {"fl_x": fx, "fl_y": fy, **center, **size},
        {"fx": fx, "fy": fy, **center, **size},
        {"camera_angle_x": angle[0], "camera_angle_y": angle[1], **center, **size},
        {"x_fov": math.degrees(angle[0]), "y_fov": math.degrees(angle[1]), **center, **size},
        {"camera_fov": angle, "camera_principal_point": [cx, cy]},
        {"intrinsics": matrix, **size},
        {"K": matrix, **size},
        {"camera_matrix": matrix, **size},
    ]
    return rng.choice(lenses), [fx, fy, cx, cy]


def check_cameras(
    folder: Path, ground_truth: dict[str, tuple], tolerance: float = 1e-3, least: int | None = None
) -> None:
    """ground_truth: intrinsics in pixels and the camera's center by the image's name."""
    views = load_views(folder, every=True)
    check(
        len(views.names) >= (least or len(ground_truth)),
        f"{len(views.names)} of {len(ground_truth)} views, notes {views.notes}",
    )
    for i, name in enumerate(views.names):
        check(name in ground_truth, f"the name {name!r}, notes {views.notes}")
        intrinsics, pose = ground_truth[name]
        off = np.abs(views.intrinsics[i].numpy() - intrinsics).max()
        check(off < 1e-2, f"{name}: intrinsics {views.intrinsics[i].tolist()}, not {intrinsics}; notes {views.notes}")
        got = views.c2w[i].numpy().astype(np.float64)
        got[:3, 3] += views.origin
        check(np.abs(got - pose).max() < tolerance, f"{name}: pose {got.tolist()}, not {pose.tolist()}")


def rgba(rng: Random, width: int, height: int) -> bytes:
    rgb = np.asarray(Image.open(io.BytesIO(random_image(rng, width, height))))
    alpha = np.zeros((height, width, 1), np.uint8)
    alpha[8:-8, 8:-8] = 255
    return png(np.concatenate([rgb, alpha], -1))


def lens(rng: Random) -> Case:
    """Spellings of a lens in the file or in each frame; unknown keys and fisheye lenses must be refused."""
    width, height = 64, 48
    files, ground_truth, frames, shared = {}, {}, [], {}
    unknown = rng.choice(UNKNOWN) if rng.random() < 0.4 else {}
    everywhere = rng.random() < 0.5
    if everywhere:
        shared, values = spelled(rng, width, height)
    for k, pose in enumerate(rotations(rng, 3)):
        fields = {}
        if not everywhere:
            fields, values = spelled(rng, width, height)
        name = f"rgba/{k}.png"
        files[name], ground_truth[name] = rgba(rng, width, height), (values, pose)
        frames.append(frame_of(name, pose, **fields))
    (shared if rng.random() < 0.5 else frames[rng.randrange(3)]).update(unknown)
    bent = bool({"is_fisheye", "fisheye", "camera_model", "camera_type", "lens_type", "ftheta_p0"} & set(unknown))
    if unknown and not bent and rng.random() < 0.5:  # no other field has the lens
        for part in (shared, *frames):
            for key in [key for key in part if key not in ("file_path", "transform_matrix", *unknown)]:
                del part[key]
        bent = True
    files["transforms.json"] = transforms(frames, **shared)
    return Case(files, lambda f: check_cameras(f, ground_truth), must_read=not unknown, must_refuse=bent)


def colmap(rng: Random) -> Case:
    """COLMAP text models: without lines of points, with blank lines, CRLF, a BOM, comments, and two models."""
    width, height, count = 64, 48, rng.choice((4, 6, 7))
    files, ground_truth, rows, cameras = {}, {}, [], []
    for k, pose in enumerate(rotations(rng, count)):
        fx, cx, cy = rng.uniform(50, 120), width / 2 + rng.uniform(-3, 3), height / 2 + rng.uniform(-3, 3)
        fy = fx * rng.uniform(0.95, 1.05)
        model, values = rng.choice(
            [("PINHOLE", [fx, fy, cx, cy]), ("SIMPLE_PINHOLE", [fx, cx, cy]), ("SIMPLE_RADIAL", [fx, cx, cy, 0.0])]
        )
        fy = fy if model == "PINHOLE" else fx
        cameras.append(f"{k + 1} {model} {width} {height} {' '.join(f'{v:.12g}' for v in values)}")
        name = rng.choice((f"{k}.png", f"a b {k}.png", f"ü/{k}.png"))
        opencv = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        view = np.linalg.inv(opencv)
        x, y, z, w = Rotation.from_matrix(view[:3, :3]).as_quat()
        numbers = " ".join(f"{v:.15g}" for v in (w, x, y, z, *view[:3, 3]))
        rows.append(f"{k + 1} {numbers} {k + 1} {name}")
        files[f"images/{name}"] = rgba(rng, width, height)
        ground_truth[name] = ([fx, fy, cx, cy], pose)
    points = rng.choice(["empty", "some", "none"])
    line = {"empty": [""], "some": ["10.5 11.25 7 20 21 -1"], "none": []}[points]
    end, bom = rng.choice(["\n", "\r\n"]), rng.choice(["", "\ufeff"])
    head = ["# Image list", "#   IMAGE_ID, QW, ..."] if rng.random() < 0.5 else []

    def text(lines: list[str]) -> bytes:
        blank = [""] if points == "none" and rng.random() < 0.5 else []
        return (bom + end.join([*head, *lines, *blank]) + end).encode()

    small = rng.choice([None, "0", "2"])
    for place, kept in ((("1" if small else "0"), rows), *([(small, rows[:2])] if small else [])):
        files[f"sparse/{place}/cameras.txt"] = text(cameras)
        files[f"sparse/{place}/images.txt"] = text([part for row in kept for part in (row, *line)])
        files[f"sparse/{place}/points3D.txt"] = b""
    return Case(files, lambda f: check_cameras(f, ground_truth), must_read=True)


def benchmarks(rng: Random) -> Case:
    """The field's benchmark folders: NeRF-synthetic splits, LLFF, NeuS."""
    width, height, count = 64, 48, 5
    fx = rng.uniform(50, 120)
    values, poses = [fx, fx, width / 2, height / 2], rotations(rng, count)
    files, ground_truth, least = {}, {}, count
    form = rng.choice(["splits", "llff", "neus"])
    if form == "splits":
        for split, some in (("train", poses[:3]), ("val", poses[3:4]), ("test", poses[4:])):
            frames = []
            for k, pose in enumerate(some):
                files[f"{split}/r_{k}.png"] = rgba(rng, width, height)
                frames.append(frame_of(f"./{split}/r_{k}", pose))
                for name in (f"{split}/r_{k}", f"./{split}/r_{k}", f"{split}/r_{k}.png"):
                    ground_truth[name] = (values, pose)
            files[f"transforms_{split}.json"] = transforms(frames, camera_angle_x=2 * math.atan(0.5 * width / fx))
        least = 3
    elif form == "llff":
        rows = []
        for k, pose in enumerate(poses):
            files[f"images/{k:03d}.png"], ground_truth[f"images/{k:03d}.png"] = rgba(rng, width, height), (values, pose)
            axes = np.stack([-pose[:3, 1], pose[:3, 0], pose[:3, 2], pose[:3, 3], [height, width, fx]], -1)
            rows.append([*axes.ravel(), 1.0, 4.0])
        files["poses_bounds.npy"] = saved(np.save, np.array(rows))
    else:
        arrays, scale = {}, np.diag([1.5, 1.5, 1.5, 1.0])
        scale[:3, 3] = [rng.uniform(-0.2, 0.2) for _ in range(3)]
        k3 = np.array([[fx, 0.0, (width - 1) / 2], [0.0, fx, (height - 1) / 2], [0.0, 0.0, 1.0]])  # as NeuS writes it
        for k, pose in enumerate(poses):
            name = f"image/{k:03d}.png"
            files[name] = rgba(rng, width, height)
            world = pose.copy()  # in the frame of the unit sphere; the file's world is scaled from it
            view = np.linalg.inv(world @ np.diag([1.0, -1.0, -1.0, 1.0]))
            projection = np.eye(4)
            projection[:3] = k3 @ view[:3]
            arrays[f"world_mat_{k}"] = rng.uniform(0.5, 2.0) * projection @ np.linalg.inv(scale)
            arrays[f"scale_mat_{k}"] = scale
            ground_truth[name] = (values, pose)
        files["cameras_sphere.npz"] = saved(np.savez, **arrays)
    return Case(files, lambda f: check_cameras(f, ground_truth, 1e-3, least), must_read=True)


def saved(write: Callable, *values, **named) -> bytes:
    data = io.BytesIO()
    write(data, *values, **named)
    return data.getvalue()


REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
PRIMARIES = {
    "none": None,
    "Rec. 709": REC709,
    "Rec. 2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290),
    "P3-D65": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290),
}


def to_xyz(c) -> np.ndarray:
    """Linear RGB of chromaticities ``rx ry gx gy bx by wx wy`` to XYZ (SMPTE RP 177)."""
    columns = np.array([[x / y, 1.0, (1 - x - y) / y] for x, y in zip(c[::2], c[1::2], strict=True)]).T
    return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3])


def exr(rng: Random) -> Case:
    """OpenEXR as its own library writes it: windows, primaries, kinds of pixels, compression."""
    height, width = rng.choice((8, 16)), 32
    space = rng.choice(list(PRIMARIES))
    pixels = np.random.default_rng(rng.getrandbits(32)).uniform(0.5, 2.0, (height, width, 3)).astype(np.float32)
    kind = rng.choice([np.float16, np.float32])
    pixels = pixels.astype(kind)
    x, y = rng.randrange(-4, 5), rng.randrange(-4, 5)
    display = rng.choice(["same", "larger"])
    data = ((x, y), (x + width - 1, y + height - 1))
    pad = (rng.randrange(6), rng.randrange(6), rng.randrange(6), rng.randrange(6)) if display == "larger" else (0,) * 4
    shown = ((x - pad[0], y - pad[1]), (x + width - 1 + pad[2], y + height - 1 + pad[3]))
    header = {
        "compression": rng.choice([OpenEXR.NO_COMPRESSION, OpenEXR.ZIP_COMPRESSION, OpenEXR.RLE_COMPRESSION]),
        "type": OpenEXR.scanlineimage,
        "dataWindow": tuple(np.array(v, np.int32) for v in data),
        "displayWindow": tuple(np.array(v, np.int32) for v in shown),
    }
    if PRIMARIES[space]:
        header["chromaticities"] = PRIMARIES[space]
    channels = {"RGB": pixels} if rng.random() < 0.5 else {c: pixels[..., k].copy() for k, c in enumerate("RGB")}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        OpenEXR.File(header, channels).write(str(path))
        content = path.read_bytes()
    matrix = np.linalg.solve(to_xyz(REC709), to_xyz(PRIMARIES[space] or REC709))
    ground_truth = np.zeros((height + pad[1] + pad[3], width + pad[0] + pad[2], 3))
    ground_truth[pad[1] : pad[1] + height, pad[0] : pad[0] + width] = pixels.astype(np.float64) @ matrix.T
    ground_truth = ground_truth.clip(min=0.0)

    def read(folder: Path) -> None:
        compare_image(read_hdr_image(folder / "a.exr").numpy(), ground_truth, 2e-4)

    return Case({"a.exr": content}, read)


def compare_image(got: np.ndarray, ground_truth: np.ndarray, relative: float) -> None:
    check(got.shape == ground_truth.shape, f"shape {got.shape}, not {ground_truth.shape}")
    error = np.abs(got - ground_truth).max() / ground_truth.max()
    check(error <= relative, f"values differ by {error:.2g} of the largest")


def rgbe(rng: Random) -> Case:
    """Radiance RGBE: flat, new and old run lengths, a first pixel like a marker, exposures."""
    width, height = 32, 16
    numbers = np.random.default_rng(rng.getrandbits(32))
    pixels = numbers.integers(128, 256, (height, width, 4), dtype=np.uint8)
    pixels[..., 3] = numbers.integers(127, 130, (height, width))
    form = rng.choice(["flat", "marker", "new", "old"])
    body = b""
    if form == "marker":
        pixels[0, 0] = (2, 2, rng.randrange(128, 256), 129)
    if form == "old":  # runs of one pixel: 1 1 1 count
        pixels[:, 8:20] = pixels[:, 8:9]
        body = b"".join(
            bytes(row[:9]) + bytes((1, 1, 1, 11)) + bytes(row[20:]) for row in (p.reshape(-1, 4) for p in pixels)
        )
    elif form == "new":
        for row in pixels:
            body += bytes((2, 2, width >> 8, width & 255))
            body += b"".join(bytes((width,)) + bytes(row[:, k]) for k in range(4))
    else:
        body = pixels.tobytes()
    exposures = [rng.choice((0.5, 2.0, 3.0)) for _ in range(rng.choice((0, 0, 1, 2)))]
    lines = ["#?RADIANCE", "# made by a test", "FORMAT=32-bit_rle_rgbe", *(f"EXPOSURE={v}" for v in exposures), "", ""]
    content = "\n".join(lines).encode() + f"-Y {height} +X {width}\n".encode() + body
    exponent = np.exp2(pixels[..., 3:].astype(np.float64) - 136)
    ground_truth = (pixels[..., :3] + 0.5) * exponent / math.prod(exposures)

    def read(folder: Path) -> None:  # readers add one half to the mantissa or none: half of 1/128 of the largest
        compare_image(read_hdr_image(folder / "a.hdr").numpy(), ground_truth, 0.5 / 128)

    return Case({"a.hdr": content}, read, must_read=form in ("flat", "new", "marker"))


def gltf(rng: Random) -> Case:
    """A textured quad: see ``known_gltf``."""
    content, look = known_gltf.quad(rng)

    def read(folder: Path) -> None:
        notes: list[str] = []
        known_gltf.compare(read_glb(folder / "a.glb", notes=notes), look, notes)

    return Case({"a.glb": content}, read, must_refuse=look.refused, must_read=look.plain)


KINDS: dict[str, Callable[[Random], Case]] = {
    "known masks": masks,
    "known names": names,
    "known lens": lens,
    "known colmap": colmap,
    "known benchmarks": benchmarks,
    "known exr": exr,
    "known rgbe": rgbe,
    "known gltf": gltf,
}
