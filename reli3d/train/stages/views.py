"""Training objects: posed views, with the ground truth that their source has; missing ground truth is None."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from reli3d._bridge import Movable, mapped, present
from reli3d.errors import InputError

Chooser = Callable[[int], Sequence[int]]  # maps the number of available views to the indices to load


@dataclass(frozen=True)
class ObjectViews(Movable):
    """``V`` views of ``S`` by ``S`` pixels in the model's frame, float32."""

    images: Tensor  # (V, S, S, 3) sRGB, straight alpha
    masks: Tensor  # (V, S, S) coverage
    c2w: Tensor  # (V, 4, 4)
    intrinsics: Tensor  # (V, 4) pixels
    background: bool  # whether the images have content outside the masks
    valid: Tensor | None = None  # (V, S, S) 1 where the pixel is inside the input image; None: everywhere
    material: Tensor | None = None  # (V, S, S, 5) base color (sRGB), roughness, metallic
    normal: Tensor | None = None  # (V, S, S, 3) world, unit
    shown: Tensor | None = None  # (V, S, S) 1 where material and normal are known
    latent: Tensor | None = None  # (L, 3) RENI++ latents of the environment
    strength: Tensor | None = None  # () logarithm of the environment's factor

    def __len__(self) -> int:
        return len(self.images)

    def select(self, views: Sequence[int]) -> "ObjectViews":
        chosen = torch.as_tensor(list(views))
        of_views = mapped(replace(self, latent=None, strength=None), lambda values: values[chosen])
        return replace(of_views, latent=self.latent, strength=self.strength)

    def resized(self, size: int) -> "ObjectViews":
        """The views at ``size`` pixels per side, antialiased; maps are averaged over the pixels that have values."""
        if size == self.images.shape[1]:
            return self

        def planes(x: Tensor) -> Tensor:
            x = interpolate(x.movedim(-1, 1), (size, size), mode="bilinear", align_corners=False, antialias=True)
            return x.movedim(1, -1)

        changed: dict[str, Any] = {
            "images": planes(self.images).clamp(0, 1).contiguous(),
            "masks": planes(self.masks[..., None])[..., 0].clamp(0, 1).contiguous(),
            "intrinsics": self.intrinsics * (size / self.images.shape[1]),
        }
        if self.valid is not None:
            changed["valid"] = (planes(self.valid[..., None])[..., 0] > 0.99).float()
        if self.shown is not None:
            known = self.shown[..., None]
            fraction = planes(known)
            if self.material is not None:
                changed["material"] = planes(self.material * known) / fraction.clamp(min=1e-3)
            if self.normal is not None:
                changed["normal"] = normalize(planes(self.normal * known) / fraction.clamp(min=1e-3), dim=-1)
            changed["shown"] = (fraction[..., 0] > 0.99).float()
        return replace(self, **changed)

    def window(self, x: int, y: int, side: int) -> "ObjectViews":
        """Crops of all views: a square of ``side`` pixels with its upper left corner at pixel ``(x, y)``."""
        maps = {name: getattr(self, name) for name in ("images", "masks", "valid", "material", "normal", "shown")}
        rows, columns = slice(y, y + side), slice(x, x + side)
        cut: dict[str, Any] = {k: v[:, rows, columns].contiguous() for k, v in maps.items() if v is not None}
        shift = self.intrinsics.new_tensor([0.0, 0.0, float(x), float(y)])
        return replace(self, intrinsics=self.intrinsics - shift, **cut)


class Source(Protocol):
    """Training objects by index."""

    def __len__(self) -> int: ...

    def load(self, index: int, choose: Chooser) -> ObjectViews: ...


def sample_views(read: Callable[[str], Any], choose: Chooser) -> ObjectViews:
    """Views of a sample of :mod:`reli3d.synthetic.samples` or of a capture in a shard.

    read: maps the name of a tensor to the tensor or a safetensors slice of it, indexed by view; None if missing.
    """
    poses = read("c2w")
    total = len(poses) if isinstance(poses, Tensor) else poses.get_shape()[0]
    chosen = list(choose(total))

    def of_views(name: str) -> Tensor | None:
        values = read(name)
        return None if values is None else torch.stack([values[k] for k in chosen]).float()

    images = present("images", of_views("images")) / 255
    c2w, intrinsics = present("c2w", of_views("c2w")), present("intrinsics", of_views("intrinsics"))
    valid, depth = of_views("view_valid"), of_views("view_depth")
    material, normal, known = of_views("view_material"), of_views("view_normal"), of_views("finish_known")
    if known is not None and not known.all():  # missing ground truth stays None
        material = None
    return ObjectViews(
        images[..., :3].contiguous(),
        images[..., 3].contiguous(),
        c2w,
        intrinsics,
        background=True,
        valid=valid,
        material=None if material is None else material / 255,
        normal=None if normal is None else normalize(normal, dim=-1),
        shown=None if depth is None else (depth > 0).float(),
    )


class Samples:
    """A folder of ``*.safetensors`` from ``reli3d-data``; ``latents``: of :func:`.latents.fitted`, by file stem."""

    def __init__(self, folder: Path, latents: dict[str, tuple[Tensor, Tensor]] | None = None):
        self.files, self.latents = sorted(folder.glob("*.safetensors")), latents or {}
        if not self.files:
            raise InputError(folder, "expected *.safetensors files, got none")

    def __len__(self) -> int:
        return len(self.files)

    def load(self, index: int, choose: Chooser) -> ObjectViews:
        with safe_open(self.files[index], "pt") as file:
            names = set(file.keys())
            views = sample_views(lambda name: file.get_slice(name) if name in names else None, choose)
        latent, strength = self.latents.get(self.files[index].stem, (None, None))
        return replace(views, latent=latent, strength=strength)


@dataclass(frozen=True)
class Draw(Movable):
    """One object of a training step: input views, the reference view first, and target views."""

    inputs: ObjectViews
    targets: ObjectViews
    background_visible: bool
    seed: int  # of the rendering


def draw(
    sources: Sequence[Source],
    seed: tuple[int, ...],
    *,
    inputs: int,
    targets: int,
    background: float,
    input_size: int,
    target_size: int,
    patch: int,
) -> Draw:
    """A random object with 1 to ``inputs`` random input views and ``targets`` others; a function of seed and sources.

    Objects with few views have fewer inputs; a single view is both input and target.  background: probability that it
    is visible.  input_size, target_size: pixels per side.  patch: side of a random crop of the targets; 0: no crop.
    """
    rng, k = np.random.default_rng(seed), 0
    ends = np.cumsum([len(s) for s in sources])
    index = int(rng.integers(ends[-1]))
    read = int(rng.integers(1, inputs + 1))

    def choose(total: int) -> list[int]:
        nonlocal k
        k = max(1, min(read, total - 1))
        return rng.permutation(total)[: k + targets].tolist()

    which = int(np.searchsorted(ends, index, side="right"))
    views = sources[which].load(index - int(ends[which]) + len(sources[which]), choose)
    compared = views.select(range(k, len(views)) if len(views) > k else [0]).resized(target_size)
    if patch:
        x, y = rng.integers(target_size - patch + 1, size=2)
        compared = compared.window(int(x), int(y), patch)
    shown = bool(rng.random() < background) and views.background
    return Draw(views.select(range(k)).resized(input_size), compared, shown, int(rng.integers(1 << 30)))
