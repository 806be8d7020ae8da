"""Whether a map fits its matches, and how an object was moved between two maps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from reli3d.capture.mapping import Map, View

EPIPOLAR_ERROR = 0.002  # of the longer side: Sampson distance up to which a match fits an essential matrix
FEWEST_MATCHES = 15  # of a pair of views
CONFIDENCE = 0.999  # of RANSAC
GROUP_TURN = np.cos(np.radians(3.0))  # between rotations of the views of a group
GROUP_ERROR = 0.02  # of the distance to the middle of the cameras, of positions in a group
SMALLEST_GROUP = 3  # views
LEAST_JOINING = 0.5  # of the matches with views in groups: the motions of groups are less exact than poses


def epipolar_fit(
    found: Map, masks: dict[str, np.ndarray], *, inside: bool = True, between: Sequence[Group] | None = None
) -> float:
    """Matches inside the masks that fit the cameras of ``found``, over those that fit one essential matrix for each
    pair of views, found by RANSAC.

    About 1 where the object did not move relative to the features of the map.  Where it was moved the matches of a
    pair still fit an essential matrix of their own, but not that of the map's cameras.  inside: False takes the matches
    outside the masks instead.  between: only pairs of views that are not in one of these groups.  1 if no pair has
    FEWEST_MATCHES inliers.
    """
    group_of = {name: k for k, group in enumerate(between or ()) for name in group.names}
    fitting, best = 0, 0
    for first, second, x, y, own in _matches(found, masks, inside):
        if between is not None and group_of.get(first.photo.name, -1) == group_of.get(second.photo.name, -2):
            continue
        best += int(np.count_nonzero(own))
        fitting += int(_fits(x, y, first, second).sum())
    return fitting / best if best else 1.0


def _matches(found: Map, masks: dict[str, np.ndarray], inside: bool) -> Iterator[tuple]:
    """Pairs of views, normalized coordinates of their matches inside (outside) the masks, and which of these fit one
    essential matrix; only pairs of at least FEWEST_MATCHES that do.
    """
    for a, b, pixels_a, pixels_b in found.matches:
        first, second = found.views[a], found.views[b]
        if first.photo.name not in masks or second.photo.name not in masks:
            continue
        kept = inside_mask(masks[first.photo.name], pixels_a) == inside
        kept &= inside_mask(masks[second.photo.name], pixels_b) == inside
        if kept.sum() < FEWEST_MATCHES:
            continue
        x, y = first.normalized(pixels_a[kept]), second.normalized(pixels_b[kept])
        cv2.setRNGSeed(0)
        _, own = cv2.findEssentialMat(x, y, np.eye(3), cv2.RANSAC, CONFIDENCE, _limit(first, second))
        if own is not None and np.count_nonzero(own) >= FEWEST_MATCHES:  # wrong matches alone fit some matrix, too
            yield first, second, x, y, own[:, 0] > 0


def _limit(a: View, b: View) -> float:
    return EPIPOLAR_ERROR * max(a.photo.size) / min(a.focal, b.focal)


def _fits(x: np.ndarray, y: np.ndarray, a: View, b: View) -> np.ndarray:
    return _sampson(x, y, _essential(a, b)) < _limit(a, b)


def inside_mask(mask: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Which of ``pixels (N, 2)`` lie inside, ``(N,)``."""
    x, y = np.clip(pixels.astype(int), 0, np.array(mask.shape[::-1]) - 1).T
    return mask[y, x] > 127


def _essential(a: View, b: View) -> np.ndarray:
    turn = b.rotation @ a.rotation.T
    x, y, z = b.translation - turn @ a.translation
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn


def _sampson(x: np.ndarray, y: np.ndarray, essential: np.ndarray) -> np.ndarray:
    """First-order distance ``(N,)`` of pairs of normalized coordinates ``(N, 2)`` from ``y^T E x = 0``."""
    x, y = (np.concatenate([p, np.ones((len(p), 1))], 1) for p in (x, y))
    line, other = x @ essential.T, y @ essential
    gradient = (line[:, :2] ** 2).sum(1) + (other[:, :2] ** 2).sum(1)
    return np.abs((y * line).sum(1)) / np.sqrt(np.maximum(gradient, 1e-30))


@dataclass(frozen=True)
class Similarity:
    """``x -> scale rotation x + translation``: from a map to another one, or to the object folder."""

    scale: float
    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,)

    def apply(self, points: np.ndarray) -> np.ndarray:
        return self.scale * points @ self.rotation.T + self.translation

    def inverse(self, points: np.ndarray) -> np.ndarray:
        return (points - self.translation) @ self.rotation / self.scale


@dataclass(frozen=True)
class Group(Similarity):
    """Views, by name, that are related by one similarity from a map to another."""

    names: tuple[str, ...]

    def moved(self, view: View) -> View:
        """The view's pose in the other map."""
        rotation = view.rotation @ self.rotation.T
        return replace(view, rotation=rotation, translation=-rotation @ self.apply(view.eye))


def rigid_groups(first: Map, second: Map) -> list[Group]:
    """Groups of views, the largest first, within which ``second`` is ``first`` but for a similarity.

    A map of the surroundings and one of the object have one for each place at which the object was.  Views that belong
    to no other SMALLEST_GROUP - 1 are in none.
    """
    by_name = {v.photo.name: v for v in first.views}
    pairs = [(by_name[v.photo.name], v) for v in second.views if v.photo.name in by_name]
    groups: list[Group] = []
    while len(pairs) >= SMALLEST_GROUP:
        a, b = (np.stack([p[k].eye for p in pairs]) for k in (0, 1))
        turns = np.stack([p[1].rotation.T @ p[0].rotation for p in pairs])
        limit = GROUP_ERROR * float(np.median(np.linalg.norm(b - b.mean(0), axis=1)))
        best = np.zeros(len(pairs), bool)
        similar = (np.einsum("iab,jab->ij", turns, turns) - 1) / 2 > GROUP_TURN
        for i in range(len(pairs)):
            for j in similar[i].nonzero()[0]:
                if (base := float(np.linalg.norm(a[j] - a[i]))) < 1e-9:
                    continue
                scale = float(np.linalg.norm(b[j] - b[i])) / base
                away = np.linalg.norm(scale * (a - a[i]) @ turns[i].T - (b - b[i]), axis=1)
                if (fits := similar[i] & (away < 2 * limit)).sum() > best.sum():
                    best = fits
        if best.sum() < SMALLEST_GROUP:
            break
        scale, turn, shift = _similarity(a[best], b[best], turns[best])
        if np.median(np.linalg.norm(scale * a[best] @ turn.T + shift - b[best], axis=1)) > limit:
            break
        groups.append(Group(scale, turn, shift, tuple(p[0].photo.name for p, k in zip(pairs, best, strict=True) if k)))
        pairs = [p for p, k in zip(pairs, best, strict=True) if not k]
    return groups


def completed_groups(first: Map, groups: Sequence[Group], masks: dict[str, np.ndarray]) -> list[Group]:
    """``groups``, extended by views of ``first`` that are in none of them.

    A view joins the group under whose motion the largest fraction of its matches with views in groups fits, if that is
    LEAST_JOINING or more.  Only matches inside the masks count that fit one essential matrix for their pair of views.
    Repeated until no view joins.
    """
    pairs = list(_matches(first, masks, True))
    poses = [{v.photo.name: group.moved(v) for v in first.views} for group in groups]
    group_of = {name: k for k, group in enumerate(groups) for name in group.names}
    while True:
        fits: dict[str, list] = {v.photo.name: [] for v in first.views if v.photo.name not in group_of}
        for a, b, x, y, own in pairs:
            for one, other, p, q in ((a, b, x[own], y[own]), (b, a, y[own], x[own])):
                if (name := one.photo.name) in fits and (known := group_of.get(other.photo.name)) is not None:
                    fits[name].append([_fits(p, q, pose[name], poses[known][other.photo.name]) for pose in poses])
        rates = {name: np.concatenate(found, 1).mean(1) for name, found in fits.items() if found}
        joined = {name: int(rate.argmax()) for name, rate in rates.items() if rate.max() >= LEAST_JOINING}
        if not joined:
            return [replace(g, names=tuple(n for n, at in group_of.items() if at == k)) for k, g in enumerate(groups)]
        group_of |= joined


def _similarity(a: np.ndarray, b: np.ndarray, turns: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and shift from ``a (N, 3)`` to ``b``: the mean of ``turns (N, 3, 3)``, which are more exact than
    positions, and the least squares with it.
    """
    u, _, vt = np.linalg.svd(turns.mean(0))
    turn = u @ vt
    a0, b0 = a.mean(0), b.mean(0)
    moved = (a - a0) @ turn.T
    scale = float((moved * (b - b0)).sum() / (moved**2).sum())
    return scale, turn, b0 - scale * turn @ a0
