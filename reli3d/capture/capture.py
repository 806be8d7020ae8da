"""Writes an object folder with cameras and masks from photographs or a video of one object."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from reli3d.capture.consistency import masked_views
from reli3d.capture.mapping import View, map_photos
from reli3d.capture.masks import is_empty, key_mask, touches_border
from reli3d.capture.moving import Segmented, object_map, segmented_masks, without_moving
from reli3d.capture.photos import FEWEST, Photo, Progress, read_photos
from reli3d.capture.report import LEAST_FIT, LEAST_REGISTERED, SMALL_STEPS, CaptureReport, check, summary, widest_gap
from reli3d.capture.rigidity import Similarity, epipolar_fit, inside_mask
from reli3d.capture.scene import find_scene
from reli3d.capture.sheet import contact_sheet
from reli3d.capture.turntable import Position, map_on_turntable, on_turntable, turntable_positions
from reli3d.errors import InputError, printable
from reli3d.io.images import decode_image, unit, with_exposure
from reli3d.output.folder import check_place, claimed
from reli3d.views.background import Remover
from reli3d.views.check import agreement
from reli3d.views.choose import choose_views
from reli3d.views.file_names import images_in
from reli3d.views.masks import mask_values
from reli3d.views.missing_cameras import PHOTOGRAPHS

RESULT_FILES = ("images", "masks", "transforms.json", "capture.json", "capture.png", "asset")  # asset: of --infer
MASK_METHODS = ("grabcut", "key", "rembg")
MOST_VIEWS = 60  # of the object folder; more are thinned by the distance between their cameras
CUT_OFF = "the object is cut off by the image's border"
UNDISTORTED = "undistorted by reli3d capture"  # comment in the masks of an object folder
OUTLIER_AGREEMENT = 0.8  # of the median: a view whose mask the hull fills less is left out


@dataclass(frozen=True)
class CaptureOptions:
    """masks: folder of masks with the images' names, instead of a method.  turntable: the object turns in front of a
    camera that is fixed at one or several heights; None detects it.  size: longest side of the object in millimeters,
    for an object folder in meters.
    """

    masks: Path | None = None
    mask_method: str = "grabcut"
    turntable: bool | None = None
    size: float | None = None


def capture(
    source: str | os.PathLike,
    output: str | os.PathLike,
    options: CaptureOptions | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> CaptureReport:
    """Write the object folder ``output`` of the photographs or the video ``source``.

    It holds ``images``, ``masks``, ``transforms.json`` (pinhole cameras, +Y up, the ground at y = 0, the object's
    longest side 1), ``capture.json`` (the report) and ``capture.png`` (masks, cameras and points).  The folder appears
    whole or not at all.  Checks that fail are in ``failed`` of the report.  Raises InputError where no object folder
    can be made: fewer than 8 images, no map, a fixed camera and features that do not turn, no object, or fewer than 8
    views that show the whole object.
    """
    options = options or CaptureOptions()
    source, output = Path(source), Path(output)
    _check_options(options)
    _check_output(source, output, options.masks)
    photos, notes = read_photos(source, progress)
    cut_out = all(p.alpha is not None for p in photos)
    if cut_out and options.masks is None and options.mask_method == "grabcut":
        options = replace(options, mask_method="alpha")
        notes.append("the alpha of the photographs is used as masks")
    report = CaptureReport(len(photos), notes=notes, mask_method="given" if options.masks else options.mask_method)
    positions = _positions(photos, options, cut_out)
    known = _known_masks(photos, options, progress)
    on_table = None
    if positions:
        on_table = map_on_turntable(source, photos, positions, report, progress, known=bool(options.turntable))
    first = on_table or map_photos(photos, progress)
    if cut_out and options.turntable is None and on_turntable(first.views):
        notes.append("the cameras lie on a circle: if the object turned before a fixed camera, pass --turntable")
    if 2 * sum(p.flash for p in photos) > len(photos):
        report.lighting = "camera"
    scene = find_scene(first)
    segmented = Segmented(first, segmented_masks(first, scene, known, progress))
    if len(segmented.masks) < FEWEST:
        enough = len(first.views) >= LEAST_REGISTERED * len(photos)
        raise InputError(
            source,
            f"expected an object that stands out in at least {FEWEST} images, got {len(segmented.masks)} of "
            f"{len(photos)} ({len(first.views)} registered); "
            + ("give --masks, or take sharper images nearer to it" if enough else SMALL_STEPS),
        )
    report.surroundings_fit = epipolar_fit(first, segmented.masks, inside=False)
    if on_table is None:
        segmented, scene = without_moving(segmented, scene, known, report, progress)
    final, up, ground = object_map(segmented, scene, known, report, progress)
    report.epipolar_fit, report.surroundings_fit = round(report.epipolar_fit, 3), round(report.surroundings_fit, 3)
    report.registered = len(final.found.views)
    registered = {v.photo.name for v in final.found.views}
    report.lost = [p.name for p in photos if p.name not in registered and p.name not in report.left_out]
    report.separate = first.separate
    report.reprojection_error = round(final.found.mean_error, 3)
    report.plane = scene.plane is not None
    views = _consistent_views(source, final, report)
    if len(views) > MOST_VIEWS:
        taken = choose_views(torch.from_numpy(np.stack([v.c2w for v in views])), MOST_VIEWS)
        report.notes.append(f"{len(views)} views thinned to {MOST_VIEWS} by the distance between their cameras")
        views = [views[k] for k in taken]
    hull, filled = agreement(masked_views(views, final.masks))
    if len(hull.points) == 0:
        raise InputError(source, "expected masks of one object, got masks that no point lies inside of; give --masks")
    frame, box = _frame(hull.points.numpy(), up, ground, options.size)
    report.agreement = round(float(np.median(filled)), 3)
    report.mask_fraction = round(float(np.median([(final.masks[v.photo.name] > 127).mean() for v in views])), 4)
    report.views = [v.photo.name for v in views]
    report.unit = "meter" if options.size else "longest side"
    inside = _object_points(final, views)
    report.object_points = len(inside)
    report.gap = round(widest_gap(np.stack([frame.apply(v.eye) for v in views]) - box.mean(0)), 1)
    check(report)
    _write(output, views, final.masks, frame, box, report, frame.apply(inside), progress)
    return report


def _check_options(options: CaptureOptions) -> None:
    if options.mask_method not in MASK_METHODS:
        raise InputError("mask-method", f"expected {', '.join(MASK_METHODS)}, got {options.mask_method!r}")
    if options.masks and not options.masks.is_dir():
        raise InputError(options.masks, "masks: expected a folder of mask images, got none; check the path")
    if options.size is not None and not 0.1 <= options.size <= 1e6:
        raise InputError("size", f"expected 0.1 to 1000000 millimeters, got {options.size}")


def _check_output(source: Path, output: Path, masks: Path | None) -> None:
    check_place(output)
    if output.resolve() in (source.resolve(), *source.resolve().parents) and (output / "capture.json").exists():
        raise InputError(output, "expected a folder without the images that are read, got theirs; give another")
    if masks and output.resolve() in (masks.resolve(), *masks.resolve().parents):
        raise InputError(masks, "expected masks outside the output, which is replaced; move your own to another folder")
    if output.is_dir() and any(output.iterdir()) and not (output / "capture.json").exists():
        raise InputError(output, "expected an empty folder or an earlier capture, got other files; give another")


def _positions(photos: Sequence[Photo], options: CaptureOptions, cut_out: bool) -> list[Position]:
    """The positions of a camera in front of a turntable; none where the camera moves."""
    if options.turntable is False or cut_out and not options.turntable:
        return []
    positions = turntable_positions([p.pixels for p in photos], fixed=bool(options.turntable))
    if options.turntable and not positions:
        raise InputError("turntable", "expected images of a fixed camera in which the object turns, got others")
    return positions


def _known_masks(photos: Sequence[Photo], options: CaptureOptions, progress: Progress) -> dict[str, np.ndarray] | None:
    """Masks that need no map: given ones, alpha, by color, or by a network.  None for those of the map's points."""
    if options.masks is None and options.mask_method == "grabcut":
        return None
    found: dict[str, np.ndarray] = {}
    remover = Remover("mask-method") if options.masks is None and options.mask_method == "rembg" else None
    for k, photo in enumerate(photos):
        progress("masks", k, len(photos))
        if options.masks:
            mask = _given_mask(options.masks, photo)
        elif options.mask_method == "alpha":
            mask = photo.alpha
        elif remover:
            mask = np.asarray(remover.mask(Image.fromarray(photo.pixels)))
        else:
            mask = key_mask(photo.pixels)
        if mask is not None and not is_empty(mask):
            found[photo.name] = mask
    if len(found) < FEWEST:
        where, what = "mask-method", "images of one object before a uniform background"
        if options.masks:
            where, what = str(options.masks), "masks with the names of the photographs, such as IMG_1.png of IMG_1.jpg,"
        elif options.mask_method == "alpha":
            where, what = "alpha", "an object that is opaque, or --masks,"
        raise InputError(where, f"expected {what} for at least {FEWEST} of {len(photos)}, got {len(found)}")
    return found


def _given_mask(folder: Path, photo: Photo) -> np.ndarray | None:
    """The mask in ``folder`` by the photograph's name, with or without that one's suffix before its own."""
    files = []
    for path in images_in(folder):
        before = Path(path.stem)
        if photo.name in (path.name, path.stem) or (before.suffix.lower() in PHOTOGRAPHS and photo.name == before.stem):
            files.append(path)
    if not files:
        return None
    if len(files) > 1:
        raise InputError(folder, f"expected one mask of {printable(photo.name)}, got {files[0].name}, {files[1].name}")
    bitmap = decode_image(files[0], upright=True)
    if bitmap.info.get("Comment") == UNDISTORTED:
        fix = "edit those in place and run reli3d-infer, or segment the photographs themselves"
        raise InputError(files[0], f"expected a mask of the photograph, got one of the undistorted image; {fix}")
    coverage = unit(mask_values(files[0], bitmap, []))  # the note on values below white is left out
    mask = np.rint(255 * coverage).astype(np.uint8)
    (width, height), (w, h) = photo.size, bitmap.size
    if abs(w * height / (h * width) - 1) > 0.01:
        turned = abs(h * height / (w * width) - 1) <= 0.01
        fix = "turn it by the EXIF orientation of the photograph" if turned else "save it at that size"
        raise InputError(files[0], f"expected the aspect of {width} x {height}, got {w} x {h}; {fix}")
    return cv2.resize(mask, photo.size, interpolation=cv2.INTER_AREA)


def _consistent_views(source: Path, final: Segmented, report: CaptureReport) -> list[View]:
    """Views that show the whole object and agree with the others; the rest is named in the report."""
    views = final.views
    for view in final.found.views:
        if view.photo.name not in final.masks:
            report.left_out[view.photo.name] = "no mask"
    for view in views:
        if touches_border(final.masks[view.photo.name]):
            report.left_out[view.photo.name] = CUT_OFF
    views = [v for v in views if v.photo.name not in report.left_out]
    while len(views) >= FEWEST:
        filled = np.array(agreement(masked_views(views, final.masks))[1])
        worst = int(filled.argmin())
        if filled.max() > 0 and filled[worst] >= OUTLIER_AGREEMENT * np.median(filled):
            break
        worst = worst if filled.max() > 0 else _least_compatible(views, final.masks)
        report.left_out[views[worst].photo.name] = "its mask does not agree with the others"
        views = [v for k, v in enumerate(views) if k != worst]
    if len(views) < FEWEST:
        fix = "take sharper images, or give --masks"
        if report.epipolar_fit < LEAST_FIT:
            fix = "something else moves: photograph the object before a background at rest, or give --masks"
        elif 2 * list(report.left_out.values()).count(CUT_OFF) >= len(report.left_out):
            fix = "step back: the whole object must be in the image"
        elif report.registered < LEAST_REGISTERED * report.images:
            fix = SMALL_STEPS
        raise InputError(
            source,
            f"expected at least {FEWEST} views that show the whole object, got {len(views)} of {report.images} images "
            f"({report.registered} registered); {fix}",
        )
    return views


def _least_compatible(views: Sequence[View], masks: dict[str, np.ndarray]) -> int:
    """Index of the view without which the hull fills most of the masks, where the hull of all views is empty."""
    scores = []
    for k in range(len(views)):
        rest = [v for j, v in enumerate(views) if j != k]
        scores.append(float(np.mean(agreement(masked_views(rest, masks))[1])))
    return int(np.argmax(scores))


def _frame(hull: np.ndarray, up: np.ndarray, ground: float | None, size: float | None) -> tuple[Similarity, np.ndarray]:
    """``up`` to +Y, the longer side of the smallest rectangle around ``hull (N, 3)`` to X, the ground at 0, the middle
    above the origin, the longest side 1 or ``size`` millimeters; and the box ``(2, 3)`` of the hull in it.
    """
    y = up / np.linalg.norm(up)
    x = np.cross(y, np.eye(3)[np.abs(y).argmin()])
    x /= np.linalg.norm(x)
    turn = np.stack([x, y, np.cross(x, y)])
    corners = cv2.boxPoints(cv2.minAreaRect((hull @ turn[::2].T).astype(np.float32)))
    side = max(corners[1] - corners[0], corners[2] - corners[1], key=np.linalg.norm).astype(np.float64)
    x = side / np.linalg.norm(side) @ turn[::2]
    turn = np.stack([x, y, np.cross(x, y)])
    turned = hull @ turn.T
    bottom = max(turned[:, 1].min(), -np.inf if ground is None else ground)
    above = turned[turned[:, 1] >= bottom]
    turned = above if len(above) > 0.2 * len(turned) else turned
    low, high = turned.min(0), turned.max(0)
    scale = (1.0 if size is None else size / 1000.0) / float((high - low).max())
    middle = (low + high) / 2
    middle[1] = bottom
    return Similarity(scale, turn, -scale * middle), scale * (np.stack([low, high]) - middle)


def _object_points(final: Segmented, views: Sequence[View]) -> np.ndarray:
    """Points of the map that lie inside the masks of the views that observe them."""
    points = np.concatenate([v.points for v in views])
    inside = np.concatenate([inside_mask(final.masks[v.photo.name], v.pixels) for v in views])
    hits, count = (np.bincount(points, weights, len(final.found.points)) for weights in (inside, None))
    return final.found.points[(count >= 2) & (hits > 0.7 * count)]


def _write(
    output: Path, views, masks, frame: Similarity, box: np.ndarray, report: CaptureReport, points, progress
) -> None:
    with claimed(output, RESULT_FILES) as replacing, replacing() as work:
        frames, thumbnails = [], []
        for name in ("images", "masks"):
            (work / name).mkdir()
        comment = PngInfo()
        comment.add_text("Comment", UNDISTORTED)
        for k, view in enumerate(views):
            name = view.photo.name
            progress("writing", k, len(views))
            image = view.undistorted(view.photo.pixels)
            mask = view.undistorted(masks[view.photo.name])
            exif = with_exposure(view.photo.exposure)
            Image.fromarray(image).save(work / "images" / f"{name}.jpg", quality=95, subsampling=0, exif=exif)
            Image.fromarray(mask).save(work / "masks" / f"{name}.png", pnginfo=comment)
            pose = view.c2w
            pose[:3, :3] = frame.rotation @ pose[:3, :3]
            pose[:3, 3] = frame.apply(view.eye)
            (cx, cy), (w, h) = view.principal.tolist(), view.photo.size
            paths = {"file_path": f"images/{name}.jpg", "mask_path": f"masks/{name}.png"}
            lens = {"fl_x": view.focal, "fl_y": view.focal, "cx": cx, "cy": cy, "w": w, "h": h}
            frames.append({**paths, "transform_matrix": pose.tolist(), **lens})
            thumbnails.append((name, image, mask, replace(view, radial=0.0)))
        facts = {"camera_model": "PINHOLE", "lighting": report.lighting, "unit": report.unit}
        content = {**facts, "object_box": box.tolist(), "frames": frames}
        (work / "transforms.json").write_text(json.dumps(content, indent=1))
        (work / "capture.json").write_text(json.dumps(asdict(report), indent=1))
        eyes = np.stack([frame.apply(v.eye) for v in views])
        lines = [summary(report), *(f"check failed: {text}" for text in report.failed[:1])]
        contact_sheet(thumbnails, points, eyes, frame.inverse, lines).save(work / "capture.png")
    progress("writing", len(views), len(views))
