"""Masks of the object without a network: GrabCut seeded by the points of the map, or a uniform background's color."""

from __future__ import annotations

import cv2
import numpy as np

from reli3d.capture.mapping import Map, View
from reli3d.capture.scene import Scene

COARSE_SIDE, SIDE = 400, 1000  # pixels along the longer side of the image that is segmented, first and last
BAND = 0.01  # of the longer side: half the width of the band about the coarse outline
OUTER_GROWTH = 0.18  # of the object's projected hull: beyond it nothing is the object
GROWTH_STEPS = 4  # times the limit grows at most: parts without a point are missing in the hull
MOST_REACHED = 0.02  # fraction of the limit's edge up to which the mask does not count as cut off by it
SEED_RADIUS = 0.004  # of the longer side: disks around keypoints that are certain
CONTEXT = 0.25  # of the outer limit's size: background around it that the color model sees
ROUNDS = 3  # of GrabCut
FEWEST_SEEDS = 6  # keypoints of the object: fewer do not show its colors
HOLE = 0.002  # of the mask's area: smaller holes and islands are noise
LEAST_COVERED = 0.0005  # fraction of an image, below which a mask shows no object
KEY_SIGMAS = 4.0  # standard deviations of the border's color beyond which a pixel is the object


def grabcut_mask(view: View, found: Map, scene: Scene, support: np.ndarray | None = None) -> np.ndarray | None:
    """Mask ``(H, W)`` uint8, 255 inside, of the object in a view; None where the object's points lie elsewhere.

    GrabCut (Rother and others 2004) with the map's points as seeds.  Foreground are the keypoints of the object's
    points, or all of its points, projected, where the view observes less than FEWEST_SEEDS of them.  Background are the
    keypoints of the support plane and everything beyond an outer limit: the hull of the object's points and of their
    feet on the plane, grown by OUTER_GROWTH, and once more as long as the mask reaches it.  support: pixels ``(K, 2)``
    of background seeds, instead of the map's.
    """
    points = found.points[scene.object]
    feet = scene.plane.foot(points) if scene.plane else points[:0]
    (pixels, depth), (foot_pixels, foot_depth) = view.project(points), view.project(feet)
    pixels, foot_pixels = pixels[depth > 0], foot_pixels[foot_depth > 0]
    seeds = view.pixels[scene.object[view.points]]
    seeds = seeds if len(seeds) >= FEWEST_SEEDS else pixels
    seeds = seeds[((seeds > 0) & (seeds < np.array(view.photo.size) - 1)).all(1)]
    if len(seeds) < FEWEST_SEEDS:
        return None
    outline = cv2.convexHull(np.concatenate([pixels, foot_pixels]).astype(np.float32))[:, 0]
    ground = view.pixels[scene.support[view.points]] if support is None else support
    found_masks = []
    for step in range(1, GROWTH_STEPS + 1):
        mask, limit = _coarse_mask(view.photo.pixels, outline, OUTER_GROWTH * step, seeds, ground)
        found_masks.append(mask)
        if _reached(limit, mask) <= MOST_REACHED:
            break
    else:  # it leaks into the background without end
        mask = found_masks[0]
    return full_size(refined(view.photo.pixels, mask), view.photo.pixels.shape)


def _coarse_mask(
    pixels: np.ndarray, outline: np.ndarray, growth: float, seeds: np.ndarray, ground: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The mask at COARSE_SIDE, and its outer limit: the convex ``outline (K, 2)`` grown by ``growth``."""
    image, scale = reduced(pixels, COARSE_SIDE)
    limit = np.zeros(image.shape[:2], np.uint8)
    middle = outline.mean(0)
    grown = (middle + (outline - middle) * (1 + growth)) * scale
    cv2.fillConvexPoly(limit, np.rint(grown).astype(np.int32), 1)
    labels = np.where(limit > 0, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    cv2.fillConvexPoly(labels, np.rint(outline * scale).astype(np.int32), cv2.GC_PR_FGD)
    radius = max(1, round(SEED_RADIUS * max(limit.shape)))
    for points, label in ((ground, cv2.GC_BGD), (seeds, cv2.GC_FGD)):
        for at in np.rint(points * scale).astype(int):
            cv2.circle(labels, at.tolist(), radius, label, -1)
    return cleaned(grabcut(image, labels, limit), seeds * scale), limit


def refined(pixels: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """``coarse`` at SIDE: segmented anew within BAND of its outline (Lombaert and others 2005, banded graph cuts)."""
    image, scale = reduced(pixels, SIDE)
    if image.shape[:2] == coarse.shape:
        return coarse
    mask = ((full_size(coarse, image.shape) > 127) * 255).astype(np.uint8)
    size = 2 * round(BAND * max(mask.shape)) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    labels = np.where(mask > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[cv2.erode(mask, kernel, borderValue=255) > 0] = cv2.GC_FGD
    around = cv2.dilate(mask, kernel)
    labels[around == 0] = cv2.GC_BGD
    return cleaned(grabcut(image, labels, around), None)


def grabcut(image: np.ndarray, labels: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """The mask ``(H, W)`` of OpenCV's ``labels``, with the background's colors from a margin around ``limit``."""
    ys, xs = limit.nonzero()
    if len(ys) == 0:
        return np.zeros(limit.shape, np.uint8)
    pad = round(CONTEXT * max(np.ptp(ys), np.ptp(xs)) + 8)
    box = slice(max(0, ys.min() - pad), ys.max() + pad), slice(max(0, xs.min() - pad), xs.max() + pad)
    part, crop = np.ascontiguousarray(labels[box]), np.ascontiguousarray(image[box][..., ::-1])
    known = {int(label) for label in np.unique(part)}
    if known & {cv2.GC_BGD, cv2.GC_PR_BGD} and known & {cv2.GC_FGD, cv2.GC_PR_FGD}:
        cv2.setRNGSeed(0)
        colors = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(crop, part, (0, 0, 0, 0), *colors, ROUNDS, cv2.GC_INIT_WITH_MASK)
    mask = np.zeros(limit.shape, np.uint8)
    mask[box] = ((part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)) * 255
    return mask


def _reached(limit: np.ndarray, mask: np.ndarray) -> float:
    """Fraction of the limit's edge, but for the image's border, at which the mask is inside."""
    edge = (limit > 0) & (cv2.erode(limit, np.ones((3, 3), np.uint8), borderValue=1) == 0)
    return float((mask[edge] > 0).mean()) if edge.any() else 0.0


def key_mask(pixels: np.ndarray) -> np.ndarray | None:
    """Mask of the pixels that differ from the color of the image's border; None unless the border has one color."""
    image, _ = reduced(pixels, SIDE)
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.float32)
    border = np.concatenate([lab[0], lab[-1], lab[:, 0], lab[:, -1]])
    middle = np.median(border, 0)
    spread = np.maximum(1.4826 * np.median(np.abs(border - middle), 0), 2.0)
    mask = ((np.abs(lab - middle) / spread).max(-1) > KEY_SIGMAS).astype(np.uint8) * 255
    mask = cleaned(cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), None)
    inside = float((mask > 0).mean())
    return full_size(mask, pixels.shape) if 0.002 < inside < 0.8 else None


def cleaned(mask: np.ndarray, seeds: np.ndarray | None) -> np.ndarray:
    """``mask`` without small islands and holes.  Islands that hold a seed ``(K, 2)`` stay, else the largest alone."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(mask)
    if count < 2:
        return mask
    area = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    area[0] = 0
    keep = area == area.max()
    if seeds is not None:
        at = np.rint(seeds).astype(int)
        at = at[(at >= 0).all(1) & (at[:, 0] < mask.shape[1]) & (at[:, 1] < mask.shape[0])]
        hit = np.bincount(label[at[:, 1], at[:, 0]], minlength=count) > 0
        keep |= hit & (area > HOLE * area.max())
    keep[0] = False
    mask = keep[label].astype(np.uint8) * 255
    count, label, stats, _ = cv2.connectedComponentsWithStats(255 - mask)
    small = stats[:, cv2.CC_STAT_AREA] < HOLE * area.max()
    small[0] = False
    mask[small[label]] = 255
    return mask


def is_empty(mask: np.ndarray) -> bool:
    """Whether less than LEAST_COVERED of the mask is inside."""
    return bool((mask > 127).mean() < LEAST_COVERED)


def touches_border(mask: np.ndarray) -> bool:
    """Whether more than a few pixels of the mask lie on the image's border."""
    inside = mask > 127
    edge = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
    return int(edge.sum()) > 0.004 * max(mask.shape)


def reduced(pixels: np.ndarray, side: int) -> tuple[np.ndarray, float]:
    scale = min(1.0, side / max(pixels.shape[:2]))
    if scale == 1.0:
        return pixels, 1.0
    size = round(pixels.shape[1] * scale), round(pixels.shape[0] * scale)
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), scale


def full_size(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if mask.shape == shape[:2]:
        return mask
    return cv2.resize(mask, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
