"""Maps of scenes in which the object, or something around it, moved between images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from reli3d.capture.consistency import aligned, hull_agreement, masked_views
from reli3d.capture.fusion import fused_masks
from reli3d.capture.mapping import Map, View, map_if_any, point_mask
from reli3d.capture.masks import grabcut_mask, is_empty, touches_border
from reli3d.capture.photos import FEWEST, Progress
from reli3d.capture.report import LEAST_FIT, CaptureReport
from reli3d.capture.rigidity import SMALLEST_GROUP, Group, completed_groups, epipolar_fit, rigid_groups
from reli3d.capture.scene import Scene, find_scene

COMPLETE_AGREEMENT = 0.99  # mean fraction filled by the hull above which masks count as complete
RIGID_FIT = 0.95  # least epipolar fit of correct cameras
KEPT_FRACTION = 0.9  # least fraction of the views, or of the masks, that a second map keeps
SAME_UP = math.cos(math.radians(15.0))  # between the upward directions of views of the object in one pose


@dataclass(frozen=True)
class Segmented:
    """A map and the masks of its views, by name."""

    found: Map
    masks: dict[str, np.ndarray]

    @property
    def views(self) -> list[View]:
        return [v for v in self.found.views if v.photo.name in self.masks]


def segmented_masks(
    found: Map, scene: Scene, known: dict | None, progress: Progress, support: dict[str, np.ndarray] | None = None
) -> dict[str, np.ndarray]:
    """Masks of the views of a map by the names of their photos, of those that have one.

    known: masks that replace those by the map's points.  support: pixels ``(N, 2)`` of points of the support by name;
    None takes those of ``scene``.
    """
    if known is not None:
        return {v.photo.name: known[v.photo.name] for v in found.views if v.photo.name in known}
    masks = {}
    for k, view in enumerate(found.views):
        progress("masks", k, len(found.views))
        seeds = None if support is None else support.get(view.photo.name, np.zeros((0, 2)))
        mask = grabcut_mask(view, found, scene, seeds)
        if mask is not None:
            masks[view.photo.name] = mask
    progress("masks", len(found.views), len(found.views))
    return _not_empty(masks)


def _not_empty(masks: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: mask for name, mask in masks.items() if not is_empty(mask)}


def without_moving(
    segmented: Segmented, scene: Scene, known: dict | None, report: CaptureReport, progress: Progress
) -> tuple[Segmented, Scene]:
    """The map of the features inside the masks and on the support alone, with its masks, and its scene.

    Returns the input if the matches around the object fit the cameras, if the object itself was moved, or if too few
    images are registered or have masks.
    """
    first, masks = segmented.found, segmented.masks
    if report.surroundings_fit >= RIGID_FIT or epipolar_fit(first, masks) < RIGID_FIT:
        return segmented, scene
    support = first.points[scene.support]
    regions = [point_mask(*v.project(support), v.photo.size[::-1]) for v in first.views]
    regions = [np.maximum(r, masks.get(v.photo.name, 0)) for r, v in zip(regions, first.views, strict=True)]
    second = map_if_any([v.photo for v in first.views], progress, regions)
    if second and len(second.views) >= KEPT_FRACTION * len(first.views) and epipolar_fit(second, masks) >= RIGID_FIT:
        again = find_scene(second)
        renewed = segmented_masks(second, again, known, progress)
        if len(renewed) >= KEPT_FRACTION * len(masks):
            report.notes.append(
                "matches around the object do not fit the cameras (something moves there): only features on the object "
                "and its support are used"
            )
            report.surroundings_fit = epipolar_fit(second, renewed, inside=False)
            return Segmented(second, renewed), again
    fit = f"{100 * report.surroundings_fit:.0f} % of the matches around the object fit the cameras"
    if report.surroundings_fit < LEAST_FIT:
        report.failed.append(f"{fit}, at least {100 * LEAST_FIT:.0f} % expected: something moves there")
    else:
        report.notes.append(f"{fit}: if something moves there, the cameras may be inaccurate")
    return segmented, scene


def object_map(
    segmented: Segmented, scene: Scene, known: dict | None, report: CaptureReport, progress: Progress
) -> tuple[Segmented, np.ndarray, float | None]:
    """The map in the object's frame with its masks, the upward direction ``(3,)`` and the ground's height along it
    (None: unknown).

    If matches inside the masks do not fit the cameras, or the masks disagree, these features are mapped separately.
    The object was moved if no similarity relates the two maps and its matches fit the second one better.  The
    intrinsics, and the relative poses within each group of views between which the object did not move, are then those
    of the first map, if the matches outside the masks fit it.  The masks are fused, in each group of a moved object,
    and then align the groups.  Consistent masks only lose pixels.
    """
    first, masks = segmented.found, segmented.masks
    report.epipolar_fit = epipolar_fit(first, masks)
    consistent = hull_agreement(segmented.views, masks) > COMPLETE_AGREEMENT
    moved = None
    if report.epipolar_fit < RIGID_FIT or not consistent:
        moved = _map_of_moved_object(segmented, report, progress)
    if moved is None:
        if known is None and report.epipolar_fit >= RIGID_FIT:
            fused = fused_masks(first, scene, masks)
            if consistent:  # the masks are complete, but may contain a contact shadow
                fused = {name: np.minimum(mask, fused[name]) for name, mask in masks.items()}
            segmented = Segmented(first, _not_empty(fused))
        return segmented, _upward(first, scene), -scene.plane.offset if scene.plane else None
    report.notes.append(
        "the object was moved relative to its surroundings: cameras are estimated from features on the object"
    )
    second, groups = moved
    by_name = {v.photo.name: v for v in first.views}
    masks = _masks_of_moved_object(segmented, scene, second, groups, known, progress)
    result = Segmented(_posed(second, _aligned_groups(groups, by_name, masks), by_name), masks)
    if groups and scene.plane:
        up = groups[0].rotation @ _upward(first, scene)
        return result, up, float(groups[0].apply(scene.plane.foot(scene.center)) @ up)
    turns = np.stack([v.rotation.T @ by_name[v.photo.name].rotation for v in second.views])
    directions = turns @ _upward(first, scene)
    similar = directions @ directions.T > SAME_UP  # of an object that was turned over, take the direction of most views
    upward = directions[similar[similar.sum(1).argmax()]].mean(0)
    return result, upward / np.linalg.norm(upward), None


def _upward(found: Map, scene: Scene) -> np.ndarray:
    """Normal of the support plane, or the mean upward direction of the cameras, ``(3,)``."""
    if scene.plane:
        return scene.plane.normal
    down = np.stack([v.rotation[1] for v in found.views]).mean(0)
    return -down / max(np.linalg.norm(down), 1e-9)


def _map_of_moved_object(
    segmented: Segmented, report: CaptureReport, progress: Progress
) -> tuple[Map, list[Group]] | None:
    """The map of the features inside the masks, and the groups of views with relative poses of the first map.

    None if the object did not move, or if its features are too few; sets ``report.epipolar_fit``.
    """
    first, views, masks = segmented.found, segmented.views, segmented.masks
    by_name = {v.photo.name: v for v in first.views}
    lenses = first if report.surroundings_fit >= RIGID_FIT else None
    second = map_if_any([v.photo for v in views], progress, [masks[v.photo.name] for v in views], lenses)
    if second is None:
        return None
    groups, after = rigid_groups(first, second), 1.0
    if not groups or len(groups[0].names) < KEPT_FRACTION * len(second.views):  # no similarity
        same = replace(second, views=tuple(by_name[v.photo.name] for v in second.views))
        report.epipolar_fit = min(report.epipolar_fit, epipolar_fit(same, masks, between=groups))
        after = epipolar_fit(second, masks, between=groups)
    if lenses and len(groups) > 1 and len(second.views) < len(views):
        groups = completed_groups(first, groups, masks)
        unseen = {name for group in groups for name in group.names} - {v.photo.name for v in second.views}
        added = (replace(v, pixels=v.pixels[:0], points=v.points[:0]) for v in views if v.photo.name in unseen)
        second = replace(second, views=(*second.views, *added))  # posed by their groups below
    if (
        len(second.views) < KEPT_FRACTION * len(first.views)
        or report.epipolar_fit >= RIGID_FIT
        or after <= report.epipolar_fit
    ):
        return None
    report.epipolar_fit = after
    groups = groups if lenses else []
    return _posed(second, groups, by_name), groups


def _masks_of_moved_object(
    segmented: Segmented, scene: Scene, second: Map, groups: Sequence[Group], known: dict | None, progress: Progress
) -> dict[str, np.ndarray]:
    """Masks by name of the views of ``second``, the object's map; those of the first map if they agree better."""
    first, before = segmented.found, Segmented(second, segmented.masks)
    support = {v.photo.name: v.pixels[scene.support[v.points]] for v in first.views}
    own = find_scene(second, supported=False)
    masks = segmented_masks(second, own, known, progress, support)
    if known is None:  # in the first map, where the support and its shadows do not move within a group
        by_name = {v.photo.name: v for v in first.views}
        for group in (g for g in groups if len(g.names) >= FEWEST):
            points = group.inverse(second.points[own.object])
            at = replace(first, views=tuple(by_name[name] for name in group.names), points=points)
            whole = replace(scene, object=np.ones(len(points), bool))
            masks |= fused_masks(at, whole, {name: masks[name] for name in group.names if name in masks})
        masks = _not_empty(masks)
    if len(masks) < KEPT_FRACTION * len(segmented.masks) or (
        known is None
        and hull_agreement(Segmented(second, masks).views, masks) < hull_agreement(before.views, before.masks)
    ):
        masks = {v.photo.name: segmented.masks[v.photo.name] for v in before.views}
    return masks


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
            motion = aligned(masked_views(before, masks), masked_views(own, masks))
            turn, shift = motion.rotation @ group.rotation, motion.apply(group.translation)
            better = Group(motion.scale * group.scale, turn, shift, group.names)
            moved = [better.moved(views[name]) for name in names]
            if hull_agreement(before + moved, masks) >= hull_agreement(before + own, masks):
                group, own = better, moved
        before += own
        corrected.append(group)
    return corrected
