"""Reads a folder of posed photographs as :class:`~reli3d.views.views.Views`."""

import itertools
import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path, PurePath

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from reli3d._bridge import full_precision, present
from reli3d.errors import InputError, printable, shown
from reli3d.io.images import ASPECT, above, color_of, decode_image, exposure, unit
from reli3d.views.array_cameras import NEUS, read_llff, read_neus
from reli3d.views.background import Remover
from reli3d.views.choose import DUPLICATE_DISTANCE_RAD, choose_views, spread_notes
from reli3d.views.colmap import find_colmap, read_colmap
from reli3d.views.exposure import equalize
from reli3d.views.file_names import ENDINGS, FolderIndex
from reli3d.views.frames import Frame, Lens, check_distortion, file_within, is_within
from reli3d.views.masks import MaskFiles, alpha_values, check_one_label, mask_values
from reli3d.views.missing_cameras import no_cameras
from reli3d.views.normalize import near_origin
from reli3d.views.reduce import MAX_FULL_PIXELS, MAX_OBJECT_PIXELS, cut
from reli3d.views.transforms import read_transforms
from reli3d.views.views import LEAST_WHOLE, MASK_EDGE, Views, touches_border

MAX_VIEWS = 16
MIN_SIDE = 8  # pixels; below it there is nothing to see, and a mistake is likely
MIN_OBJECT = 16  # pixels of the mask
SPLITS = tuple(f"transforms_{name}.json" for name in ("train", "val", "test"))  # of NeRF-synthetic


@full_precision
def load_views(
    folder: str | os.PathLike,
    *,
    views: int | None = None,
    masks: str | os.PathLike | None = None,
    every: bool = False,
    whole: bool = False,
    remove_background: bool = False,
) -> Views:
    """Reads the images of an object folder with cameras and masks, in folder order.

    folder: with ``transforms.json`` (or NeRF-synthetic's splits), a COLMAP model, LLFF's ``poses_bounds.npy``, or IDR's
    and NeuS's ``cameras_sphere.npz``.
    views: number of views, 1 to 16, by farthest-point sampling, the default above 16.  every: all views;
    :meth:`Views.taken` selects later.  masks: folder; None: ``mask_path`` of a frame, alpha, or a folder ``masks`` or
    ``mask``.  whole: downsample images above two megapixels instead of cropping to the object.  remove_background:
    compute missing masks with ``rembg`` (extra ``masks``, downloads its network).

    Cameras far from the world origin are translated by ``-Views.origin``.  Raises InputError: file, field, value, fix.

    >>> views = reli3d.load_views("photos/shoe", views=4)
    >>> notes = views.notes
    """
    if views is not None and (isinstance(views, bool) or not isinstance(views, int) or not 1 <= views <= MAX_VIEWS):
        raise InputError("views", f"expected 1 to {MAX_VIEWS}, got {views!r}; give a number in that range")
    root = Path(folder)
    if not os.path.isdir(root):
        raise no_cameras(root)
    if masks is not None and not Path(masks).is_dir():
        raise InputError(masks, "masks: expected a folder of mask images, got none; check the path")
    frames, notes = _read_cameras(root)
    index = FolderIndex()
    frames = [
        replace(f, image=_existing(root, f.image, index), mask=f.mask and _existing(root, f.mask, index))
        for f in frames
    ]
    _check_poses(frames)
    files = MaskFiles(root, frames, None if masks is None else Path(masks))
    offered, names = len(frames), [frame.name for frame in frames]
    origin, moved = _origin(frames, folder)
    notes += moved
    remover = Remover() if remove_background else None
    read: dict[int, tuple[Tensor, Tensor, list[float], float | None, list[str], bool]] = {}
    usable = list(range(len(frames)))  # for the choice: not those whose mask touches the border
    while True:
        taken, choice = _chosen(frames, usable, views)
        kept = list(range(len(frames))) if every else taken
        missing = [i for i in kept if i not in read]
        # decoding releases the GIL; torch is not used there, as each of these threads would start threads of its own
        with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
            read |= zip(missing, pool.map(lambda i: _load(root, frames[i], files, whole, remover), missing))
        cut_off = [i for i in sorted(read) if touches_border(read[i][1])]
        others = [i for i in usable if i not in cut_off]
        if len(others) == len(usable) or len(others) < LEAST_WHOLE and len(usable) == len(frames):
            break
        usable = others if len(others) >= LEAST_WHOLE else list(range(len(frames)))
    frames, loaded = [frames[i] for i in kept], [read[i] for i in kept]
    notes += choice + _grouped([(f, note) for f in frames for note in f.notes], len(frames))
    notes += _cut_off(names, cut_off, usable)
    notes += _grouped([(f, note) for f, (*_, found, _) in zip(frames, loaded) for note in found], len(frames))
    check_one_label(root, notes)
    if reduced := sum(smaller for *_, smaller in loaded):
        part = f"scaled down to {MAX_FULL_PIXELS} pixels"
        if not whole:
            part = f"cut to the object, at most {MAX_OBJECT_PIXELS} pixels of it"
        notes.append(f"{reduced} of {len(loaded)} photographs have more than {MAX_FULL_PIXELS} pixels: {part}")
    if remover and remover.masks:
        notes.append(f"{remover.masks} of {len(loaded)} masks made by rembg ({remover.network})")
    images, masks_of, intrinsics, exposures = zip(*(values[:4] for values in loaded), strict=True)
    notes += equalize(images, masks_of, exposures)
    poses, box = np.stack([f.c2w for f in frames]), frames[0].object_box
    poses[:, :3, 3] -= origin
    return Views(
        images=images,
        masks=masks_of,
        c2w=torch.from_numpy(poses.astype(np.float32)),
        intrinsics=torch.tensor(intrinsics, dtype=torch.float32, device="cpu"),
        names=tuple(f.name for f in frames),
        notes=tuple(dict.fromkeys(notes)),
        in_folder=offered,
        chosen=tuple(taken) if every else None,
        origin=origin,
        lighting=frames[0].lighting,
        object_box=box and tuple(tuple(a - b for a, b in zip(corner, origin)) for corner in box),
    )


def _grouped(notes: list[tuple[Frame, str]], total: int) -> list[str]:
    """One of those notes that differ only in the frame, with their number."""
    groups: dict[str, dict[str, str]] = {}
    for frame, note in notes:
        text = note.removeprefix(frame.where)
        text = text.partition(": ")[2] if text.startswith(frame.image.stem) else text
        groups.setdefault(text, {}).setdefault(frame.name, note)  # a mask often has the note of its image
    first = [(next(iter(group.values())), len(group)) for group in groups.values()]
    return [note if count == 1 else f"{note}; {count} of {total} such images" for note, count in first]


def _read_cameras(root: Path) -> tuple[list[Frame], list[str]]:
    """Frames and notes of the first form of cameras in ``root``; a note names it where it is not the only one."""
    forms = [name for name in ("transforms.json", *SPLITS) if os.path.lexists(root / name)]
    models = find_colmap(root)
    forms += [models[0].parent.relative_to(root).as_posix() + " (COLMAP)"] if models else []
    forms += [name for name in ("poses_bounds.npy", *NEUS) if os.path.lexists(root / name)]
    if not forms:
        raise no_cameras(root)
    used = forms[0]
    if used.endswith(".json"):
        frames, notes = read_transforms(file_within(root, str(root), used, used))
    elif models:
        frames, notes = read_colmap(root, models)
    else:
        path = file_within(root, str(root), used, used)
        frames, notes = (read_llff if used == "poses_bounds.npy" else read_neus)(root, path)
    if len(forms) > 1 or used != "transforms.json" and not models:
        others = f"; not read: {', '.join(forms[1:])}" if len(forms) > 1 else ""
        notes.insert(0, f"cameras of {len(frames)} images from {used}{others}")
    return frames, notes


def _check_poses(frames: list[Frame]) -> None:
    """Raises InputError where two frames have the same image with different poses."""
    first: dict[str, Frame] = {}
    for frame in frames:
        other = first.setdefault(os.path.realpath(frame.image), frame)
        if not np.allclose(other.c2w, frame.c2w):
            got = f"another for {shown(frame.name)} than {other.where} has for the same file"
            raise InputError(frame.where, f"pose: expected one for each image, got {got}; remove one of them")


def _origin(frames: list[Frame], folder) -> tuple[tuple[float, float, float], list[str]]:
    """Where the frame of the views begins, in the folder's, and a note where that is elsewhere."""
    try:
        at = tuple(near_origin(torch.from_numpy(np.stack([f.c2w for f in frames]))).tolist())
    except InputError as error:
        raise InputError(folder, str(error)) from None
    place = ", ".join(f"{v:.6g}" for v in at)
    return at, [f"the cameras are far from their origin: work is done about ({place})"] if any(at) else []


def _chosen(frames: list[Frame], usable: list[int], views: int | None) -> tuple[list[int], list[str]]:
    """Indices of the frames for a network, of those in ``usable``, and notes on the choice and on how they lie."""
    poses, count, notes = torch.from_numpy(np.stack([frames[i].c2w for i in usable])), len(usable), []
    if views is not None or count > MAX_VIEWS:
        taken = choose_views(poses, views or MAX_VIEWS, min_distance=0.0 if views else DUPLICATE_DISTANCE_RAD)
        if len(taken) < count:
            indices = ", ".join(str(usable[i]) for i in taken)
            notes.append(f"{len(taken)} of {len(frames)} views taken by farthest-point sampling: {indices}")
    else:
        taken = list(range(count))
    return [usable[i] for i in taken], notes + spread_notes(poses[taken])


def _cut_off(names: list[str], cut_off: list[int], usable: list[int]) -> list[str]:
    """Notes on the views whose mask touches the border: those left out, and those that are used all the same."""
    notes = []
    for left_out, what in ((True, "left out of the hull and of the choice of views"), (False, "used all the same")):
        which = [i for i in cut_off if (i not in usable) == left_out]
        if which:
            some = ", ".join(f"{i} ({printable(names[i])})" for i in which[:4]) + (", ..." if len(which) > 4 else "")
            notes.append(f"{len(which)} masks touch the image's border, where the object is cut off: {some}; {what}")
    return notes


def _load(
    root: Path, frame: Frame, files: MaskFiles, whole: bool, remover: Remover | None
) -> tuple[Tensor, Tensor, list[float], float | None, list[str], bool]:
    """Image, mask, intrinsics, exposure and notes of one frame, and whether less than the whole image is kept."""
    notes: list[str] = []
    path = frame.image
    if not os.path.exists(path):
        got = f"{shown(frame.name)} which does not exist"
        fix = "paths are relative to the camera file and use /"
        raise InputError(frame.where, f"file_path: expected an image, got {got}; {fix}")
    _still_inside(root, path, frame, "file_path")
    bitmap = decode_image(path, notes=notes, calibrated=frame.lens.size)
    width, height = bitmap.size
    if min(height, width) < MIN_SIDE:
        raise InputError(path, f"expected at least {MIN_SIDE} pixels a side, got {width} x {height}; scale it up")
    mask = _mask(root, frame, bitmap, files, notes, remover)
    if mask.size != (width, height):
        got = f"{mask.size[0]} x {mask.size[1]}"
        raise InputError(path, f"mask: expected the image's {width} x {height} pixels, got {got}; save it at that size")
    _not_empty(mask, path)
    camera = intrinsics_of(frame.lens, width, height, frame.where, notes)
    part = cut(bitmap.size, above(mask, MASK_EDGE), whole=whole)
    if part is not None:
        bitmap, mask, camera = part.pixels(bitmap), part.pixels(mask), part.intrinsics(camera)
        _not_empty(mask, path)  # isolated pixels vanish in a smaller image
    image, alpha = color_of(bitmap), unit(mask)
    if looks_premultiplied(image.numpy(), alpha):
        notes.append(f"{path.name}: the color looks multiplied by alpha, edges will be dark; save straight alpha")
    return image, torch.from_numpy(alpha), camera, exposure(path), notes, part is not None


def _not_empty(mask: Image.Image, path: Path) -> None:
    if int(above(mask, 0.5).sum()) < MIN_OBJECT:
        expected = "expected the object to be opaque (white), got a mask that is empty"
        raise InputError(path, f"mask: {expected}; check that it is neither blank nor inverted")


def looks_premultiplied(image: np.ndarray, mask: np.ndarray) -> bool:
    """Whether no edge pixel of ``image (H, W, 3)`` is brighter than its alpha, and only black lies outside.

    In an image with straight alpha and a bright object, faint edge pixels are brighter than their alpha.
    """
    if (image[::8, ::8].max(-1)[mask[::8, ::8] < 0.02] > 0.02).any():  # a background: the usual case, found in a few
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
    root: Path, frame: Frame, bitmap: Image.Image, files: MaskFiles, notes: list[str], remover: Remover | None
) -> Image.Image:
    """The mask of a frame in full size, of mode L or F."""
    alpha = None if files.given or frame.mask is not None else alpha_values(bitmap, notes)
    if alpha is not None:
        return alpha
    found = files.of(frame)
    if found is not None:
        if not os.path.exists(found):
            got = f"{shown(os.path.relpath(found, root))}, which does not exist"
            raise InputError(frame.where, f"mask_path: expected an image, got {got}; correct the path")
        if files.given is None:
            _still_inside(root, found, frame, "mask")
        return mask_values(found, decode_image(found, notes=notes, calibrated=frame.lens.size), notes)
    if files.given is not None:
        expected = f"expected a file with the stem of {shown(frame.image.name)}"
        raise InputError(files.given, f"masks: {expected}, got none; add it")
    if remover is not None:
        return remover.mask(bitmap)
    got = "alpha that is opaque everywhere" if bitmap.mode == "RGBA" else "no alpha"
    fix = "save RGBA images, put white-on-black masks of the same names (and sub-folders) into a folder 'masks'"
    problem = f"expected alpha or a foreground mask, got {got}"
    raise InputError(frame.image, f"{problem}; {fix}, or give --remove-background")


def _existing(root: Path, path: Path, index: FolderIndex) -> Path:
    """``path``, or that with the ending of an image (Blender's exporter leaves it out), or with other cases."""
    candidates = [path.with_name(path.name + ending) for ending in ("", *ENDINGS)] if path.name else [path]
    below = os.path.relpath(path.parent, root)
    others = (index.find(root, PurePath(os.path.normpath(os.path.join(below, c.name)))) for c in candidates)
    return next((p for p in itertools.chain(candidates, others) if p is not None and os.path.isfile(p)), path)


def _still_inside(root: Path, path: Path, frame: Frame, field: str) -> None:
    if not is_within(root, path):
        got = f"{shown(path.name)} which links out of it"
        raise InputError(frame.where, f"{field}: expected a file within the folder, got {got}; copy the file in")


def intrinsics_of(lens: Lens, width: int, height: int, where: str, notes: list[str]) -> list[float]:
    """``[fx, fy, cx, cy]`` in pixels of the stored image of ``width`` x ``height``.

    A camera calibrated at another image size is scaled, with a note; raises InputError if the aspect ratios differ.
    """
    sx = sy = 1.0
    if lens.size is not None and lens.size != (width, height):
        sx, sy = width / lens.size[0], height / lens.size[1]
        given = f"{lens.size[0]} x {lens.size[1]}"
        if abs(sx / sy - 1.0) > ASPECT:
            expected = f"expected the image's size {width} x {height}, got {given}"
            raise InputError(where, f"w, h: {expected}; calibrate on these images")
        notes.append(f"{where}: intrinsics scaled from {given} to {width} x {height}")
    if lens.focal is not None:
        fx, fy = lens.focal[0] * sx, lens.focal[1] * sy
    else:
        across, upright = present("lens.fov", lens.fov)
        fx = 0.5 * width / math.tan(0.5 * across)
        fy = fx if math.isnan(upright) else 0.5 * height / math.tan(0.5 * upright)
    x, y = lens.center or (math.nan, math.nan)
    cx = 0.5 * width if math.isnan(x) else x * sx
    cy = 0.5 * height if math.isnan(y) else y * sy
    if max(abs(x), abs(y)) <= 1:
        got = f"{x:.6g} and {y:.6g}, fractions of the image"
        raise InputError(where, f"cx, cy: expected pixels, got {got}; multiply them by its width and height")
    for name, value, side in (("cx", cx, width), ("cy", cy, height)):
        if not -side < value < 2 * side:
            expected = f"expected a principal point near the image of {side} pixels, got {value:.6g}"
            raise InputError(where, f"{name}: {expected}; give pixels of the stored image")
    notes += check_distortion(where, lens, fx, (max(cx, width - cx), max(cy, height - cy)))
    if min(fx / width, fy / height) < 0.05 or max(fx / width, fy / height) > 1000:
        expected = f"expected 0.05 to 1000 image sides, got {fx:.6g} pixels for {width}"
        raise InputError(where, f"focal length: {expected}; give pixels (or radians for an angle)")
    return [fx, fy, cx, cy]
