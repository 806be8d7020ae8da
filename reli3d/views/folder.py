"""A folder of posed photographs -> Views.

Read are: an object folder as published (``transforms.json`` with per-frame ``camera_fov``), a Blender or nerfstudio
``transforms.json``, and a COLMAP model (``sparse/0`` beside ``images``).  The object is separated from the background
by the images' alpha, by ``mask_path``, or by a ``masks`` folder with a file of the same stem for each image.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageChops
from torch import Tensor

from reli3d._bridge import present
from reli3d.io.files import InputError, shown
from reli3d.io.images import above, colour, read_picture, unit
from reli3d.views.advice import no_cameras
from reli3d.views.background import Remover
from reli3d.views.choose import NEAR, choose_views, spread_notes
from reli3d.views.colmap import find_colmap, read_colmap
from reli3d.views.normalize import near_origin
from reli3d.views.reduce import LARGE, OBJECT, cut
from reli3d.views.shots import Lens, Shot, inside, straight
from reli3d.views.transforms import read_transforms
from reli3d.views.views import MASK_EDGE, Views

MAX_VIEWS = 16
MIN_SIDE = 8  # pixels; below it there is nothing to see, and a mistake is likely
MIN_OBJECT = 16  # pixels of the mask
ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".PNG", ".JPG", ".JPEG")
ASPECT = 0.01  # relative difference of the image's aspect and the camera's up to which the intrinsics are rescaled


def load_views(
    folder: str | os.PathLike,
    *,
    views: int | None = None,
    first_views: int | None = None,
    masks: str | os.PathLike | None = None,
    allow_outside: bool = False,
    every: bool = False,
    whole: bool = False,
    remove_background: bool = False,
) -> Views:
    """Photographs of an object folder, with their cameras and masks, in the order of the folder.

    views: how many, farthest apart, the first among them.  first_views: how many from the beginning.  Neither: all,
    at most 16.  every: all; :meth:`Views.taken` are those without it.  masks: folder of masks with the images' stems;
    else ``mask_path`` of a frame, alpha, or a folder ``masks`` or ``mask``, in this order.  allow_outside: the camera
    file may name images outside ``folder``.  whole: keep all of photographs of more than two megapixels, scaled to
    two, not the object alone at 768 pixels.  remove_background: masks by ``rembg`` (extra ``masks``) where there are
    none; may download.

    Cameras far from their origin are moved by ``-origin``.  Raises InputError, one line.

    >>> views = reli3d.load_views("photos/shoe", views=4)
    >>> notes = views.notes
    """
    for name, value in (("views", views), ("first_views", first_views)):
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MAX_VIEWS):
            raise InputError(name, f"expected 1 to {MAX_VIEWS}, got {value!r}; give a number in that range")
    if views is not None and first_views is not None:
        raise InputError("views", "expected views or first_views, got both; give one of them")
    root = Path(folder)
    try:
        is_folder = root.is_dir()
    except (OSError, ValueError):
        is_folder = False
    if not is_folder:
        raise InputError(folder, "expected a folder with transforms.json or a COLMAP model; check the path")
    if masks is not None and not Path(masks).is_dir():
        raise InputError(masks, "masks: expected a folder of mask images, got none; check the path")
    system = None
    if (root / "transforms.json").exists() or (root / "transforms.json").is_symlink():
        cameras = inside(root, str(root), "transforms.json", "transforms.json", outside=allow_outside)
        shots, notes, system = read_transforms(cameras, outside=allow_outside)
    else:
        model = find_colmap(root)
        if model is None:
            raise no_cameras(root)
        shots, notes = read_colmap(root, model, outside=allow_outside)
    offered = len(shots)
    origin, moved = _origin(shots, folder)
    notes += moved
    taken, choice = _chosen(shots, views, first_views)
    shots = shots if every else [shots[i] for i in taken]
    notes += choice + [note for shot in shots for note in shot.notes]
    remover = Remover() if remove_background else None
    # decoding releases the GIL; torch is not used there, as each of these threads would start threads of its own
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        loaded = list(pool.map(lambda shot: _load(root, shot, masks, allow_outside, whole, remover), shots))
    notes += [note for *_, found, _ in loaded for note in found]
    if reduced := sum(smaller for *_, smaller in loaded):
        kept = f"scaled down to {LARGE} pixels" if whole else f"cut to the object, at most {OBJECT} pixels of it"
        notes.append(f"{reduced} of {len(loaded)} photographs have more than {LARGE} pixels: {kept}")
    if remover and remover.masks:
        notes.append(f"{remover.masks} of {len(loaded)} masks made by rembg ({remover.network})")
    return Views(
        images=tuple(image for image, *_ in loaded),
        masks=tuple(mask for _, mask, *_ in loaded),
        c2w=_poses(shots, origin),
        intrinsics=torch.tensor([k for _, _, k, *_ in loaded], dtype=torch.float32),
        names=tuple(s.name for s in shots),
        notes=tuple(dict.fromkeys(notes)),
        coordinate_system=system,
        in_folder=offered,
        chosen=tuple(taken) if every else None,
        origin=origin,
    )


def _origin(shots: list[Shot], folder) -> tuple[tuple[float, float, float], list[str]]:
    """Where the frame of the views begins, in the folder's, and a note where that is elsewhere."""
    try:
        at = tuple(near_origin(torch.from_numpy(np.stack([s.c2w for s in shots]))).tolist())
    except ValueError as error:
        raise InputError(folder, str(error)) from None
    place = ", ".join(f"{v:.6g}" for v in at)
    return at, [f"the cameras are far from their origin: work is done about ({place})"] if any(at) else []


def _poses(shots: list[Shot], origin: tuple[float, float, float]) -> Tensor:
    poses = np.stack([s.c2w for s in shots])
    poses[:, :3, 3] -= origin
    return torch.from_numpy(poses.astype(np.float32))


def _chosen(shots: list[Shot], views: int | None, first_views: int | None) -> tuple[list[int], list[str]]:
    """Indices of the shots for a network, and notes on the choice and on how they lie."""
    poses, count, notes = torch.from_numpy(np.stack([s.c2w for s in shots])), len(shots), []
    if first_views is not None:
        taken = list(range(min(first_views, count)))
    elif views is not None or count > MAX_VIEWS:
        taken = choose_views(poses, views or MAX_VIEWS, apart=0.0 if views else NEAR)
        if len(taken) < count:
            names = ", ".join(str(i) for i in taken)
            notes.append(
                f"{len(taken)} of {count} views taken, farthest apart in direction and distance: {names}; "
                "--first-views N takes the first N"
            )
    else:
        taken = list(range(count))
    return taken, notes + spread_notes(poses[taken])


def _load(
    root: Path, shot: Shot, masks, outside: bool, whole: bool, remover: Remover | None
) -> tuple[Tensor, Tensor, list[float], list[str], bool]:
    """Image, mask, intrinsics and notes of one shot, and whether less than the whole picture is kept."""
    notes: list[str] = []
    path = _existing(shot.image)
    if path is None:
        raise InputError(
            shot.where,
            f"file_path: expected an image, got {shown(shot.name)} which does not exist; "
            "paths are relative to the camera file and use /",
        )
    _still_inside(root, path, shot, outside)
    picture = read_picture(path, notes=notes, calibrated=shot.lens.size)
    width, height = picture.size
    if min(height, width) < MIN_SIDE:
        raise InputError(
            path, f"expected at least {MIN_SIDE} pixels a side, got {width} x {height}; give a larger image"
        )
    mask = _mask(root, shot, path, picture, masks, notes, outside, remover)
    if mask.size != (width, height):
        got = f"{mask.size[0]} x {mask.size[1]}"
        raise InputError(
            path, f"mask: expected {width} x {height} pixels as the image, got {got}; save it at that size"
        )
    if int(above(mask, 0.5).sum()) < MIN_OBJECT:
        raise InputError(
            path,
            "mask: expected the object to be opaque (white), got a mask that is empty; "
            "check that it is neither blank nor inverted",
        )
    camera = intrinsics_of(shot.lens, width, height, shot.where, notes)
    part = cut(picture.size, above(mask, MASK_EDGE), whole=whole)
    if part is not None:
        picture, mask, camera = part.pixels(picture), part.pixels(mask), part.intrinsics(camera)
    image, share = colour(picture), unit(mask)
    if looks_premultiplied(image.numpy(), share):
        notes.append(f"{path.name}: the colour looks multiplied by alpha, edges will be dark; save straight alpha")
    return image, torch.from_numpy(share), camera, notes, part is not None


def looks_premultiplied(image: np.ndarray, mask: np.ndarray) -> bool:
    """Whether no edge pixel of ``image (H, W, 3)`` is brighter than its alpha, and only black lies outside.

    Of a straight image with a bright object the faint edge pixels are brighter than their alpha.
    """
    if (image[::8, ::8].max(-1)[mask[::8, ::8] < 0.02] > 0.02).any():  # a background: the usual case, seen by a few
        return False
    edge = mask > 0.02
    if not (edge & (mask < 0.5)).any():  # a binary mask
        return False
    value, opaque = image.max(-1), mask > 0.98
    bright = float(np.median(value[opaque])) if opaque.any() else 0.0
    faint = edge & (mask < 0.5 * bright)
    if int(faint.sum()) < MIN_OBJECT or bool((value[mask < 0.02] > 0.02).any()):
        return False
    return bool((value[faint] <= mask[faint] + 1 / 255).all())  # both are rounded to 8 bits


def _mask(
    root: Path,
    shot: Shot,
    path: Path,
    picture: Image.Image,
    masks,
    notes: list[str],
    outside: bool,
    remover: Remover | None,
) -> Image.Image:
    """The mask of a shot in full size, of mode L or F."""
    if masks is not None:
        found = _beside(Path(masks), path)
        if found is None:
            raise InputError(masks, f"masks: expected a file with the stem of {shown(path.name)}, got none; add it")
        return _grey(found, notes, shot.lens.size)
    if shot.mask is not None:
        found = _existing(shot.mask)
        if found is None:
            raise InputError(
                shot.where,
                f"mask_path: expected an image, got {shown(shot.mask.name)} which does not exist; correct the path",
            )
        _still_inside(root, found, shot, outside)
        return _grey(found, notes, shot.lens.size)
    alpha = _alpha(picture)
    if alpha is not None:
        return alpha
    for name in ("masks", "mask"):
        found = _beside(root / name, path)
        if found is not None:
            _still_inside(root, found, shot, outside)
            return _grey(found, notes, shot.lens.size)
    if remover is not None:
        return remover.mask(picture)
    got = "alpha that is opaque everywhere" if picture.mode == "RGBA" else "no alpha"
    raise InputError(
        path,
        f"expected alpha or a mask that tells the object from the background, got {got}; save RGBA "
        "images, put white-on-black masks of the same names into a folder 'masks', or give "
        "--remove-background",
    )


def _alpha(picture: Image.Image) -> Image.Image | None:
    """The alpha of a picture that has one which is used."""
    alpha = picture.getchannel("A") if picture.mode == "RGBA" else None
    if alpha is None:
        return None
    return alpha if np.asarray(alpha).min() < 128 else None


def _grey(path: Path, notes: list[str], calibrated: tuple[int, int] | None) -> Image.Image:
    """A mask file as grey: its alpha where that is used, else its brightest channel."""
    picture = read_picture(path, notes=notes, calibrated=calibrated)
    if picture.mode in ("L", "F"):
        return picture
    red, green, blue, *_ = picture.split()
    return _alpha(picture) or ImageChops.lighter(ImageChops.lighter(red, green), blue)


def _existing(path: Path) -> Path | None:
    """``path``, or ``path`` with the ending of an image that exists (Blender's exporter leaves it out)."""
    try:
        for candidate in (path, *(path.with_name(path.name + ending) for ending in ENDINGS)):
            if candidate.is_file():
                return candidate
        return path if path.exists() else None
    except (OSError, ValueError):
        return None


def _beside(folder: Path, image: Path) -> Path | None:
    """The mask of ``image`` in ``folder``: the same stem or the full name (COLMAP), with the ending of an image."""
    names = (image.name, *(stem + ending for stem in (image.stem, image.name) for ending in ENDINGS))
    return next(
        (folder / name for name in names if os.path.isfile(folder / name)), None
    )  # False, too, for a name too long


def _still_inside(root: Path, path: Path, shot: Shot, outside: bool) -> None:
    if not outside and not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(root)):
        raise InputError(
            shot.where,
            f"file_path: expected a file within the folder, got {shown(path.name)} which "
            "links out of it; copy the file in",
        )


def intrinsics_of(lens: Lens, width: int, height: int, where: str, notes: list[str]) -> list[float]:
    """``[fx, fy, cx, cy]`` in pixels of the stored image of ``width`` x ``height``.

    A camera calibrated at another size of the same aspect is scaled, with a note; InputError if the aspects differ.
    """
    sx = sy = 1.0
    if lens.size is not None and lens.size != (width, height):
        sx, sy = width / lens.size[0], height / lens.size[1]
        if abs(sx / sy - 1.0) > ASPECT:
            raise InputError(
                where,
                f"w, h: expected the image's size {width} x {height}, got {lens.size[0]} x "
                f"{lens.size[1]}; calibrate on these images",
            )
        notes.append(f"{where}: intrinsics scaled from {lens.size[0]} x {lens.size[1]} to {width} x {height}")
    if lens.focal is not None:
        fx, fy = lens.focal[0] * sx, lens.focal[1] * sy
    else:
        across, upright = present("lens.fov", lens.fov)
        fx = 0.5 * width / math.tan(0.5 * across)
        fy = fx if math.isnan(upright) else 0.5 * height / math.tan(0.5 * upright)
    note = straight(where, lens, fx, width, height)
    notes.extend([note] if note else [])
    cx, cy = (0.5 * width, 0.5 * height) if lens.centre is None else (lens.centre[0] * sx, lens.centre[1] * sy)
    for name, value, side in (("cx", cx, width), ("cy", cy, height)):
        if not -side < value < 2 * side:
            raise InputError(
                where,
                f"{name}: expected a principal point near the image of {side} pixels, got "
                f"{value:.6g}; "
                "give pixels of the stored image",
            )
    if min(fx / width, fy / height) < 0.05 or max(fx / width, fy / height) > 1000:
        raise InputError(
            where,
            f"focal length: expected 0.05 to 1000 image sides, got {fx:.6g} pixels for {width}; "
            "give pixels (or radians for an angle)",
        )
    return [fx, fy, cx, cy]
