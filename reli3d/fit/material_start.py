"""Roughness and metallic from which the maps are fitted: those of the start, or constants if they fit as well."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import torch

from reli3d.fit import losses
from reli3d.fit.budget import Budget
from reli3d.fit.maps import PIXELS_PER_STEP, SHADING_SAMPLES, FixedSurface, fit_maps, maps_loss, traced
from reli3d.fit.unknowns import Unknowns
from reli3d.geometry.rays import RayScene

ROUGHNESS, METALLIC = 0.25, 0.05  # a glossy nonmetal
TRIAL = 0.1  # fraction of the budget for each of the two fits
# Ratio of errors up to which the nonmetal is preferred: metals fit images of nonmetals almost as well, by a base color
# and a lighting that are both wrong.  On six meshes and 14 views the ratio is 0.98 to 1.03 for nonmetals, 1.11 and 1.17
# for a rough crate and a metal.
PREFERENCE = 1.05
MIN_STEPS = 40  # of each fit; after fewer, the start that needs fewer changes has the smaller error
MIN_BASE_COLOR = 0.02
CHECK_BATCHES = 4
IMAGE_ONLY = losses.Weights(**{name: float(name == "image") for name in vars(losses.Weights())})


def nonmetal(data: FixedSurface) -> FixedSurface:
    """``data`` with constant roughness and metallic; the diffuse albedo stays."""
    maps = data.asset.textures
    base_color = maps.base_color * ((1.0 - maps.metallic) / (1.0 - METALLIC))[..., None]
    textures = replace(
        maps,
        base_color=base_color.clamp(MIN_BASE_COLOR, 1.0),
        roughness=torch.full_like(maps.roughness, ROUGHNESS),
        metallic=torch.full_like(maps.metallic, METALLIC),
    )
    return replace(data, asset=replace(data.asset, textures=textures))


@torch.no_grad()
def image_error(unknowns: Unknowns, data: FixedSurface, views: list[int], seed: int) -> float:
    """:func:`~reli3d.fit.losses.display_error` of at most ``CHECK_BATCHES * PIXELS_PER_STEP`` pixels of ``views``."""
    scene = RayScene(data.asset.mesh.vertices, data.asset.mesh.faces)
    pixels = traced(replace(data, used=views), scene, seed)
    total, order = 0.0, pixels.order[: CHECK_BATCHES * PIXELS_PER_STEP]
    for k, rows in enumerate(order.split(PIXELS_PER_STEP)):
        part = unknowns, data, pixels, rows, IMAGE_ONLY
        total += len(rows) * float(maps_loss(*part, scene=scene, samples=SHADING_SAMPLES[1], seed=seed + k))
    return total / max(len(order), 1)


def best_material_start(
    unknowns: Unknowns, data: FixedSurface, held: list[int], weights: losses.Weights, budget: Budget, *, seed: int
) -> tuple[Unknowns, FixedSurface]:
    """Fits the maps briefly from the start and from :func:`nonmetal`; returns the better fit and its data.

    From a rough or half metallic start, descent can end in a local minimum, with too high roughness and a lighting
    without highlights.  The error is the sum of the means over fitted views and over ``held``, indices of the held-out
    views; the nonmetal's may be ``PREFERENCE`` times the other.  After fewer than ``MIN_STEPS`` steps it is the start's
    fit.  seed: of pixels and light samples.
    """
    began, error = budget.used(), 0.0
    other = deepcopy(unknowns)
    for grid in other.material:
        grid[..., 3:] = 0.0
    fits = {"trial of start": (unknowns, data), "trial of nonmetal": (other, nonmetal(data))}
    best = unknowns, data
    for k, (name, fit) in enumerate(fits.items()):
        fit_maps(*fit, weights, budget, name, began + (k + 1) * TRIAL, seed=seed)
        if budget.counts[name] < MIN_STEPS:
            break
        found = sum(image_error(*fit, views, seed) for views in (data.used, held))
        if k == 0 or found <= PREFERENCE * error:
            best, error = fit, found
    return best
