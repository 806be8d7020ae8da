"""The report of a capture, and its checks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

SIDE_ELEVATION = 45.0  # degrees up to which a direction looks at a side of the object
LEAST_REGISTERED, MAX_MEAN_ERROR, WIDEST_GAP = 0.8, 1.0, 60.0
LEAST_POINTS, LEAST_AGREEMENT, LEAST_MASK, LEAST_FIT = 200, 0.85, 0.03, 0.8
SMALL_STEPS = "take sharp images of one object in small steps around it"


@dataclass
class CaptureReport:
    """What was found, and which checks failed; written to ``capture.json``."""

    images: int  # to be registered
    registered: int = 0
    lost: list[str] = field(default_factory=list)  # not registered
    separate: int = 0  # of these, images of the largest other map, as of another object or after a gap
    left_out: dict[str, str] = field(default_factory=dict)  # excluded: name and reason
    views: list[str] = field(default_factory=list)
    reprojection_error: float = 0.0  # pixels, mean
    object_points: int = 0
    gap: float = 0.0  # degrees, the widest between cameras around the object
    agreement: float = 0.0  # median fraction of a mask that the visual hull fills
    epipolar_fit: float = 1.0  # matches on the object that fit the cameras, over those that fit pairs of views
    surroundings_fit: float = 1.0  # the same outside the masks; of the first map, if the object was moved
    mask_fraction: float = 0.0  # median fraction of an image that the mask covers
    mask_method: str = ""
    plane: bool = False
    lighting: str = "object"  # what the lighting is fixed to: object, camera or turntable
    unit: str = "longest side"
    failed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


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


def check(report: CaptureReport) -> None:
    """Fill ``failed`` with a line for each check that fails."""
    registered = report.registered / report.images
    error = report.reprojection_error
    checks = (
        (
            registered >= LEAST_REGISTERED,
            f"{report.registered} of {report.images} images registered, at least {100 * LEAST_REGISTERED:.0f} % "
            "expected; "
            + (f"{report.separate} others fit together (a second object, or a gap); " if report.separate else "")
            + SMALL_STEPS,
        ),
        (error < MAX_MEAN_ERROR, f"reprojection error {error} px, below {MAX_MEAN_ERROR:.0f} expected"),
        (
            report.epipolar_fit >= LEAST_FIT,
            f"{100 * report.epipolar_fit:.1f} % of the matches on the object fit the cameras, at least "
            f"{100 * LEAST_FIT:.0f} % expected: the object, or something around it, moved",
        ),
        (
            report.gap < WIDEST_GAP,
            f"no view within a sector of {report.gap:.1f} degrees, less than {WIDEST_GAP:.0f} expected; "
            "add images from there",
        ),
        (
            report.object_points >= LEAST_POINTS,
            f"{report.object_points} points on the object, at least {LEAST_POINTS} expected: it lacks texture, "
            "or is not the same object in all images",
        ),
        (
            report.agreement >= LEAST_AGREEMENT,
            f"the visual hull fills {100 * report.agreement:.1f} % of a mask, at least {100 * LEAST_AGREEMENT:.0f} % "
            "expected: masks lack a part of the object; give --masks or --mask-method rembg",
        ),
        (
            report.mask_fraction >= LEAST_MASK,
            f"the object covers {100 * report.mask_fraction:.2f} % of an image, at least {100 * LEAST_MASK:.0f} % "
            "expected",
        ),
    )
    report.failed += [text for passed, text in checks if not passed]


def summary(report: CaptureReport) -> str:
    """One line on the result."""
    return (
        f"{report.registered} of {report.images} images registered, {len(report.views)} views kept, "
        f"reprojection error {report.reprojection_error:.2f} px, widest gap {math.floor(report.gap)} degrees, "
        f"visual hull fills {100 * report.agreement:.0f} % of the masks"
    )
