"""Which of many views to take: those that lie farthest apart, by their cameras alone."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from reli3d._bridge import full_precision
from reli3d.views.normalize import meeting_point

NEAR = math.radians(3.0)  # views nearer than this show the same: a hand's breadth at two metres
NARROW = math.radians(25.0)  # views all within this angle leave the depth of the object open
CLOSER = 0.5  # radians that a factor e in distance counts for: half the distance is worth 20 degrees


@full_precision
def view_distances(c2w: Tensor) -> tuple[Tensor, Tensor]:
    """Angles [rad] between the views ``(V, V)`` and their distances ``(V, V)``, float64.

    The angle is that between the directions to the eyes from the point where the cameras look; the distance adds, at
    a right angle, ``CLOSER`` times the logarithm of how much nearer one of the eyes is.  Roll and lens do not count.
    """
    poses = c2w.double().cpu()
    eyes, axes = poses[:, :3, 3], -poses[:, :3, 2]
    away = eyes - _looked_at(eyes, axes)
    length = away.norm(dim=-1).clamp_min(1e-12)
    to = away / length[:, None]
    across = torch.linalg.cross(to[:, None].expand(-1, len(to), -1), to[None].expand(len(to), -1, -1)).norm(dim=-1)
    angle = torch.atan2(across, to @ to.T)  # exact for small angles, where the arc cosine is not
    closer = CLOSER * (length.log()[:, None] - length.log())
    return angle, (angle.square() + closer.square()).sqrt()


def _looked_at(eyes: Tensor, axes: Tensor) -> Tensor:
    """The point nearest to all axes, also where they are too alike for :func:`meeting_point`, whose guess is the prior.

    A weight of 1e-5 of an axis leaves the point to axes that differ by a degree.
    """
    one = torch.eye(3, dtype=axes.dtype, device=axes.device)
    across = one - axes[:, :, None] * axes[:, None]
    right = (across @ eyes[..., None]).mean(0)[:, 0]
    return torch.linalg.solve(across.mean(0) + 1e-5 * one, right + 1e-5 * meeting_point(eyes, axes)[0])


@full_precision
def choose_views(c2w: Tensor, count: int, *, apart: float = 0.0) -> list[int]:
    """Indices, ascending, of up to ``count`` views: view 0, then each time the one farthest from those taken.

    c2w: ``(V, 4, 4)``.  apart: distance (:func:`view_distances`) from the taken views at which to stop before
    ``count``.  Farthest-point choice covers within twice the best possible distance (Gonzalez 1985).
    """
    if not count >= 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    distance = view_distances(c2w)[1]
    taken, nearest = [0], distance[0].clone()
    while len(taken) < min(count, len(c2w)):
        nearest[taken[-1]] = -1.0  # not again, also where all views are the same
        farthest = int(nearest.argmax())
        if float(nearest[farthest]) < apart:
            break
        taken.append(farthest)
        nearest = torch.minimum(nearest, distance[farthest])
    return sorted(taken)


def spread_notes(c2w: Tensor) -> list[str]:
    """A line on views that are nearly the same, a line on views that all look from one side; none where all is well."""
    angle, distance = view_distances(c2w)
    notes = []
    again = (distance + torch.full_like(distance, torch.inf).triu()).amin(1) < NEAR  # near to an earlier view
    if bool(again.any()):
        which = ", ".join(str(i) for i in again.nonzero()[:, 0].tolist()[:8]) + (", ..." if again.sum() > 8 else "")
        notes.append(
            f"{int(again.sum())} of {len(c2w)} views lie within {math.degrees(NEAR):.0f} degrees of an "
            f"earlier one and add little: {which}"
        )
    widest = float(angle.max())
    if len(c2w) > 1 and widest < NARROW:
        notes.append(
            f"narrow baseline: all views lie within {math.degrees(widest):.1f} degrees; depth and the other "
            "sides are guessed, add views from all around"
        )
    return notes
