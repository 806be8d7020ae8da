"""Silhouette consistency: aligns groups of views, and completes masks that lack parts of the object."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch.nn.functional import grid_sample, huber_loss, normalize, pad, softplus

from reli3d.capture.mapping import View, point_mask, shown_pixels
from reli3d.capture.masks import full_size, touches_border
from reli3d.capture.rigidity import Similarity
from reli3d.geometry.camera import Camera
from reli3d.geometry.hull import hull_grid, mask_distance
from reli3d.views.check import agreement
from reli3d.views.normalize import visual_hull
from reli3d.views.views import Views

MASK_SIDE = 512  # pixels along the longer side of the masks of visual hulls
CELLS = 160  # along the longest side of the object
MARGIN = 0.1  # of the longest side, around the box of the object
SLAB = 8  # layers of cells at a time
MOST_OUTSIDE = 0.3  # fraction of the views in which a cell may lie outside the mask
OUTSIDE_WEIGHT = 0.5  # of a covered pixel outside a mask over an uncovered pixel inside
OVERLAP_CELLS = 0.7  # cells by which the silhouettes of cells reach over an outline
EDGE_CELLS = 2.0  # cells: pixels nearer to the outline have smaller weights
STEPS, STEP_SIZE, START_LOGIT = 60, 0.2, -1.5  # of Adam on logits
GRID, HULL_HALF_SIDE = 96, 0.75  # cells along the volume of a hull; half its side over the longest side of the object
OUTLINE_PIXELS = -0.5, 1.0  # signed distance of the pixels from which rays are taken, positive inside
RAYS, RAY_SAMPLES = 2500, 48  # of each side; along a ray
ALIGN_STEPS, ALIGN_STEP_SIZE = 60, 0.004  # of Adam; at first, in radians, of HULL_HALF_SIDE and of a logarithm
HUBER_DELTA = 0.004  # of HULL_HALF_SIDE: residuals beyond count linearly
MOTION_PENALTY = 0.0005  # of motions that silhouettes do not constrain, such as rotations about an axis of symmetry


def masked_views(views: Sequence[View], masks: dict[str, np.ndarray]) -> Views:
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
        c2w=torch.from_numpy(np.stack([v.c2w for v in views]).astype(np.float32)),
        intrinsics=torch.tensor(cameras, dtype=torch.float32),
        names=tuple(v.photo.name for v in views),
    )


def hull_agreement(views: Sequence[View], masks: dict[str, np.ndarray]) -> float:
    """Mean fraction of the masks that the visual hull fills, of the views whose masks do not touch the border; 0 if
    these are fewer than two.
    """
    whole = [v for v in views if not touches_border(masks[v.photo.name])]
    return float(np.mean(agreement(masked_views(whole, masks))[1])) if len(whole) >= 2 else 0.0


def completed_masks(views: Sequence[View], masks: dict[str, np.ndarray], box: np.ndarray) -> dict[str, np.ndarray]:
    """Masks by name, united with the silhouettes of the volume that explains all masks with the fewest wrong pixels.

    A visual hull lacks each part that a single mask lacks.  The volume is the hull and further cells: these minimize
    the number of pixels inside masks that no occupied cell projects to, plus OUTSIDE_WEIGHT times the number of pixels
    outside the masks that an occupied cell projects to.  Occupancies are probabilities, and a pixel is covered unless
    all of its cells are empty.  box: lower and upper corner ``(2, 3)`` of the object.
    """
    cell = float((box[1] - box[0]).max()) / CELLS
    views = [v for v in views if (masks[v.photo.name] > 127).any()]
    if cell == 0 or not views:
        return masks
    inside = [masks[v.photo.name] > 127 for v in views]
    points, outside = _cells(views, inside, box, cell)
    hull, more = points[outside == 0], points[outside > 0]
    if len(hull) == 0 or len(more) == 0:
        return masks
    sizes, pixels, target, weight = [], [], [], []
    count = 0
    for view, mask in zip(views, inside, strict=True):
        footprint = max(1.0, view.focal * cell / float(np.median(view.project(points)[1])))  # pixels
        size = max(1, round(mask.shape[1] / footprint)), max(1, round(mask.shape[0] / footprint))
        small = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5).astype(np.uint8)
        away = cv2.distanceTransform(small, cv2.DIST_L2, 5) + cv2.distanceTransform(1 - small, cv2.DIST_L2, 5)
        cost = np.minimum(away / EDGE_CELLS, 1) * np.where(small, 1.0, OUTSIDE_WEIGHT) * (_shown(view, hull, size) == 0)
        sizes.append(size)
        reached, index = np.unique(_indices(view, more, size), return_inverse=True)  # the others do not change
        pixels.append(count + index)
        target.append(np.append(small > 0, False)[reached])
        weight.append(np.append(cost, 0.0)[reached].astype(np.float32))
        count += len(reached)
    added = more[_explaining(np.stack(pixels), np.concatenate(target), np.concatenate(weight))]
    completed = dict(masks)
    for view, size in zip(views, sizes, strict=True):
        mask = masks[view.photo.name]
        union = np.maximum(mask, full_size(_shown(view, added, size), mask.shape))
        overlap = max(1, int(OVERLAP_CELLS * mask.shape[1] / size[0]))
        union = cv2.erode(union, np.ones((2 * overlap + 1, 2 * overlap + 1), np.uint8))
        completed[view.photo.name] = np.maximum(mask, union)
    return completed


def _cells(
    views: Sequence[View], inside: Sequence[np.ndarray], box: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Centers ``(N, 3)`` of cells that at most MOST_OUTSIDE of the views show outside their masks, and the number of
    these views ``(N,)``.  A view that does not show a cell is not counted.
    """
    margin = MARGIN * (box[1] - box[0]).max()
    x, y, z = (np.arange(low - margin, high + margin, cell, dtype=np.float32) for low, high in box.T)
    found = []
    for some in np.array_split(x, max(1, len(x) // SLAB)):
        points = np.stack(np.meshgrid(some, y, z, indexing="ij"), -1).reshape(-1, 3)
        outside = np.zeros(len(points), np.int32)
        for view, mask in zip(views, inside, strict=True):
            u, v, shown = shown_pixels(*view.project(points), mask.shape)
            outside[shown] += ~mask[v, u]
            points, outside = (a[outside <= MOST_OUTSIDE * len(views)] for a in (points, outside))
        found.append((points, outside))
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


def _indices(view: View, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Indices ``(N,)`` of the pixels of ``points (N, 3)`` in an image of ``size`` (width, height), or their number for
    points that it does not show.
    """
    index = np.full(len(points), size[0] * size[1])
    pixels, depth = view.project(points)
    x, y, shown = shown_pixels(pixels * (np.array(size) / view.photo.size), depth, size[::-1])
    index[shown] = y * size[0] + x
    return index


def _shown(view: View, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Silhouette ``(H, W)`` uint8, 0 or 255, of cells of a pixel's size about ``points``."""
    pixels, depth = view.project(points)
    silhouette = point_mask(pixels * (np.array(size) / view.photo.size), depth, size[::-1])
    return cv2.morphologyEx(silhouette, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))


@torch.inference_mode(False)
@torch.enable_grad()
def _explaining(pixels: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Which cells ``(N,)`` are occupied.  pixels: those of each cell ``(V, N)``.  target, weight: of each pixel."""
    uncovered = target & (weight > 0)
    useful = uncovered[pixels].any(0)
    at = torch.from_numpy(pixels[:, useful].ravel())
    inside, cost = torch.from_numpy(target), torch.from_numpy(weight)
    logits = torch.full((int(useful.sum()),), START_LOGIT, dtype=torch.float32, requires_grad=True)
    optimizer = torch.optim.Adam([logits], STEP_SIZE)
    for _ in range(STEPS):
        empty = -softplus(logits).expand(len(pixels), -1).reshape(-1)  # log of the probability
        empty = torch.zeros_like(cost).index_add(0, at, empty).exp()
        loss = (cost * torch.where(inside, empty, 1 - empty)).sum()
        (logits.grad,) = torch.autograd.grad(loss, logits)
        optimizer.step()
    useful[useful] = (logits.detach() > 0).numpy()
    return useful


@torch.inference_mode(False)
@torch.enable_grad()
def aligned(fixed: Views, others: Views) -> Similarity:
    """The similarity that moves the cameras of ``others`` to where their silhouettes agree with those of ``fixed``.

    Minimizes the distance between the viewing rays along the outlines of either side and the visual hull of the other
    (silhouette coherence, Hernandez, Schmitt and Cipolla 2007): a ray through the object meets every hull.  Converges
    from errors of a few percent of the object's size.  The identity where either hull is empty.
    """
    hulls = [visual_hull(v) for v in (fixed, others)]
    if any(len(h.points) == 0 for h in hulls):
        return Similarity(1.0, np.eye(3), np.zeros(3))
    low, high = hulls[0].box()
    middle, radius = (low + high) / 2, HULL_HALF_SIDE * max(float((high - low).max()), hulls[0].cell)
    (hull, *rays), (other_hull, *other_rays) = (_hull_and_rays(v, middle, radius) for v in (fixed, others))
    motion = torch.zeros(7, dtype=torch.float32, requires_grad=True)  # rotation vector, shift, logarithm of the scale
    optimizer = torch.optim.Adam([motion], ALIGN_STEP_SIZE)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, ALIGN_STEPS)
    for _ in range(ALIGN_STEPS):
        turn, shift, scale = _moved(motion)
        origins, directions = other_rays
        missed = _distance(hull, scale * origins @ turn.T + shift, directions @ turn.T)
        origins, directions = rays
        back = scale * _distance(other_hull, (origins - shift) @ turn / scale, directions @ turn)
        missed = torch.cat([missed, back])
        loss = huber_loss(missed, torch.zeros_like(missed), delta=HUBER_DELTA) + MOTION_PENALTY * motion.square().sum()
        (motion.grad,) = torch.autograd.grad(loss, motion)
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        turn, shift, scale = (x.double() for x in _moved(motion))
    shift = radius * shift + middle - scale * turn @ middle
    return Similarity(float(scale), turn.numpy(), shift.numpy())


def _moved(motion: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rotation ``(3, 3)``, shift ``(3,)`` and scale."""
    x, y, z = motion[:3]
    o = torch.zeros_like(x)
    return torch.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o]).view(3, 3)), motion[3:6], motion[6].exp()


def _hull_and_rays(
    views: Views, middle: torch.Tensor, radius: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Signed distance of the hull of ``views`` on a grid, and origins and directions ``(R, 3)`` of rays along their
    outlines, in units of ``radius`` about ``middle``.
    """
    height, width = (max(m.shape[k] for m in views.masks) for k in (0, 1))
    masks = torch.stack([pad(m, (0, width - m.shape[1], 0, height - m.shape[0])) for m in views.masks])
    c2w = views.c2w.clone()
    c2w[:, :3, 3] = (c2w[:, :3, 3] - middle.float()) / radius
    camera = Camera(c2w, views.intrinsics, width, height)
    distance = mask_distance(masks)
    at = ((distance > OUTLINE_PIXELS[0]) & (distance < OUTLINE_PIXELS[1])).nonzero()
    at = at[:: max(1, len(at) // RAYS)]
    view, y, x = at.unbind(-1)
    fx, fy, cx, cy = views.intrinsics[view].unbind(-1)
    local = torch.stack([(x + 0.5 - cx) / fx, -(y + 0.5 - cy) / fy, -torch.ones_like(fx)], -1)
    directions = normalize((c2w[view, :3, :3] @ local[..., None])[..., 0], dim=-1)
    hull = hull_grid(torch.linspace(-1.0, 1.0, GRID, dtype=torch.float32), distance, camera)
    return hull, c2w[view, :3, 3], directions


def _distance(hull: torch.Tensor, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Distance ``(R,)`` by which rays miss the hull, 0 where they meet it."""
    nearest = -(origins * directions).sum(-1, keepdim=True)
    along = nearest + torch.linspace(-1.0, 1.0, RAY_SAMPLES, dtype=torch.float32)
    points = origins[:, None] + along[..., None] * directions[:, None]
    inside = grid_sample(hull[None, None], points.flip(-1)[None, None], align_corners=True, padding_mode="border")
    return (-inside[0, 0, 0].amax(-1)).clamp_min(0.0)
