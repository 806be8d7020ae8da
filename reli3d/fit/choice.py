"""Which parts of a fit are taken: surface, paint and light, by pictures of views whose colours it did not use."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from reli3d.fit.bounce import thrown_back
from reli3d.fit.photographs import Photographs
from reli3d.fit.shading import radiance
from reli3d.fit.transfer import changed
from reli3d.fit.unknowns import Start, Unknowns, environment
from reli3d.geometry.hits import interpolate
from reli3d.geometry.rays import RayScene
from reli3d.render.asset import Asset
from reli3d.render.color import linear_to_srgb
from reli3d.render.environment import Environment
from reli3d.render.gbuffer import primary_hits, surface_points

CHECK_PIXELS = 96  # of a photograph, a side, by which candidates are compared
CHECK_SAMPLES = (16, 16, 4)
STRENGTHS = tuple(math.exp(0.05 * k) for k in range(-12, 13))
SLACK = 0.02  # dB: the noise of a comparison
# dB that the surface alone may lose in the mean of the views used, of those held out, and of all: the masks of all
# views have bounded it, while the start's paint and light hold shading of the start's surface
ALONE = (0.1, 0.3, 0.05)


@dataclass(frozen=True)
class Parts:
    """Shares of a fit in what is returned, 0 the start and 1 the fit: surface (0 or 1), paint (of the changes of the
    materials' logits and of the bend of the normals), light (of the changes of log radiance)."""

    surface: float
    paint: float
    light: float

    def __str__(self) -> str:
        words = {0.0: "of the start", 0.5: "half fitted", 1.0: "fitted"}
        return ", ".join(f"{name} {words[value]}" for name, value in vars(self).items())


NOTHING = Parts(0.0, 0.0, 0.0)
# Shares of paint and light.  Relighting shows surface and paint, not the light, so half of the light goes first.  Paint
# fitted beside a light of which no half is right is not trusted; the surface is, as the masks hold it.
ORDER = ((1.0, 1.0), (1.0, 0.5), (0.5, 1.0), (0.5, 0.5), (0.0, 1.0), (0.0, 0.5), (0.0, 0.0))
FEW = 4  # views used: of fewer, at most half of the paint is taken, and, where a view is held out, half of the light


@dataclass(frozen=True)
class Fitted:
    """A start and what a fit made of it.

    first: the start.  surface: the new surface with the maps and light of the start; ``first`` where it did not move.
    received: ``(V, 3)``, of :func:`~reli3d.fit.bounce.gathered` at the vertices of ``surface``.
    photographs: with their cameras as corrected.
    """

    first: Asset
    surface: Asset
    received: Tensor
    start: Start
    unknowns: Unknowns
    photographs: Photographs

    @torch.no_grad()
    def mixed(self, paint: float, light: float) -> Asset:
        """The new surface with these shares of the other changes."""
        asset, unknowns = self.surface, self.unknowns
        if paint:
            material, bend = ([paint * grid for grid in grids] for grids in (unknowns.material, unknowns.bend))
            asset = changed(asset, replace(unknowns, material=material, bend=bend, detail=paint * unknowns.detail))
        if light:
            maps = [light * values for values in unknowns.light]
            asset = replace(asset, environment=environment(replace(unknowns, light=maps), self.start))
        return asset


class Pictures:
    """Small photographs, and what their rays hit of one surface, traced once.

    received: ``(V, 3)``, of :func:`~reli3d.fit.bounce.gathered` at the vertices.  Of each of V views: ``wanted (V, S,
    S, 3)`` display values on white; ``rays``: which pixels hit ``(S, S)``, their faces ``(N,)``, barycentrics ``(N,
    2)`` and unit directions to the eye ``(N, 3)``; ``inside (N,)``: well in masks.
    """

    @torch.no_grad()
    def __init__(self, asset: Asset, received: Tensor, photographs: Photographs):
        small = photographs.resized(min(CHECK_PIXELS, photographs.size))
        self.mesh, self.scene = asset.mesh, RayScene(asset.mesh.vertices, asset.mesh.faces)
        shown = linear_to_srgb(small.color.clamp(0.0, 1.0))
        self.wanted = torch.lerp(torch.ones_like(shown), shown, small.mask[..., None])
        self.rays, self.inside, inside = [], [], small.inside()
        self.received = received
        for view in range(len(small)):
            hits, _, directions = primary_hits(self.scene, small.camera[view])
            seen = hits.face >= 0
            self.rays.append((seen, hits.face[seen], hits.bary[seen], -directions[seen]))
            self.inside.append(inside[view][seen])

    @torch.no_grad()
    def lit(self, asset: Asset) -> list[tuple[Tensor, Tensor]]:
        """Linear radiance of each view's rays, by the light of ``asset``, which has this surface, and by what it throws
        on itself, ``(N, 3)`` each.  The random numbers depend on the view alone.
        """
        lit = []
        for view, (_, face, bary, wo) in enumerate(self.rays):
            at = surface_points(self.mesh, asset.textures, face, bary)
            bounced = thrown_back(at, interpolate(self.received, self.mesh.faces, face, bary))
            lit.append((radiance(at, wo, asset.light, samples=CHECK_SAMPLES, scene=self.scene, seed=view), bounced))
        return lit

    @torch.no_grad()
    def errors(self, lit: list[tuple[Tensor, Tensor]], strength: float = 1.0) -> Tensor:
        """Mean squared display error ``(V,)`` of whole pictures on white; light times ``strength``."""
        errors = []
        for (direct, bounced), (seen, *_), wanted in zip(lit, self.rays, self.wanted, strict=True):
            image = torch.ones_like(wanted)
            image[seen] = linear_to_srgb((strength * direct + bounced).clamp(0.0, 1.0))
            errors.append((image - wanted).square().mean())
        return torch.stack(errors)

    @torch.no_grad()
    def strength(self, lit: list[tuple[Tensor, Tensor]], views: list[int]) -> float:
        """The one of ``STRENGTHS`` that ``views`` show, by pixels well inside the masks: white shines in at the rim."""
        got, bounced = (torch.cat([lit[view][k][self.inside[view]] for view in views]) for k in range(2))
        want = torch.cat([self.wanted[view][self.rays[view][0]][self.inside[view]] for view in views])
        if not len(got):
            return 1.0

        def error(strength: float) -> float:
            return float((linear_to_srgb((strength * got + bounced).clamp(0.0, 1.0)) - want).square().mean())

        return min(STRENGTHS, key=error)


def picture_error(asset: Asset, received: Tensor, photographs: Photographs) -> Tensor:
    """Mean squared display error ``(V,)`` of whole pictures on white, at pixel centres, under the asset's own light and
    what it throws on itself: ``received``, of :func:`~reli3d.fit.bounce.gathered` at its vertices."""
    pictures = Pictures(asset, received, photographs)
    return pictures.errors(pictures.lit(asset))


def decibels(errors: Tensor) -> float:
    """Mean PSNR over views, NaN of none."""
    return float((-10.0 * errors.clamp(min=1e-9).log10()).mean()) if len(errors) else math.nan


@torch.no_grad()
def chosen(fitted: Fitted, used: list[int], held: list[int], before: Tensor) -> tuple[Asset, Parts, Tensor]:
    """The first of ``ORDER``, of few views with less (``FEW``), that is no worse than the start on the views ``used``
    and on those ``held`` out, else the start.  The surface alone may be worse by ``ALONE`` on these and on
    all together.  Returns its parts as well, and the errors ``(V,)`` of its pictures.

    used, held: indices of photographs.  before: errors ``(V,)`` of the start.  The strength of each candidate's light
    is the one that the used views show best: the fit's error is that of the display's tangent, which rises faster than
    the display, so the fit ends too dark; and a mean of logarithms is darker than either of its lights.
    """
    pictures = Pictures(fitted.surface, fitted.received, fitted.photographs)
    moved = float(fitted.surface is not fitted.first)
    few = len(used) < FEW
    for paint, light in ORDER:
        if few and (paint > 0.5 or (held and light > 0.5)):
            continue
        asset = fitted.mixed(paint, light)
        lit = pictures.lit(asset)
        strength = pictures.strength(lit, used) if light else 1.0
        errors = pictures.errors(lit, strength)
        slack = (SLACK, SLACK, SLACK) if paint or light else ALONE
        asked = zip((used, held, [*used, *held]), slack, strict=True)
        if all(decibels(errors[which]) >= decibels(before[which]) - most for which, most in asked if which):
            asset = replace(asset, environment=Environment(strength * asset.light.radiance))
            return asset, Parts(moved, paint, light), errors
    return fitted.first, NOTHING, before
