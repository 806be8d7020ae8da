"""Network input from views: resampling, silhouette distances, and mirror images of symmetric objects."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from reli3d._bridge import full_precision, present
from reli3d.geometry.camera import Camera
from reli3d.geometry.hull import mask_distance
from reli3d.geometry.symmetry import MirrorPlane, mirror_plane
from reli3d.nn.presets import LocalPreset, Preset
from reli3d.nn.weights import Network
from reli3d.views.published_views import published_views
from reli3d.views.similarity import Similarity
from reli3d.views.views import ViewBatch, Views

DETAIL = 512  # side [pixels] of the images that colors and silhouettes are read from, larger than the network's input
MAX_MIRRORED = 8  # views: the network reads 16 including mirror images


@dataclass(frozen=True)
class Prepared:
    """Views in the model frame: the network input, and images of ``DETAIL`` pixels for lookup at points."""

    batch: ViewBatch
    images: Tensor  # (V, D, D, 4) sRGB and signed silhouette distance
    camera: Camera  # of ``images``
    mirrored: int = 0  # number of views at the end that are mirror images of the first views, in order

    def with_mirror(self, plane: MirrorPlane) -> Prepared:
        """The views, followed by their mirror images: flipped images with cameras mirrored at ``plane``."""
        batch, flipped = self.batch, plane.mirrored(self.batch.camera)
        parts = [torch.cat([t, t.flip(2)]) for t in (batch.images, batch.masks, self.images)]
        c2w, intrinsics = (torch.cat([getattr(batch, name), getattr(flipped, name)]) for name in ("c2w", "intrinsics"))
        camera, other = self.camera, plane.mirrored(self.camera)
        camera = Camera(c2w, torch.cat([camera.intrinsics, other.intrinsics]), camera.width, camera.height)
        return Prepared(ViewBatch(parts[0], parts[1], c2w, intrinsics), parts[2], camera, len(batch))


@full_precision
def prepare(model: Network, views: Views, model_from_input: Similarity) -> Prepared:
    """Resamples ``views`` for ``model``: cropped to the object, or as in the release if ``published_input``."""
    moved = views.transformed(model_from_input).to(model.device)
    published = published_input(model.preset)
    if published:
        batch = published_views(moved.to("cpu"), model.preset.image_size).to(model.device)  # the codec runs there
    else:
        batch = moved.resampled(model.preset.image_size)
    detail = moved.resampled(DETAIL, crop=not published)
    silhouette = mask_distance(present("silhouettes", detail.silhouettes))
    return Prepared(batch, torch.cat([detail.images, silhouette[..., None]], -1).contiguous(), detail.camera)


@full_precision
def completed(prepared: Prepared) -> Prepared:
    """``prepared`` with mirror images, if its 3 to ``MAX_MIRRORED`` silhouettes fit a mirror plane, else unchanged.

    See :func:`~reli3d.geometry.symmetry.mirror_plane`.
    """
    plane = None
    if len(prepared.batch) <= MAX_MIRRORED:
        plane = mirror_plane(prepared.images[..., 3].contiguous(), prepared.camera)
    return prepared if plane is None else prepared.with_mirror(plane)


def published_input(preset: Preset | LocalPreset) -> bool:
    """Whether views are prepared as in the release."""
    return isinstance(preset, Preset) and preset.published_input
