"""View selection by farthest-point sampling of the cameras."""

import math

import torch
from torch import Tensor

from reli3d._bridge import full_precision
from reli3d.views.normalize import meeting_point

DUPLICATE_DISTANCE_RAD = math.radians(3.0)  # below it, views are near-duplicates
NARROW_BASELINE_RAD = math.radians(25.0)  # views within this angle constrain depth poorly
LOG_DISTANCE_WEIGHT_RAD = 0.5  # radians per factor e of distance: half the distance counts as 20 degrees


@full_precision
def view_distances(c2w: Tensor) -> tuple[Tensor, Tensor]:
    """Angles [rad] between the views ``(V, V)`` and their distances ``(V, V)``, float64.

    angle: between the directions to the cameras from the point that they look at.  distance: sqrt(angle^2 + (w log
    r)^2), where r is the ratio of the cameras' distances to this point and w is ``LOG_DISTANCE_WEIGHT_RAD``.  Roll and
    lens have no effect.
    """
    poses = c2w.double().cpu()
    eyes, axes = poses[:, :3, 3], -poses[:, :3, 2]
    one = torch.eye(3, dtype=axes.dtype, device=axes.device)
    across_axis = one - axes[:, :, None] * axes[:, None]
    right = (across_axis @ eyes[..., None]).mean(0)[:, 0] + 1e-5 * meeting_point(eyes, axes)[0]
    away = eyes - torch.linalg.solve(across_axis.mean(0) + 1e-5 * one, right)  # prior: meeting_point
    length = away.norm(dim=-1).clamp_min(1e-12)
    to = away / length[:, None]
    across = torch.linalg.cross(to[:, None].expand(-1, len(to), -1), to[None].expand(len(to), -1, -1)).norm(dim=-1)
    angle = torch.atan2(across, to @ to.T)  # exact for small angles, where the arc cosine is not
    closer = LOG_DISTANCE_WEIGHT_RAD * (length.log()[:, None] - length.log())
    return angle, (angle.square() + closer.square()).sqrt()


@full_precision
def choose_views(c2w: Tensor, count: int, *, min_distance: float = 0.0) -> list[int]:
    """Selects up to ``count`` views by farthest-point sampling, starting with view 0; returns ascending indices.

    c2w: ``(V, 4, 4)``.  min_distance: no view closer than this to a selected view is selected ([rad], as in
    :func:`view_distances`).  The covering radius is at most 2 times the optimum (Gonzalez 1985).
    """
    if not count >= 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    distance = view_distances(c2w)[1]
    taken, nearest = [0], distance[0].clone()
    while len(taken) < min(count, len(c2w)):
        nearest[taken[-1]] = -1.0  # never selected twice, even if all views are equal
        farthest = int(nearest.argmax())
        if float(nearest[farthest]) < min_distance:
            break
        taken.append(farthest)
        nearest = torch.minimum(nearest, distance[farthest])
    return sorted(taken)


def spread_notes(c2w: Tensor) -> list[str]:
    """Notes on near-duplicate views and on a narrow baseline, at most one line each."""
    angle, distance = view_distances(c2w)
    notes, limit = [], DUPLICATE_DISTANCE_RAD
    again = [i for i, row in enumerate(distance.tolist()) if min(row[:i], default=math.inf) < limit]
    if again:
        which = ", ".join(map(str, again[:8])) + (", ..." if len(again) > 8 else "")
        text = f"{len(again)} of {len(c2w)} views lie within {math.degrees(limit):.0f} degrees of an earlier one"
        notes.append(f"{text} and add little information: {which}")
    widest = float(angle.max())
    if len(c2w) > 1 and widest < NARROW_BASELINE_RAD:
        text = f"narrow baseline: all views lie within {math.degrees(widest):.1f} degrees"
        notes.append(f"{text}; depth and unobserved sides are poorly constrained, add views from all around")
    return notes
