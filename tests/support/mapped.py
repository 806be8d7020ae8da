"""Views of a map of a capture, without images."""

import numpy as np

from reli3d.capture.mapping import View
from reli3d.capture.photos import Photo

SIZE = 400, 300


def view(k: int, eye: np.ndarray, radial: float = 0.0) -> View:
    """A camera at ``eye`` that looks at the origin, +Z of the world up."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    photo = Photo(str(k), np.zeros((SIZE[1], SIZE[0], 3), np.uint8), None, ())
    principal = np.array(SIZE) / 2 + (3, -2)
    return View(photo, rotation, -rotation @ eye, 500.0, principal, radial, np.zeros((0, 2)), np.zeros(0, np.int64))


def overlap(mask: np.ndarray, expected: np.ndarray) -> float:
    """Intersection over union."""
    return ((mask > 127) & (expected > 0)).sum() / ((mask > 127) | (expected > 0)).sum()
