"""Selects which parts of a fit are kept (surface, material, light) by the errors of input and held-out views."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from reli3d.fit.bounce import reflected
from reli3d.fit.input_images import InputImages
from reli3d.fit.lighting import Lights, radiance
from reli3d.fit.transfer import changed
from reli3d.fit.unknowns import Start, Unknowns
from reli3d.geometry.hits import interpolate
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import primary_hits, surface_points

CHECK_PIXELS = 96  # along a side of the images by which candidates are compared
CHECK_SAMPLES = (16, 16, 4)
LIGHT_SCALES = tuple(math.exp(0.05 * k) for k in range(-12, 13))
PSNR_TOLERANCE_DB = 0.02  # the noise of a comparison
# Tolerances of the mean PSNR over input views, held-out views and all views when only the surface is kept: the masks of
# all views have bounded the surface, while the start's material and lighting contain shading of the start's surface.
SURFACE_TOLERANCES_DB = (0.1, 0.3, 0.05)


@dataclass(frozen=True)
class Parts:
    """Blend weights between start (0), with the lighting of :mod:`reli3d.fit.light_hue`, and fit (1).

    surface: 0 or 1.  material: factor on the changes of material logits and on the bend of the normals.  light: factor
    on the changes of log radiance.
    """

    surface: float
    material: float
    light: float

    def __str__(self) -> str:
        words = {0.0: "start", 0.5: "half fitted", 1.0: "fitted"}
        return ", ".join(f"{name}: {words[value]}" for name, value in vars(self).items())


UNCHANGED = Parts(0.0, 0.0, 0.0)
# Weights of material and lighting in the order of trial.  Relighting shows surface and material but not the estimated
# lighting, so the lighting is reduced first.  Fitted material without any of the lighting fitted with it is not tried.
CANDIDATES = ((1.0, 1.0), (1.0, 0.5), (0.5, 1.0), (0.5, 0.5), (0.0, 1.0), (0.0, 0.5), (0.0, 0.0))
# With fewer input views the material's weight, and with a held-out view the light's, is <= 0.5.
MIN_VIEWS_FULL_WEIGHT = 4


@dataclass(frozen=True)
class Fitted:
    """A start and the result of a fit.

    first: the start.  surface: the fitted surface with the start's maps and lighting; ``first`` if the surface was not
    fitted.  received: ``(V, 3)``, from :func:`~reli3d.fit.bounce.gathered` at the vertices of ``surface``.  images:
    with corrected cameras.  material_start: ``surface`` with the maps that the changes of the material refer to; None:
    those of ``surface``.
    """

    first: Asset
    surface: Asset
    received: Tensor
    start: Start
    unknowns: Unknowns
    images: InputImages
    material_start: Asset | None = None

    @torch.no_grad()
    def blended(self, material: float, light: float) -> Asset:
        """The fitted surface with the changes of material and lighting scaled by these weights."""
        asset, unknowns = self.surface, self.unknowns
        if material:
            grids, bend = ([material * grid for grid in grids] for grids in (unknowns.material, unknowns.bend))
            change = replace(unknowns, material=grids, bend=bend, detail=material * unknowns.detail)
            asset = changed(self.material_start or asset, change)
        return replace(asset, environment=self.lights(light).of_view(0)) if light else asset

    def lights(self, weight: float) -> Lights:
        """Lights of all views with the changes scaled by ``weight``."""
        maps = [weight * values for values in self.unknowns.light]
        return Lights.of(replace(self.unknowns, light=maps), self.start, self.images)


class ViewRenderer:
    """Renders one surface in all views at low resolution and compares with the input images; rays are traced once.

    received: ``(vertices, 3)``, from :func:`~reli3d.fit.bounce.gathered`.  target: ``(V, S, S, 3)`` display values on
    white.  rays: for each view, hit mask ``(S, S)``, faces ``(N,)``, barycentrics ``(N, 2)`` and unit directions to the
    eye ``(N, 3)``.  inside: for each view ``(N,)``, whether the hit is at least one pixel inside the mask.
    """

    @torch.no_grad()
    def __init__(self, asset: Asset, received: Tensor, images: InputImages):
        small = images.resized(min(CHECK_PIXELS, images.size))
        self.scene, self.photographed = RayScene(asset.mesh.vertices, asset.mesh.faces), small.photographed()
        display = linear_to_srgb(small.color.clamp(0.0, 1.0))
        self.target = torch.lerp(torch.ones_like(display), display, small.mask[..., None])
        self.rays, self.inside, inside = [], [], small.inside()
        self.received = received
        for view in range(len(small)):
            hits, _, directions = primary_hits(self.scene, small.camera[view])
            hit = hits.face >= 0
            self.rays.append((hit, hits.face[hit], hits.bary[hit], -directions[hit]))
            self.inside.append(inside[view][hit])

    @torch.no_grad()
    def lit(self, asset: Asset, lights: Lights | None = None) -> list[tuple[Tensor, Tensor]]:
        """Per view, linear radiance ``(N, 3)`` from direct light and from one-bounce interreflection.

        asset: with the same surface.  lights: None: the environment of ``asset``.  Random numbers depend only on the
        view.
        """
        lit = []
        for view, (_, face, bary, wo) in enumerate(self.rays):
            at = surface_points(asset.mesh, asset.textures, face, bary)
            bounced = reflected(at, interpolate(self.received, asset.mesh.faces, face, bary))
            shaded = partial(radiance, samples=CHECK_SAMPLES, scene=self.scene, seed=view)
            views = torch.full_like(face, view, dtype=torch.long)
            direct = shaded(at, wo, asset.light) if lights is None else lights.evaluate(at, wo, views, shaded)
            lit.append((direct, bounced))
        return lit

    @torch.no_grad()
    def errors(self, lit: list[tuple[Tensor, Tensor]], light_scale: float = 1.0) -> Tensor:
        """Mean squared display error ``(V,)`` of photographed pixels on white, direct light times ``light_scale``."""
        errors, views = [], zip(lit, self.rays, self.target, self.photographed, strict=True)
        for (direct, bounced), (hit, *_), target, valid in views:
            image = torch.ones_like(target)
            image[hit] = linear_to_srgb((light_scale * direct + bounced).clamp(0.0, 1.0))
            errors.append((image - target)[valid].square().mean())
        return torch.stack(errors)

    @torch.no_grad()
    def light_scale(self, lit: list[tuple[Tensor, Tensor]], views: list[int]) -> float:
        """Value of ``LIGHT_SCALES`` with the least error in ``views``, over pixels inside the masks."""
        got, bounced = (torch.cat([lit[view][k][self.inside[view]] for view in views]) for k in range(2))
        target = torch.cat([self.target[view][self.rays[view][0]][self.inside[view]] for view in views])
        if not len(got):
            return 1.0

        def error(light_scale: float) -> float:
            return float((linear_to_srgb((light_scale * got + bounced).clamp(0.0, 1.0)) - target).square().mean())

        return min(LIGHT_SCALES, key=error)


def view_errors(asset: Asset, received: Tensor, images: InputImages) -> Tensor:
    """Mean squared display error ``(V,)`` of renderings on white, sampled at pixel centers.

    Lighting: the asset's environment and one-bounce interreflection.  received: from
    :func:`~reli3d.fit.bounce.gathered` at the asset's vertices.
    """
    renderer = ViewRenderer(asset, received, images)
    return renderer.errors(renderer.lit(asset))


def mean_psnr(errors: Tensor) -> float:
    """Mean PSNR over views; NaN without views."""
    return float((-10.0 * errors.clamp(min=1e-9).log10()).mean()) if len(errors) else math.nan


@torch.no_grad()
def chosen(fitted: Fitted, used: list[int], held: list[int], before: Tensor) -> tuple[Asset, Parts, Tensor]:
    """Selects the first of ``CANDIDATES`` that is no worse than the start; returns asset, weights, errors ``(V,)``.

    used, held: indices of views.  before: errors ``(V,)`` of the start.  A candidate is accepted if its mean PSNR is at
    most ``PSNR_TOLERANCE_DB`` (``SURFACE_TOLERANCES_DB`` if only the surface changes) below the start's on the ``used``
    views, on the ``held`` views and on all views; if none is, the start is returned.

    Each candidate's light scale is fitted to the used views, because the fit underestimates the lighting: the tangent
    of the display curve in the loss rises faster than the curve, and a blend of log radiance is darker than one of
    radiance.
    """
    renderer = ViewRenderer(fitted.surface, fitted.received, fitted.images)
    moved = float(fitted.surface is not fitted.first)
    few = len(used) < MIN_VIEWS_FULL_WEIGHT
    for material, light in CANDIDATES:
        if few and (material > 0.5 or (held and light > 0.5)):
            continue
        asset = fitted.blended(material, light)
        lit = renderer.lit(asset, fitted.lights(light) if light else None)
        light_scale = renderer.light_scale(lit, used) if light else 1.0
        errors = renderer.errors(lit, light_scale)
        tolerances = (PSNR_TOLERANCE_DB,) * 3 if material or light else SURFACE_TOLERANCES_DB
        checks = zip((used, held, [*used, *held]), tolerances, strict=True)
        if all(mean_psnr(errors[v]) >= mean_psnr(before[v]) - tolerance for v, tolerance in checks if v):
            asset = replace(asset, environment=Environment(light_scale * asset.light.radiance))
            return asset, Parts(moved, material, light), errors
    return fitted.first, UNCHANGED, before
