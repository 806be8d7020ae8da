"""Training of the 2D U-Net alone, at growing resolution (after Karras et al. 2018, Progressive Growing, 1710.10196)."""

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
from reli3d.nn.local import QUARTER, LocalReconstructor, PixelMaps, mean_logit, pixel_colors
from reli3d.nn.presets import LocalPreset
from reli3d.nn.pyramid import ImagePyramid, depth_of_origin, pixel_hull_depths, pixel_positions
from reli3d.train.batches import UNCHANGED_PROBABILITY, TrainingViews, finish_known, permuted, valid_means, with_noise

FULL_SIDE = 256  # pixels of an image at the finest level
CACHE_BYTES = 1 << 31  # of small images in the memory of a process


@dataclass(frozen=True)
class Group:
    """Views of several objects for one forward pass; ``counts``: number of views of each object."""

    views: TrainingViews
    counts: tuple[int, ...]

    @staticmethod
    def of(objects: list[TrainingViews]) -> "Group":
        parts = {f.name: torch.cat([getattr(o, f.name) for o in objects]) for f in fields(TrainingViews)}
        return Group(TrainingViews(**parts), tuple(len(o.masks) for o in objects))


def reduced_model(model: LocalReconstructor, finest: int) -> LocalReconstructor:
    """A network whose 2D U-Net reads images ``2**finest`` times smaller, with the common parameters of ``model``."""
    small = LocalReconstructor(model.preset)
    small.pyramid = ImagePyramid(model.preset.pyramid, finest)
    have = small.state_dict()
    small.load_state_dict({k: v for k, v in model.state_dict().items() if k in have})
    return small


def missing_parameters(preset: LocalPreset, names: Container[str]) -> set[str]:
    """Names of the parameters that a checkpoint with ``names`` lacks because it was trained on smaller images."""
    if "pyramid.reads.0.0.weight" in names:
        return set()
    finest = 1 if "pyramid.reads.1.0.weight" in names else 2
    with torch.device("meta"):
        whole, small = (set(ImagePyramid(preset.pyramid, k).state_dict()) for k in (0, finest))
    return {f"pyramid.{name}" for name in whole - small}


def is_pixel_parameter(name: str) -> bool:
    """Whether the per-pixel predictions depend on the parameter ``name``."""
    return name.startswith("pyramid.") and not name.startswith("pyramid.features.")


def predict_pixels(model: LocalReconstructor, group: Group) -> tuple[PixelMaps, Tensor]:
    """Predictions of the 2D U-Net for all views, and the observed colors ``(V, P, P, 3)``, sRGB."""
    views = group.views
    size = views.masks.shape[1]
    camera = Camera(views.c2w, views.intrinsics, size, size)
    seen = functional.avg_pool2d(views.masks[:, None], QUARTER)[:, 0]
    quarter, half = camera.resized(*seen.shape[:0:-1]), camera.resized(size // 2, size // 2)
    color, mask = pixel_colors(views.images, views.masks, half)
    spans, means, first = [], [], 0
    for count in group.counts:  # the hull and the exposure are those of one object
        of = slice(first, first + count)
        spans.append(pixel_hull_depths(views.silhouette[of], camera[of], seen[of], quarter[of]))
        means.append(mean_logit(color[of], mask[of]).expand(count))
        first += count
    span, mean = torch.cat(spans), torch.cat(means)[:, None, None, None]
    _, raw = model.pyramid(views.images, views.masks, pixel_positions(camera), span, group.counts)
    return PixelMaps.of(raw, span, half, mean), color


def read_views_reduced(path: Path, factor: int, device: torch.device | str = "cpu") -> TrainingViews:
    """All views of a sample, reduced by ``factor``, on ``device``."""
    with safe_open(path, "pt", device=str(device)) as file:
        names = "images", "view_material", "view_normal", "view_depth", "c2w", "intrinsics"
        images, material, normal, depth, c2w, intrinsics = (file.get_tensor(name).float() for name in names)
        known = finish_known(file)
    images = functional.avg_pool2d(images.permute(0, 3, 1, 2) / 255, factor).permute(0, 2, 3, 1).contiguous()
    valid = depth > 0
    origin = depth_of_origin(c2w)[:, None, None]
    masks = images[..., 3].contiguous()
    return TrainingViews(
        images=images[..., :3].contiguous(),
        masks=masks,
        silhouette=mask_distance(masks),
        c2w=c2w,
        intrinsics=intrinsics / factor,
        view_material=valid_means(material / 255, valid, 2 * factor),
        view_normal=functional.normalize(valid_means(normal, valid, 2 * factor), dim=-1),
        view_depth=valid_means(depth[..., None], valid, 2 * factor)[..., 0] - origin,
        view_valid=functional.avg_pool2d(valid.float()[:, None], 2 * factor)[:, 0] > 0.99,
        finish_known=known,
    )


def augmented(views: TrainingViews, rng: np.random.Generator) -> TrainingViews:
    """``views`` in random order, randomly mirrored, with permuted color channels and noise."""
    device = views.images.device
    views = views.of_views(torch.as_tensor(rng.permutation(len(views.masks)), device=device))
    if rng.random() > UNCHANGED_PROBABILITY:
        maps = ("images", "masks", "silhouette", "view_material", "view_normal", "view_depth", "view_valid")
        changed = {name: getattr(views, name).flip(2).contiguous() for name in maps}
        flip = torch.tensor([-1.0, 1.0, 1.0], device=device)
        changed["view_normal"] = changed["view_normal"] * flip
        c2w, intrinsics = views.c2w.clone(), views.intrinsics.clone()
        c2w[:, :3] *= flip[:, None]
        c2w[:, :, 0] *= -1  # the camera stays right-handed, its image is flipped
        intrinsics[:, 2] = views.masks.shape[2] - intrinsics[:, 2]
        views = replace(views, c2w=c2w, intrinsics=intrinsics, **changed)
    color, material = views.images, views.view_material
    if rng.random() > UNCHANGED_PROBABILITY:
        color, material = permuted(rng, color, material)
    return replace(views, images=with_noise(color, rng).contiguous(), view_material=material.contiguous())


class ViewCache:
    """Views of samples at about ``FULL_SIDE >> finest`` pixels, not fewer, on ``device``; caches up to CACHE_BYTES."""

    def __init__(self, finest: int, device: torch.device | str = "cpu"):
        self.finest, self.device, self._kept, self._bytes = finest, device, dict[Path, TrainingViews](), 0

    def __getitem__(self, path: Path) -> TrainingViews:
        if path in self._kept:
            return self._kept[path]
        with safe_open(path, "pt") as file:
            size = file.get_slice("images").get_shape()[1]
        views = read_views_reduced(path, max(1, (size << self.finest) // FULL_SIDE), self.device)
        if self._bytes < CACHE_BYTES:
            self._kept[path] = views
            self._bytes += sum(getattr(views, f.name).nbytes for f in fields(views))
        return views


def draw_group(files: Sequence[Path], seeds: Iterable[tuple[int, ...]], cache: ViewCache, *, max_views: int) -> Group:
    """For each of ``seeds`` all views of a random file, split into objects of 1 to ``max_views`` views."""
    objects = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        views, first = augmented(cache[files[int(rng.integers(len(files)))]], rng), 0
        while first < len(views.masks):
            count = int(rng.integers(1, max_views + 1))
            objects.append(views.of_views(slice(first, first + count)))
            first += count
    return Group.of(objects)
