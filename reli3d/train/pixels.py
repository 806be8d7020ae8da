"""Training of the 2D U-Net alone: views of many objects a step, in pictures of the full size or of a half or a quarter.

A small picture shows as well as a large one which side of an object is flat, and costs a fraction of it.  The coarse
levels of the U-Net learn from small pictures first; the finer levels follow from larger pictures, and begin by adding
nothing (after Karras and others 2018, Progressive Growing of GANs, arXiv 1710.10196).
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor
from torch.nn import functional

from reli3d.geometry.camera import Camera
from reli3d.geometry.hull import mask_distance
from reli3d.nn.local import QUARTER, LocalReconstructor, PixelMaps, mean_logit, shown_pixels
from reli3d.nn.presets import LocalPreset
from reli3d.nn.pyramid import ImagePyramid, place_of_pixels, span_of_pixels
from reli3d.train.batches import KEPT, NOISE, Pictures, finish_known

FULL_SIDE = 256  # pixels of an image at the finest level
CACHE_BYTES = 1 << 31  # of small images in the memory of a process


@dataclass(frozen=True)
class Group:
    """Views of several objects for one call of the network; ``counts``: how many views each object has."""

    views: Pictures
    counts: tuple[int, ...]

    @staticmethod
    def of(objects: list[Pictures]) -> Group:
        parts = {f.name: torch.cat([getattr(o, f.name) for o in objects]) for f in fields(Pictures)}
        return Group(Pictures(**parts), tuple(len(o.masks) for o in objects))


def for_small_pictures(model: LocalReconstructor, finest: int) -> LocalReconstructor:
    """A network whose 2D U-Net reads pictures ``2**finest`` times smaller, with what ``model`` knows of its levels."""
    small = LocalReconstructor(model.preset)
    small.pyramid = ImagePyramid(model.preset.pyramid, finest)
    have = small.state_dict()
    small.load_state_dict({k: v for k, v in model.state_dict().items() if k in have})
    return small


def lacking(preset: LocalPreset, names: Container[str]) -> set[str]:
    """Parameters of the network that a training on small pictures has not, if ``names`` are those of one."""
    if "pyramid.reads.0.0.weight" in names:
        return set()
    finest = 1 if "pyramid.reads.1.0.weight" in names else 2
    with torch.device("meta"):
        whole, small = (set(ImagePyramid(preset.pyramid, k).state_dict()) for k in (0, finest))
    return {f"pyramid.{name}" for name in whole - small}


def take_levels(model: LocalReconstructor, state: dict[str, Tensor]) -> LocalReconstructor:
    """``model`` with the parameters of ``state``, which may lack the finer levels of the 2D U-Net, as small pictures
    leave it.  Raises ValueError where others are missing.
    """
    missing, unknown = model.load_state_dict(state, strict=False)
    if lost := [*unknown, *(set(missing) - lacking(model.preset, state))]:
        raise ValueError(f"state: expected the parameters of the network, got a difference in {lost[0]}")
    return model


def predicts(name: str) -> bool:
    """Whether the predictions of pixels need the parameter ``name``."""
    return name.startswith("pyramid.") and not name.startswith("pyramid.features.")


def predicted(model: LocalReconstructor, group: Group) -> tuple[PixelMaps, Tensor]:
    """What the 2D U-Net says of the pixels of all views, and the colors ``(V, P, P, 3)`` that they show."""
    views = group.views
    size = views.masks.shape[1]
    camera = Camera(views.c2w, views.intrinsics, size, size)
    seen = functional.avg_pool2d(views.masks[:, None], QUARTER)[:, 0]
    quarter, half = camera.resized(*seen.shape[:0:-1]), camera.resized(size // 2, size // 2)
    color, mask = shown_pixels(views.images, views.masks, half)
    spans, levels, first = [], [], 0
    for count in group.counts:  # the hull and the exposure are those of one object
        of = slice(first, first + count)
        spans.append(span_of_pixels(views.silhouette[of], camera[of], seen[of], quarter[of]))
        levels.append(mean_logit(color[of], mask[of]).expand(count))
        first += count
    span, level = torch.cat(spans), torch.cat(levels)[:, None, None, None]
    _, raw = model.pyramid(views.images, views.masks, place_of_pixels(camera), span, group.counts)
    return PixelMaps.of(raw, span, half, level), color


def reduction(path: Path, finest: int) -> int:
    """Factor by which the views of a sample are reduced for level ``finest``: to ``FULL_SIDE >> finest`` pixels, or
    somewhat more where that does not divide their size.
    """
    with safe_open(path, "pt") as file:
        size = file.get_slice("images").get_shape()[1]
    return max(1, (size << finest) // FULL_SIDE)


def read_pictures(path: Path, factor: int) -> Pictures:
    """All views of a sample, ``factor`` times smaller."""
    with safe_open(path, "pt") as file:
        images, material, normal, depth, c2w, intrinsics = (
            file.get_tensor(name).float()
            for name in ("images", "view_material", "view_normal", "view_depth", "c2w", "intrinsics")
        )
        known = finish_known(file)
    images = functional.avg_pool2d(images.permute(0, 3, 1, 2) / 255, factor).permute(0, 2, 3, 1).contiguous()
    valid = (depth > 0).float()[:, None]
    share = functional.avg_pool2d(valid, 2 * factor)

    def pooled(values: Tensor) -> Tensor:
        mean = functional.avg_pool2d(values.permute(0, 3, 1, 2) * valid, 2 * factor) / share.clamp(min=0.25)
        return mean.permute(0, 2, 3, 1)

    origin = (c2w[:, :3, 3] * c2w[:, :3, 2]).sum(-1)[:, None, None]  # depth of the world's origin
    masks = images[..., 3].contiguous()
    return Pictures(
        images=images[..., :3].contiguous(),
        masks=masks,
        silhouette=mask_distance(masks),
        c2w=c2w,
        intrinsics=intrinsics / factor,
        view_material=pooled(material / 255),
        view_normal=functional.normalize(pooled(normal), dim=-1),
        view_depth=pooled(depth[..., None])[..., 0] - origin,
        view_valid=share[:, 0] > 0.99,
        finish_known=known,
    )


def augmented(views: Pictures, rng: np.random.Generator) -> Pictures:
    """``views`` in any order, some mirrored, some with their color channels exchanged, with noise."""
    views = views.of_views(torch.as_tensor(rng.permutation(len(views.masks))))
    changed = {}
    if rng.random() > KEPT:
        pictures = ("images", "masks", "silhouette", "view_material", "view_normal", "view_depth", "view_valid")
        views = replace(views, **{name: getattr(views, name).flip(2).contiguous() for name in pictures})
        flip = torch.tensor([-1.0, 1.0, 1.0])
        c2w, intrinsics = views.c2w.clone(), views.intrinsics.clone()
        c2w[:, :3] *= flip[:, None]
        c2w[:, :, 0] *= -1  # the camera stays right-handed, its picture is flipped
        intrinsics[:, 2] = views.masks.shape[2] - intrinsics[:, 2]
        changed = {"c2w": c2w, "intrinsics": intrinsics, "view_normal": views.view_normal * flip}
    color, material = views.images, views.view_material
    if rng.random() > KEPT:
        channels = torch.as_tensor(rng.permutation(3))
        color, material = color[..., channels], torch.cat([material[..., channels], material[..., 3:]], -1)
    noise = torch.from_numpy(rng.standard_normal(color.shape, dtype=np.float32))
    color = (color + float(rng.random()) * NOISE * noise).clamp(0, 1).contiguous()
    return replace(views, images=color, view_material=material.contiguous(), **changed)


class ViewCache:
    """All views of samples as level ``finest`` of the 2D U-Net reads them; at most ``CACHE_BYTES`` stay in memory."""

    def __init__(self, finest: int):
        self.finest, self._kept, self._bytes = finest, dict[Path, Pictures](), 0

    def __getitem__(self, path: Path) -> Pictures:
        if path in self._kept:
            return self._kept[path]
        views = read_pictures(path, reduction(path, self.finest))
        if self._bytes < CACHE_BYTES:
            self._kept[path] = views
            self._bytes += sum(getattr(views, f.name).nbytes for f in fields(views))
        return views


def draw_group(files: Sequence[Path], seeds: Iterable[tuple[int, ...]], cache: ViewCache, *, max_views: int) -> Group:
    """All views of a random file for each of ``seeds``, divided into objects of 1 to ``max_views`` views."""
    objects = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        views, first = augmented(cache[files[int(rng.integers(len(files)))]], rng), 0
        while first < len(views.masks):
            count = int(rng.integers(1, max_views + 1))
            objects.append(views.of_views(slice(first, first + count)))
            first += count
    return Group.of(objects)
