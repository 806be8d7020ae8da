"""Training examples of the small network: views, points and maps from :mod:`reli3d.synthetic.samples`, augmented."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor
from torch.nn import functional

from reli3d._bridge import mapped
from reli3d.geometry.camera import Camera
from reli3d.geometry.hull import mask_distance
from reli3d.geometry.symmetry import MirrorPlane
from reli3d.nn.pyramid import depth_of_origin
from reli3d.render.latlong import lat_long_directions, quarter_turn
from reli3d.synthetic.procedural import yaw_matrix
from reli3d.train.mirror import mirrored_visibility, surface_mirror
from reli3d.train.relight import Finish, draw_flash, draw_light, relight_views
from reli3d.views.views import Views

OTHER_UP_PROBABILITY = 0.12  # of a world that is not +Y up: captures come in any frame
MAX_NOISE = 0.012  # largest standard deviation of the image noise, sRGB
RELIGHT_PROBABILITY = 0.6  # of samples that are rendered again under another environment
TONE_PROBABILITY, TONE_SIGMA = 0.5, 0.2  # of a random exponent of the sRGB colors; deviation of its logarithm
MIRROR_PROBABILITY = 0.55  # of mirror images of the views of a symmetric object, as at inference
MAX_MIRRORED = 4  # views with mirror images
PLACEMENT_PROBABILITY, SCALE_SIGMA, SHIFT_SIGMA = 0.35, 0.18, 0.04  # deviations of log scale and of position
UNCHANGED_PROBABILITY = 0.75  # of not mirroring, and of not permuting the color channels


def random_turn(rng: np.random.Generator) -> Tensor:
    """Random rotation ``(3, 3)``: a yaw about +Y, with OTHER_UP_PROBABILITY followed by a change of the up axis."""
    yaw = yaw_matrix(rng.uniform(0, 2 * np.pi))
    if rng.random() < OTHER_UP_PROBABILITY:
        x, y, z = np.eye(3, dtype=int)
        yaw = np.array(((x, -z, y), (y, -x, z), (x, -y, -z))[rng.integers(3)]) @ yaw
    return torch.as_tensor(yaw, dtype=torch.float32)


def finish_known(file: safe_open) -> Tensor:
    """``(V,)`` bool of an open sample; of one that does not store it, all true."""
    if "finish_known" in file.keys():  # noqa: SIM118 - no iterable
        return file.get_tensor("finish_known").bool()
    return torch.ones_like(file.get_tensor("c2w")[:, 0, 0], dtype=torch.bool)


def permuted(rng: np.random.Generator, *values: Tensor) -> list[Tensor]:
    """``values (..., C)`` with their first three channels, the colors, in one random order."""
    order = torch.as_tensor(rng.permutation(3), device=values[0].device)
    return [torch.cat([v[..., order], v[..., 3:]], -1) for v in values]


def with_noise(color: Tensor, rng: np.random.Generator) -> Tensor:
    """``color``, sRGB, with normal noise of a random deviation of at most MAX_NOISE."""
    source = torch.Generator(color.device).manual_seed(int(rng.integers(1 << 62)))
    noise = torch.randn(color.shape, generator=source, device=color.device)
    return (color + float(rng.random()) * MAX_NOISE * noise).clamp(0, 1)


def valid_means(values: Tensor, valid: Tensor, factor: int) -> Tensor:
    """Means ``(V, H/f, W/f, C)`` of ``values (V, H, W, C)`` over the valid pixels of squares of ``factor``."""
    fraction = functional.avg_pool2d(valid.float()[:, None], factor)
    means = functional.avg_pool2d((values * valid[..., None]).permute(0, 3, 1, 2), factor) / fraction.clamp(min=0.25)
    return means.permute(0, 2, 3, 1)


@dataclass(frozen=True)
class TrainingViews:
    """``V`` views of ``S`` by ``S`` pixels with ground-truth maps of ``P = S/2`` pixels; float32."""

    images: Tensor  # (V, S, S, 3) sRGB
    masks: Tensor  # (V, S, S)
    silhouette: Tensor  # (V, S, S) pixels
    c2w: Tensor  # (V, 4, 4)
    intrinsics: Tensor  # (V, 4)
    view_material: Tensor  # (V, P, P, 5) base color (sRGB), roughness, metallic
    view_normal: Tensor  # (V, P, P, 3) world, unit
    view_depth: Tensor  # (V, P, P) from the world's origin along the camera's axis
    view_valid: Tensor  # (V, P, P) bool: the surface covers the whole pixel
    finish_known: Tensor  # (V,) bool: roughness and metallic are ground truth, not placeholders

    def of_views(self, chosen: slice | Tensor) -> "TrainingViews":
        return mapped(self, lambda values: values[chosen])


@dataclass(frozen=True)
class Sample(TrainingViews):
    """One object: views, points of the volume and of the surface, and lighting, in a randomly rotated world."""

    points: Tensor  # (M, 3)
    distance: Tensor  # (M,)
    surface: Tensor  # (N, 3, 3) position, normal, bump-mapped normal
    material: Tensor  # (N, 5)
    visible: Tensor  # (N, V + M), in mirror images only what no view shows
    light_directions: Tensor  # (2048, 3)
    light: Tensor  # (2048, 3) linear radiance
    mirrored_c2w: Tensor  # (M, 4, 4), M = V cameras of the mirror images of a symmetric object, or 0
    mirrored_intrinsics: Tensor  # (M, 4)


def load_sample(
    path: Path,
    views: int,
    points: int,
    rng: np.random.Generator,
    *,
    augment: bool = True,
    lights: Tensor | None = None,
    device: torch.device | str = "cpu",
) -> Sample:
    """Reads up to ``views`` random views of a file, ``points`` volume points and half as many surface points.

    augment: False takes the first views unchanged.  lights: ``(n, H, 2H, 3)``, for relighting some of the samples.
    """
    with safe_open(path, "pt", device=str(device)) as file:
        stored = file.get_slice
        total = stored("c2w").get_shape()[0]
        chosen = (rng.permutation(total) if augment else np.arange(total))[:views].tolist()

        def of_views(key: str) -> Tensor:
            return torch.stack([stored(key)[k] for k in chosen])

        def run(low: int, high: int) -> slice:
            first = low + int(rng.integers(max(1, high - low - points // 2 + 1)))
            return slice(first, first + points // 2)

        n = stored("distance").get_shape()[0]
        runs = [run(0, n // 2), run(n // 2, n)]
        volume, distance = (torch.cat([stored(k)[r] for r in runs]).float() for k in ("points", "distance"))
        s = run(0, stored("material").get_shape()[0])
        surface, material = stored("surface")[s].float(), stored("material")[s].float() / 255
        visible, plane = stored("visible")[s][:, chosen].float(), None
        if augment and len(chosen) <= MAX_MIRRORED and rng.spawn(1)[0].random() < MIRROR_PROBABILITY:
            every = stored("surface")[:, 0].cpu().numpy().astype(np.float64)
            plane = surface_mirror(every)
        if plane is not None:
            seen = stored("visible")[:][:, chosen].cpu().numpy()
            shown = mirrored_visibility(every, seen, surface[:, 0].cpu().numpy().astype(np.float64), plane)
            unseen = 1.0 - visible.amax(1, keepdim=True)
            visible = torch.cat([visible, torch.as_tensor(shown).to(visible) * unseen], 1)
        images, c2w, intrinsics = of_views("images").float() / 255, of_views("c2w"), of_views("intrinsics")
        known = finish_known(file)[chosen]
        of_pixels = of_views("view_material").float() / 255
        normal, depth = of_views("view_normal").float() / 127, of_views("view_depth").float()
        light = quarter_turn(file.get_tensor("environment").float(), -1)  # stored with -Z at the horizontal center
    valid = depth > 0
    if augment and lights is not None and rng.random() < RELIGHT_PROBABILITY:
        finish = Finish.draw(rng)
        material, of_pixels, known = finish.apply(material), finish.apply(of_pixels), torch.ones_like(known)
        other, flash = draw_light(lights, rng), draw_flash(rng)
        camera = Camera(c2w, intrinsics, *images.shape[2:0:-1])
        images, light = relight_views(images, of_pixels, normal, valid, camera, other, rng, flash)
    turn = random_turn(rng) if augment else torch.eye(3)
    mirrored = augment and rng.random() > UNCHANGED_PROBABILITY
    flip = torch.tensor([-1.0 if mirrored else 1.0, 1.0, 1.0])
    turn = (turn * flip).to(device)  # a mirror at the plane x = 0, then the turn
    if mirrored:
        images, of_pixels, normal, depth, valid = (t.flip(2) for t in (images, of_pixels, normal, depth, valid))
        intrinsics = intrinsics.clone()
        intrinsics[:, 2] = images.shape[2] - intrinsics[:, 2]
    scale, shift = 1.0, np.zeros(3)
    if augment and rng.random() <= PLACEMENT_PROBABILITY:  # the visual hull is larger
        scale, shift = float(np.exp(-abs(rng.normal(0, SCALE_SIGMA)))), rng.normal(0, SHIFT_SIGMA, 3)
    moved = torch.as_tensor(shift, dtype=torch.float32, device=device)
    volume, distance, depth = scale * volume + moved, scale * distance, scale * depth
    surface[:, 0] = scale * surface[:, 0] + moved
    c2w = c2w.clone()
    c2w[:, :3, 3] = scale * c2w[:, :3, 3] + moved
    c2w[:, :3] = turn @ c2w[:, :3]
    if mirrored:
        c2w[:, :, 0] *= -1  # the camera stays right-handed, its image is flipped
    if augment and rng.random() > UNCHANGED_PROBABILITY:
        images, light, material, of_pixels = permuted(rng, images, light, material, of_pixels)
    color, masks = images[..., :3], images[..., 3]
    if augment:
        tone = float(np.exp(TONE_SIGMA * rng.normal())) if rng.random() < TONE_PROBABILITY else 1.0
        color = with_noise(color**tone, rng)
    mirrors = Camera(c2w[:0], intrinsics[:0], *masks.shape[:0:-1])
    if plane is not None:
        plane = plane[0], scale * plane[1] + float(np.dot(plane[0], shift))
        axis = turn @ torch.as_tensor(plane[0], dtype=torch.float32, device=device)
        mirrors = MirrorPlane(axis, plane[1]).mirrored(Camera(c2w, intrinsics, *masks.shape[:0:-1]))
    origin = depth_of_origin(c2w)[:, None, None]
    return Sample(
        images=color.contiguous(),
        masks=masks.contiguous(),
        silhouette=mask_distance(masks.contiguous()),
        c2w=c2w,
        intrinsics=intrinsics,
        view_material=valid_means(of_pixels, valid, 2),
        view_normal=functional.normalize(valid_means(normal, valid, 2) @ turn.T, dim=-1),
        view_depth=valid_means(depth[..., None], valid, 2)[..., 0] - origin,
        view_valid=functional.avg_pool2d(valid.float()[:, None], 2)[:, 0] > 0.99,
        finish_known=known,
        points=volume @ turn.T,
        distance=distance,
        surface=surface @ turn.T,
        material=material,
        visible=visible,
        light_directions=lat_long_directions(light.shape[0], device=device).reshape(-1, 3) @ turn.T,
        light=light.reshape(-1, 3),
        mirrored_c2w=mirrors.c2w,
        mirrored_intrinsics=mirrors.intrinsics,
    )


def draw_samples(
    files: Sequence[Path], seeds: Iterable[tuple[int, ...]], *, points: int, max_views: int, **options: Any
) -> list[Sample]:
    """For each of ``seeds`` a random object of ``files`` with 1 to ``max_views`` views.  options: of load_sample."""
    drawn = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        file, views = files[int(rng.integers(len(files)))], int(rng.integers(1, max_views + 1))
        drawn.append(load_sample(file, views, points, rng, **options))
    return drawn


def stored_views(sample: dict[str, Tensor], count: int) -> Views:
    """The first ``count`` views of a stored sample, as input of the pipeline."""
    color, alpha = (sample["images"][:count].float() / 255).split([3, 1], -1)
    images, masks, names = color.contiguous(), alpha[..., 0].contiguous(), tuple(f"{i:04d}" for i in range(count))
    return Views(tuple(images), tuple(masks), sample["c2w"][:count], sample["intrinsics"][:count], names)
