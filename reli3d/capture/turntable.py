"""Turntables: an object that turns in front of a camera that is fixed at one position, or at several in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from reli3d.capture.mapping import Map, View, map_if_any, map_photos
from reli3d.capture.masks import cleaned
from reli3d.capture.photos import FEWEST, Photo, Progress
from reli3d.capture.report import LEAST_REGISTERED, CaptureReport
from reli3d.capture.rigidity import SMALLEST_GROUP
from reli3d.errors import InputError

REGION_SIDE = 160  # pixels along the width at which images are compared
STILL = 3.0  # of 255: standard deviation between images up to which a pixel does not change: noise and JPEG
LEAST_STILL = 0.1  # fraction of such pixels from which the camera is fixed; hand-held images have none
SAME_POSITION = 0.5  # of that fraction in the most similar pair of either image: a pair with less has two positions
BORDER_STILL = 5.0  # of 255: standard deviation between images, of four fifths of the border's pixels
CLIPPED = 8  # of 255: distance from black and white
LEAST_ROTATION = 5.0  # degrees between two views of an object that turns
AXIS_ANGLE = 1.0  # degrees by which the axis of a turntable may differ between the cameras' axes, median
AXIS_SHIFT = 0.02  # the same of its position, relative to the distance


@dataclass(frozen=True)
class Position:
    """A position of the camera: indices of its images, and the mask ``(H, W)`` of the turntable with the object."""

    images: tuple[int, ...]
    region: np.ndarray


def turntable_positions(pixels: Sequence[np.ndarray], *, fixed: bool = False) -> list[Position]:
    """The positions of the camera, if the images of each agree except at the turntable with the object; else none.

    pixels: ``(H, W, 3)`` uint8, of any sizes.  Images of one size have one position if they are linked by pairs in
    which at least SAME_POSITION as many pixels agree as in the most similar pair of either image.  A camera is fixed
    where LEAST_STILL of the pixels do not change, or nearly all of the image's border does not.  A position has at
    least FEWEST images; without a position are at most 1 - LEAST_REGISTERED of all.  fixed: True where that is known; a
    position then has at least SMALLEST_GROUP images.
    """
    shapes = [p.shape for p in pixels]
    sizes = [tuple(k for k, own in enumerate(shapes) if own == shape) for shape in dict.fromkeys(shapes)]
    small = [_small(p) for p in pixels]
    similar = [group for same_size in sizes for group in _similar_images(small, same_size)]
    least = SMALLEST_GROUP if fixed else FEWEST
    found = _with_regions(pixels, small, similar, least)
    if len(found) < 2:
        found = _with_regions(pixels, small, sizes, least) or found
    return found or (_with_regions(pixels, small, sizes, least, fixed=True) if fixed else [])


def _small(pixels: np.ndarray) -> np.ndarray:
    """The image REGION_SIDE wide, float32."""
    size = REGION_SIDE, max(1, round(REGION_SIDE * pixels.shape[0] / pixels.shape[1]))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _similar_images(small: Sequence[np.ndarray], same_size: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Groups of images of one size, linked by pairs with enough pixels that do not change."""
    images = np.stack([small[k] for k in same_size])
    brightness, same = images.mean(-1), np.zeros((len(images), len(images)))
    for b in range(1, len(images)):
        deviation = np.abs(images[:b] - images[b]).max(-1) / 2
        spread = np.stack([cv2.blur(d, (3, 3)) for d in deviation])
        same[:b, b] = _unchanged(spread, (brightness[:b] + brightness[b]) / 2).mean((1, 2))
    best = np.maximum(same, same.T).max(1)
    linked = same > np.maximum(LEAST_STILL, SAME_POSITION * np.maximum.outer(best, best))
    count, group = connected_components(linked, directed=False)
    return [tuple(same_size[k] for k in (group == g).nonzero()[0]) for g in range(count)]


def _with_regions(
    pixels: Sequence[np.ndarray],
    small: Sequence[np.ndarray],
    groups: Sequence[tuple[int, ...]],
    least: int,
    *,
    fixed: bool = False,
) -> list[Position]:
    """The groups of at least ``least`` images that have a region, if these are nearly all images; else none."""
    found = []
    for group in groups:
        region = _moving_region(np.stack([small[k] for k in group]), fixed=fixed) if len(group) >= least else None
        if region is not None:
            size = pixels[group[0]].shape[1::-1]
            found.append(Position(group, cv2.resize(region, size, interpolation=cv2.INTER_NEAREST)))
    return found if sum(len(p.images) for p in found) >= LEAST_REGISTERED * len(pixels) else []


def _unchanged(spread: np.ndarray, brightness: np.ndarray) -> np.ndarray:
    """Pixels of small standard deviation that are not clipped, as in an overexposed sky."""
    return (spread < STILL) & (brightness > CLIPPED) & (brightness < 255 - CLIPPED)


def _moving_region(images: np.ndarray, *, fixed: bool) -> np.ndarray | None:
    """Mask ``(H, W)`` of where images ``(N, H, W, 3)`` of a fixed camera differ; None if it moves or nothing does."""
    spread = cv2.blur(images.std(0).max(-1), (3, 3))
    noise = float(np.quantile(spread, 0.05))
    if float(np.quantile(spread, 0.97)) < max(12.0, 4.0 * noise):
        return None
    ring = np.concatenate([spread[:4].ravel(), spread[-4:].ravel(), spread[:, :4].ravel(), spread[:, -4:].ravel()])
    still = _unchanged(spread, images.mean((0, 3))).mean()
    if not fixed and still < LEAST_STILL and float(np.quantile(ring, 0.8)) > BORDER_STILL:
        return None
    moving = (spread > max(6.0, 3.0 * noise)).astype(np.uint8) * 255
    return cleaned(cv2.morphologyEx(moving, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)), None)


def rotates(views: Sequence[View]) -> bool:
    """Whether two views differ by a rotation of LEAST_ROTATION or more."""
    rotations = np.array([v.rotation for v in views]).reshape(-1, 3, 3)
    cosines = (np.einsum("iab,jab->ij", rotations, rotations) - 1) / 2
    return bool((cosines <= np.cos(np.radians(LEAST_ROTATION))).any())


def on_turntable(views: Sequence[View]) -> bool:
    """Whether these are views of a fixed camera: the object turns about an axis that is constant in camera axes.

    False without a rotation, and for fewer than SMALLEST_GROUP, which any axis fits.
    """
    if len(views) < SMALLEST_GROUP or not rotates(views):
        return False
    rotations, shifts = np.stack([v.rotation for v in views]), np.stack([v.translation for v in views])
    u, _, vt = np.linalg.svd(rotations.mean(0))  # the direction that the mean rotation shortens least, and its image
    angles = np.degrees(np.arccos(np.clip(rotations @ vt[0] @ u[:, 0], -1, 1)))
    rows = np.concatenate([rotations, np.broadcast_to(-np.eye(3), rotations.shape)], 2).reshape(-1, 6)
    point, at = np.split(np.linalg.lstsq(rows, -shifts.ravel(), rcond=None)[0], 2)  # in the world, in camera axes
    away = np.linalg.norm(rotations @ point + shifts - at, axis=1)
    return bool(np.median(angles) < AXIS_ANGLE and np.median(away) < AXIS_SHIFT * np.linalg.norm(at))


def map_on_turntable(
    source: Path,
    photos: Sequence[Photo],
    positions: Sequence[Position],
    report: CaptureReport,
    progress: Progress,
    *,
    known: bool,
) -> Map | None:
    """The map of what turns, from features inside the regions; None if its views are not those of a turntable.

    Sets the lighting of ``report`` and adds notes.  known: True where it is a turntable: views that are not those of
    one only add a note.  Raises InputError if the features do not turn, and, where ``known``, without a map.
    """
    position_of = {photos[k].name: n for n, position in enumerate(positions) for k in position.images}
    others = [p.name for p in photos if p.name not in position_of]
    photos = [p for p in photos if p.name in position_of]
    regions = [positions[position_of[p.name]].region for p in photos]
    found = (map_photos if known else map_if_any)(photos, progress, regions)
    views = found.views if found else ()
    groups = [[v for v in views if position_of[v.photo.name] == n] for n in range(len(positions))]
    groups = [group for group in groups if group]
    if len(views) >= LEAST_REGISTERED * len(photos) and not any(map(rotates, groups)):
        raise InputError(
            source,
            "expected an object that turns together with what it stands on, or a camera that moves around it, got a "
            "fixed camera and features that do not turn; use a turntable with texture, or walk around the object",
        )
    fits = [on_turntable(group) for group in groups if len(group) >= SMALLEST_GROUP]
    turning = bool(fits) and all(fits)
    if not (turning or known):
        return None
    places = f" at {len(groups)} positions" if len(groups) > 1 else ""
    report.notes.append(f"turntable: the camera is fixed{places}, and the object turns")
    report.images = len(photos)
    report.left_out |= dict.fromkeys(others, "not from a position of the camera")
    if not turning:
        report.notes.append(
            "the cameras do not fit a turntable seen from one height before this background: if you moved around the "
            "object, omit --turntable"
        )
    report.lighting = "camera" if len(groups) == 1 and turning else "turntable"
    return found
