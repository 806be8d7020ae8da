"""Real captures as training objects: images with masks and cameras, without ground-truth materials or lighting."""

import json
from functools import lru_cache
from pathlib import Path

import torch

from reli3d.errors import InputError, shown
from reli3d.io.files import read_bytes
from reli3d.train.stages.views import Chooser, ObjectViews
from reli3d.views.folder import load_views
from reli3d.views.normalize import normalize
from reli3d.views.published_views import has_background
from reli3d.views.views import Views

SIZE = 256  # pixels of the square crops; the stages scale them further
SCORES = ("camera_quality_score", "gaussian_splats_quality_score")  # of UCO3D's metadata.json
MIN_SCORE = 1.0  # of both, as in the paper
METADATA_LIMIT = 1 << 20  # bytes
CACHED_CAPTURES = 64  # preprocessed captures in memory: 50 MB at 4 views


class Captures:
    """Object folders in a folder, but those ``rejected`` (name: reason) by UCO3D's quality scores; or InputError."""

    def __init__(self, folder: Path, size: int = SIZE):
        reasons = {p.parent: unfit(p.parent) for p in sorted(folder.glob("*/transforms.json"))}
        self.folders = [one for one, reason in reasons.items() if reason is None]
        self.rejected = {one.name: reason for one, reason in reasons.items() if reason}
        if not self.folders:
            why = "; ".join(f"{k}: {v}" for k, v in list(self.rejected.items())[:3]) or "no */transforms.json"
            raise InputError(folder, f"expected captures of good quality, got none ({why})")
        self._views = lru_cache(CACHED_CAPTURES)(lambda k: capture_views(load_views(self.folders[k], every=True), size))

    def __len__(self) -> int:
        return len(self.folders)

    def load(self, index: int, choose: Chooser) -> ObjectViews:
        views = self._views(index)
        return views.select(choose(len(views)))


def unfit(folder: Path) -> str | None:
    """The reason to exclude a capture by UCO3D's quality scores; None if there is none or it has no scores."""
    path = folder / "metadata.json"
    if not path.exists():
        return None
    try:
        scores = json.loads(read_bytes(path, METADATA_LIMIT))
        values = [float(scores[name]) for name in SCORES]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        return f"metadata.json: expected {' and '.join(SCORES)}, got a broken file ({shown(str(error))})"
    low = [f"{n} {v:.2f}" for n, v in zip(SCORES, values, strict=True) if not v >= MIN_SCORE]
    return f"expected scores of at least {MIN_SCORE:g}, got {', '.join(low)}" if low else None


def capture_views(views: Views, size: int) -> ObjectViews:
    """Square crops around the object, in a frame in which the longest side of its visual hull is 1, as in samples."""
    moved = views.transformed(normalize(views, "hull"))
    cut = moved.resampled(size)
    cameras = zip(cut.intrinsics, moved.intrinsics, moved.masks, strict=True)
    at, valid = torch.arange(size, dtype=torch.float32) + 0.5, []
    for new, old, mask in cameras:  # pixels of the crop that are inside the input image
        x, y = ((at - new[k]) * (old[k - 2] / new[k - 2]) + old[k] for k in (2, 3))
        valid.append(((y >= 0) & (y <= mask.shape[0]))[:, None] & ((x >= 0) & (x <= mask.shape[1])))
    background = all(has_background(i, m) for i, m in zip(views.images, views.masks, strict=True))
    return ObjectViews(cut.images, cut.masks, cut.c2w, cut.intrinsics, background, torch.stack(valid).float())
