"""Turntables: an object that turns in front of a camera that is fixed at one position, or at several in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from reli3d.capture.mapping import View
from reli3d.capture.masks import cleaned
from reli3d.capture.photos import FEWEST
from reli3d.capture.rigidity import SMALLEST_GROUP

REGION_SIDE = 160  # pixels along the width at which images are compared
STILL = 3.0  # of 255: standard deviation between images up to which a pixel does not change: noise and JPEG
LEAST_STILL = 0.1  # fraction of such pixels from which the camera is fixed; hand-held images have none
SAME_POSITION = 0.5  # of the most similar pair's fraction of such pixels: a pair that has less is of two positions
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
    """The positions of the camera, if all images of each agree except at the turntable with the object; else none.

    Images have one position if they are linked by pairs in which at least SAME_POSITION as many pixels agree as in the
    most similar pair; each position has at least FEWEST images.  A camera is fixed where LEAST_STILL of the pixels do
    not change, or nearly all of the image's border does not.  fixed: True where that is known; a position then has at
    least SMALLEST_GROUP images.
    """
    if len({p.shape for p in pixels}) != 1:
        return []
    small, shape, least = _small(pixels), pixels[0].shape[:2], SMALLEST_GROUP if fixed else FEWEST
    every = [tuple(range(len(small)))]
    for groups, known in ((_similar_images(small), False), (every, False), (every, True))[: 3 if fixed else 2]:
        found = []
        for group in groups:
            region = _moving_region(small[list(group)], fixed=known) if len(group) >= least else None
            if region is not None:
                found.append(Position(group, cv2.resize(region, shape[::-1], interpolation=cv2.INTER_NEAREST)))
        if len(found) == len(groups):
            return found
    return []


def _small(pixels: Sequence[np.ndarray]) -> np.ndarray:
    """Images of one size ``(N, h, REGION_SIDE, 3)`` float32."""
    size = REGION_SIDE, max(1, round(REGION_SIDE * pixels[0].shape[0] / pixels[0].shape[1]))
    return np.stack([cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in pixels]).astype(np.float32)


def _similar_images(images: np.ndarray) -> list[tuple[int, ...]]:
    """Groups of the images ``(N, H, W, 3)`` linked by pairs with enough pixels that do not change."""
    same = np.zeros((len(images), len(images)))
    for b in range(len(images)):
        for a in range(b):
            same[a, b] = _still(images[[a, b]])[0].mean()
    count, group = connected_components(same > max(LEAST_STILL, SAME_POSITION * same.max()), directed=False)
    return [tuple((group == k).nonzero()[0].tolist()) for k in range(count)]


def _still(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels ``(H, W)`` that do not change and are not clipped, and the standard deviations."""
    spread = cv2.blur(images.std(0).max(-1), (3, 3))
    brightness = images.mean((0, 3))
    return (spread < STILL) & (brightness > CLIPPED) & (brightness < 255 - CLIPPED), spread  # not overexposed sky


def _moving_region(images: np.ndarray, *, fixed: bool) -> np.ndarray | None:
    """Mask ``(H, W)`` of where images ``(N, H, W, 3)`` of a fixed camera differ; None if it moves or nothing does."""
    still, spread = _still(images)
    noise = float(np.quantile(spread, 0.05))
    if float(np.quantile(spread, 0.97)) < max(12.0, 4.0 * noise):
        return None
    ring = np.concatenate([spread[:4].ravel(), spread[-4:].ravel(), spread[:, :4].ravel(), spread[:, -4:].ravel()])
    if not fixed and still.mean() < LEAST_STILL and float(np.quantile(ring, 0.8)) > BORDER_STILL:
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
