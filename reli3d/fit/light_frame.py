"""Tests whether the lighting of posed images moves with the camera."""

from __future__ import annotations

import torch
from torch import Tensor

from reli3d._bridge import present
from reli3d.fit.input_images import InputImages
from reli3d.fit.losses import MIN_LINEAR
from reli3d.fit.unknowns import unit
from reli3d.fit.view_colors import MIN_COVERAGE, display_planes, view_colors, view_weights
from reli3d.geometry.mesh import Mesh
from reli3d.geometry.rays import RayScene
from reli3d.render.color import srgb_to_linear
from reli3d.render.sampling import reflect
from reli3d.render.transfer import spherical_harmonics

COMPARED_POINTS, COMPARED_VIEWS = 4096, 64  # at most; memory is quadratic in the views
SATURATED_DISPLAY = 0.98  # a brighter value may be clipped
HARMONICS = slice(1, 9)  # of degree 1 and 2; with degree 0 they hold 99 % of a light's irradiance
# Above both limits the lighting counts as moving with the camera.  Measured with 12 to 48 views: fixed lighting (13
# objects) up to 0.18 with ratio 0.4 to 1.4, and below 0.08 up to 3.8; moving lighting (3) 0.05 to 0.18, 1.8 to 4.1.
MIN_DEVIATION, MIN_RATIO = 0.08, 1.6


def light_follows_camera(mesh: Mesh, images: InputImages) -> bool:
    """Whether the brightness of surface points varies over the views as under lighting that moves with the camera."""
    camera, object_ = explained_deviations(mesh, images)
    return camera > max(MIN_DEVIATION, MIN_RATIO * object_)


@torch.no_grad()
def explained_deviations(mesh: Mesh, images: InputImages) -> tuple[float, float]:
    """Standard deviations of log brightness over a point's views, explained by camera-fixed and object-fixed lighting.

    Under lighting fixed to the camera, log radiance is fitted as a function of the normal in camera axes (diffuse
    points); under lighting fixed to the object, as one of the reflected direction in object axes (glossy points).  Each
    function is a sum of spherical harmonics of degree 1 and 2, fitted by weighted least squares (visibility, viewing
    angle) with a constant for each point and each view (albedo, exposure) and Schlick's Fresnel term, which brightens
    grazing angles under any lighting.  The explained deviation is the square root of the variance that the function
    removes.

    mesh: with normals.  No gradient.
    """
    if len(images) > COMPARED_VIEWS:
        images = images.select(list(range(0, len(images), -(-len(images) // COMPARED_VIEWS))))
    step = max(1, -(-len(mesh.vertices) // COMPARED_POINTS))
    position, normal = mesh.vertices[::step], present("mesh.normals", mesh.normals)[::step]
    color, cover = view_colors(display_planes(images), position, images.camera)
    weight = view_weights(RayScene(mesh.vertices, mesh.faces), position, normal, images.camera)
    weight = weight * (cover > MIN_COVERAGE) * (color.amax(-1) < SATURATED_DISPLAY)
    bright = srgb_to_linear(color.clamp(0.0, 1.0)).mean(-1).clamp(min=MIN_LINEAR).log()
    turned = torch.einsum("vij,ni->nvj", images.camera.c2w[:, :3, :3], normal)
    wo, n = unit(images.camera.c2w[None, :, :3, 3] - position[:, None]), normal[:, None]
    reflected = reflect(wo, n)
    views = torch.eye(len(images), device=normal.device, dtype=torch.float32).expand(len(normal), -1, -1)
    fresnel = (1.0 - (wo * n).sum(-1, keepdim=True).clamp(0.0, 1.0)) ** 5
    common = torch.cat([views, fresnel], -1)
    harmonics = [spherical_harmonics(d)[..., HARMONICS] for d in (turned, reflected)]
    constant = _residual(bright, [common], weight)
    camera, object_ = (max(0.0, constant - _residual(bright, [common, h], weight)) ** 0.5 for h in harmonics)
    return camera, object_


def _residual(value: Tensor, columns: list[Tensor], weight: Tensor) -> float:
    """Mean squared residual of ``value (N, V)`` fitted by ``columns (N, V, C)`` and a constant for each row."""
    rows = torch.cat([value[..., None], *columns], -1)
    mean = (weight[..., None] * rows).sum(1) / weight.sum(1).clamp(min=1e-6)[:, None]
    rows = (weight.sqrt()[..., None] * (rows - mean[:, None])).reshape(-1, rows.shape[-1]).double()
    y, x = rows[:, 0], rows[:, 1:]
    gram = x.T @ x
    gram.diagonal().add_(1e-9 * float(gram.diagonal().sum()) + 1e-12)  # the constants of all views are dependent
    error = (y - x @ torch.linalg.solve(gram, x.T @ y)).square().sum()
    return float(error / weight.double().sum().clamp(min=1e-6))
