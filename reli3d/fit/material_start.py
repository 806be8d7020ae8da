"""Roughness and metallic from which the maps are fitted: those of the start or of a glossy metal or dielectric."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace
from functools import partial

import torch

from reli3d.fit import losses
from reli3d.fit.budget import Budget, Part
from reli3d.fit.lighting import radiance
from reli3d.fit.maps import PIXELS_PER_STEP, SHADING_SAMPLES, FixedSurface, Pixels, fit_maps, maps_loss, traced
from reli3d.fit.unknowns import Unknowns
from reli3d.geometry.rays import RayScene

TRIAL_ROUGHNESS = 0.25
TRIAL_METALLIC = {"metal": 0.95, "dielectric": 0.05}
TRIAL = 0.08  # fraction of the budget for each of the three fits; 0.12 for MIN_STEPS
# Ratio to the start's error up to which the dielectric is preferred if it fits better than the metal: half metals fit
# images of dielectrics almost as well, by a base color and a lighting that are both wrong.  It is 0.95 to 1.04 for
# glossy dielectrics, 1.10 to 1.29 for others; for a painted metal 0.99 to 1.02, where the metal does not always
# fit better.
PREFERENCE = 1.05
# Ratio to the start's error below which the metal is taken.  It is 0.975 to 1.19 for objects of metal, whose starts are
# metallic, and 0.98 for an object of plastic and steel, which the metal's fit makes metallic everywhere.
METAL_GAIN = 0.97
MIN_STEPS = 30  # of each fit; after fewer, the start that needs fewer changes has the smaller error
MIN_BASE_COLOR = 0.02
CHECK_BATCHES = 4
IMAGE_ONLY = losses.Weights(**{name: float(name == "image") for name in vars(losses.Weights())})


def with_metallic(data: FixedSurface, metallic: float) -> FixedSurface:
    """``data`` with constant roughness and metallic; the diffuse albedo of a dielectric stays that of ``data``."""
    maps = data.asset.textures
    base_color = maps.base_color
    if metallic < 0.5:
        base_color = base_color * ((1.0 - maps.metallic) / (1.0 - metallic))[..., None]
    textures = replace(
        maps,
        base_color=base_color.clamp(MIN_BASE_COLOR, 1.0),
        roughness=torch.full_like(maps.roughness, TRIAL_ROUGHNESS),
        metallic=torch.full_like(maps.metallic, metallic),
    )
    return replace(data, asset=replace(data.asset, textures=textures))


@torch.no_grad()
def image_error(unknowns: Unknowns, data: FixedSurface, pixels: Pixels, scene: RayScene, seed: int) -> float:
    """:func:`~reli3d.fit.losses.display_error` of at most ``CHECK_BATCHES * PIXELS_PER_STEP`` of the pixels."""
    total, order = 0.0, pixels.order[: CHECK_BATCHES * PIXELS_PER_STEP]
    direct = partial(radiance, samples=SHADING_SAMPLES[1], scene=scene)
    for k, rows in enumerate(order.split(PIXELS_PER_STEP)):
        total += len(rows) * float(maps_loss(unknowns, data, pixels, rows, IMAGE_ONLY, direct=direct, seed=seed + k))
    return total / max(len(order), 1)


def best_material_start(
    unknowns: Unknowns, data: FixedSurface, held: list[int], weights: losses.Weights, budget: Budget, *, seed: int
) -> tuple[Unknowns, FixedSurface]:
    """Fits the maps briefly from the start, a glossy metal and a glossy dielectric; returns the best fit and its data.

    From a rough or half metallic start, descent can end in a local minimum, with too high roughness and a lighting
    without highlights.  The error is the sum of the means over fitted views and over ``held``, indices of the held-out
    views.  The dielectric's may be ``PREFERENCE`` times the start's if it is below the metal's; the metal's must be
    below ``METAL_GAIN`` times the start's.  After fewer than ``MIN_STEPS`` steps of a fit the next ones are left out.
    seed: of pixels and light samples.
    """
    if budget.steps is not None and TRIAL * budget.steps < MIN_STEPS:
        return unknowns, data
    plain = deepcopy(unknowns)
    for grid in plain.material:
        grid[..., 3:] = 0.0
    scene = RayScene(data.asset.mesh.vertices, data.asset.mesh.faces)
    pixels = [traced(replace(data, used=views), scene, seed) for views in (data.used, held) if views]
    fits, errors = {"start": (unknowns, data)}, dict.fromkeys(("start", *TRIAL_METALLIC), math.inf)
    for name in errors:
        if name in TRIAL_METALLIC:
            fits[name] = deepcopy(plain), with_metallic(data, TRIAL_METALLIC[name])
        part = Part(f"trial of {name}", budget.used() + TRIAL, MIN_STEPS)
        own = [some.with_maps(fits[name][1].asset) for some in pixels]
        fit_maps(*fits[name], weights, budget, part, seed=seed, pixels=own[0])
        if budget.counts[part.name] < MIN_STEPS:
            break
        errors[name] = sum(image_error(*fits[name], of_views, scene, seed) for of_views in own)
    if errors["dielectric"] < errors["metal"]:
        errors["dielectric"] /= PREFERENCE
    errors["metal"] /= METAL_GAIN
    return fits[min(errors, key=lambda name: errors[name])]
