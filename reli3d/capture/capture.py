"""Photographs or a video of one object, without cameras, to an object folder with cameras and masks."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image

from reli3d.capture.consistency import aligned
from reli3d.capture.fusion import fused_masks
from reli3d.capture.mapping import Map, View, map_photos, shown_pixels
from reli3d.capture.masks import grabcut_mask, is_empty, key_mask, moving_region, touches_border
from reli3d.capture.photos import FEWEST, Photo, Progress, read_photos
from reli3d.capture.rigidity import (
    SMALLEST_GROUP,
    Frame,
    Group,
    completed_groups,
    epipolar_fit,
    inside_mask,
    on_turntable,
    rigid_groups,
)
from reli3d.capture.scene import Scene, find_scene
from reli3d.capture.sheet import contact_sheet
from reli3d.errors import InputError, printable
from reli3d.io.images import decode_image, unit
from reli3d.output.folder import check_place, claimed
from reli3d.views.background import Remover
from reli3d.views.check import agreement
from reli3d.views.choose import choose_views
from reli3d.views.file_names import images_in
from reli3d.views.masks import mask_values
from reli3d.views.missing_cameras import PHOTOGRAPHS
from reli3d.views.views import Views

RESULT_FILES = ("images", "masks", "transforms.json", "capture.json", "capture.png")
MASK_METHODS = ("grabcut", "key", "rembg")
MOST_VIEWS = 60  # of the object folder; more are thinned by the distance between their cameras
MASK_SIDE = 512  # pixels of masks by which the visual hull is judged
SURE_AGREEMENT = 0.99  # mean fraction of the masks that the hull fills, above which they lack nothing
RIGID_FIT = 0.95  # of the matches that fit pairs of views: cameras that fit more are right
KEPT_FRACTION = 0.9  # of the first map's images that the second must register
SAME_UP = math.cos(math.radians(15.0))  # between the upward directions of views that saw the object in one pose
OUTLIER_AGREEMENT = 0.8  # of the median: a view whose mask the hull fills less is left out
SIDE_ELEVATION = 45.0  # degrees up to which a direction looks at a side of the object
LEAST_REGISTERED, MOST_ERROR, WIDEST_GAP = 0.8, 1.0, 60.0
SMALL_STEPS = "take sharp images of one object in small steps around it"
LEAST_POINTS, LEAST_AGREEMENT, LEAST_MASK, LEAST_FIT = 200, 0.85, 0.03, 0.8


@dataclass(frozen=True)
class CaptureOptions:
    """masks: folder of masks with the images' names, instead of a method.  turntable: the object turns in front of a
    fixed camera; None detects it.  size: longest side of the object in millimeters, for an object folder in meters.
    """

    masks: Path | None = None
    mask_method: str = "grabcut"
    turntable: bool | None = None
    size: float | None = None


@dataclass
class CaptureReport:
    """What was found, and which checks failed; written to ``capture.json``."""

    images: int
    registered: int = 0
    lost: list[str] = field(default_factory=list)  # not registered
    separate: int = 0  # of these, images that form a second map, as of another object or after a gap
    left_out: dict[str, str] = field(default_factory=dict)  # registered, but of no use: name and reason
    views: list[str] = field(default_factory=list)
    reprojection_error: float = 0.0  # pixels, mean
    object_points: int = 0
    gap: float = 0.0  # degrees, the widest between cameras around the object
    agreement: float = 0.0  # median fraction of a mask that the visual hull fills
    epipolar_fit: float = 1.0  # matches on the object that fit the cameras, over those that fit pairs of views
    surroundings_fit: float = 1.0  # the same around it; of the first map, where the object was moved
    mask_fraction: float = 0.0  # median fraction of an image that the mask covers
    mask_method: str = ""
    plane: bool = False
    lighting: str = "object"  # frame in which the lighting is fixed: object or camera
    unit: str = "longest side"
    failed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Segmented:
    """A map and the masks of its views, by name."""

    found: Map
    masks: dict[str, np.ndarray]

    @property
    def views(self) -> list[View]:
        return [v for v in self.found.views if v.photo.name in self.masks]


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
    can be made: fewer than 8 images, no map, no object, or fewer than 8 views that show the whole object.
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
    region = None
    if options.turntable or options.turntable is None and not cut_out:  # detected by the background
        region = moving_region([p.pixels for p in photos], fixed=bool(options.turntable))
    if options.turntable and region is None:
        raise InputError("turntable", "expected images of one size in which the object turns, got others")
    known = _known_masks(photos, options, progress)
    first = map_photos(photos, progress, None if region is None else [region] * len(photos))
    if region is not None and not options.turntable and not on_turntable(first.views):
        region, first = None, map_photos(photos, progress)  # a background without texture hid that the camera moves
    if region is not None:
        notes.append("turntable: the camera is fixed and the object turns; the lighting is fixed to the camera")
    if region is not None or 2 * sum(p.flash for p in photos) > len(photos):
        report.lighting = "camera"
    scene = find_scene(first)
    segmented = _Segmented(first, _masks(first, scene, known, None, progress))
    if len(segmented.masks) < FEWEST:
        enough = len(first.views) >= LEAST_REGISTERED * len(photos)
        raise InputError(
            source,
            f"expected an object that stands out in at least {FEWEST} images, got {len(segmented.masks)} of "
            f"{len(photos)} ({len(first.views)} registered); "
            + ("give --masks, or take sharper images nearer to it" if enough else SMALL_STEPS),
        )
    report.surroundings_fit = epipolar_fit(first, segmented.masks, inside=False)
    if region is None and report.surroundings_fit < RIGID_FIT:
        segmented, scene = _without_moving(segmented, scene, known, report, progress)
    final, up, ground = _refined(segmented, scene, known, report, progress)
    report.epipolar_fit, report.surroundings_fit = round(report.epipolar_fit, 3), round(report.surroundings_fit, 3)
    report.registered = len(final.found.views)
    registered = {v.photo.name for v in final.found.views}
    report.lost = [p.name for p in photos if p.name not in registered]
    report.separate = first.separate
    report.reprojection_error = round(final.found.mean_error, 3)
    report.plane = scene.plane is not None
    views = _whole_views(source, final, report)
    if len(views) > MOST_VIEWS:
        taken = choose_views(torch.from_numpy(np.stack([_c2w(v) for v in views])), MOST_VIEWS)
        report.notes.append(f"{len(views)} views thinned to {MOST_VIEWS} by the distance between their cameras")
        views = [views[k] for k in taken]
    hull, filled = agreement(_as_views(views, final.masks))
    if len(hull.points) == 0:
        raise InputError(source, "expected masks of one object, got masks that no point lies inside of; give --masks")
    frame, box = _frame(hull.points.numpy(), up, ground, options.size)
    report.agreement = round(float(np.median(filled)), 3)
    report.mask_fraction = round(float(np.median([(final.masks[v.photo.name] > 127).mean() for v in views])), 4)
    report.views = [v.photo.name for v in views]
    report.unit = "meter" if options.size else "longest side"
    inside = _object_points(final, views)
    report.object_points = len(inside)
    middle = (box[0] + box[1]) / 2
    report.gap = round(widest_gap(np.stack([frame.apply(v.eye) for v in views]) - middle), 1)
    _check(report)
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
        raise InputError(masks, "expected masks outside the output, which is replaced; copy them to another folder")
    if output.is_dir() and any(output.iterdir()) and not (output / "capture.json").exists():
        raise InputError(output, "expected an empty folder or an earlier capture, got other files; give another")


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
    coverage = unit(mask_values(files[0], bitmap, []))  # the note on values below white is left out
    mask = np.rint(255 * coverage).astype(np.uint8)
    (width, height), (w, h) = photo.size, bitmap.size
    if abs(w * height / (h * width) - 1) > 0.01:
        turned = abs(h * height / (w * width) - 1) <= 0.01
        fix = "turn it by the EXIF orientation of the photograph" if turned else "save it at that size"
        raise InputError(files[0], f"expected the aspect of {width} x {height}, got {w} x {h}; {fix}")
    return cv2.resize(mask, photo.size, interpolation=cv2.INTER_AREA)


def _masks(
    found: Map, scene: Scene, known: dict | None, support: dict[str, np.ndarray] | None, progress: Progress
) -> dict[str, np.ndarray]:
    """Masks of the views of a map by the names of their photos, of those that have one."""
    if known is not None:
        return {v.photo.name: known[v.photo.name] for v in found.views if v.photo.name in known}
    masks = {}
    for k, view in enumerate(found.views):
        progress("masks", k, len(found.views))
        seeds = None if support is None else support.get(view.photo.name, np.zeros((0, 2)))
        mask = grabcut_mask(view, found, scene, seeds)
        if mask is not None and not is_empty(mask):
            masks[view.photo.name] = mask
    progress("masks", len(found.views), len(found.views))
    return masks


def _without_moving(
    segmented: _Segmented, scene: Scene, known: dict | None, report: CaptureReport, progress: Progress
) -> tuple[_Segmented, Scene]:
    """The map with its masks, and the scene, of features inside the masks and on the support alone.

    Unchanged where the object itself was moved, and where these features are too few.
    """
    first, masks = segmented.found, segmented.masks
    if epipolar_fit(first, masks) < RIGID_FIT:
        return segmented, scene
    regions = [_still_region(v, first.points[scene.support], masks.get(v.photo.name)) for v in first.views]
    second = None
    with suppress(InputError):
        second = map_photos([v.photo for v in first.views], progress, regions)
    if second and len(second.views) >= KEPT_FRACTION * len(first.views) and epipolar_fit(second, masks) >= RIGID_FIT:
        again = find_scene(second)
        renewed = _masks(second, again, known, None, progress)
        if len(renewed) >= KEPT_FRACTION * len(masks):
            report.notes.append(
                "matches around the object do not fit the cameras, as where something moves: "
                "features of the object and its support are used"
            )
            report.surroundings_fit = epipolar_fit(second, renewed, inside=False)
            return _Segmented(second, renewed), again
    fit = f"{100 * report.surroundings_fit:.0f} % of the matches around the object fit the cameras"
    if report.surroundings_fit < LEAST_FIT:
        report.failed.append(f"{fit}, at least 80 % expected: something moves there")
    else:
        report.notes.append(f"{fit}: if something moves there, the cameras may be inaccurate")
    return segmented, scene


def _still_region(view: View, support: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """``(H, W)`` uint8, 255 inside the mask and at the points ``support (N, 3)``."""
    shape = view.photo.size[::-1]
    x, y, _ = shown_pixels(*view.project(support), shape)
    region = np.zeros(shape, np.uint8) if mask is None else mask.copy()
    region[y, x] = 255
    return region


def _refined(
    segmented: _Segmented, scene: Scene, known: dict | None, report: CaptureReport, progress: Progress
) -> tuple[_Segmented, np.ndarray, float | None]:
    """The map in whose frame the object does not move, with its masks; in it the upward direction ``(3,)`` and the
    ground's height along it (None: unknown).

    Where matches inside the masks do not fit the cameras, or masks disagree, their features are mapped alone.  If
    the two maps differ by more than a similarity, and these features fit the second one better, the object was moved.
    The first map, if matches outside the masks fit it, still has the better lenses, and the better cameras within each
    group of views between which the object did not move.  The masks are fused, per group for a moved object, and then
    align the groups.  Masks that agree only lose contact shadows.
    """
    first = segmented.found
    down = np.stack([v.rotation[1] for v in first.views]).mean(0)
    up = scene.plane.normal if scene.plane else -down / max(np.linalg.norm(down), 1e-9)
    ground = -scene.plane.offset if scene.plane else None
    report.epipolar_fit = epipolar_fit(first, segmented.masks)
    consistent = _agreement(segmented.views, segmented.masks) > SURE_AGREEMENT
    if report.epipolar_fit >= RIGID_FIT and consistent:
        if known is None:  # the masks lack nothing, but may hold a contact shadow
            fused = fused_masks(first, scene, segmented.masks)
            masks = {name: np.minimum(mask, fused[name]) for name, mask in segmented.masks.items()}
            segmented = _Segmented(first, {name: mask for name, mask in masks.items() if not is_empty(mask)})
        return segmented, up, ground
    views, by_name = segmented.views, {v.photo.name: v for v in first.views}
    lenses = first if report.surroundings_fit >= RIGID_FIT else None
    second, groups, after = None, list[Group](), 1.0
    with suppress(InputError):
        second = map_photos([v.photo for v in views], progress, [segmented.masks[v.photo.name] for v in views], lenses)
    if second:
        groups = rigid_groups(first, second)
        if not groups or len(groups[0].names) < KEPT_FRACTION * len(second.views):  # the maps differ: which is right?
            same = replace(second, views=tuple(by_name[v.photo.name] for v in second.views))
            report.epipolar_fit = min(report.epipolar_fit, epipolar_fit(same, segmented.masks, between=groups))
            after = epipolar_fit(second, segmented.masks, between=groups)
        if lenses and len(groups) > 1 and len(second.views) < len(views):
            groups = completed_groups(first, groups, segmented.masks)
            unseen = {name for group in groups for name in group.names} - {v.photo.name for v in second.views}
            added = (replace(v, pixels=v.pixels[:0], points=v.points[:0]) for v in views if v.photo.name in unseen)
            second = replace(second, views=(*second.views, *added))  # posed by their groups below
    if (
        second is None
        or len(second.views) < KEPT_FRACTION * len(first.views)
        or report.epipolar_fit >= RIGID_FIT
        or after <= report.epipolar_fit
    ):
        if known is None and not consistent and report.epipolar_fit >= RIGID_FIT:
            fused = fused_masks(first, scene, segmented.masks)
            segmented = _Segmented(first, {name: mask for name, mask in fused.items() if not is_empty(mask)})
        return segmented, up, ground
    report.epipolar_fit = after
    groups = groups if lenses else []
    second = _posed(second, groups, by_name)
    report.notes.append("the object was moved relative to its surroundings: its own features decide on the cameras")
    again = [v for v in second.views if v.photo.name in segmented.masks]
    support = None
    if known is None:
        support = {v.photo.name: v.pixels[scene.support[v.points]] for v in first.views}
    own = find_scene(second, supported=False)
    masks = _masks(second, own, known, support, progress)
    if known is None:  # in the first map, where the support and its shadows do not move within a group
        for group in (g for g in groups if len(g.names) >= FEWEST):
            points = group.inverse(second.points[own.object])
            at = replace(first, views=tuple(by_name[name] for name in group.names), points=points)
            whole = replace(scene, object=np.ones(len(points), bool))
            masks |= fused_masks(at, whole, {name: masks[name] for name in group.names if name in masks})
        masks = {name: mask for name, mask in masks.items() if not is_empty(mask)}
    if len(masks) < KEPT_FRACTION * len(segmented.masks) or (
        known is None and _agreement(_Segmented(second, masks).views, masks) < _agreement(again, segmented.masks)
    ):
        masks = {v.photo.name: segmented.masks[v.photo.name] for v in again}
    refined = _Segmented(_posed(second, _aligned_groups(groups, by_name, masks), by_name), masks)
    if groups and scene.plane:
        up = groups[0].turn @ up
        return refined, up, float(groups[0].apply(scene.plane.foot(scene.center)) @ up)
    pairs = [(by_name[v.photo.name], v) for v in second.views]
    directions = np.stack([b.rotation.T @ a.rotation @ up for a, b in pairs])
    similar = directions @ directions.T > SAME_UP  # an object that was turned over has two: that of most views is up
    upward = directions[similar[similar.sum(1).argmax()]].mean(0)
    return refined, upward / np.linalg.norm(upward), None


def _posed(found: Map, groups: Sequence[Group], views: dict[str, View]) -> Map:
    """``found`` with the poses of ``views`` in the groups, moved by these."""
    moved = {name: group.moved(views[name]) for group in groups for name in group.names}
    poses = [moved.get(v.photo.name, v) for v in found.views]
    pairs = zip(found.views, poses, strict=True)
    return replace(found, views=tuple(replace(v, rotation=p.rotation, translation=p.translation) for v, p in pairs))


def _aligned_groups(groups: Sequence[Group], views: dict[str, View], masks: dict[str, np.ndarray]) -> list[Group]:
    """The groups with motions corrected, one after the other, by the silhouettes of the groups before.

    A correction that makes the visual hull of all these views fill less of the masks is left out.
    """
    whole = {name for name, mask in masks.items() if not touches_border(mask)}
    before: list[View] = []
    corrected = []
    for group in groups:
        names = [name for name in group.names if name in whole]
        own = [group.moved(views[name]) for name in names]
        if min(len(own), len(before)) >= SMALLEST_GROUP:
            motion = aligned(_as_views(before, masks), _as_views(own, masks))
            shift = motion.apply(group.shift)
            better = replace(group, scale=motion.scale * group.scale, turn=motion.turn @ group.turn, shift=shift)
            moved = [better.moved(views[name]) for name in names]
            if _agreement(before + moved, masks) >= _agreement(before + own, masks):
                group, own = better, moved
        before += own
        corrected.append(group)
    return corrected


def _c2w(view: View) -> np.ndarray:
    """Camera to world ``(4, 4)`` in OpenGL axes."""
    pose = np.eye(4)
    pose[:3, :3] = view.rotation.T @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = view.eye
    return pose


def _as_views(views: Sequence[View], masks: dict[str, np.ndarray]) -> Views:
    """Small undistorted masks and their cameras; the images are black."""
    small, cameras = [], []
    for view in views:
        w, h = view.photo.size
        scale = min(1.0, MASK_SIDE / max(w, h))
        mask = cv2.resize(masks[view.photo.name], (round(w * scale), round(h * scale)), interpolation=cv2.INTER_AREA)
        small.append(torch.from_numpy(view.undistorted(mask).astype(np.float32) / 255).clamp(0, 1))
        cameras.append([view.focal * scale, view.focal * scale, *(view.principal * scale)])
    return Views(
        images=tuple(torch.zeros(1, dtype=torch.float32).expand(*m.shape, 3) for m in small),
        masks=tuple(small),
        c2w=torch.from_numpy(np.stack([_c2w(v) for v in views]).astype(np.float32)),
        intrinsics=torch.tensor(cameras, dtype=torch.float32),
        names=tuple(v.photo.name for v in views),
    )


def _agreement(views: Sequence[View], masks: dict[str, np.ndarray]) -> float:
    """Mean fraction of the masks that the visual hull fills."""
    whole = [v for v in views if not touches_border(masks[v.photo.name])]
    return float(np.mean(agreement(_as_views(whole, masks))[1])) if len(whole) >= 2 else 0.0


def _whole_views(source: Path, final: _Segmented, report: CaptureReport) -> list[View]:
    """Views that show the whole object and agree with the others; the rest is named in the report."""
    views = final.views
    for view in final.found.views:
        if view.photo.name not in final.masks:
            report.left_out[view.photo.name] = "no mask"
    for view in views:
        if touches_border(final.masks[view.photo.name]):
            report.left_out[view.photo.name] = "the object is cut off by the image's border"
    views = [v for v in views if v.photo.name not in report.left_out]
    while len(views) >= FEWEST:
        filled = np.array(agreement(_as_views(views, final.masks))[1])
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
        elif any("border" in reason for reason in report.left_out.values()):
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
    """The view without which the hull of the others is fullest, where all together have none."""
    scores = []
    for k in range(len(views)):
        rest = [v for j, v in enumerate(views) if j != k]
        scores.append(float(np.mean(agreement(_as_views(rest, masks))[1])))
    return int(np.argmax(scores))


def _frame(hull: np.ndarray, up: np.ndarray, ground: float | None, size: float | None) -> tuple[Frame, np.ndarray]:
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
    bottom = turned[:, 1].min() if ground is None else max(ground, turned[:, 1].min())
    above = turned[turned[:, 1] >= bottom]
    turned = above if len(above) > 0.2 * len(turned) else turned
    bottom = max(bottom, turned[:, 1].min()) if ground is None else bottom
    low, high = turned.min(0), turned.max(0)
    scale = (1.0 if size is None else size / 1000.0) / float((high - low).max())
    middle = (low + high) / 2
    middle[1] = bottom
    return Frame(scale, turn, -scale * middle), scale * (np.stack([low, high]) - middle)


def _object_points(final: _Segmented, views: Sequence[View]) -> np.ndarray:
    """Points of the map that lie inside the masks of the views that observe them."""
    hits, count = np.zeros(len(final.found.points)), np.zeros(len(final.found.points))
    for view in views:
        np.add.at(hits, view.points, inside_mask(final.masks[view.photo.name], view.pixels))
        np.add.at(count, view.points, 1)
    return final.found.points[(count >= 2) & (hits > 0.7 * count)]


def widest_gap(eyes: np.ndarray) -> float:
    """Degrees of the widest gap between the cameras ``eyes (V, 3)`` around an object at the origin, +Y up.

    Twice the largest angle, over all azimuths, between a camera and the nearest direction of that azimuth at most
    SIDE_ELEVATION up or down: for a horizontal ring the angle between neighbors, up to 180; cameras that look down from
    higher up see more of the sides, and from directly above none.
    """
    azimuth, elevation = np.radians(np.arange(360.0)), np.radians(np.linspace(-SIDE_ELEVATION, SIDE_ELEVATION, 31))
    radius, height = np.cos(elevation), np.broadcast_to(np.sin(elevation), (360, 31))
    sides = np.stack([np.sin(azimuth)[:, None] * radius, height, np.cos(azimuth)[:, None] * radius], -1)
    cosine = (sides @ (eyes / np.linalg.norm(eyes, axis=1, keepdims=True)).T).max((1, 2))
    return float(2 * np.degrees(np.arccos(np.clip(cosine.min(), -1, 1))))


def _check(report: CaptureReport) -> None:
    """Fill ``failed`` with a line for each check that fails."""
    registered = report.registered / report.images
    error = report.reprojection_error
    checks = (
        (
            registered >= LEAST_REGISTERED,
            f"{100 * registered:.0f} % of the images registered, at least 80 % expected; "
            + (f"{report.separate} others fit together (a second object, or a gap); " if report.separate else "")
            + SMALL_STEPS,
        ),
        (error < MOST_ERROR, f"reprojection error {error} px, below 1 expected"),
        (
            report.epipolar_fit >= LEAST_FIT,
            f"{100 * report.epipolar_fit:.0f} % of the matches on the object fit the cameras, at least 80 % expected: "
            "the object was moved relative to its surroundings",
        ),
        (
            report.gap < WIDEST_GAP,
            f"no view within a sector of {math.floor(report.gap)} degrees, at most 60 expected; add images from there",
        ),
        (
            report.object_points >= LEAST_POINTS,
            f"{report.object_points} points on the object, at least 200 expected: it lacks texture, or is not the same "
            "object in all images",
        ),
        (
            report.agreement >= LEAST_AGREEMENT,
            f"the visual hull fills {100 * report.agreement:.0f} % of a mask, at least 85 % expected: masks lack "
            "a part of the object; give --masks or --mask-method rembg",
        ),
        (
            report.mask_fraction >= LEAST_MASK,
            f"the object covers {100 * report.mask_fraction:.1f} % of an image, at least 3 % expected",
        ),
    )
    report.failed += [text for passed, text in checks if not passed]


def _write(output: Path, views, masks, frame: Frame, box: np.ndarray, report: CaptureReport, points, progress) -> None:
    with claimed(output, RESULT_FILES) as replacing, replacing() as work:
        frames, thumbnails = [], []
        for name in ("images", "masks"):
            (work / name).mkdir()
        for k, view in enumerate(views):
            name = view.photo.name
            progress("writing", k, len(views))
            image = view.undistorted(view.photo.pixels)
            mask = view.undistorted(masks[view.photo.name])
            Image.fromarray(image).save(work / "images" / f"{name}.jpg", quality=95, subsampling=0)
            Image.fromarray(mask).save(work / "masks" / f"{name}.png")
            pose = _c2w(view)
            pose[:3, :3] = frame.turn @ pose[:3, :3]
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


def summary(report: CaptureReport) -> str:
    """One line on the result."""
    return (
        f"{report.registered} of {report.images} images registered, {len(report.views)} views kept, "
        f"reprojection error {report.reprojection_error:.2f} px, widest gap {math.floor(report.gap)} degrees, "
        f"visual hull fills {100 * report.agreement:.0f} % of the masks"
    )
