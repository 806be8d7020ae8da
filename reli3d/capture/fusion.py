"""Joint segmentation of all views: log odds of pixels, from the object's colors and the texture of the support plane,
are fused in a volume.

Where object and background have similar colors, one image does not show the outline.  Other views do: from above,
the object is in front of the plane, whose texture is known from the views that see it uncovered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from reli3d.capture.consistency import completed_masks
from reli3d.capture.mapping import Map, View, grown, point_mask, shown_pixels
from reli3d.capture.masks import COARSE_SIDE, full_size, grabcut, reduced, refined
from reli3d.capture.rigidity import Similarity
from reli3d.capture.scene import Scene

SIDES = COARSE_SIDE, COARSE_SIDE, 720  # pixels along the longer side of the images; memory limits the last
TEXEL = 1.5  # pixels of the images, at the cameras' median distance
ROWS, GAIN_STEP = 64, 4  # texels: rows at a time; gains are compared at every fourth in both directions
TEXTURE_REACH = 0.9  # of the cameras' median distance: half the side of the textured square
FEWEST_SAMPLES = 2  # views that show a texel
COVER_MARGIN = 0.01  # of the longer side: no texels are taken so near to the object, whose outline is uncertain
MASK_MARGIN = 0.004  # the same where enough views show a texel outside the masks
LEAST_SPREAD, MOST_SPREAD = 3.0, 40.0  # of 255: standard deviation of a texel over the views, and where it is unknown
DARKEST = 8.0  # of 255: darker texels are counted as this bright in gains
UNLIKE_PLANE = 3.0  # spreads from which a pixel does not show the plane
NEAR_AND_AROUND = 9, 161  # pixels: sides of the squares by which the mask is grown; colors between are the background's
FEWEST_PIXELS = 100  # from which a median or a mixture is taken
SHADOWS = 0.05  # fraction of the plane's pixels that do not look like its texture
COMPONENTS, COLOR_NOISE, COLOR_SAMPLES = 5, 2.0, 3000  # of a mixture of Gaussians; of 255; pixels
LOWEST_DENSITY = -23.0  # logarithm of a density of colors, per 1 / 255^3
PLANE_EVIDENCE, COLOR_EVIDENCE = 4.0, 1.5  # largest log odds of a pixel, before the plane and elsewhere
COVERED = 0.85  # probability that a pixel shows the object although a point near it on the same ray is empty
GRIDS = 64, 96, 160  # cells along the volume's side, in each pass
LEAST_SEEN = 0.5  # fraction of the views that must show a cell
VOLUME_SIDE = 2.0, 1.15, 1.15  # sides of the volume over those of the object so far, in each pass
PRIOR_INSIDE, PRIOR_OUTSIDE = 3.0, 6.0  # largest log odds by the distance in pixels from the volume's silhouette
SHADOW_HEIGHT = 0.1, 0.4  # of the object's longest side and of its height: lower cells may be a shadow on the plane
POINT_REACH = 0.04  # of the object's longest side: cells so near to one of its points are no shadow
CERTAIN_OBJECT = 3.0  # log odds from which GrabCut keeps a pixel whose neighbors have them too: evidence is blurred
CERTAIN_BACKGROUND = 2.0  # the same of the background: GrabCut would add shadows of a color like the object
CERTAIN_PLANE = 3.0  # the same without the prior of the silhouettes; only the plane's texture reaches it
LIMIT_PIXELS = 12  # around the silhouette: farther out nothing is the object


@dataclass(frozen=True)
class _Small:
    """A view with its image at one of SIDES."""

    view: View
    image: np.ndarray  # (H, W, 3) uint8
    scale: float

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixels, depth = self.view.project(points)
        return pixels * self.scale, depth


def fused_masks(found: Map, scene: Scene, masks: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Masks by name of the views in ``masks``, segmented jointly; unchanged without a support plane.

    The log odds of a pixel, object over background, compare a mixture of Gaussians of the object's colors with the
    plane's texture, or elsewhere with the colors around the object.  Those of all views give the log odds that a cell
    of a volume is occupied (Franco and Boyer 2005).  From the second pass on, cells below SHADOW_HEIGHT
    without points of the object near them do not hide the plane: a contact shadow becomes a part of its texture.  Each
    pass ends with GrabCut from the log odds of pixels and silhouettes; the last has larger images.
    :func:`completed_masks` adds parts that some masks lack.
    """
    if scene.plane is None or not masks:
        return masks
    axes = Similarity(1.0, scene.plane.axes.T, scene.plane.foot(scene.center))  # from the plane's axes to the map
    views = [v for v in found.views if v.photo.name in masks]
    inside = [masks[v.photo.name] for v in views]
    points = axes.inverse(found.points[scene.object])
    box = np.stack([np.minimum(points.min(0), [np.inf, np.inf, 0]), points.max(0)])
    on_object, cover = cKDTree(points), inside
    for side, cells, growth in zip(SIDES, GRIDS, VOLUME_SIDE, strict=True):
        smalls = [_Small(v, *reduced(v.photo.pixels, side)) for v in views]
        inside, cover = (
            [full_size(m, s.image.shape) > 127 for m, s in zip(x, smalls, strict=True)] for x in (inside, cover)
        )
        texture = _plane_texture(smalls, inside, cover, axes, scene)
        expected = [_expected(texture, axes, s) for s in smalls]
        evidence = _evidence(smalls, inside, expected)
        occupied, cell = _occupied(smalls, evidence, axes, box, points, cells, growth)
        if len(occupied) == 0:
            return masks
        box = np.stack([occupied.min(0), occupied.max(0)])
        longest = (box[1] - box[0]).max()
        high = occupied[:, 2] > min(SHADOW_HEIGHT[0] * longest, SHADOW_HEIGHT[1] * box[1, 2])
        high |= on_object.query(occupied)[0] < POINT_REACH * longest
        occupied = axes.apply(occupied)
        cover = [_silhouette(s, occupied[high], cell) for s in smalls]
        odds = [_with_prior(s, e, occupied, cell) for s, e in zip(smalls, evidence, strict=True)]
        inside = [_segmented(s.image, o, e) for s, o, e in zip(smalls, odds, evidence, strict=True)]
    photos = [v.photo for v in views]
    fused = {p.name: full_size(refined(p.pixels, m), p.pixels.shape) for p, m in zip(photos, inside, strict=True)}
    return completed_masks(views, fused, np.stack([occupied.min(0), occupied.max(0)]))


@dataclass(frozen=True)
class _Texture:
    """Colors ``(N, N, 3)`` of squares of the plane about the origin of its axes, and their spread ``(N, N)``."""

    cell: float
    color: np.ndarray
    spread: np.ndarray


def _plane_texture(
    smalls: Sequence[_Small], inside: Sequence[np.ndarray], cover: Sequence[np.ndarray], axes: Similarity, scene: Scene
) -> _Texture:
    """Median over views, after one gain for each view and channel, of what they show outside ``cover``.

    Views that show a texel outside the masks ``inside`` too are preferred, if there are FEWEST_SAMPLES: ``cover`` lacks
    the low parts of the object.
    """
    cell = TEXEL * scene.distance / float(np.median([s.view.focal * s.scale for s in smalls]))
    count = int(2 * TEXTURE_REACH * scene.distance / cell)
    at = (np.arange(count) + 0.5 - count / 2) * cell
    hidden = [
        np.where(grown(c, COVER_MARGIN) > 0, np.uint8(2), grown(m, MASK_MARGIN))
        for m, c in zip(inside, cover, strict=True)
    ]
    coarse, _ = _plane_samples(smalls, hidden, axes, at[::GAIN_STEP], at[::GAIN_STEP])
    reference = _median(coarse)
    gains = np.stack([_gain(s, reference) for s in coarse])[:, None, None]
    color, spread = np.zeros((count, count, 3), np.float32), np.zeros((count, count), np.float32)
    for first in range(0, count, ROWS):
        rows = slice(first, first + ROWS)
        stack, outside = _plane_samples(smalls, hidden, axes, at, at[rows])
        stack /= gains
        stack[~outside & (np.count_nonzero(outside, axis=0) >= FEWEST_SAMPLES)] = np.nan
        middle = _median(stack)
        deviation = 1.4826 * _median(np.abs(stack - middle)).max(-1)
        known = np.count_nonzero(~np.isnan(stack[..., 0]), axis=0) >= FEWEST_SAMPLES
        color[rows] = np.nan_to_num(middle)
        spread[rows] = np.where(known, np.maximum(deviation, LEAST_SPREAD), 10 * MOST_SPREAD)
    return _Texture(cell, color, spread)


def _plane_samples(
    smalls, hidden: Sequence[np.ndarray], axes: Similarity, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colors ``(V, len(v), len(u), 3)`` of points of the plane in each view, NaN where it does not show them or
    ``hidden`` is 2; and where it shows them and ``hidden`` is 0.
    """
    grid = axes.apply(np.stack([*np.meshgrid(u, v), np.zeros((len(v), len(u)))], -1).reshape(-1, 3)).astype(np.float32)
    samples = np.zeros((len(smalls), len(v), len(u), 3), np.float32)
    outside = np.zeros(samples.shape[:3], bool)
    for k, (small, values) in enumerate(zip(smalls, hidden, strict=True)):
        pixels, depth = small.project(grid)
        x, y = (pixels.T - 0.5).astype(np.float32).reshape(2, len(v), len(u))
        samples[k] = cv2.remap(small.image, x, y, cv2.INTER_LINEAR)
        found = cv2.remap(values, x, y, cv2.INTER_NEAREST, borderValue=2)
        found[depth.reshape(found.shape) <= 0] = 2
        samples[k][found == 2] = np.nan
        outside[k] = found == 0
    return samples, outside


def _median(stack: np.ndarray) -> np.ndarray:
    return torch.from_numpy(stack).nanmedian(0).values.numpy()


def _gain(color: np.ndarray, reference: np.ndarray) -> np.ndarray:
    ratio = (color / np.maximum(reference, DARKEST)).reshape(-1, 3)
    return np.nan_to_num(_median(ratio), nan=1.0).clip(0.2, 5.0)


@dataclass(frozen=True)
class _Expected:
    """The plane as a view shows it: color ``(H, W, 3)`` float32 and spread ``(H, W)``."""

    color: np.ndarray
    spread: np.ndarray
    known: np.ndarray  # (H, W) bool

    def away(self, image: np.ndarray, gain: np.ndarray | float) -> np.ndarray:
        """Distance ``(H, W, 3)`` of the colors of ``image`` from the plane's, of the nearest pixels within one.

        It is symmetric: a gray lies within the local range of a print's colors, but not the reverse.
        """
        image, plane = image.astype(np.float32), (self.color * gain).astype(np.float32)
        return np.maximum(_outside(image, plane), _outside(plane, image))


def _outside(colors: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distance ``(H, W, 3)`` of ``colors`` from the range of ``others`` within a pixel."""
    window = np.ones((3, 3), np.uint8)
    return np.maximum(np.maximum(colors - cv2.dilate(others, window), cv2.erode(others, window) - colors), 0.0)


def _expected(texture: _Texture, axes: Similarity, small: _Small) -> _Expected:
    h, w = small.image.shape[:2]
    y, x = (np.mgrid[:h, :w] + 0.5) / small.scale
    rays = small.view.rays(np.stack([x, y], -1).reshape(-1, 2)) @ axes.rotation
    eye = axes.inverse(small.view.eye)
    along = -eye[2] / np.where(np.abs(rays[:, 2]) > 1e-9, rays[:, 2], 1e-9)
    hit = (eye[:2] + along[:, None] * rays[:, :2]) / texture.cell + len(texture.color) / 2 - 0.5
    hit[along <= 0] = -10
    u, v = hit.T.astype(np.float32).reshape(2, h, w)
    color = cv2.remap(texture.color, u, v, cv2.INTER_LINEAR)
    spread = cv2.remap(texture.spread, u, v, cv2.INTER_LINEAR, borderValue=10 * MOST_SPREAD)
    return _Expected(color, np.maximum(spread, LEAST_SPREAD), spread < MOST_SPREAD)


class _Colors:
    """A mixture of Gaussians of colors ``(N, 3)``, one for each of COMPONENTS clusters; of none, the least density."""

    def __init__(self, colors: np.ndarray) -> None:
        some = colors[np.random.default_rng(0).permutation(len(colors))[:COLOR_SAMPLES]].astype(np.float32)
        cv2.setRNGSeed(0)
        count = min(COMPONENTS, len(some))
        label = np.zeros((len(some), 1), np.int32)
        if count:
            cv2.kmeans(some, count, label, (3, 10, 1.0), 1, cv2.KMEANS_PP_CENTERS)
        self.parts = []
        for k in range(count):
            part = some[label[:, 0] == k]
            covariance = np.cov(part.T) if len(part) > 3 else np.zeros((3, 3))
            covariance = covariance + COLOR_NOISE**2 * np.eye(3)
            constant = np.log(len(part) / len(some)) - 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]
            self.parts.append((part.mean(0), np.linalg.inv(covariance).astype(np.float32), np.float32(constant)))

    def log_density(self, image: np.ndarray) -> np.ndarray:
        flat = np.ascontiguousarray(image.reshape(-1, 3).T, np.float32)
        density = np.full(flat.shape[1], np.exp(LOWEST_DENSITY), np.float32)
        for middle, inverse, constant in self.parts:
            away = flat - middle[:, None]
            density += np.exp(constant - 0.5 * (away * (inverse @ away)).sum(0))
        return np.log(density).reshape(image.shape[:2])


def _evidence(
    smalls: Sequence[_Small], inside: Sequence[np.ndarray], expected: Sequence[_Expected]
) -> list[np.ndarray]:
    """Log odds ``(H, W)`` of the pixels of each view: object over background."""
    samples = []
    for small, mask, plane in zip(smalls, inside, expected, strict=True):
        core = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        unlike = plane.away(small.image, 1.0).max(-1) > UNLIKE_PLANE * plane.spread
        samples.append(small.image[core & (unlike | ~plane.known)])
    own = _Colors(np.concatenate(samples))
    return [_log_odds(s.image, m, plane, own) for s, m, plane in zip(smalls, inside, expected, strict=True)]


def _log_odds(image: np.ndarray, inside: np.ndarray, plane: _Expected, own: _Colors) -> np.ndarray:
    near, around = (cv2.dilate(inside.astype(np.uint8), np.ones((k, k), np.uint8)) > 0 for k in NEAR_AND_AROUND)
    sample, gain = ~near & plane.known, np.ones(3)
    if sample.sum() > FEWEST_PIXELS:
        gain = np.median(image[sample] / np.maximum(plane.color[sample], DARKEST), 0)
    context = around & ~near
    other = _Colors(image[context if context.sum() > FEWEST_PIXELS else ~inside]).log_density(image)
    as_plane = -0.5 * (plane.away(image, gain) ** 2).sum(-1) / plane.spread**2
    as_plane -= 3 * np.log(plane.spread) + 1.5 * np.log(2 * np.pi)
    as_plane = np.logaddexp(np.log(1 - SHADOWS) + as_plane, np.log(SHADOWS) + other)
    odds = own.log_density(image) - np.where(plane.known, as_plane, other)
    limit = np.where(plane.known, PLANE_EVIDENCE, COLOR_EVIDENCE)
    return np.clip(cv2.GaussianBlur(np.clip(odds, -8, 8), (0, 0), 1.2), -limit, limit).astype(np.float32)


def _occupied(smalls, evidence, axes: Similarity, box, points, cells: int, growth: float) -> tuple[np.ndarray, float]:
    """Centers ``(N, 3)``, in ``axes``, of the outermost cells of the occupied ones that are connected to ``points``,
    and their size.
    """
    extent = box[1] - box[0]
    cell = growth * float(extent.max()) / cells
    margin = (growth - 1) / 2 * float(extent.max())
    low, high = box[0] - margin, box[1] + margin
    low[2] = max(low[2], 0.0)
    shape = np.ceil((high - low) / cell).astype(int).clip(min=1)
    at = [start + (np.arange(n) + 0.5) * cell for start, n in zip(low, shape, strict=True)]
    grid = np.stack(np.meshgrid(*at, indexing="ij"), -1)
    flat = axes.apply(grid.reshape(-1, 3)).astype(np.float32)
    index, odds, seen = np.arange(len(flat)), np.zeros(len(flat), np.float32), np.zeros(len(flat), np.float32)
    for k, (small, e) in enumerate(zip(smalls, evidence, strict=True), 1):
        added = -np.log(COVERED + (1 - COVERED) * np.exp(-e))
        pixels, depth = small.project(flat)
        x, y, shown = shown_pixels(pixels, depth, e.shape)
        odds[shown] += added[y, x]
        seen += shown
        most_added = -np.log(COVERED) * (len(smalls) - k)  # by the views to come
        open_cells = odds > -most_added
        index, flat, odds, seen = index[open_cells], flat[open_cells], odds[open_cells], seen[open_cells]
    full = np.zeros(shape.prod(), bool)
    full[index] = seen >= LEAST_SEEN * len(smalls)
    label, count = ndimage.label(full.reshape(shape))
    if count == 0:
        return np.zeros((0, 3)), cell
    index = np.floor((points - low) / cell).astype(int)
    index = index[((index >= 0) & (index < shape)).all(1)]
    votes = np.bincount(label[tuple(index.T)], minlength=count + 1)
    votes[0] = 0
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    sizes[0] = 0
    best = votes.argmax() if votes.max() > 0 else sizes.argmax()
    return grid[(label == best) & ~ndimage.binary_erosion(label == best)], cell


def _silhouette(small: _Small, centers: np.ndarray, cell: float) -> np.ndarray:
    """``(H, W)`` uint8, 255 where the view shows the cells of size ``cell`` about ``centers (N, 3)``."""
    pixels, depth = small.project(centers)
    silhouette = point_mask(pixels, depth, small.image.shape)
    if not silhouette.any():
        return silhouette
    width = int(np.ceil(small.view.focal * small.scale * cell / np.median(depth[depth > 0]))) + 2
    return cv2.morphologyEx(silhouette, cv2.MORPH_CLOSE, np.ones((width, width), np.uint8))


def _with_prior(small: _Small, evidence: np.ndarray, occupied: np.ndarray, cell: float) -> np.ndarray:
    """``evidence`` plus log odds by the distance from the silhouette of the occupied cells; -inf far outside of it."""
    closed = _silhouette(small, occupied, cell)
    if not closed.any():
        return np.full_like(evidence, -np.inf)
    away = cv2.distanceTransform(closed, cv2.DIST_L2, 3) - cv2.distanceTransform(255 - closed, cv2.DIST_L2, 3)
    away += 0.5 * small.view.focal * small.scale * cell / np.median(small.project(occupied)[1])  # cells, not centers
    return np.where(away > -LIMIT_PIXELS, evidence + np.clip(away, -PRIOR_OUTSIDE, PRIOR_INSIDE), -np.inf)


def _segmented(image: np.ndarray, odds: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """Mask ``(H, W)`` uint8 by GrabCut, which starts from the log odds of the pixels; ``evidence``: without prior."""
    limit = odds > -np.inf
    labels = np.where(odds > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    background = (odds < -CERTAIN_BACKGROUND) | (evidence < -CERTAIN_PLANE)
    for certain, label in ((odds > CERTAIN_OBJECT, cv2.GC_FGD), (background, cv2.GC_BGD)):
        labels[cv2.erode(certain.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0] = label
    labels[~limit] = cv2.GC_BGD
    return grabcut(image, labels, limit)
